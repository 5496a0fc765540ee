"""The check that a step treats a row alone as among others, and reproducibly.

A trace sees one row once. A mean over the batch, a branch on its size, random numbers, counters and clocks
look like constants there. So the step of a user is called in plain torch with one row, again, and beside the
row that differs most from it: numbers that change give it away. What only rounding decides is told apart by
moving the inputs by a few units in the last place. No code is read: what a function may do cannot be.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..calls.choice import RepaysError
from ..calls.inputs import Given
from ..row_numbers import over_rows, some_rows
from ..tree import Shared, Tree, flatten, mapped, plain
from .loops import few_passes

_BITS = (1, -1, 3, -5, 17)  # units in the last place by which inputs are moved
_NEARBY = (0.1, 1e-3)  # of an input and of 1: points beside those that are given
_CLOSE = 1e-2  # of the largest entry: far above what another order of sums does to an ill-conditioned row
_ZERO = 1e-4  # of the largest number, or of 1: above what is left where large products cancel

Step = Callable[..., Any]


def doubt(step: Step, given: Given, *, again: bool = True) -> str | None:
    """Return why a step must not be written down with a single row, None where it may.

    It is called with one row, ``again`` unless it has been, and with that row beside the one that differs
    most from it. What draws random numbers, counts its calls, reads a clock or takes a mean over the batch
    gives itself away.
    """
    first, other = 0, _farthest(given)
    with undrawn(), torch.no_grad():
        alone = _called(step, given, [first])
        if again:  # the same operations in the same order
            repeated = _called(step, given, [first])
            if len(alone) != len(repeated) or not all(map(_are_close, alone, repeated)):
                return "gives other numbers when it is called again (random numbers, a counter, a clock?)"
        if given.rows == 1:
            return None
        try:
            both = _called(step, given, [first, other])
        except RepaysError:  # the loop around it takes longer than a compiler
            raise
        except Exception as error:  # which plain torch will raise again, for all rows
            return f"takes one row but not two: {type(error).__name__}: {error}"
        for at, row in enumerate((first, other)):
            found = alone if row == first else _called(step, given, [row])
            beside = [leaf[at : at + 1] for leaf in both]
            if len(found) != len(beside):
                return _MIXED
            differ = _differing(step, given, row, found, beside)
            if differ and not _cancelled(step, given, [first, other], at, differ, found, beside):
                return _MIXED
    return None


_MIXED = "gives a row other numbers beside another row (a mean over the batch, a branch on its size?)"


def _differing(
    step: Step, given: Given, row: int, alone: Sequence[Tensor], beside: Sequence[Tensor]
) -> list[int]:
    """Return which leaves of a row alone are not those beside another, as far as rounding lets them mean
    anything.

    One row and two are not summed in the same order. What then changes by more than a hundredth, a matrix
    that is singular to rounding, changes with the last bits of the inputs, too, and says nothing.
    """
    differ = [k for k, pair in enumerate(zip(alone, beside, strict=True)) if not _are_close(*pair, _CLOSE)]
    for bits in _BITS:
        if differ:
            moved = _called(step, given, [row], bits)
            differ = [k for k in differ if _are_close(alone[k], moved[k], _CLOSE)]
    return differ


def _cancelled(
    step: Step,
    given: Given,
    rows: Sequence[int],
    at: int,
    differ: Sequence[int],
    alone: Sequence[Tensor],
    beside: Sequence[Tensor],
) -> bool:
    """Return whether leaves of a row differ as they are zero but for rounding, which no last bit of a zero
    moves: a variance at a point that is known.

    They differ by little, and not at all at points nearby. What looks at other rows does so there, too.
    """
    for k in differ:
        if alone[k].shape != beside[k].shape or not alone[k].is_floating_point():
            return False
        size = max(1.0, float(alone[k].abs().nan_to_num(0.0).max()))
        if float((alone[k] - beside[k]).abs().nan_to_num(0.0).max()) > _ZERO * size:
            return False
    rest = [*differ]
    for share in _NEARBY:
        try:
            one = _called(step, given, [rows[at]], share=share)
            both = [leaf[at : at + 1] for leaf in _called(step, given, rows, share=share)]
        except RepaysError:  # the loop around it takes longer than a compiler
            raise
        except Exception:  # the step takes no such inputs
            continue
        if len(one) == len(both) == len(alone):
            near = [k for k in rest if one[k].isfinite().any() and _are_close(one[k], both[k], _CLOSE)]
            rest = [k for k in rest if k not in near]
    return not rest


@contextmanager
def undrawn() -> Iterator[None]:
    """Put the states of all common random numbers back at the end: to compile draws none."""
    put_back = generators()
    try:
        yield
    finally:
        put_back()


def generators() -> Callable[[], None]:
    """Return the function that puts the states of all common random numbers back to what they are now."""
    common = np.random.get_state()  # noqa: NPY002 - a user's code draws from it
    states = torch.get_rng_state(), common, random.getstate()
    cards = torch.cuda.get_rng_state_all() if torch.cuda.is_initialized() else []

    def put_back() -> None:
        torch.set_rng_state(states[0])
        if cards:
            torch.cuda.set_rng_state_all(cards)
        np.random.set_state(states[1])  # noqa: NPY002
        random.setstate(states[2])

    return put_back


def _farthest(given: Given) -> int:
    """The row whose inputs differ most from those of the first."""
    distance = torch.zeros(given.rows, dtype=torch.float64, device="cpu")
    for leaf in (*given.carry, *given.now, *given.row):
        if isinstance(leaf, Tensor) and leaf.numel():
            at = leaf[:, 0] if any(leaf is other for other in given.now) else leaf
            numbers = at.detach().cpu().double().reshape(given.rows, -1).nan_to_num(0.0, 0.0, 0.0)
            distance += (numbers - numbers[:1]).abs().sum(-1)
    return int(distance.argmax()) if given.rows > 1 else 0


def _called(step: Step, given: Given, rows: Sequence[int], bits: int = 0, share: float = 0.0) -> list[Tensor]:
    """All leaves of what a step makes of some rows at the first time; the inputs are copies.

    ``bits`` are units in the last place by which all numbers are moved, ``share`` is of their size and of 1.
    """

    def few(leaf: Any, time: bool) -> Any:
        if isinstance(leaf, Shared):
            shared = leaf.tensor[0] if time else plain(leaf)
            return Shared(moved(shared, shared.shape).clone())
        some = (leaf[:, 0] if time else leaf)[rows]
        return moved(some, some.shape[1:])

    def moved(leaf: Tensor, shape: torch.Size) -> Tensor:
        if not leaf.is_floating_point():
            return leaf
        if share:  # all rows by as much
            way = torch.arange(1, shape.numel() + 1, device=leaf.device).cos().view(shape).to(leaf)
            return leaf + share * (1 + leaf.abs()) * way
        return leaf * (1 + bits * torch.finfo(leaf.dtype).eps) if bits else leaf

    carry, now, row = (
        given.tree(name, [few(leaf, name == "now") for leaf in getattr(given, name)])
        for name in ("carry", "now", "row")
    )

    def plainly(*given: Tree) -> Tree:
        return step(*mapped(plain, given))

    with few_passes(), some_rows(torch.tensor(rows, dtype=torch.int64, device="cpu")):
        return flatten(over_rows(plainly, carry, now, row))[0]


def _are_close(found: Tensor, other: Tensor, tolerance: float = 0.0) -> bool:
    if found.shape != other.shape:
        return False
    one, two = found.double(), other.double()
    finite = torch.isfinite(one)
    if not torch.equal(finite, torch.isfinite(two)):
        return False
    one, two = one[finite], two[finite]
    return not one.numel() or bool(
        (one - two).abs().max() <= tolerance * max(one.abs().max(), two.abs().max())
    )

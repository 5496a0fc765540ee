"""The check that a step treats a row alone as among others, and reproducibly.

A trace sees one row once. A mean over the batch, a branch on its size, random numbers, counters and clocks
look like constants there. So the step of a user is called in plain torch with one row, again, and beside the
row that differs most from it: numbers that change give it away. What only rounding decides is told apart by
moving the inputs by a few units in the last place. No code is read: what a function may do cannot be.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

from ..calls.choice import RepaysError
from ..calls.inputs import Given
from ..row_numbers import over_rows, some_rows
from ..tree import Shared, Tree, flatten, mapped, plain
from .loops import few_passes

_BITS = (1, -1, 3, -5, 17)  # units in the last place by which inputs are moved
_NEARBY = (0.1, 1e-3)  # of an input and of 1: points beside those that are given
_CLOSE = 1e-2  # of the largest entry: far above what another order of sums does to an ill-conditioned row
_SUMMED = 1e3  # roundings of the largest product in a sum, by which another order may change it
_PRODUCTS = frozenset(("matmul", "__matmul__", "__rmatmul__", "mm", "bmm", "mv", "dot", "inner", "linear",
                       "einsum", "tensordot", "vecdot", "addmm", "addmv", "baddbmm"))  # fmt: skip


def doubt(step: Callable[..., Any], given: Given, *, again: bool = True) -> str | None:
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
            if len(alone) != len(repeated) or not all(map(_leaves_are_close, alone, repeated)):
                return "gives other numbers when it is called again (random numbers, a counter, a clock?)"
        if given.rows == 1:
            return None
        try:
            both = _called(step, given, [first, other])
        except RepaysError:  # the loop around it takes longer than a compiler
            raise
        except Exception as error:  # which plain torch will raise again, for all rows
            return f"takes one row but not two: {type(error).__name__}: {error}"
        for row, at in ((first, 0), (other, 1)):
            found = alone if row == first else _called(step, given, [row])
            beside = [leaf[at : at + 1] for leaf in both]
            differ = _differing(step, given, row, found, beside)
            if differ and not _cancelled(step, given, [first, other], at, differ, found, beside):
                return (
                    "gives a row other numbers beside another row "
                    "(a mean over the batch, a branch on its size?)"
                )
    return None


def _differing(
    step: Callable[..., Any], given: Given, row: int, alone: Sequence[Tensor], beside: Sequence[Tensor]
) -> list[int]:
    """Return which leaves of a row alone are not those beside another, as far as rounding lets them mean
    anything.

    One row and two are not summed in the same order. What then changes by more than a hundredth, a matrix
    that is singular to rounding, changes with the last bits of the inputs, too, and says nothing.
    """
    if len(alone) != len(beside):
        return [*range(max(len(alone), len(beside)))]
    differ = [
        k for k, pair in enumerate(zip(alone, beside, strict=True)) if not _leaves_are_close(*pair, _CLOSE)
    ]
    for bits in _BITS:
        if not differ:
            break
        moved = _called(step, given, [row], bits)
        differ = [k for k in differ if _leaves_are_close(alone[k], moved[k], _CLOSE)]
    return differ


def _cancelled(
    step: Callable[..., Any],
    given: Given,
    rows: Sequence[int],
    at: int,
    differ: Sequence[int],
    alone: Sequence[Tensor],
    beside: Sequence[Tensor],
) -> bool:
    """Return whether leaves of a row differ as they are zero but for rounding, which no last bit of a zero
    moves: a variance at a point that is known.

    They differ by less than half the digits of what the step computes with, or by few roundings of what a
    product of matrices sums up, and not at all at points nearby. What looks at other rows does so there, too.
    """
    if len(alone) != len(beside):
        return False
    with _Largest() as seen:
        _called(step, given, [rows[at]])
    for k in differ:
        if alone[k].shape != beside[k].shape or not alone[k].is_floating_point():
            return False
        change = float((alone[k] - beside[k]).abs().nan_to_num(0.0).max())
        eps = torch.finfo(alone[k].dtype).eps
        if change > max(eps**0.5 * seen.size, _SUMMED * eps * seen.summed):
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
        pairs = {k: (one[k], both[k]) for k in rest if len(one) == len(both) == len(alone)}
        near = {
            k for k, pair in pairs.items() if _leaves_are_close(*pair, _CLOSE) and pair[0].isfinite().any()
        }
        rest = [k for k in rest if k not in near]
    return not rest


class _Largest(TorchFunctionMode):
    """Context: the sizes of the largest number that torch computes inside of it, and of the largest product
    that it sums up in one operation, a matrix' by a vector's, of which only the sum is seen."""

    size = 0.0
    summed = 0.0

    def __torch_function__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        out = func(*args, **(kwargs or {}))
        self.size = max(self.size, *map(_largest, out if type(out) in (tuple, list) else (out,)), 0.0)
        if getattr(func, "__name__", "") in _PRODUCTS:
            factors = [part for arg in args for part in (arg if type(arg) in (tuple, list) else (arg,))]
            self.summed = max(self.summed, math.prod(map(_largest, factors[-2:])))
        return out


def _largest(part: Any) -> float:
    """Return the size of the largest number of a tensor, 0 of anything else."""
    while isinstance(part, Tensor) and torch._C._functorch.is_functorch_wrapped_tensor(part):
        part = torch._C._functorch.get_unwrapped(part)
    if not (isinstance(part, Tensor) and part.is_floating_point() and part.numel()):
        return 0.0
    with torch._C.DisableTorchFunction():
        return float(part.detach().abs().nan_to_num(0.0, 0.0, 0.0).max())


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


def _called(
    step: Callable[..., Any], given: Given, rows: Sequence[int], bits: int = 0, share: float = 0.0
) -> list[Tensor]:
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


def _leaves_are_close(found: Tensor, other: Tensor, tolerance: float = 0.0) -> bool:
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

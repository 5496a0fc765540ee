"""What a user's function returns, tried with two numbers of rows that are no other size of the problem.

With as many rows as there are states, inputs, centers or walls a function that confuses the two returns the
right shape and wrong numbers. So it is called with other numbers of rows, and its values are looked at.
"""

from __future__ import annotations

import functools
import weakref
from collections.abc import Callable, Collection, Hashable, Sequence
from typing import Any

import torch
from torch import Tensor

from ..lanes.row_numbers import each_row
from . import show

_known: weakref.WeakKeyDictionary[Any, set[Any]] = weakref.WeakKeyDictionary()  # targets that were tried
_COUNTS = (5, 7, 11, 13, 17, 19, 23, 29, 31, 37)


def row_counts(sizes: Collection[int]) -> tuple[int, int]:
    """Two numbers of rows, neither of which is one of the sizes of a problem."""
    first, second, *_ = (count for count in _COUNTS if count not in sizes)
    return first, second


def is_ours(function: object) -> bool:
    """Return whether a function is of this library, and has shapes that the tests know."""
    return str(getattr(getattr(function, "func", function), "__module__", "")).startswith("staf_torch.")


def check_rows(
    what: str,
    function: Callable[..., Any],
    given: Sequence[Tensor],
    inner: tuple[int, ...] = (),
    *,
    shared: Sequence[Tensor] = (),
    sizes: Collection[int] = (),
    rule: str = "`{what}` must map rows {given} to {returned}, whatever their number",
) -> None:
    """Refuse a function of rows that does not return floating-point numbers of a shape for every row.

    Args:
        what: the argument, in the words of its door: ``SafetyFilter(constraints=...)``.
        function: of tensors (R, ...) and then the shared ones, to (R, ...).
        given: of one row each, (...).
        inner: shape of what it returns for a row.
        shared: as they are.
        sizes: of the problem, beside those of ``given`` and ``inner``.
        rule: the beginning of the sentence.

    Raises:
        ValueError: that says what it returned, or raised, for how many rows.
    """
    random = torch.get_rng_state()
    known = {*sizes, *inner, *(size for part in given for size in part.shape)}
    for count in row_counts(known):
        rows = [part.detach().repeat(count, *(1 for _ in part.shape)) for part in given]
        came = ", ".join(str(tuple(part.shape)) for part in rows)
        told = rule.format(what=what, given=came, returned=(count, *inner))
        try:
            with torch.no_grad():
                (found,) = each_row(functools.partial(function, *rows, *shared), 1)
        except Exception as error:
            said = str(error).splitlines()[0] if str(error) else ""
            sized = "size" in said or "shape" in said
            hint = " Numbers of a row's own stand in `staf_torch.rows`." if sized else ""
            hint = " A network in float32 needs `.double()`." if "dtype" in said else hint
            raise ValueError(f"{told}; it raised {type(error).__name__} ({said}).{hint}") from error
        finally:
            torch.set_rng_state(random)  # a function that draws numbers draws the same ones afterwards
        if not isinstance(found, Tensor):
            raise ValueError(f"{told}, as a tensor; got {show(found)}.")
        if found.shape != (count, *inner):
            raise ValueError(f"{told}; got {tuple(found.shape)}.")
        if not found.is_floating_point():
            raise ValueError(f"{told}, of floating point; got {found.dtype}.")


def once(function: Any, kind: Hashable, check: Callable[[], None]) -> None:
    """Call a check of a function the first time in a process that it comes with this kind of problem.

    Args:
        function: of a user; of this library's nothing is checked.
        kind: what else decides: the check, sizes.
        check: raises where the function breaks its rule.
    """
    holder, kind = getattr(function, "__self__", function), (getattr(function, "__func__", None), kind)
    try:
        known = _known.setdefault(holder, set())
    except TypeError:  # what has no hash, or no weak reference
        known = set()
    if kind not in known:
        if not is_ours(function):
            check()
        known.add(kind)


def check_target(
    target: Callable[[Tensor], Any], x: Tensor, outputs: int | None = None, *, sizes: Collection[int] = ()
) -> None:
    """Refuse a target V that is not one number a point, or k, whatever the number of points: once a target.

    Args:
        target: of points (..., n).
        x: some of them, (..., n), of which one is tried.
        outputs: k; None for one number.
        sizes: of the problem.
    """

    def check() -> None:
        name = getattr(target, "__name__", type(target).__name__)
        form, inner = ("(...)", ()) if outputs is None else (f"(..., {outputs})", (outputs,))
        rule = (
            "The target `{what}` must map points of shape (..., n) to values of shape "
            f"{form}: " + "{given} must give {returned}"
        )
        check_rows(name, target, [x.reshape(-1, x.shape[-1])[0]], inner, sizes=(*sizes, *x.shape), rule=rule)

    once(target, (x.shape[-1], outputs), check)

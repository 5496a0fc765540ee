"""Rows of a batch: choices among them, quantiles, and checks of a user's function of rows.

A function is checked by calls with two numbers of rows that are no other size of the problem. With as many
rows as there are states, inputs, centers or walls a function that confuses the two returns the right shape
and wrong numbers. So it is called with other numbers of rows, and its values are looked at.
"""

from __future__ import annotations

import dataclasses
import functools
import weakref
from collections.abc import Callable, Collection, Hashable, Sequence
from typing import Any, TypeVar

import torch
from torch import Tensor

from ..lanes.per_row.decisions import each_row
from . import show
from .checks import fail

Some = TypeVar("Some", bound=tuple[Tensor, ...])
_known: weakref.WeakKeyDictionary[Any, set[Any]] = weakref.WeakKeyDictionary()  # targets that were tried
_COUNTS = (5, 7, 11, 13, 17, 19, 23, 29, 31, 37)


def row_counts(sizes: Collection[int]) -> tuple[int, int]:
    """Two numbers of rows, neither of which is one of the sizes of a problem."""
    first, second, *_ = (count for count in _COUNTS if count not in sizes)
    return first, second


def is_ours(function: object) -> bool:
    """Return whether a function is of this library, and has shapes that the tests know."""
    function = getattr(function, "__func__", getattr(function, "func", function))
    return str(getattr(function, "__module__", "")).startswith("staf_torch.")


def check_rows(
    what: str,  # the argument, in the words of its door: ``SafetyFilter(constraints=...)``
    function: Callable[..., Any],  # of tensors (R, ...) and then the shared ones, to (R, ...)
    given: Sequence[Tensor],  # of one row each, (...)
    inner: tuple[int, ...] = (),  # shape of what it returns for a row
    *,
    shared: Sequence[Tensor] = (),
    sizes: Collection[int] = (),  # of the problem, beside those of ``given`` and ``inner``
    rule: str = "`{what}` must map rows {given} to {returned}, whatever their number",
) -> None:
    """Refuse a function of rows that does not return floating-point numbers of a shape for every row.

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
            hint = _of_precision(given[0].dtype) if "dtype" in said else hint
            raise ValueError(f"{told}; it raised {type(error).__name__} ({said}).{hint}") from error
        finally:
            torch.set_rng_state(random)  # a function that draws numbers draws the same ones afterwards
        if not isinstance(found, Tensor):
            raise ValueError(f"{told}, as a tensor; got {show(found)}.")
        if found.shape != (count, *inner):
            raise ValueError(f"{told}; got {tuple(found.shape)}.")
        if not found.is_floating_point():
            raise ValueError(f"{told}, of floating point; got {found.dtype}.")


def _of_precision(dtype: torch.dtype) -> str:
    """Return how a function and rows in different precisions come together."""
    if dtype == torch.float32:
        return " The states are in float32: a network in float64 needs them `.double()`."
    return " A network in float32 needs `.double()`."


def once(function: Any, kind: Hashable, check: Callable[[], None]) -> None:
    """Call a check of a user's function the first time in a process that it comes with this kind of
    problem: what else decides, as sizes. Of this library's functions nothing is checked."""
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
    """Refuse a target V of points (..., n) that is not one number a point, or ``outputs``, whatever the
    number of points: once a target, at one of the points x."""

    def check() -> None:
        if not callable(target):
            raise fail("StaFBasis", "target", "must be a function of points (..., n)", target)
        name = getattr(target, "__name__", type(target).__name__)
        form, inner = ("(...)", ()) if outputs is None else (f"(..., {outputs})", (outputs,))
        rule = (
            "The target `{what}` must map points of shape (..., n) to values of shape "
            f"{form}: " + "{given} must give {returned}"
        )
        check_rows(name, target, [x.reshape(-1, x.shape[-1])[0]], inner, sizes=(*sizes, *x.shape), rule=rule)

    once(target, (x.shape[-1], outputs), check)


def check_radius(radius: Callable[[Tensor], Any], directions: Tensor) -> None:
    """Refuse a radius nu of a user that is not one number a state, or one for all states, whatever their
    number; its centers have directions (M, n)."""
    if is_ours(type(radius)) or directions.is_meta:
        return

    def of_rows(x: Tensor) -> Any:
        found = radius(x)
        return found.expand(len(x)) if isinstance(found, Tensor) and found.dim() == 0 else found

    def check() -> None:
        x, name = _somewhere(directions, directions.shape[1]), type(radius).__name__
        check_rows(name, of_rows, [x], sizes=directions.shape)
        with torch.no_grad():
            found = [of_rows(x.repeat(count, 1))[0] for count in row_counts(directions.shape)]
        if not torch.allclose(found[0], found[1], rtol=1e-6, equal_nan=True):
            raise ValueError(f"`{name}` must map each state by itself; nu depends on how many there are.")

    once(radius, ("radius", directions.shape), check)


def check_kernel(kernel: Any, directions: Tensor) -> None:
    """Refuse a kernel of a user, or a closed form of it, that does not return its shape in every row; its
    centers have directions (M, n)."""
    if is_ours(type(kernel)) or directions.is_meta:
        return

    def check() -> None:
        n, name = directions.shape[1], type(kernel).__name__
        few, many = [size for size in (2, 3, 4) if size != n][:2]
        x, y, c, b = (_somewhere(directions, *shape) for shape in ((n,), (few, n), (many, n), (many,)))
        check_rows(f"{name}.forward", kernel, [y, c], (few, many), sizes=directions.shape)
        forms: dict[str, tuple[list[Tensor], tuple[int, ...]]] = {
            "gradient": ([y, c, b], (few, n)),
            "core": ([x, y, c], (few, many)),
        }
        forms |= {"log_gain": ([x], ()), "log_scale": ([x, y], (few,))}
        for form, (given, inner) in forms.items():
            method = getattr(kernel, form)
            if not is_ours(method) and method(*given) is not None:
                check_rows(f"{name}.{form}", method, given, inner, sizes=directions.shape)

    once(kernel, ("kernel", directions.shape), check)


def check_law(law: Any, objective: Callable[[Tensor, Tensor], Any], row: Tensor) -> None:
    """Refuse a law of a user that does not return weights and a state of every row (M,); ``objective``
    makes one of Gram matrices (R, M, M) and values (R, M)."""
    if is_ours(type(law)):
        return
    count, name = len(row), type(law).__name__

    def stepped(rows: Tensor) -> tuple[Tensor, tuple[Tensor, ...]]:
        given = objective(
            torch.eye(count, dtype=rows.dtype, device=rows.device).expand(len(rows), -1, -1),
            torch.ones_like(rows),
        )
        moved: tuple[Tensor, tuple[Tensor, ...]] = law.step(
            given, rows, law.begin(given, rows, law.init(rows))
        )
        return moved

    def check() -> None:
        check_rows(f"{name}.step", lambda rows: stepped(rows)[0], [row], (count,))
        for k, part in enumerate(law.init(row.expand(1, -1))):
            if part.is_floating_point():
                what = f"{name}.step(...)[1][{k}]"
                check_rows(what, lambda rows, k=k: stepped(rows)[1][k], [row], tuple(part.shape[1:]))

    once(law, ("law", count, row.dtype), check)


def check_metric(metric: Callable[[Any, Any], Any], result: Any, problem: Any) -> None:
    """Refuse a metric of a user that does not return one number a time of every row, (B, T), where the
    number of rows is also another size of the result, and its shape alone says nothing.

    The result is a dataclass of tensors (B, ...), ``time`` (T,), and dictionaries of such.
    """
    batch, times = result.state.shape[:2]
    parts = {f.name: getattr(result, f.name) for f in dataclasses.fields(result) if f.name != "time"}
    known = {size for part in parts.values() if isinstance(part, Tensor) for size in part.shape[1:]}
    if is_ours(type(metric)) or batch not in known:
        return

    def of_rows(count: int, part: Any) -> Any:
        if isinstance(part, dict):
            return {name: of_rows(count, inner) for name, inner in part.items()}
        own = isinstance(part, Tensor) and part.dim() > 0 and len(part) == batch
        return part[:1].expand(count, *part.shape[1:]) if own else part

    def some(rows: Tensor) -> Any:
        fewer = {name: of_rows(len(rows), part) for name, part in parts.items()}
        return metric(dataclasses.replace(result, **fewer), problem)

    def check() -> None:
        check_rows(type(metric).__name__, some, [result.state[0, 0]], (times,), sizes=known)

    once(metric, ("metric", result.state.shape[1:]), check)


def _somewhere(like: Tensor, *shape: int) -> Tensor:
    """Return points without a pattern, of the dtype and device of a tensor."""
    numbers = torch.arange(1.0, 1.0 + torch.Size(shape).numel(), dtype=like.dtype, device=like.device)
    return (0.7 * numbers).cos().reshape(shape)


def chosen(rows: Tensor, new: Some, old: Some) -> Some:
    """The tensors of ``new`` in ``rows`` (B,), those of ``old`` in the others."""

    def pick(a: Tensor, b: Tensor) -> Tensor:
        return torch.where(rows.reshape(-1, *[1] * (a.dim() - 1)), a, b)

    picked = map(pick, new, old)
    return type(new)(*picked) if hasattr(new, "_fields") else type(new)(picked)


def known_quantile(values: Tensor, share: float, *, lower: bool = False) -> Tensor:
    """Return the quantile of the values that are not NaN, (P,) -> (); NaN where there are none. With
    ``lower`` it is the value below, else both neighbours are interpolated linearly."""
    ordered = values.sort().values  # NaN last
    last = (values == values).sum() - 1
    place = (share * last.clamp(min=0).to(values)).unsqueeze(0)
    below = ordered.gather(0, place.floor().long())[0]
    if lower:
        return below
    return torch.lerp(below, ordered.gather(0, place.ceil().long())[0], (place - place.floor())[0])

"""Objects whose numbers differ from row to row: made of all rows at once, and merged into one.

A constructor decides by values (it refuses what is not positive, counts modes). It runs for all rows that
decide alike together (`decisions`), or for every row alone. The objects that come out are of one
structure, and where they differ they differ in numbers: tensors and floats become `RowNumbers`, everywhere
else they must be equal.
"""

from __future__ import annotations

import abc
import contextlib
import functools
import inspect
import sys
import threading
import weakref
from collections.abc import Callable, Sequence
from types import CellType, FrameType, FunctionType, MethodType
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor, nn

from ..dependencies.contents import Contents
from ..dependencies.walk import BOUND, Derived
from ..row_numbers import RowNumbers, all_rows, in_use, over_rows
from ..tree import Shared, plain
from .decisions import DecidedByRows, at_once, beside, is_of_rows, spread_rows, tried

Some = TypeVar("Some")
Given = ParamSpec("Given")
_LANES = __package__.rpartition(".")[0]


def rows(numbers: Tensor | Sequence[nn.Module]) -> Any:
    """Mark numbers of which every row of a batch has its own: the first dimension is the rows.

    Wherever a number may stand, such a tensor may stand: in a plant, a cost, a kernel, a law, in a module or
    a function of your own, which sees the number of one row, without the dimension of rows. Its meaning is
    `torch.func.vmap` over the rows; compiled, a row's numbers are columns of a program.

    Example:
        >>> masses = torch.linspace(0.5, 2.0, 4).double()
        >>> plant = systems.Pendulum(mass=rows(masses))
        >>> x0 = torch.tensor([[1.0, 0.0]]).double().expand(4, 2)
        >>> systems.simulate(plant, x0, dt=0.01, steps=100).shape  # four pendulums
        torch.Size([4, 101, 2])

        Shown by `staf_torch/lanes/ROWS.md`.

    Args:
        numbers: (B, ...), floating-point; or B modules of one class, which differ in numbers: the module that
            has the numbers of all, as `torch.func.stack_module_state` stacks them.

    Raises:
        ValueError: if there is no row, numbers are no floating-point numbers, or modules differ in more than
            numbers.
    """
    if isinstance(numbers, RowNumbers):
        return numbers
    if isinstance(numbers, Tensor):
        if not numbers.is_floating_point():
            raise ValueError(f"`rows(numbers=...)` must be floating-point numbers; got {numbers.dtype}.")
        if numbers.dim() == 0 or not len(numbers):
            raise ValueError(
                f"`rows(numbers=...)` must have a first dimension of rows, one at least; "
                f"got the shape {tuple(numbers.shape)}."
            )
        return RowNumbers(numbers)
    modules = list(numbers) if isinstance(numbers, Sequence | nn.ModuleList) else [numbers]
    alike = modules and all(type(each) is type(modules[0]) for each in modules)
    if not alike or not hasattr(modules[0], "__dict__") or isinstance(modules[0], Tensor):
        kinds = ", ".join(sorted({type(each).__name__ for each in modules}))
        rule = "must be a tensor (B, ...), as `torch.stack` makes it, or modules of one class"
        raise ValueError(f"`rows(numbers=...)` {rule}; got {kinds or 'none'}.")
    return merged(modules)


def refuse_rows(call: str, instead: str = "make one for each row", **given: Any) -> None:
    """Refuse objects with numbers of a row's own, of a door that does not serve them.

    Raises:
        ValueError: that names the first one.
    """
    for name, value in given.items():
        if counts_of_rows(value):
            rule = "must have no numbers of a row's own (`staf_torch.rows`), which are not served here"
            raise ValueError(f"`{call}({name}=...)` {rule}: {instead}.")


def counts_of_rows(*objects: Any) -> set[int]:
    """Return of how many rows objects hold numbers; no number where they hold none of rows."""
    tensors = Contents(*objects).tensors if RowNumbers.made else ()
    return {len(tensor.full) for tensor in tensors if isinstance(tensor, RowNumbers)}


def by_rows(function: Callable[Given, Some]) -> Callable[Given, Some]:
    """Decorator of a function that decides by values: with numbers of rows it runs for all that decide alike.

    Its results are merged: tensors and floats that differ become `RowNumbers`.
    """

    @functools.wraps(function)
    def either(*args: Given.args, **kwargs: Given.kwargs) -> Some:
        return made_by_rows(lambda: function(*args, **kwargs))

    return either


def made_by_rows(make: Callable[[], Some]) -> Some:
    """Return what ``make`` returns; where it reads numbers of rows, that of all rows, merged."""
    found, count = tried(make)
    if count is None:
        return found  # type: ignore[return-value]
    parts = at_once(make, count, spread_rows(count))
    if len(parts) == 1 and parts[0].together:
        return parts[0].found  # type: ignore[no-any-return]
    objects, rows = [part.found for part in parts], [part.rows for part in parts]
    try:
        made: Some = merged(objects, rows)
    except ValueError:
        join = getattr(type(objects[0]), "of_kinds", None)
        if join is None:
            raise
        return join(objects, rows, count)  # type: ignore[no-any-return]
    if any(isinstance(tensor, RowNumbers) for tensor in Contents(made).tensors):
        return made
    made = merged(objects, rows, beside(make))  # as many rows as there are, although all are alike
    return made


class Note(str):
    """A text on what an object lacks: of rows, which all lack it or none, that of the first."""


class Rowwise(abc.ABCMeta):
    """Metaclass of modules whose methods are functions of points.

    A class says in ``rowwise`` which of its methods, and of those of its subclasses, are functions of points:
    by the name, how many dimensions each argument has without rows. Called with numbers of rows by somebody
    who has not said whose, such a method takes arguments (B, ...) row by row; one without rows is for all.
    Until a process has numbers of rows its methods are as they were written: there a call asks nothing.
    """

    def __new__(mcs, name: str, bases: tuple[type, ...], space: dict[str, Any], **more: Any) -> Any:
        known = [space.get("rowwise", {}), *(getattr(base, "rowwise", {}) for base in bases)]
        rowwise = {key: dims for each in reversed(known) for key, dims in each.items()}
        made: Any = super().__new__(mcs, name, bases, {**space, "rowwise": rowwise}, **more)
        _unserved.add(made)
        if RowNumbers.made:
            _serve_rows()
        return made

    told = True  # `told_copies`: floats of the library's own classes are numbers of a table


class OfRows(Rowwise):
    """Metaclass of modules whose constructors decide by values: with numbers of rows they run row by row."""

    @property
    def __signature__(cls) -> inspect.Signature:
        """That of the constructor, for Hydra and editors, not that of `_made_with_rows`."""
        whole = inspect.signature(cls.__init__)  # type: ignore[misc]
        return whole.replace(parameters=list(whole.parameters.values())[1:])


def _made_with_rows(cls: type[Some], *args: Any, **kwargs: Any) -> Some:
    """Make an object of a class of `OfRows`: with numbers of rows for all rows at once, or row by row."""
    make: Callable[..., Some] = functools.partial(type.__call__, cls)
    if not _holds_rows((args, kwargs)):
        return made_by_rows(lambda: make(*args, **kwargs))
    try:
        return make(*args, **kwargs)  # with all rows at once, or within one of them
    except (ValueError, TypeError, RuntimeError):  # it decides by values, or takes no tensors
        pass

    def one() -> Some:
        return make(*map(_alone, args), **{name: _alone(value) for name, value in kwargs.items()})

    return made_by_rows(one)


_unserved: weakref.WeakSet[Any] = weakref.WeakSet()  # classes of `Rowwise` whose methods are as written
_serving = threading.Lock()


def _serve_rows() -> None:
    """Have methods of points and constructors look for numbers of rows, of which there are some now."""
    with _serving:
        OfRows.__call__ = _made_with_rows  # type: ignore[method-assign, assignment]
        while _unserved:
            kind = _unserved.pop()
            for key, dims in kind.rowwise.items():
                if isinstance(method := vars(kind).get(key), FunctionType):
                    setattr(kind, key, _of_points(method, dims))


RowNumbers.prepare.append(_serve_rows)


def _of_points(method: Any, dims: Sequence[int]) -> Any:
    """Return a method that takes points (B, ...) row by row where it reads numbers of rows."""

    @functools.wraps(method)
    def of_points(self: Any, *args: Any, **kwargs: Any) -> Any:
        if not in_use():
            return method(self, *args, **kwargs)
        if kwargs:
            bound = inspect.signature(method).bind(self, *args, **kwargs)
            args, kwargs = bound.args[1:], bound.kwargs
        given = [_with_rows(arg, size) for arg, size in zip(args, dims, strict=False)]
        rest = args[len(given) :]

        def at(*points: Any) -> Any:
            alone = (plain(p) if isinstance(p, Shared | Tensor) else p for p in points)
            return method(self, *alone, *rest, **kwargs)

        return over_rows(at, *given)

    return of_points


def beyond_rows(stacklevel: int) -> int:
    """Return the ``stacklevel`` of a warning of the caller's, of which frames of numbers of rows are none."""
    frame: FrameType | None = sys._getframe(1)
    level = seen = 0
    while frame is not None and seen < stacklevel:
        level += 1
        seen += not frame.f_globals.get("__name__", "").startswith(_LANES)
        frame = frame.f_back
    return level


def _holds_rows(value: Any) -> bool:
    """Return whether numbers of rows are among arguments, also in lists and dictionaries of numbers."""
    if isinstance(value, list | tuple):
        return any(map(_holds_rows, value))
    return _holds_rows([*value.values()]) if isinstance(value, dict) else isinstance(value, RowNumbers)


def _alone(value: Any) -> Any:
    """Return the number of the row whose turn it is: a float, or a tensor of more, or of many rows."""
    if isinstance(value, list | tuple) and _holds_rows(value):
        parts = map(_alone, value)
        return type(value)(*parts) if hasattr(value, "_fields") else type(value)(parts)
    if isinstance(value, dict) and _holds_rows(value):
        return {name: _alone(part) for name, part in value.items()}
    if not isinstance(value, RowNumbers):
        return value
    tensor = value + 0.0
    return tensor.item() if tensor.dim() == 0 and not is_of_rows(tensor) else tensor


def _with_rows(value: Any, size: int) -> Any:
    return Shared(value) if isinstance(value, Tensor) and value.dim() <= size else value


def merged(objects: Sequence[Some], rows: Sequence[Tensor] | None = None, other: Some | None = None) -> Some:
    """Return the object that has the numbers of all rows.

    Args:
        objects: of one class and structure, one a row.
        rows: of each object, (R,), where an object has the numbers of several; all of them are all rows.
        other: one with other numbers; equal numbers in which it differs are of rows, too.

    Raises:
        ValueError: if they differ in more than numbers.
    """
    if rows is None:
        rows = [torch.tensor([row], dtype=torch.int64, device="cpu") for row in range(len(objects))]
    pairs = sorted(zip(rows, objects, strict=True), key=lambda pair: int(pair[0][0]))
    rows, values = [pair[0] for pair in pairs], [pair[1] for pair in pairs]
    if other is not None:
        with contextlib.suppress(ValueError):  # it may differ in more
            found: Some = Merge(rows).of([*values, other], type(other).__name__)
            return found
    made: Some = Merge(rows).of(values, type(values[0]).__name__)
    return made


class Merge:
    """Merges objects, each with the numbers of these rows; one more may say which numbers are of rows."""

    def __init__(self, rows: Sequence[Tensor], count: int | None = None) -> None:
        self._rows = rows
        self._count = sum(map(len, rows)) if count is None else count
        self._made: dict[tuple[int, ...], Any] = {}
        self._kept: list[Any] = []  # addresses are used once

    def of(self, values: list[Any], name: str) -> Any:
        first = values[0]
        if all(value is first for value in values):
            return first
        kind = type(first)
        if any(isinstance(value, Tensor) for value in values):
            return self._tensor(values, name)
        if any(type(value) is not kind for value in values):
            raise self._differ(values, name)
        if kind is float:
            if all(value == first or (value != value and first != first) for value in values):
                return first
            return self._tensor(values, name)
        key = tuple(map(id, values))
        if key not in self._made:
            self._kept.append(values)
            self._made[key] = self._new(values, kind, name, key)
        return self._made[key]

    def _tensor(self, values: list[Any], name: str) -> Any:
        one = next((v for v in values if isinstance(v, Tensor)), None)
        real, device = (torch.float64, "cpu") if one is None else (one.dtype, str(one.device))
        values = [torch.tensor(v, dtype=real, device=device) if isinstance(v, float) else v for v in values]
        first = values[0]
        alike = all(
            isinstance(v, Tensor) and v.shape == first.shape and v.dtype == first.dtype for v in values
        )
        if not alike:
            raise self._differ([tuple(v.shape) if isinstance(v, Tensor) else v for v in values], name)
        if not any(isinstance(v, RowNumbers) for v in values) and all(torch.equal(v, first) for v in values):
            return first
        if not first.is_floating_point():
            raise self._differ(values, name)
        start = all_rows(first).detach()[:1] if isinstance(first, RowNumbers) else first.detach()
        full = start.expand(self._count, *first.shape).clone()
        for value, rows in zip(values, self._rows, strict=False):
            part = all_rows(value).detach()  # of all rows where it was not made for these
            full[rows] = part[rows] if isinstance(value, RowNumbers) and len(part) != len(rows) else part
        made = RowNumbers(full)
        return nn.Parameter(made, first.requires_grad) if isinstance(first, nn.Parameter) else made

    def _new(self, values: list[Any], kind: type, name: str, key: tuple[int, ...]) -> Any:
        first = values[0]
        if isinstance(first, list | tuple):
            if any(len(value) != len(first) for value in values):
                raise self._differ(values, name)
            parts = [
                self.of(list(column), f"{name}[{k}]") for k, column in enumerate(zip(*values, strict=True))
            ]
            return kind(*parts) if hasattr(first, "_fields") else kind(parts)
        if isinstance(first, dict):
            return kind(self._dict(values, name))
        if isinstance(first, FunctionType):
            return self._function(values, name)
        if isinstance(first, MethodType):
            return MethodType(first.__func__, self.of([value.__self__ for value in values], name))
        if isinstance(first, functools.partial):
            parts = [(value.func, value.args, value.keywords) for value in values]
            function, args, keywords = self.of(parts, name)
            return functools.partial(function, *args, **keywords)
        if isinstance(first, Derived):
            return kind(**self._dict([value.__getstate__() for value in values], name))
        if hasattr(first, "__dict__") and not isinstance(first, type | str):
            made: Any = object.__new__(kind)
            self._made[key] = made
            held = [dict(vars(value)) for value in values]
            for key in getattr(kind, "none_is_zero", ()):
                there: Any = next((each[key] for each in held if each[key] is not None), None)
                for each in held if there is not None else ():
                    each[key] = torch.zeros_like(there) if each[key] is None else each[key]
            for key in getattr(kind, "largest", ()):  # counts of loops that rows leave earlier
                most = max(each[key] for each in held)
                for each in held:
                    each[key] = most
            vars(made).update(self._dict(held, name))
            return made
        if all(value == first for value in values) or (isinstance(first, Note) and all(values)):
            return first
        raise self._differ(values, name)

    def _dict(self, values: list[dict[Any, Any]], name: str) -> dict[Any, Any]:
        if name.endswith("_hooks"):  # their keys count all hooks of the process
            values = [dict(zip(values[0], each.values(), strict=False)) for each in values]
        keys = [key for key in values[0] if key != BOUND]
        if any([key for key in value if key != BOUND] != keys for value in values):
            raise self._differ([list(value) for value in values], name)
        inside = {"_parameters", "_buffers", "_modules"}
        return {
            key: self.of([value[key] for value in values], name if key in inside else f"{name}.{key}")
            for key in keys
        }

    def _function(self, values: list[Any], name: str) -> Any:
        first = values[0]
        if any(value.__code__ is not first.__code__ for value in values):
            raise self._differ(values, name)
        parts = [
            (
                [cell.cell_contents for cell in value.__closure__ or ()],
                value.__defaults__,
                value.__kwdefaults__,
            )
            for value in values
        ]
        closed, defaults, keywords = self.of(parts, name)
        cells = tuple(CellType(content) for content in closed) or None
        made = FunctionType(first.__code__, first.__globals__, first.__name__, defaults, cells)
        made.__kwdefaults__ = keywords
        return made

    def _differ(self, values: list[Any], name: str) -> ValueError:
        other = next(k for k, value in enumerate(values) if not _equal(value, values[0]))
        row, first = (int(self._rows[k][0]) if k < len(self._rows) else None for k in (other, 0))
        left, right = (x.tolist() if isinstance(x, Tensor) else x for x in (values[0], values[other]))
        return ValueError(
            f"rows differ in `{name}`, which is no number: {left!r} in row {first} and "
            f"{right!r} in row {row}; what is no number must be the same in all rows."
        )


class _Alone(Merge):
    """Copies an object of many rows with the numbers of one."""

    def of(self, values: list[Any], name: str) -> Any:
        first = values[0]
        if isinstance(first, RowNumbers):
            return all_rows(first)[int(self._rows[0][0])]
        if isinstance(first, Tensor | float):
            return first
        key = (id(first),)
        if key not in self._made:
            self._kept.append(values)
            self._made[key] = self._new(values, type(first), name, key)
        return self._made[key]


def row_of(value: Some, row: int) -> Some:
    """Return a copy of an object with the numbers of one row alone."""
    if len(getattr(value, "kinds", ())) and isinstance(kind := getattr(value, "kind", None), RowNumbers):
        value = value.kinds[int(kind.full[row])]  # type: ignore[attr-defined]
    found: Some = _Alone([torch.tensor([row], dtype=torch.int64, device="cpu")]).of([value], "")
    for part in found.modules() if isinstance(found, nn.Module) else ():
        if isinstance(part, DecidedByRows):
            part.decide_alone()
    return found


def _equal(one: Any, other: Any) -> bool:
    try:
        if isinstance(one, Tensor):
            return isinstance(other, Tensor) and torch.equal(one, other)
        return type(one) is type(other) and bool(one == other)
    except (RuntimeError, ValueError):
        return False

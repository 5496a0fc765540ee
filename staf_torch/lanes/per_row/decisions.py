"""Designs, checks and constructors that read values, of all rows at once or row by row.

A function that reads numbers of rows runs under one `torch.func.vmap` over the rows. Where it reads a value
(`bool(x > 0)`) and all rows agree, that is the value; where they do not, the rows part into groups that
agree, and the function runs again for each. What it returns, a tensor or an object that holds some, then has
the numbers of all of its rows. A value that differs from row to row as a number (`float(x)`, SciPy) leaves
the rows of that group to a loop.
"""

from __future__ import annotations

import functools
import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FunctionType, MethodType, ModuleType
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

from ..dependencies.walk import BOUND, EMPTY, Derived, content_of
from ..row_numbers import RowNumbers, RowsMetError, all_rows, column_of, columns, in_use, refuse, resolving

Some = TypeVar("Some")
_active = threading.local()


def tried(function: Callable[[], Some]) -> tuple[Some | None, int | None]:
    """Return function(), and how many rows the numbers have that it read: with None it read none of rows.
    It is left where it reads the first."""
    if not in_use():
        return function(), None
    try:
        with resolving(refuse):
            return function(), None
    except RowsMetError as error:
        count = len(columns([error.numbers], None)[0])
    for met in getattr(_active, "met", ()):
        met.append(count)
    return None, count


def each_row(function: Callable[[], Some], most: int | None = None) -> list[Some]:
    """function() of every row, or of ``most`` spread over all, which sees its own numbers alone; once
    where it reads no numbers of rows."""
    found, count = tried(function)
    if count is None:
        return [found]  # type: ignore[list-item]
    return [in_row(row, count, function) for row in spread_rows(count, most).tolist()]


def spread_rows(count: int, most: int | None = None) -> Tensor:
    """Return rows (R,), so many at most, spread over all of them."""
    few = count if most is None else min(count, most)
    return torch.linspace(0, count - 1, few, dtype=torch.float64, device="cpu").round().long()


def beside(function: Callable[[], Some]) -> Some | None:
    """function() with numbers beside those of the first row; None where that is against a rule."""
    for share in (1 - 1e-6, 1 + 1e-6):
        try:
            with resolving(functools.partial(_other, share)):
                return function()
        except (ValueError, TypeError, RuntimeError):
            continue
    return None


def _other(share: float, numbers: RowNumbers) -> Tensor:
    first = columns([numbers], None)[0][0]
    return torch.where(first == 0, abs(1 - share), first * share)


@contextmanager
def met_rows() -> Iterator[list[int]]:
    """Yield a list that is not empty once `each_row` has met numbers of rows in the block."""
    met = list[int]()
    before, _active.met = getattr(_active, "met", ()), [*getattr(_active, "met", ()), met]
    try:
        yield met
    finally:
        _active.met = before


def in_row(row: int, count: int, function: Callable[[], Some]) -> Some:
    """function() with the numbers of one row of so many."""
    column = column_of(count)
    with turn_of(row), resolving(lambda numbers: column(numbers)[row]):
        return function()


@contextmanager
def turn_of(row: int) -> Iterator[None]:
    """Within the block a function runs for this row, or for several of which it is the first."""
    before, _active.row = getattr(_active, "row", 0), row
    try:
        yield
    finally:
        _active.row = before


def first_row() -> bool:
    """Return whether it is the turn of the first row, or of none: one warning in the log is enough."""
    return getattr(_active, "row", 0) == 0


_log = logging.getLogger(__name__)
_TRUTH = frozenset([Tensor.__bool__, Tensor.is_nonzero, torch.is_nonzero])
_COMPARED = frozenset([torch.equal, Tensor.equal, torch.allclose, Tensor.allclose])
_OPAQUE = frozenset([Tensor.numpy, Tensor.__array__, Tensor.__contains__, Tensor.__dlpack__, Tensor.data_ptr])
_NUMBER = frozenset([Tensor.item, Tensor.tolist, Tensor.__float__, Tensor.__int__, Tensor.__index__])
_READS = _TRUTH | _COMPARED | _OPAQUE | _NUMBER
_ATOMS = (str, bytes, int, float, complex, bool, type(None), type, ModuleType, torch.dtype, torch.device)


class Alike(NamedTuple):
    """Outputs of a function for rows that decided alike."""

    rows: Tensor  # (R,) int64
    found: Any  # with numbers (R, ...) as `RowNumbers`, or those of one row alone
    together: bool = True


class DecidedByRows:
    """Base of what holds decisions of Python that were made of the numbers of all its rows."""

    def decide_alone(self) -> None:
        """Decide anew by the numbers of one row, which a copy has: as if it had been made of them."""
        raise NotImplementedError


class _SplitError(BaseException):
    """The signal that rows decide differently."""

    def __init__(self, holds: Tensor) -> None:
        super().__init__()
        self.holds = holds


class _AloneError(BaseException):
    """The signal that a number is wanted which differs from row to row."""


def at_once(function: Callable[[], Some], count: int, rows: Tensor) -> list[Alike]:
    """function() for these rows of so many, in groups that decide alike.

    Args:
        function: of no arguments, which reads numbers of rows.
        count: B.
        rows: (R,) int64, rising.

    Raises:
        Exception: what the function raises in the first row in which it does.
    """
    parts, found, failed = [rows], list[Alike](), dict[int, Exception]()
    while parts:
        part = parts.pop()
        try:
            found.append(_together(function, count, part))
            continue
        except _SplitError as split:
            parts += [part[~split.holds], part[split.holds]]
            continue
        except (_AloneError, Exception) as error:  # the first row alone says what it is, if it is its fault
            _log.debug("%d rows are computed one by one: %s %s", len(part), type(error).__name__, error)
        for row in part.tolist():
            try:
                alone = torch.tensor([row], dtype=torch.int64, device="cpu")
                found.append(Alike(alone, in_row(row, count, function), together=False))
            except Exception as error:
                failed[row] = error
                break
    if failed:
        row = min(failed)
        if isinstance(failed[row], ValueError):
            raise ValueError(f"{failed[row]} (in row {row})") from failed[row]
        raise failed[row]
    return found


def decided(function: Callable[[], Any], most: int | None = None) -> None:
    """Call function(), a check without arguments, for rows with numbers of their own, ``most`` of them at
    most, spread over all; once where it reads none."""
    count = tried(function)[1]
    if count is not None:
        at_once(function, count, spread_rows(count, most))


class NumbersOfRows(NamedTuple):
    """Numbers that a function returned for some rows."""

    numbers: list[Tensor]  # (R, ...) each
    rows: Tensor  # (R,) int64
    known: int | None  # number of all rows; None where no number of rows was read

    def of(self, place: int, function: Callable[[], Some]) -> Some:
        """Return function() of the row at a place of ``rows``."""
        return function() if self.known is None else in_row(int(self.rows[place]), self.known, function)


def numbers_of_rows(function: Callable[[], tuple[Tensor, ...]], most: int | None = None) -> NumbersOfRows:
    """Return the tensors that function() returns for rows with numbers of their own, ``most`` of them at
    most, spread over all; for one row where it reads none."""
    single, count = tried(function)
    if count is None:
        assert single is not None
        return NumbersOfRows(
            [value.unsqueeze(0) for value in single], torch.zeros(1, dtype=torch.int64, device="cpu"), None
        )
    rows = spread_rows(count, most)
    parts = at_once(function, count, rows)
    order, found = torch.cat([part.rows for part in parts]).argsort(), []
    for column in zip(*(part.found for part in parts), strict=True):
        each = [
            value.full if isinstance(value, RowNumbers) else value.expand(len(part.rows), *value.shape)
            for value, part in zip(column, parts, strict=True)
        ]
        found.append(torch.cat(each)[order])
    return NumbersOfRows(found, rows, count)


def of_first(tensor: Tensor) -> Tensor:
    """Return the number of the first of many rows, for a message; a tensor of none as it is."""
    values = _values(tensor)
    return tensor if values is None else values[0]


def most_of_rows(count: Tensor) -> int:
    """Return the largest of the counts of all rows, (): that of a loop which rows share."""
    values = _values(count)
    return int(count if values is None else values.max())


def rows_of(tensor: Tensor) -> int:
    """Return of how many rows a tensor stands for the numbers; 1 of none."""
    values = _values(tensor)
    return 1 if values is None else len(values)


def is_of_rows(tensor: Any) -> bool:
    """Return whether a tensor (or anything else) stands for those of many rows of a `torch.func.vmap`."""
    return _values(tensor) is not None


def agreed(tensor: Tensor) -> bool:
    """Return whether a number () is the same in all rows."""
    values = _values(tensor)
    return values is None or bool((values == values[:1]).all())


def in_any_row(condition: Tensor) -> bool:
    """Return whether a condition holds in an entry of any row: a decision that rows share."""
    values = _values(condition)
    return bool((all_rows(condition) if values is None else values).any())


def _together(function: Callable[[], Any], count: int, rows: Tensor) -> Alike:
    column, found = column_of(count), list[Any]()

    def one(index: Tensor) -> tuple[Tensor, ...]:
        known: dict[int, Tensor] = {}

        def resolve(numbers: RowNumbers) -> Tensor:
            if id(numbers) not in known:
                known[id(numbers)] = column(numbers)[index]
            return known[id(numbers)]

        parts = _RowTensors(level := torch._C._functorch.maybe_get_level(index))
        with turn_of(int(rows[0])), resolving(resolve), _Decisions(level):
            result = function()
        found.extend((parts, changed(result, parts.take)))
        return tuple(parts.tensors) or (index,)

    columns = torch.func.vmap(one, randomness="same")(rows)
    parts, result = found
    parts.columns = columns
    return Alike(rows, changed(result, parts.put))


class _Decisions(TorchFunctionMode):
    """Context in which a value is read of all rows: that on which they agree."""

    def __init__(self, level: int) -> None:
        super().__init__()
        self._level = level

    def __torch_function__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        if func in _READS:  # of dozens one
            values = [_values(part, self._level) for part in args[:2]]
            if any(value is not None for value in values):
                return _read(func, values[0], *args, **(kwargs or {}))
        return func(*args, **kwargs) if kwargs else func(*args)


def _read(func: Any, values: Tensor | None, *args: Any, **kwargs: Any) -> Any:
    """Return what all rows have as the value of a function, of a tensor with these ``values``."""
    if func in _COMPARED:
        one, other, *rest = args
        if func is torch.equal or func is Tensor.equal:
            return one.shape == other.shape and one.dtype == other.dtype and bool((one == other).all())
        far = {"rtol": 1e-5, "atol": 1e-8, **dict(zip(("rtol", "atol"), rest, strict=False)), **kwargs}
        near = (one - other).abs() <= far["atol"] + far["rtol"] * other.abs()
        return bool(((one == other) | near).all())
    if values is None or func in _OPAQUE:
        raise _AloneError
    if func in _TRUTH:
        return _agreed(values)
    first = values[0]
    if not bool(((values == first) | ((values != values) & (first != first))).all()):
        raise _AloneError
    return func(first, *args[1:], **kwargs)


def _agreed(values: Tensor) -> bool:
    rows = values.reshape(len(values), -1) != 0
    if rows.shape[1] != 1 and bool((rows != rows[:, :1]).any()):
        raise _AloneError  # of a `vmap` inside, too
    holds = rows[:, 0]
    if bool((holds != holds[0]).any()):
        raise _SplitError(holds)
    return bool(holds[0])


def _values(tensor: Any, level: int | None = None) -> Tensor | None:
    """Return the values of a tensor in all rows, (R, ...), of the `vmap` over the rows of a level, or of
    any; None where they are one for all rows, and of anything else."""
    if not isinstance(tensor, Tensor) or isinstance(tensor, RowNumbers):
        return None
    batched, plain = False, tensor
    while torch._C._functorch.is_functorch_wrapped_tensor(plain):
        if torch._C._functorch.is_batchedtensor(plain):
            batched = batched or level in (None, torch._C._functorch.maybe_get_level(plain))
            at = torch._C._functorch.maybe_get_bdim(plain)
            plain = torch._C._functorch.get_unwrapped(plain).movedim(at, 0)
        else:
            plain = torch._C._functorch.get_unwrapped(plain)
    return plain.detach() if batched else None


class _Place:
    """Placeholder of a tensor of all rows until its values are known."""

    def __init__(self, at: int) -> None:
        self.at = at


class _RowTensors:
    """Tensors of rows out of what a function returned."""

    def __init__(self, level: int) -> None:
        self.level = level
        self.tensors: list[Tensor] = []
        self.columns: tuple[Tensor, ...] = ()
        self._made: dict[int, Any] = {}
        self._known: dict[int, _Place] = {}

    def take(self, value: Any) -> Any:
        """Return a place in place of a tensor of the rows."""
        if (
            not isinstance(value, Tensor)
            or isinstance(value, RowNumbers)
            or _values(value, self.level) is None
        ):
            return value
        if id(value) not in self._known:
            self._known[id(value)] = _Place(len(self.tensors))
            self.tensors.append(value)
        return self._known[id(value)]

    def put(self, value: Any) -> Any:
        """Return the numbers of all rows in place of a place."""
        if not isinstance(value, _Place):
            return value
        if value.at not in self._made:
            self._made[value.at] = _numbers(self.columns[value.at])
        return self._made[value.at]


def _numbers(column: Tensor) -> Tensor:
    """Return numbers of rows; integers and flags as they are in all rows."""
    if column.is_floating_point():
        return RowNumbers(column.detach())
    if not bool((column == column[:1]).all()):
        raise _AloneError  # whoever merges the rows says where they differ
    return column[0].clone()


def changed(value: Any, change: Callable[[Any], Any], known: dict[int, Any] | None = None) -> Any:
    """Return a value in which ``change`` has replaced what it is or holds: objects, containers, closures."""
    known = {} if known is None else known
    new = change(value)
    if new is not value or isinstance(value, (*_ATOMS, Tensor)):
        return new
    if id(value) in known:
        return known[id(value)]
    known[id(value)] = value
    inside = functools.partial(changed, change=change, known=known)
    if isinstance(value, dict):
        _change_dict(value, inside)
    elif isinstance(value, list):
        for k, part in enumerate(value):
            value[k] = inside(part)
    elif isinstance(value, tuple):
        parts = [inside(part) for part in value]
        if any(new is not old for new, old in zip(parts, value, strict=True)):
            known[id(value)] = type(value)(*parts) if hasattr(value, "_fields") else type(value)(parts)
    elif isinstance(value, FunctionType):
        for cell in value.__closure__ or ():
            content = content_of(cell)
            if content is not EMPTY and (new := inside(content)) is not content:
                cell.cell_contents = new
        value.__defaults__ = inside(value.__defaults__)
        inside(value.__kwdefaults__)
    elif isinstance(value, MethodType):
        inside(value.__self__)
    elif isinstance(value, functools.partial):
        state = value.func, value.args, value.keywords
        new = tuple(inside(part) for part in state)
        if any(one is not other for one, other in zip(new, state, strict=True)):
            known[id(value)] = functools.partial(new[0], *new[1], **new[2])
    elif isinstance(value, Derived):
        before: Any = value.__getstate__()
        after = {key: inside(part) for key, part in before.items()}
        if any(after[key] is not before[key] for key in before):
            known[id(value)] = type(value)(**after)
    elif hasattr(value, "__dict__"):
        _change_dict(vars(value), inside)
    return known[id(value)]


def _change_dict(value: dict[Any, Any], inside: Callable[[Any], Any]) -> None:
    for key in [key for key in value if key != BOUND]:
        new = inside(value[key])
        if new is not value[key]:
            value[key] = new

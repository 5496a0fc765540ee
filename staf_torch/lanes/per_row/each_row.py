"""Functions without arguments that run once a row, where they read numbers of a row's own."""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar

import torch
from torch import Tensor

from ..row_numbers import RowNumbers, RowsMetError, column_of, columns, in_use, refuse, resolving

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

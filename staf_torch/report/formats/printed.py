"""What a table to be read shows: few digits, mean and spread in one column, the best of a column marked."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from json import dumps

from ..overrides import Value
from ..table import Column, Table

_LARGER_IS_BETTER = frozenset({"regulated_fraction"})
_SPREADS = ("std", "ci95")
_COUNTS = ("n", "failed")
_HIDDEN = ("directory", "reasons")  # long, and said in the notes


@dataclasses.dataclass(frozen=True)
class Style:
    """How numbers are shown.

    Args:
        digits: significant ones.
        bold: the best number of each column is bold.
    """

    digits: int = 3
    bold: bool = False


@dataclasses.dataclass(frozen=True)
class Number:
    """A number, maybe with what stands behind a plus-minus sign."""

    value: float
    spread: float | None = None


@dataclasses.dataclass(frozen=True)
class PrintedColumn:
    """A column as it is read."""

    heading: str
    over: str  # the heading above that it shares with its neighbours; empty: none
    cells: tuple[Number | str | None, ...]
    best: frozenset[int] = frozenset()  # rows

    @property
    def numeric(self) -> bool:
        """Whether no cell is a text."""
        return not any(isinstance(cell, str) for cell in self.cells)


def printed(table: Table, show: Callable[[Number], str], style: Style) -> list[PrintedColumn]:
    """The columns as they are read.

    Args:
        table: the table.
        show: a number as the format writes it; cells that look the same as the best one are best too.
        style: how.
    """
    found = []
    for column in table.columns:
        if column.metric is None and column.name not in _HIDDEN:
            found.append(PrintedColumn(column.name, "", _plain(table, column.name)))
        elif column.metric is not None and column.statistic is None:
            cells = _plain(table, column.name)
            found.append(PrintedColumn(column.name, "", cells, _best(cells, column.metric, show, style)))
    if not table.aggregated:
        return _status_only_if_it_says_something(found)
    return found + list(_aggregated(table, show, style)) + _counts(table)


def _status_only_if_it_says_something(found: list[PrintedColumn]) -> list[PrintedColumn]:
    return [c for c in found if c.heading != "status" or set(c.cells) != {"completed"}]


def _plain(table: Table, name: str) -> tuple[Number | str | None, ...]:
    return tuple(_cell(row.cells.get(name)) for row in table.rows)


def _cell(value: Value) -> Number | str | None:
    if isinstance(value, bool | list):
        return dumps(value)
    return Number(value) if isinstance(value, int | float) else value


def _aggregated(table: Table, show: Callable[[Number], str], style: Style) -> Iterator[PrintedColumn]:
    """One column for each metric, place and statistic; the spread joins the mean."""
    for metric, at in dict.fromkeys((c.metric, c.at) for c in table.columns if c.metric is not None):
        assert metric is not None
        here = {c.statistic: c for c in table.columns if (c.metric, c.at) == (metric, at)}
        spread = next((here[name] for name in _SPREADS if name in here and "mean" in here), None)
        shown = [c for name, c in here.items() if name not in _COUNTS and c is not spread]
        for column in shown:
            joined = spread if column.statistic == "mean" else None
            cells = tuple(_joined(row.cells, column, joined) for row in table.rows)
            what = _what(table, column, joined)
            best = _best(cells, metric, show, style)
            if not at:
                yield PrintedColumn(", ".join(filter(None, (metric, what))), "", cells, best)
            elif len(shown) > 1:
                yield PrintedColumn(", ".join(filter(None, (at, what))), metric, cells, best)
            else:
                yield PrintedColumn(at, ", ".join(filter(None, (metric, what))), cells, best)


def _what(table: Table, column: Column, spread: Column | None) -> str:
    """The statistic; nothing for the mean where no row has more than one run."""
    assert column.statistic is not None
    if column.statistic == "mean" and spread is not None:
        return f"mean ± {spread.statistic}"
    runs = (row.cells[c.name] for row in table.rows for c in table.columns if c.statistic == "n")
    single = all(count == 0 or count == 1 for count in runs)
    return "" if single and column.statistic == "mean" else column.statistic


def _joined(cells: Mapping[str, Value], column: Column, spread: Column | None) -> Number | None:
    value = cells.get(column.name)
    if not isinstance(value, int | float):
        return None
    width = cells.get(spread.name) if spread is not None else None
    return Number(value, width if isinstance(width, int | float) else None)


def _counts(table: Table) -> list[PrintedColumn]:
    """Over how many runs a number of the row is, `4-5` where they differ, and how many runs gave none."""
    found = []
    for count in _COUNTS:
        names = [c.name for c in table.columns if c.statistic == count]
        cells = [_range([row.cells[name] for name in names]) for row in table.rows]
        if count == "n" or any(cell != Number(0) for cell in cells):
            found.append(PrintedColumn(count, "", tuple(cells)))
    return found


def _range(counts: Sequence[Value]) -> Number | str:
    whole = [count for count in counts if isinstance(count, int)]
    least, most = min(whole), max(whole)
    return Number(least) if least == most else f"{least}-{most}"


def _best(
    cells: Sequence[Number | str | None], metric: str, show: Callable[[Number], str], style: Style
) -> frozenset[int]:
    numbers = [cell for cell in cells if isinstance(cell, Number)]
    if not style.bold or len(numbers) < 2:
        return frozenset()
    larger = metric in _LARGER_IS_BETTER
    best = (max if larger else min)(numbers, key=lambda number: number.value)
    alike = show(Number(best.value))
    same = [i for i, c in enumerate(cells) if isinstance(c, Number) and show(Number(c.value)) == alike]
    return frozenset(same)


def significant(number: float, digits: int) -> str:
    """So many digits; small whole numbers as they are."""
    if isinstance(number, int) or (number == round(number) and abs(number) < 1e6):
        return str(round(number))
    return f"{number:.{digits}g}"

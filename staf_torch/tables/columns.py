"""Columns of a table, and what they show to people: few digits, mean and spread in one, the best marked."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from json import dumps

from ..results.reader import Value
from ..results.run import CLASS_PATH, class_name

_Cells = tuple["Number | str | None", ...]
_SPREADS = ("std", "ci95")
_COUNTS = ("n", "failed")


@dataclasses.dataclass(frozen=True)
class Column:
    """A column of plain values."""

    name: str  # unique: `centers.radius`, `ball_error`, `ball_error.mean`, `ball_error.mean[centers.count=3]`
    metric: str | None = None  # of which it is a number; None: a setting, or something about the run
    statistic: str | None = None  # over the runs of the row; `n` and `failed` count them
    at: str = ""  # `centers.count=3` where the metric is spread over columns
    heading: str = ""  # for people; empty: the name
    shown: bool = True  # False: for programs alone
    larger_is_better: bool = False  # of the metric


@dataclasses.dataclass(frozen=True)
class Row:
    """A row: a run, or the runs that agree in the settings of the row."""

    cells: Mapping[str, Value]  # by the names of the columns
    reasons: Mapping[str, str] = dataclasses.field(default_factory=dict)  # name of a column -> why it is None
    # name of a column -> share of the runs and trajectories that its number does not speak of
    lost: Mapping[str, float] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class Style:
    """Style of printed numbers.

    Example:
        >>> Style(digits=2, bold=True)
        Style(digits=2, bold=True)

        Shown by `staf-table runs --best bold --digits 2`.

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
    name: str = ""  # of the setting or the metric
    metric: bool = False
    at: str = ""  # `centers.count=3` where a metric is spread over columns
    what: str = ""  # `mean ± std`, `max`: what of several runs

    @functools.cached_property
    def numeric(self) -> bool:
        """Return whether no cell is a text."""
        return not any(isinstance(cell, str) for cell in self.cells)


def significant(number: float | None, digits: int = 3) -> str:
    """Return a number with so many digits, small whole ones as they are, None as a dash."""
    if number is None:
        return "-"
    if isinstance(number, int) or (math.isfinite(number) and number == round(number) and abs(number) < 1e6):
        return str(round(number))
    return f"{number:.{digits}g}"


def show(number: Number, digits: int) -> str:
    """Return a number and its spread as text."""
    text = significant(number.value, digits)
    return text if number.spread is None else f"{text} ± {significant(number.spread, 2)}"


def _classes(name: str, cells: _Cells) -> _Cells:
    """Return what a setting such as `kernel.path` names without the modules, where the classes differ."""
    if not name.endswith(CLASS_PATH):
        return cells
    short = {cell: class_name(cell) for cell in cells if isinstance(cell, str)}
    unique = len(set(short.values())) == len(short)
    return tuple(short[cell] if unique and isinstance(cell, str) else cell for cell in cells)


def printed(columns: Sequence[Column], rows: Sequence[Row], style: Style) -> list[PrintedColumn]:
    """Return the columns as they are read."""
    found = []
    for column in columns:
        cells = _classes(column.name, tuple(_cell(row.cells.get(column.name)) for row in rows))
        if column.shown and column.statistic is None:
            best = _best(cells, column, rows, style)
            name = "" if column.heading else column.name
            measured = column.metric is not None
            found.append(PrintedColumn(column.heading or column.name, "", cells, best, name, measured))
    if any(column.statistic is not None for column in columns):
        return [*found, *_aggregated(columns, rows, style), *_counts(columns, rows)]
    return [c for c in found if c.heading != "status" or set(c.cells) != {"completed"}]  # which says nothing


def _cell(value: Value) -> Number | str | None:
    if isinstance(value, bool | list):
        return dumps(value)
    return Number(value) if isinstance(value, int | float) else value


def _aggregated(columns: Sequence[Column], rows: Sequence[Row], style: Style) -> Iterator[PrintedColumn]:
    """Yield a column for each metric, place and statistic; the spread joins the mean."""
    runs = [row.cells[column.name] for row in rows for column in columns if column.statistic == "n"]
    single = all(count in (0, 1) for count in runs)
    places: dict[tuple[str, str], dict[str | None, Column]] = {}
    for column in columns:
        if column.metric is not None:
            places.setdefault((column.metric, column.at), {})[column.statistic] = column
    for (metric, at), here in places.items():
        spread = next((here[name] for name in _SPREADS if name in here and "mean" in here), None)
        shown = [c for name, c in here.items() if name not in _COUNTS and c is not spread]
        for column in shown:
            joined = spread if column.statistic == "mean" else None
            what = "" if single and column.statistic == "mean" else str(column.statistic)
            what = f"mean ± {joined.statistic}" if joined is not None else what
            cells = tuple(_joined(row.cells, column, joined) for row in rows)
            alone = at and len(shown) == 1  # the statistic joins the heading above
            heading = ", ".join(filter(None, (at or metric, "" if alone else what)))
            over = ", ".join(filter(None, (metric, what if alone else ""))) if at else ""
            yield PrintedColumn(
                heading, over, cells, _best(cells, column, rows, style), metric, True, at, what
            )


def _joined(cells: Mapping[str, Value], column: Column, spread: Column | None) -> Number | None:
    value = cells.get(column.name)
    if not isinstance(value, int | float):
        return None
    width = cells.get(spread.name) if spread is not None else None
    return Number(value, width if isinstance(width, int | float) else None)


def _counts(columns: Sequence[Column], rows: Sequence[Row]) -> Iterator[PrintedColumn]:
    """Over how many runs a number of the row is, `4-5` where they differ, and how many runs gave none."""
    for count in _COUNTS:
        names = [column.name for column in columns if column.statistic == count]
        cells = tuple(_range([row.cells[name] for name in names]) for row in rows)
        if count == "n" or any(cell != Number(0) for cell in cells):
            yield PrintedColumn(count, "", cells, name=count)


def _range(counts: Sequence[Value]) -> Number | str:
    whole = [count for count in counts if isinstance(count, int)]
    least, most = min(whole), max(whole)
    return Number(least) if least == most else f"{least}-{most}"


def _best(
    cells: Sequence[Number | str | None], column: Column, rows: Sequence[Row], style: Style
) -> frozenset[int]:
    """The rows of the best number and of all that look the same, among those that lost the least."""
    values = {k: c.value for k, c in enumerate(cells) if isinstance(c, Number) and not math.isnan(c.value)}
    if column.metric is None or not style.bold or len(values) < 2:
        return frozenset()
    lost = {k: rows[k].lost.get(column.name, 0.0) for k in values}
    values = {k: value for k, value in values.items() if lost[k] == min(lost.values())}
    chosen: Callable[..., float] = max if column.larger_is_better else min
    best = significant(chosen(values.values()), style.digits)
    return frozenset(k for k, value in values.items() if significant(value, style.digits) == best)

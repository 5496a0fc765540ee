"""Runs to a table: one row a run, or one row and its statistics for all runs that agree in some settings."""

from __future__ import annotations

import dataclasses
import difflib
import functools
import math
import statistics
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TypeVar

from ..numerics import TABLE_COMMAND, fail
from ..results.files import COMPLETED, grouped, is_number, visible
from ..results.reader import Collection, RecordedRun, Value, identity
from ..results.run import OWN, as_text
from .model import Column, Row, Style, Table

T = TypeVar("T")
_SERIES = 200  # degrees of freedom from which the expansion is more accurate than 1e-12
_MOST = 6  # metrics that a table shows where none is declared a headline
_NAMED = 3  # runs without a result that a note names
_SEED = "seed"
_ASCENDING, _DESCENDING = ":asc", ":desc"


def mean(numbers: Sequence[float]) -> float:
    """The arithmetic mean."""
    return math.fsum(number / len(numbers) for number in numbers)


def deviation(numbers: Sequence[float]) -> float | None:
    """The standard deviation with n - 1; None for a single number."""
    if len(numbers) < 2:
        return None
    middle = mean(numbers)
    found = math.hypot(*(number - middle for number in numbers)) / math.sqrt(len(numbers) - 1)
    return found if found > 2 * sys.float_info.epsilon * abs(middle) else 0.0  # rounding of the mean


def half_width(numbers: Sequence[float]) -> float | None:
    """Half the width of the 95 % confidence interval of the mean, t s / sqrt(n); None for a single number."""
    s, n = deviation(numbers), len(numbers)
    return None if s is None else student_quantile(n - 1) * s / math.sqrt(n)


AGGREGATES: Mapping[str, Callable[[Sequence[float]], float | None]] = {
    "mean": mean,
    "std": deviation,
    "ci95": half_width,
    "min": min,
    "max": max,
    "median": statistics.median,
}
"""By the names of `staf-table --aggregate`; each of one or more finite numbers."""


@functools.cache
def student_quantile(freedom: int) -> float:
    """t with P(|T| <= t) = 0.95 for Student's T with that many degrees of freedom, at least 1.

    With theta = atan(t / sqrt(freedom)) the probability is a finite sum of sin(theta) cos(theta)^k, which is
    solved by bisection; for many degrees of freedom, the expansion around the normal quantile.

    Source: Abramowitz and Stegun, 26.7.3, 26.7.4 and 26.7.5.
    """
    if freedom >= _SERIES:
        return _expansion(freedom)
    low, high = 0.0, math.pi / 2
    while True:
        theta = (low + high) / 2
        if theta in (low, high):
            return math.tan(theta) * math.sqrt(freedom)
        if _probability(theta, freedom) < 0.95:
            low = theta
        else:
            high = theta


def _probability(theta: float, freedom: int) -> float:
    """P(|T| <= sqrt(freedom) tan(theta))."""
    odd = freedom % 2
    cosine = math.cos(theta)
    term = math.sin(theta) * (cosine if odd else 1.0)
    terms = []
    for k in range(1 + odd, freedom, 2):  # the next factor is k / (k + 1) cos^2
        terms.append(term)
        term *= k / (k + 1) * cosine**2
    total = math.fsum(terms)
    return 2 / math.pi * (theta + total) if odd else total


def _expansion(freedom: int) -> float:
    x = statistics.NormalDist().inv_cdf(0.975)
    terms = (
        x,
        (x**3 + x) / 4,
        (5 * x**5 + 16 * x**3 + 3 * x) / 96,
        (3 * x**7 + 19 * x**5 + 17 * x**3 - 15 * x) / 384,
        (79 * x**9 + 776 * x**7 + 1482 * x**5 - 1920 * x**3 - 945 * x) / 92160,
    )
    return math.fsum(term / freedom**k for k, term in enumerate(terms))


@dataclasses.dataclass(frozen=True)
class Layout:
    """Layout of a table: the options of `staf-table`.

    Example:
        >>> Layout(rows=("kernel",), metrics=("ball_error",), sort=("ball_error:desc",)).rows
        ('kernel',)

        Shown by `staf-table runs --rows kernel --metric ball_error`.

    Args:
        rows: settings that tell rows apart; empty: all that were swept (without the seed where aggregated).
        columns: settings whose values become columns of each metric.
        metrics: empty: those that are declared headlines, or all of them.
        aggregates: of `AGGREGATES`; empty: none, or mean and std where a row stands for several runs.
        sort: names of columns, the best of a metric first; `:asc` the smallest, `:desc` the largest.
        every_metric: all metrics where none is named.
        style: how people see it.
    """

    rows: tuple[str, ...] = ()
    columns: tuple[str, ...] = ()
    metrics: tuple[str, ...] = ()
    aggregates: tuple[str, ...] = ()
    sort: tuple[str, ...] = ()
    every_metric: bool = False
    style: Style = dataclasses.field(default_factory=Style)


def tabulate(found: Collection, layout: Layout | None = None) -> Table:
    """Return the table of some runs.

    Example:
        >>> done = sweep("centers.radius=0.1,0.2", "duration=0.1", "settle_time=0", "figures=false")
        >>> table = tabulate(collect(done[0].directory.parent), Layout(metrics=("ball_error",)))
        >>> [column.name for column in table.columns][:2]
        ['centers.radius', 'ball_error']

        Shown by `staf-table runs`.

    Raises:
        ValueError: for a metric, setting or aggregate that there is not; the message lists those that exist.
    """
    layout = Layout() if layout is None else layout
    _check(found, layout)
    metrics = layout.metrics or _metrics(found, layout.every_metric)
    if layout.rows or layout.columns or layout.aggregates:
        table = _grouped(found, layout, metrics)
    else:
        table = _one_a_run(found, metrics)
    rows = _sorted(table, layout.sort)
    notes = (*table.notes, *_without_effect(found))
    return dataclasses.replace(table, rows=tuple(rows), notes=notes, style=layout.style)


def _without_effect(found: Collection) -> Iterator[str]:
    """Yield a note for each swept setting that changed no metric, all others being equal."""
    runs = [(run, frozenset(run.metrics.items())) for run in found.rows if run.metrics]
    values = {key: [identity(run.value(key)) for run, _ in runs] for key in found.swept}
    for key in found.swept:
        groups: dict[tuple[str, ...], tuple[set[str], set[frozenset[tuple[str, float | None]]]]] = {}
        others = [values[other] for other in found.swept if other != key]
        for value, (_, metrics), *rest in zip(values[key], runs, *others, strict=True):
            here, there = groups.setdefault(tuple(rest), (set(), set()))
            here.add(value)
            there.add(metrics)
        compared = [group for group in groups.values() if len(group[0]) > 1]
        if compared and all(len(metrics) == 1 for _, metrics in compared):
            yield f"`{key}` was swept and changed no metric in any row."


def _check(found: Collection, layout: Layout) -> None:
    settings = sorted(set(found.keys))
    for option, names, known in (
        ("rows", layout.rows, settings),
        ("columns", layout.columns, settings),
        ("metric", layout.metrics, list(found.metrics)),
        ("aggregate", layout.aggregates, list(AGGREGATES)),
    ):
        for name in names:
            if name not in known:
                raise fail(TABLE_COMMAND, option, _one_of(known, name), name)


def _one_of(known: Sequence[str], name: str) -> str:
    """Return the rule of a name: one of those that are known, the near ones first."""
    near = [each for each in known if each.endswith(f".{name}")] or difflib.get_close_matches(name, known)
    order = dict.fromkeys((*near, *known))
    return f"must be one of {', '.join(order)}" if known else "cannot be chosen: no run has any"


def _metrics(found: Collection, every: bool) -> tuple[str, ...]:
    """All metrics, or the headlines: the library's own as they are declared, then those of the user's own."""
    own = [info.name for info in OWN]
    ordered = sorted(found.metrics, key=lambda name: own.index(name) if name in own else len(own))
    headlines = tuple(name for name in ordered if found.infos[name].headline)
    return found.metrics if every else headlines or found.metrics[:_MOST]


def _one_a_run(found: Collection, metrics: Sequence[str]) -> Table:
    troubled = any(run.status != COMPLETED or run.reason is not None for run in found.rows)
    about = ("status", "reason") if troubled else ("status",)
    larger = {name for name, info in found.infos.items() if info.larger_is_better}
    columns = [Column(name) for name in found.swept]
    columns += [Column(name, metric=name, larger_is_better=name in larger) for name in metrics]
    columns += [*map(Column, about), Column("directory", shown=False)]
    if any(run.row is not None for run in found.rows):
        columns.append(Column("row"))
    rows = []
    for run in found.rows:
        cells = {c.name: run.metrics.get(c.name) if c.metric else run.value(c.name) for c in columns}
        reasons = {name: run.absence(name) for name in metrics if cells[name] is None}
        rows.append(Row(cells, reasons, {name: lost_share(run, name) for name in metrics}))
    return Table(tuple(columns), tuple(rows))


def _grouped(found: Collection, layout: Layout, metrics: Sequence[str]) -> Table:
    # Runs of different settings or builds never share a row, whatever was asked for.
    keys = layout.rows or tuple(key for key in found.swept if key not in (*layout.columns, _SEED))
    keys += tuple(key for key in found.unswept if key not in (*keys, *layout.columns))
    groups = _groups(found.rows, keys)
    places = {place(run, layout.columns): [run.value(key) for key in layout.columns] for run in found.rows}
    spread = sorted(places, key=lambda at: [rank(value) for value in places[at]])
    several = any(len(group) > 1 for group in _groups(found.rows, (*keys, *layout.columns)).values())
    aggregates = layout.aggregates or (("mean", "std") if several else ("mean",))
    columns = [Column(key) for key in keys]
    for metric in metrics:
        larger = found.infos[metric].larger_is_better
        for at in spread:
            inside = f"[{at}]" if at else ""
            columns += [
                Column(f"{metric}.{statistic}{inside}", metric, statistic, at, larger_is_better=larger)
                for statistic in (*aggregates, "n", "failed")
            ]
    columns.append(Column("reasons", shown=False))
    rows = [_row(group, keys, layout.columns, columns) for group in groups.values()]
    return Table(tuple(columns), tuple(rows), tuple(_notes(found.rows)))


def _groups(runs: Sequence[RecordedRun], keys: Sequence[str]) -> Mapping[tuple[str, ...], list[RecordedRun]]:
    return grouped(runs, lambda run: tuple(identity(run.value(key)) for key in keys))


def place(run: RecordedRun, keys: Sequence[str]) -> str:
    """Return where a run stands among the columns: `key=value` of each."""
    return ", ".join(f"{key}={as_text(run.value(key))}" for key in keys)


def rank(value: Value) -> tuple[bool, float]:
    """Return a sorting key: numbers in order, everything else after them as it came."""
    return (False, float(value)) if is_number(value) else (True, 0.0)


def _row(
    runs: Sequence[RecordedRun], keys: Sequence[str], spread: Sequence[str], columns: Sequence[Column]
) -> Row:
    cells: dict[str, Value] = {key: runs[0].value(key) for key in keys}
    reasons: dict[str, str] = {}
    lost: dict[str, float] = {}
    places = grouped(runs, lambda run: place(run, spread))
    for column in columns:
        if column.metric is None or column.statistic is None:
            continue
        here = places.get(column.at, [])
        numbers = [n for run in here if (n := run.metrics.get(column.metric)) is not None]
        if column.statistic in ("n", "failed"):
            cells[column.name] = len(numbers) if column.statistic == "n" else len(here) - len(numbers)
            continue
        lost[column.name] = mean([lost_share(run, column.metric) for run in here])
        cells[column.name] = AGGREGATES[column.statistic](numbers) if numbers else None
        if cells[column.name] is None:
            absent = dict.fromkeys(
                run.absence(column.metric) for run in here if run.metrics.get(column.metric) is None
            )
            several = "needs two runs or more" if here else "there is no such run"
            reasons[column.name] = "; ".join(absent) or several
    metrics = dict.fromkeys(column.metric for column in columns if column.metric is not None)
    missing = (run.absence(metric) for run in runs for metric in metrics if run.metrics.get(metric) is None)
    cells["reasons"] = "; ".join(dict.fromkeys(missing)) or None
    return Row(cells, reasons, lost)


def lost_share(run: RecordedRun, metric: str) -> float:
    """Return the share of a run's trajectories that a metric does not speak of: 1 where it is missing."""
    return 1.0 if run.metrics.get(metric) is None else run.metrics.get("diverged_fraction") or 0.0


def _notes(runs: Sequence[RecordedRun]) -> Iterator[str]:
    """Yield a note for each reason for which runs have no result, or a reader should look twice."""
    troubled = [run for run in runs if run.reason is not None]
    for (status, reason), those in grouped(troubled, lambda run: (run.status, run.reason)).items():
        shown = ", ".join(visible(str(run.directory)) for run in those[:_NAMED])
        more = f" and {len(those) - _NAMED} more" if len(those) > _NAMED else ""
        yield f"{len(those)} of {len(runs)} {status}: {reason} (in {shown}{more})"


def _sorted(table: Table, names: Sequence[str]) -> list[Row]:
    """By columns, the first counts most."""
    rows = list(table.rows)
    for name in reversed(names):  # stable: the last sort is by the first name
        column, largest = _column(table, name.removesuffix(_ASCENDING).removesuffix(_DESCENDING))
        descending = name.endswith(_DESCENDING) or (largest and not name.endswith(_ASCENDING))
        rows = in_order(rows, lambda row: row.cells.get(column), descending=descending)  # noqa: B023 (at once)
    return rows


def in_order(items: Sequence[T], value: Callable[[T], Value], *, descending: bool) -> list[T]:
    """Return items by a value: numbers before texts, what is missing last in either direction."""

    def key(item: T) -> tuple[bool, float, str]:
        found = value(item)
        return (False, float(found), "") if isinstance(found, int | float) else (True, 0.0, str(found))

    missing = [item for item in items if value(item) is None or value(item) != value(item)]  # None or NaN
    present = [item for item in items if value(item) is not None and value(item) == value(item)]
    return sorted(present, key=key, reverse=descending) + missing


def _column(table: Table, name: str) -> tuple[str, bool]:
    """The column of that name, or the first of that metric, and whether its largest number is the best."""
    for column in sorted(table.columns, key=lambda column: column.name != name):
        if name in (column.name, column.metric):
            return column.name, column.larger_is_better
    raise fail(TABLE_COMMAND, "sort", _one_of(table.names, name), name)

"""Runs to a table: one row a run, or one row for all runs that agree in some settings."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator, Mapping, Sequence

from .._wording import TABLE_COMMAND, fail
from .collection import Collection, identity
from .overrides import Value
from .run import COMPLETED, Run
from .sorting import sort_rows
from .statistics import AGGREGATES
from .table import Column, Row, Table

HEADLINES = (
    "ball_error",
    "ball_floor_error",
    "gradient_error",
    "cost",
    "cost_ratio",
    "regulated_fraction",
)
"""The metrics that a table to be read shows where none is named: those of them that there are."""
_MOST = 6  # else so many of the first ones
_NAMED = 3  # runs without a result that a note names
_SEED = "seed"


@dataclasses.dataclass(frozen=True)
class Layout:
    """What a table shall show; the options of `staf-table`.

    Args:
        rows: settings that tell rows apart; empty: all that were swept (without the seed where aggregated).
        columns: settings over whose values a metric is spread.
        metrics: empty: the `HEADLINES`, or all of them.
        aggregates: of `AGGREGATES`; empty: none, or mean and std where a row stands for several runs.
        sort: names of columns, each maybe with `:desc`.
        every_metric: all metrics where none is named.
    """

    rows: tuple[str, ...] = ()
    columns: tuple[str, ...] = ()
    metrics: tuple[str, ...] = ()
    aggregates: tuple[str, ...] = ()
    sort: tuple[str, ...] = ()
    every_metric: bool = False


def tabulate(found: Collection, layout: Layout | None = None) -> Table:
    """The table of some runs.

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
    return sort_rows(table, layout.sort)


def _check(found: Collection, layout: Layout) -> None:
    settings = sorted(found.keys)
    for option, names, known in (
        ("rows", layout.rows, settings),
        ("columns", layout.columns, settings),
        ("metric", layout.metrics, list(found.metrics)),
        ("aggregate", layout.aggregates, list(AGGREGATES)),
    ):
        for name in names:
            if name not in known:
                raise fail(TABLE_COMMAND, option, _one_of(known), name)


def _one_of(known: Sequence[str]) -> str:
    return f"must be one of {', '.join(known)}" if known else "cannot be chosen: no run has any"


def _metrics(found: Collection, every: bool) -> tuple[str, ...]:
    headlines = tuple(name for name in HEADLINES if name in found.metrics)
    return found.metrics if every else headlines or found.metrics[:_MOST]


def _one_a_run(found: Collection, metrics: Sequence[str]) -> Table:
    troubled = any(run.status != COMPLETED or run.reason is not None for run in found.rows)
    about = ("status", "reason") if troubled else ("status",)
    columns = [Column(name) for name in found.swept] + [Column(name, metric=name) for name in metrics]
    columns += [Column(name) for name in (*about, "directory")]
    if any(run.member is not None for run in found.rows):
        columns.append(Column("member"))
    rows = []
    for run in found.rows:
        cells = {c.name: run.metrics.get(c.name) if c.metric else run.value(c.name) for c in columns}
        reasons = {name: run.absence(name) for name in metrics if cells[name] is None}
        rows.append(Row(cells, reasons))
    return Table(tuple(columns), tuple(rows))


def _grouped(found: Collection, layout: Layout, metrics: Sequence[str]) -> Table:
    keys = layout.rows or tuple(key for key in found.swept if key not in (*layout.columns, _SEED))
    groups = _groups(found.rows, keys)
    spread = _places(found.rows, layout.columns)
    aggregates = layout.aggregates or _default(found.rows, (*keys, *layout.columns))
    columns = [Column(key) for key in keys]
    for metric in metrics:
        for at in spread:
            inside = f"[{at}]" if at else ""
            columns += [
                Column(f"{metric}.{statistic}{inside}", metric, statistic, at)
                for statistic in (*aggregates, "n", "failed")
            ]
    columns.append(Column("reasons"))
    rows = [_row(group, keys, layout.columns, columns) for group in groups.values()]
    return Table(tuple(columns), tuple(rows), tuple(_notes(found.rows)))


def _groups(runs: Sequence[Run], keys: Sequence[str]) -> Mapping[tuple[str, ...], list[Run]]:
    groups: dict[tuple[str, ...], list[Run]] = {}
    for run in runs:
        groups.setdefault(tuple(identity(run.value(key)) for key in keys), []).append(run)
    return groups


def _places(runs: Sequence[Run], keys: Sequence[str]) -> list[str]:
    """`key=value` of the columns over which a metric is spread: numbers in order, then what is not one."""
    first = {place(run, keys): [run.value(key) for key in keys] for run in runs}
    return sorted(first, key=lambda at: [rank(value) for value in first[at]])


def place(run: Run, keys: Sequence[str]) -> str:
    """Where a run stands among the columns."""
    return ", ".join(f"{key}={as_text(run.value(key))}" for key in keys)


def rank(value: Value) -> tuple[bool, float]:
    """Numbers in order; everything else after them, in the order in which it came."""
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return (not number, float(value) if number else 0.0)  # type: ignore[arg-type]


def as_text(value: Value) -> str:
    """A value as it would be typed."""
    return value if isinstance(value, str) else json.dumps(value)


def _default(runs: Sequence[Run], keys: Sequence[str]) -> tuple[str, ...]:
    several = any(len(group) > 1 for group in _groups(runs, keys).values())
    return ("mean", "std") if several else ("mean",)


def _row(runs: Sequence[Run], keys: Sequence[str], spread: Sequence[str], columns: Sequence[Column]) -> Row:
    cells: dict[str, Value] = {key: runs[0].value(key) for key in keys}
    reasons: dict[str, str] = {}
    for column in columns:
        if column.metric is None or column.statistic is None:
            continue
        here = [run for run in runs if place(run, spread) == column.at]
        numbers = [n for run in here if (n := run.metrics.get(column.metric)) is not None]
        if column.statistic in ("n", "failed"):
            cells[column.name] = len(numbers) if column.statistic == "n" else len(here) - len(numbers)
            continue
        cells[column.name] = AGGREGATES[column.statistic](numbers) if numbers else None
        if cells[column.name] is None:
            reasons[column.name] = _why(here, column.metric)
    cells["reasons"] = "; ".join(dict.fromkeys(_absences(runs, columns))) or None
    return Row(cells, reasons)


def _why(runs: Sequence[Run], metric: str) -> str:
    if not runs:
        return "there is no such run"
    absent = dict.fromkeys(run.absence(metric) for run in runs if run.metrics.get(metric) is None)
    return "; ".join(absent) or "needs two runs or more"


def _absences(runs: Sequence[Run], columns: Sequence[Column]) -> Iterator[str]:
    metrics = dict.fromkeys(column.metric for column in columns if column.metric is not None)
    for run in runs:
        for metric in metrics:
            if run.metrics.get(metric) is None:
                yield run.absence(metric)


def _notes(runs: Sequence[Run]) -> Iterator[str]:
    """One note for each reason for which runs have no result, or a reader should look twice."""
    reasons: dict[tuple[str, str], list[Run]] = {}
    for run in runs:
        if run.reason is not None:
            reasons.setdefault((run.status, run.reason), []).append(run)
    for (status, reason), those in reasons.items():
        shown = ", ".join(str(run.directory) for run in those[:_NAMED])
        more = f" and {len(those) - _NAMED} more" if len(those) > _NAMED else ""
        yield f"{len(those)} of {len(runs)} {status}: {reason} (in {shown}{more})"

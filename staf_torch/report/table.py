"""A table, whatever it will be printed as."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

from .overrides import Value


@dataclasses.dataclass(frozen=True)
class Column:
    """One column of plain values."""

    name: str  # unique: `centers.radius`, `ball_error`, `ball_error.mean`, `ball_error.mean[centers.count=3]`
    metric: str | None = None  # of which it is a number; None: a setting, or something about the run
    statistic: str | None = None  # over the runs of the row; `n` and `failed` count them
    at: str = ""  # `centers.count=3` where the metric is spread over columns


@dataclasses.dataclass(frozen=True)
class Row:
    """One row: a run, or the runs that agree in the settings of the row."""

    cells: Mapping[str, Value]  # by the names of the columns
    reasons: Mapping[str, str]  # why a cell is None, by the name of the column


@dataclasses.dataclass(frozen=True)
class Table:
    """What `tabulate` makes."""

    columns: tuple[Column, ...]
    rows: tuple[Row, ...]
    notes: tuple[str, ...] = ()  # runs without a result, and why

    @property
    def names(self) -> tuple[str, ...]:
        """Of the columns."""
        return tuple(column.name for column in self.columns)

    @property
    def aggregated(self) -> bool:
        """Whether a row stands for several runs."""
        return any(column.statistic is not None for column in self.columns)

"""The frame of experiments with methods beside each other: of each a row, metrics and a line of the log."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Mapping, Sequence
from typing import Any

from ..results.run_directory import RunDirectory
from ..tables import Style, Table
from ..tables.columns import significant
from .registry import Metrics, finite


class Comparison:
    """Collect what methods have reached, in the order of the table.

    Args:
        columns: of the table: name of a number or label -> heading.
        logged: numbers that the log shows.
        log: where the experiment logs.
    """

    def __init__(self, columns: Mapping[str, str], logged: Sequence[str], log: logging.Logger) -> None:
        self._columns, self._logged, self._log = dict(columns), tuple(logged), log
        self._rows: list[dict[str, Any]] = []
        self.metrics: Metrics = {}

    def add(self, prefix: str, measured: Mapping[str, float | None], **labels: str) -> None:
        """Add a method.

        Args:
            prefix: of its names in `metrics.json`; empty for the method that the experiment is about.
            measured: name -> number, or None where there is none.
            labels: what the row is called, by column.
        """
        self._rows.append(labels | dict(measured))
        self.metrics |= {prefix + name: finite(value) for name, value in measured.items()}
        shown = [f"{self._heading(name)} {significant(measured[name], 5)}" for name in self._logged]
        self._log.info("%s: %s", ", ".join(labels.values()), ", ".join(shown))

    def write(self, out: RunDirectory, name: str, digits: int | None = None) -> None:
        """Write the table, with so many digits."""
        table = Table.of(self._rows, self._columns)
        out.table(name, table if digits is None else dataclasses.replace(table, style=Style(digits=digits)))

    def _heading(self, name: str) -> str:
        return name.replace("_", " ")

"""The order of the rows."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from .._wording import TABLE_COMMAND, fail
from .overrides import Value
from .table import Row, Table

_DESCENDING = ":desc"


def sort_rows(table: Table, names: Sequence[str]) -> Table:
    """By columns, the first counts most; numbers before texts, what is missing last in either direction.

    Args:
        table: the table.
        names: of columns, or of a metric for its first column; with `:desc` the largest first.

    Raises:
        ValueError: for a column that there is not; the message lists those that exist.
    """
    rows = list(table.rows)
    for name in reversed(names):  # stable: the last sort is by the first name
        plain = name.removesuffix(_DESCENDING)
        column = _column(table, plain)
        present = [row for row in rows if row.cells.get(column) is not None]
        missing = [row for row in rows if row.cells.get(column) is None]
        present.sort(key=lambda row: _key(row, column), reverse=name.endswith(_DESCENDING))
        rows = present + missing
    return dataclasses.replace(table, rows=tuple(rows))


def _column(table: Table, name: str) -> str:
    for column in table.columns:
        if name == column.name:
            return name
    for column in table.columns:
        if name == column.metric:
            return column.name
    raise fail(TABLE_COMMAND, "sort", f"must be one of {', '.join(table.names)}", name)


def _key(row: Row, column: str) -> tuple[bool, float, str]:
    value: Value = row.cells[column]
    if isinstance(value, int | float):
        return (False, float(value), "")
    return (True, 0.0, str(value))

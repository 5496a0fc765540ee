"""CSV: every number with all its digits, what is missing as an empty cell."""

from __future__ import annotations

from json import dumps

from ..overrides import Value
from ..table import Table
from ..tables import Cell, csv_table


def csv_text(table: Table) -> str:
    """The table as CSV; `float` of a cell gives back the number to the last bit, lists are JSON."""
    rows = [{name: _cell(value) for name, value in row.cells.items()} for row in table.rows]
    return csv_table(rows, table.names)


def _cell(value: Value) -> Cell:
    return dumps(value) if isinstance(value, list | bool) else value

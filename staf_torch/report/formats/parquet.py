"""Parquet, through pandas and pyarrow."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from json import dumps
from typing import Any

from ..overrides import Value
from ..table import Table


def parquet_bytes(table: Table) -> bytes:
    """The table as a Parquet file; a column of several types becomes one of texts, a list becomes JSON.

    Raises:
        ValueError: without pandas and pyarrow.
    """
    try:
        import pandas
        import pyarrow  # noqa: F401 (pandas writes through it)
    except ImportError as error:
        raise ValueError(
            f"Parquet needs {error.name}: install the extra `tables`, pip install 'staf_torch[tables]'."
        ) from error
    columns = {
        c.name: _uniform([row.cells.get(c.name) for row in table.rows], c.metric is not None)
        for c in table.columns
    }
    buffer = io.BytesIO()
    pandas.DataFrame(columns).to_parquet(buffer, engine="pyarrow", index=False)
    return buffer.getvalue()


def _uniform(cells: Sequence[Value], number: bool) -> list[Any]:
    kinds = {bool if isinstance(cell, bool) else type(cell) for cell in cells if cell is not None}
    if kinds <= {int, float} and (kinds or number):
        return [math.nan if cell is None else cell for cell in cells]
    if kinds == {bool}:
        return list(cells)
    return [cell if cell is None or isinstance(cell, str) else dumps(cell) for cell in cells]

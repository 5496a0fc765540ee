"""Rows to text."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence

Cell = str | float | int | None
Row = Mapping[str, Cell]


def markdown_table(rows: Sequence[Row], headings: Mapping[str, str]) -> str:
    """A table in Markdown, its columns aligned as text too; three digits a number.

    Args:
        rows: one mapping a row; a missing or None cell is a dash.
        headings: key of the column to its heading, in order.
    """
    lines = [list(headings.values())] + [[_short(row.get(key)) for key in headings] for row in rows]
    width = [max(3, *(len(line[i]) for line in lines)) for i in range(len(headings))]
    number = [all(not isinstance(row.get(key), str) for row in rows) for key in headings]

    def show(cells: Sequence[str]) -> str:
        padded = [c.rjust(w) if n else c.ljust(w) for c, w, n in zip(cells, width, number, strict=True)]
        return "| " + " | ".join(padded) + " |\n"

    rule = ["-" * (w - 1) + ":" if n else "-" * w for w, n in zip(width, number, strict=True)]
    return show(lines[0]) + show(rule) + "".join(show(line) for line in lines[1:])


def csv_table(rows: Sequence[Row], columns: Sequence[str]) -> str:
    """The same as CSV, every number with all its digits, None as an empty cell."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    for row in rows:
        writer.writerow(["" if row.get(key) is None else row[key] for key in columns])
    return text.getvalue()


def _short(cell: Cell) -> str:
    if cell is None:
        return "-"
    if isinstance(cell, str):
        return cell.replace("|", "\\|")
    if isinstance(cell, int) or (math.isfinite(cell) and cell == round(cell) and abs(cell) < 1e6):
        return str(round(cell))
    return f"{cell:.3g}"

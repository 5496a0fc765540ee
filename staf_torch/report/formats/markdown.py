"""Markdown, aligned as text too."""

from __future__ import annotations

from collections.abc import Callable

from ..table import Table
from .printed import Number, PrintedColumn, Style, printed, significant


def markdown_text(table: Table, style: Style = Style()) -> str:  # noqa: B008 (it cannot change)
    """The table, then a line for each reason for which runs have no result."""

    def show(number: Number) -> str:
        text = significant(number.value, style.digits)
        return text if number.spread is None else f"{text} ± {significant(number.spread, 2)}"

    columns = printed(table, show, style)
    over = {column.over for column in columns if column.over}
    title = f"{_escaped(over.pop())}\n\n" if len(over) == 1 else ""
    headings = [_escaped(f"{c.over}, {c.heading}" if c.over and not title else c.heading) for c in columns]
    lines = [[_cell(c, i, show) for c in columns] for i in range(len(table.rows))]
    widths = [max(3, *(len(line[k]) for line in [headings, *lines])) for k in range(len(columns))]

    def joined(cells: list[str]) -> str:
        aligned = zip(cells, widths, columns, strict=True)
        return "| " + " | ".join(t.rjust(w) if c.numeric else t.ljust(w) for t, w, c in aligned) + " |\n"

    rule = ["-" * (w - 1) + ":" if c.numeric else "-" * w for w, c in zip(widths, columns, strict=True)]
    notes = "".join(f"\n{_escaped(note)}\n" for note in table.notes)
    return title + joined(headings) + joined(rule) + "".join(joined(line) for line in lines) + notes


def _cell(column: PrintedColumn, row: int, show: Callable[[Number], str]) -> str:
    cell = column.cells[row]
    if cell is None:
        return "-"
    if isinstance(cell, str):
        return _escaped(cell)
    text = show(cell)
    return f"**{text}**" if row in column.best else text


def _escaped(text: str) -> str:
    """On one line, without what would end the cell, begin a tag, or stay open; code in `backquotes` stays."""
    special = "|<" if text.count("`") % 2 == 0 and "`" in text else "\\|<*`"
    return "".join(f"\\{c}" if c in special else c for c in " ".join(text.split()))

"""A table: rows of plain values, as Markdown and HTML for people, as CSV, JSON and Parquet for programs."""

from __future__ import annotations

import csv
import dataclasses
import html
import importlib
import io
import math
import re
from collections.abc import Callable, Mapping, Sequence
from json import dumps
from typing import Any

from ..results.reader import Value
from ..results.untrusted import visible
from .columns import Column, Number, PrintedColumn, Row, Style, printed, show

_LINK = re.compile(r"\]\s*[(\[:]")
# What a spreadsheet computes, wide letters too.
_FORMULA = re.compile("\\s*[=+\\-@|%\uff1d\uff0b\uff0d\uff20]|[\\t\\r]")
_BLOCK = re.compile(r"^(?:#{1,6} |> ?|[-+=~]{3,}|[-+] )")  # of Markdown, at the begin of a line


@dataclasses.dataclass(frozen=True)
class Table:
    """Rows of values under columns, and how people see them.

    Example:
        >>> done = sweep("centers.radius=0.1,0.2", "duration=0.1", "settle_time=0", "figures=false")
        >>> print(done.table(metrics=("ball_error",)).csv().splitlines()[0])
        centers.radius,ball_error,status,directory

        Shown by `staf-table runs`.
    """

    columns: tuple[Column, ...]
    rows: tuple[Row, ...]
    notes: tuple[str, ...] = ()  # runs without a result, and why
    style: Style = dataclasses.field(default_factory=Style)

    @classmethod
    def of(cls, rows: Sequence[Mapping[str, Value]], headings: Mapping[str, str] | None = None) -> Table:
        """Return a table of rows that have been computed.

        Args:
            rows: one mapping a row; a missing cell is None.
            headings: key of a column to its heading, in order; None: the keys themselves, all of them.
        """
        named = headings or {key: "" for row in rows for key in row}
        columns = tuple(Column(key, heading=heading) for key, heading in named.items())
        return cls(columns, tuple(Row(row) for row in rows))

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the columns."""
        return tuple(column.name for column in self.columns)

    def printed(self) -> list[PrintedColumn]:
        """Return the columns as people read them."""
        return printed(self.columns, self.rows, self.style)

    def markdown(self) -> str:
        """Return the table in Markdown, aligned as text too, then a line for each note."""
        columns = self.printed()
        over = {column.over for column in columns if column.over}
        title = f"{escaped(over.pop())}\n\n" if len(over) == 1 else ""
        heads = [escaped(f"{c.over}, {c.heading}" if c.over and not title else c.heading) for c in columns]
        lines = self.texts(escaped, lambda number: show(number, self.style.digits), "-", "**{}**")
        widths = [max(3, *(len(line[k]) for line in [heads, *lines])) for k in range(len(columns))]

        def joined(cells: list[str]) -> str:
            aligned = zip(cells, widths, columns, strict=True)
            return "| " + " | ".join(t.rjust(w) if c.numeric else t.ljust(w) for t, w, c in aligned) + " |\n"

        rule = ["-" * (w - 1) + ":" if c.numeric else "-" * w for w, c in zip(widths, columns, strict=True)]
        notes = "".join(f"\n{escaped(note)}\n" for note in self.notes)
        return title + joined(heads) + joined(rule) + "".join(joined(line) for line in lines) + notes

    def csv(self) -> str:
        """Return the table as CSV: `float` of a cell gives the number back to the last bit.

        Lists are JSON, and what is missing is an empty cell. An apostrophe goes before a text that
        a spreadsheet would take for a formula.
        """
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(map(_csv_cell, self.names))
        for row in self.rows:
            writer.writerow([_csv_cell(row.cells.get(name)) for name in self.names])
        return text.getvalue()

    def texts(
        self, escape: Callable[[str], str], number: Callable[[Number], str], missing: str, bold: str
    ) -> list[list[str]]:
        """Return the cells row by row as a format for people writes them.

        Args:
            escape: of a text.
            number: writes a number.
            missing: what stands for None.
            bold: with braces for the best number of a column.
        """

        def text(column: PrintedColumn, row: int) -> str:
            cell = column.cells[row]
            if not isinstance(cell, Number):
                return missing if cell is None else escape(cell)
            return bold.format(number(cell)) if row in column.best else number(cell)

        columns = self.printed()
        return [[text(column, row) for column in columns] for row in range(len(self.rows))]


def _csv_cell(value: Value) -> Value:
    if isinstance(value, list | bool):
        return dumps(value)
    return f"'{value}" if isinstance(value, str) and _FORMULA.match(value) else value


def escaped(text: str) -> str:
    """On one line, without what would end the cell, begin a tag, a link or an image, or stay open.

    Code in `single backquotes` stays.
    """
    text = " ".join(visible(text).split())
    parts = text.split("`")
    code = len(parts) % 2 == 1 and "``" not in text  # closed, and no other number of backquotes opens it
    stars = "*" if text.count("*") > 1 else ""
    links = "[]" if _LINK.search(text) else ""
    outside = f"\\|<{stars}{links}"
    found = [
        "".join(f"\\{c}" if c in ("|" if inside else outside) else c for c in part)
        for inside, part in ((bool(code and n % 2), part) for n, part in enumerate(parts))
    ]
    return _BLOCK.sub(r"\\\g<0>", ("`" if code else "\\`").join(found))


def json_text(table: Table) -> str:
    """Return ``[{"ball_error": null, "reasons": {"ball_error": "..."}}, ...]``: `pandas.read_json` reads it.

    Every row has every column, and the reasons of what is missing. NaN and infinity, which JSON does not
    have, are null with the reason.

    Example:
        >>> done = sweep("centers.radius=0.1,0.2", "duration=0.1", "settle_time=0", "figures=false")
        >>> json_text(done.table(metrics=("ball_error",))).count("directory")
        2

        Shown by `staf-table runs --format json`.
    """
    content = [_json_row(table.names, row) for row in table.rows]
    return dumps(content, indent=2, allow_nan=False, ensure_ascii=False) + "\n"


def _json_row(names: Sequence[str], row: Row) -> dict[str, Any]:
    lost = {n: v for n, v in row.cells.items() if isinstance(v, float) and not math.isfinite(v)}
    reasons = {**row.reasons, **{name: f"{value!r} is not a JSON number" for name, value in lost.items()}}
    return {**dict.fromkeys(names), **row.cells, **dict.fromkeys(lost), "reasons": reasons}


def parquet_bytes(table: Table) -> bytes:
    """Return the table as a Parquet file; a column of several types becomes one of texts, a list JSON.

    Example:
        >>> done = sweep("centers.radius=0.1,0.2", "duration=0.1", "settle_time=0", "figures=false")
        >>> parquet_bytes(done.table(metrics=("ball_error",)))[:4]  # doctest: +SKIP
        b'PAR1'

        Shown by `staf-table runs --format parquet --output table.parquet`.

    Raises:
        ValueError: without pandas and pyarrow.
    """
    require("pyarrow", "Parquet")  # pandas writes through it
    buffer = io.BytesIO()
    data_frame(table, "Parquet").to_parquet(buffer, engine="pyarrow", index=False)
    return buffer.getvalue()


def data_frame(table: Table, what: str = "a DataFrame") -> Any:
    """Return the table as a pandas `DataFrame`, columns as in `parquet_bytes`.

    Raises:
        ValueError: without pandas, which ``what`` needs.
    """
    columns = {
        c.name: _uniform([row.cells.get(c.name) for row in table.rows], c.metric is not None)
        for c in table.columns
    }
    return require("pandas", what).DataFrame(columns)


def require(package: str, what: str) -> Any:
    """Return a package of the extra `tables`.

    Raises:
        ValueError: if it is not installed; ``what`` says for what it is needed.
    """
    try:
        return importlib.import_module(package)
    except ImportError as error:
        raise ValueError(
            f"{what} needs {error.name}: install the extra `tables`, pip install 'staf_torch[tables]'."
        ) from error


def html_text(table: Table) -> str:
    """Return the table as an HTML element, with the best numbers bold and a line for each note.

    Example:
        >>> done = sweep("centers.radius=0.1,0.2", "duration=0.1", "settle_time=0", "figures=false")
        >>> html_text(done.table(metrics=("ball_error",))).startswith("<table")
        True

        Shown by `staf experiment=ablation`.
    """
    heads = "".join(
        f"<th>{html.escape(f'{c.over}, {c.heading}' if c.over else c.heading)}</th>" for c in table.printed()
    )
    digits = table.style.digits
    cells = table.texts(html.escape, lambda number: html.escape(show(number, digits)), "-", "<b>{}</b>")
    rows = "".join("<tr>" + "".join(f"<td>{text}</td>" for text in row) + "</tr>" for row in cells)
    notes = "".join(f"<p>{html.escape(note)}</p>" for note in table.notes)
    return f"<table><thead><tr>{heads}</tr></thead><tbody>{rows}</tbody></table>{notes}"


def _uniform(cells: Sequence[Value], number: bool) -> list[Any]:
    kinds = {bool if isinstance(cell, bool) else type(cell) for cell in cells if cell is not None}
    if kinds <= {int, float} and (kinds or number):
        return [math.nan if cell is None else cell for cell in cells]
    if kinds == {bool}:
        return list(cells)
    return [cell if cell is None or isinstance(cell, str) else dumps(cell) for cell in cells]

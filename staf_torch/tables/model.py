"""A table: rows of plain values, as Markdown and HTML for people, as CSV, JSON and Parquet for programs.

People see few digits, mean and spread in one column, the best marked; programs every digit.
"""

from __future__ import annotations

import csv
import dataclasses
import functools
import html
import importlib
import io
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from json import dumps
from typing import Any

from ..results.files import visible
from ..results.reader import Value
from ..results.run import CLASS_PATH, class_name

_SPREADS = ("std", "ci95")
_COUNTS = ("n", "failed")


@dataclasses.dataclass(frozen=True)
class Column:
    """A column of plain values."""

    name: str  # unique: `centers.radius`, `ball_error`, `ball_error.mean`, `ball_error.mean[centers.count=3]`
    metric: str | None = None  # of which it is a number; None: a setting, or something about the run
    statistic: str | None = None  # over the runs of the row; `n` and `failed` count them
    at: str = ""  # `centers.count=3` where the metric is spread over columns
    heading: str = ""  # for people; empty: the name
    shown: bool = True  # False: for programs alone
    larger_is_better: bool = False  # of the metric


@dataclasses.dataclass(frozen=True)
class Row:
    """A row: a run, or the runs that agree in the settings of the row."""

    cells: Mapping[str, Value]  # by the names of the columns
    reasons: Mapping[str, str] = dataclasses.field(default_factory=dict)  # name of a column -> why it is None
    # name of a column -> share of the runs and trajectories that its number does not speak of
    lost: Mapping[str, float] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class Style:
    """Style of printed numbers.

    Example:
        >>> Style(digits=2, bold=True)
        Style(digits=2, bold=True)

        Shown by `staf-table runs --best bold --digits 2`.

    Args:
        digits: significant ones.
        bold: the best number of each column is bold.
    """

    digits: int = 3
    bold: bool = False


@dataclasses.dataclass(frozen=True)
class Number:
    """A number, maybe with what stands behind a plus-minus sign."""

    value: float
    spread: float | None = None


@dataclasses.dataclass(frozen=True)
class PrintedColumn:
    """A column as it is read."""

    heading: str
    over: str  # the heading above that it shares with its neighbours; empty: none
    cells: tuple[Number | str | None, ...]
    best: frozenset[int] = frozenset()  # rows
    name: str = ""  # of the setting or the metric
    metric: bool = False
    at: str = ""  # `centers.count=3` where a metric is spread over columns
    what: str = ""  # `mean ± std`, `max`: what of several runs

    @functools.cached_property
    def numeric(self) -> bool:
        """Return whether no cell is a text."""
        return not any(isinstance(cell, str) for cell in self.cells)


def significant(number: float | None, digits: int = 3) -> str:
    """Return a number with so many digits, small whole ones as they are, None as a dash."""
    if number is None:
        return "-"
    if isinstance(number, int) or (math.isfinite(number) and number == round(number) and abs(number) < 1e6):
        return str(round(number))
    return f"{number:.{digits}g}"


def show(number: Number, digits: int) -> str:
    """Return a number and its spread as text."""
    text = significant(number.value, digits)
    return text if number.spread is None else f"{text} ± {significant(number.spread, 2)}"


def printed(columns: Sequence[Column], rows: Sequence[Row], style: Style) -> list[PrintedColumn]:
    """Return the columns as they are read."""
    found = []
    for column in columns:
        cells = tuple(_cell(row.cells.get(column.name)) for row in rows)
        if column.name.endswith(CLASS_PATH):  # the classes without the modules, where these differ
            short = {cell: class_name(cell) for cell in cells if isinstance(cell, str)}
            if len(set(short.values())) == len(short):
                cells = tuple(short[cell] if isinstance(cell, str) else cell for cell in cells)
        if column.shown and column.statistic is None:
            best = _best(cells, column, rows, style)
            name = "" if column.heading else column.name
            measured = column.metric is not None
            found.append(PrintedColumn(column.heading or column.name, "", cells, best, name, measured))
    if any(column.statistic is not None for column in columns):
        return [*found, *_aggregated(columns, rows, style), *_counts(columns, rows)]
    return [c for c in found if c.heading != "status" or set(c.cells) != {"completed"}]  # which says nothing


def _cell(value: Value) -> Number | str | None:
    if isinstance(value, bool | list):
        return dumps(value)
    return Number(value) if isinstance(value, int | float) else value


def _aggregated(columns: Sequence[Column], rows: Sequence[Row], style: Style) -> Iterator[PrintedColumn]:
    """Yield a column for each metric, place and statistic; the spread joins the mean."""
    runs = [row.cells[column.name] for row in rows for column in columns if column.statistic == "n"]
    single = all(count in (0, 1) for count in runs)
    places: dict[tuple[str, str], dict[str | None, Column]] = {}
    for column in columns:
        if column.metric is not None:
            places.setdefault((column.metric, column.at), {})[column.statistic] = column
    for (metric, at), here in places.items():
        spread = next((here[name] for name in _SPREADS if name in here and "mean" in here), None)
        shown = [c for name, c in here.items() if name not in _COUNTS and c is not spread]
        for column in shown:
            joined = spread if column.statistic == "mean" else None
            what = "" if single and column.statistic == "mean" else str(column.statistic)
            what = f"mean ± {joined.statistic}" if joined is not None else what
            cells = tuple(map(_cell, (row.cells.get(column.name) for row in rows)))
            if joined is not None:
                widths = [row.cells.get(joined.name) for row in rows]
                cells = tuple(
                    Number(cell.value, w) if isinstance(cell, Number) and isinstance(w, int | float) else cell
                    for cell, w in zip(cells, widths, strict=True)
                )
            alone = at and len(shown) == 1  # the statistic joins the heading above
            heading = ", ".join(filter(None, (at or metric, "" if alone else what)))
            over = ", ".join(filter(None, (metric, what if alone else ""))) if at else ""
            yield PrintedColumn(
                heading, over, cells, _best(cells, column, rows, style), metric, True, at, what
            )


def _counts(columns: Sequence[Column], rows: Sequence[Row]) -> Iterator[PrintedColumn]:
    """Over how many runs a number of the row is, `4-5` where they differ, and how many runs gave none."""
    for count in _COUNTS:
        names = [column.name for column in columns if column.statistic == count]
        cells: list[Number | str] = []
        for row in rows:
            whole = [number for name in names if isinstance(number := row.cells[name], int)]
            least, most = min(whole), max(whole)
            cells.append(Number(least) if least == most else f"{least}-{most}")
        if count == "n" or any(cell != Number(0) for cell in cells):
            yield PrintedColumn(count, "", tuple(cells), name=count)


def _best(
    cells: Sequence[Number | str | None], column: Column, rows: Sequence[Row], style: Style
) -> frozenset[int]:
    """The rows of the best number and of all that look the same, among those that lost the least."""
    values = {k: c.value for k, c in enumerate(cells) if isinstance(c, Number) and not math.isnan(c.value)}
    if column.metric is None or not style.bold or len(values) < 2:
        return frozenset()
    lost = {k: rows[k].lost.get(column.name, 0.0) for k in values}
    values = {k: value for k, value in values.items() if lost[k] == min(lost.values())}
    chosen: Callable[..., float] = max if column.larger_is_better else min
    best = significant(chosen(values.values()), style.digits)
    return frozenset(k for k, value in values.items() if significant(value, style.digits) == best)


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
        """Return a table of rows that have been computed, in which a missing cell is None.

        ``headings`` has the heading of each column, in order; None: the keys themselves, all of them.
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
        """Return the cells row by row as a format for people writes them: texts by ``escape``, numbers by
        ``number``, None as ``missing``, the best number of a column within the braces of ``bold``."""

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
    content = []
    for row in table.rows:
        lost = {n: v for n, v in row.cells.items() if isinstance(v, float) and not math.isfinite(v)}
        why = {name: f"{value!r} is not a JSON number" for name, value in lost.items()}
        cells: dict[str, Any] = {**dict.fromkeys(table.names), **row.cells, **dict.fromkeys(lost)}
        content.append(cells | {"reasons": {**row.reasons, **why}})
    return dumps(content, indent=2, allow_nan=False, ensure_ascii=False) + "\n"


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

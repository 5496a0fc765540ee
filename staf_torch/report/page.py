"""`report.html`: one self-contained file with the table, the figures and the settings."""

from __future__ import annotations

import base64
import importlib.resources
import string
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path

from .collection import Collection, identity
from .formats.printed import Number, PrintedColumn, Style, printed, significant
from .overrides import Value
from .table import Table
from .tabulate import as_text

_STYLE = Style(digits=4, bold=True)


def page(found: Collection, table: Table, figures: Mapping[str, Path], title: str) -> str:
    """The page as text.

    Args:
        found: the runs.
        table: of them.
        figures: what each shows, and its PNG.
        title: heading of the page.
    """
    template = importlib.resources.files(__package__) / "report.html"
    columns = printed(table, _show, _STYLE)
    return string.Template(template.read_text(encoding="utf-8")).substitute(
        title=escape(title),
        about=escape(_about(found)),
        notes=_list(
            [*table.notes, *(f"skipped {s.path}: {s.reason}" for s in found.skipped), *found.remarks]
        ),
        head="".join(_head(column) for column in columns),
        body="\n".join(_row(columns, row) for row in range(len(table.rows))),
        figures="".join(_figure(what, path) for what, path in figures.items()),
        settings="\n".join(
            f"<dt>{escape(key)}</dt><dd>{escape(as_text(value))}</dd>"
            for key, value in _common(found).items()
        ),
    )


def _about(found: Collection) -> str:
    completed = sum(run.status == "completed" for run in found.rows)
    tasks = ", ".join(dict.fromkeys(run.task for run in found.rows if run.task))
    versions = ", ".join(dict.fromkeys(run.version for run in found.rows if run.version))
    by = f", staf_torch {versions}" if versions else ""
    return f"{tasks or 'runs'}: {len(found.rows)} runs, {completed} completed{by}"


def _common(found: Collection) -> dict[str, Value]:
    """The settings that are the same in all runs that know theirs."""
    known = [run.settings for run in found.rows if run.settings]
    if not known:
        return {}
    return {
        key: value
        for key, value in sorted(known[0].items())
        if len({identity(settings.get(key)) for settings in known}) == 1
    }


def _show(number: Number) -> str:
    text = significant(number.value, _STYLE.digits)
    return text if number.spread is None else f"{text} ± {significant(number.spread, 2)}"


def _list(notes: Sequence[str]) -> str:
    if not notes:
        return ""
    return "<ul>" + "".join(f"<li>{escape(note)}</li>" for note in notes) + "</ul>"


def _head(column: PrintedColumn) -> str:
    kind = "number" if column.numeric else "text"
    heading = f"{column.over}, {column.heading}" if column.over else column.heading
    return (
        f'<th scope="col" class="{kind}" data-kind="{kind}" aria-sort="none">'
        f'<button type="button">{escape(heading)}</button></th>'
    )


def _row(columns: Sequence[PrintedColumn], row: int) -> str:
    cells = []
    for column in columns:
        cell, kind = column.cells[row], "number" if column.numeric else "text"
        if cell is None:
            cells.append(f'<td class="{kind} absent">-</td>')
            continue
        value = repr(cell.value) if isinstance(cell, Number) else cell
        shown = _show(cell) if isinstance(cell, Number) else cell
        best = " best" if row in column.best else ""
        cells.append(f'<td class="{kind}{best}" data-value="{escape(value)}">{escape(shown)}</td>')
    return "<tr>" + "".join(cells) + "</tr>"


def _figure(what: str, path: Path) -> str:
    data = base64.b64encode(path.read_bytes()).decode()
    return (
        f"<h2>{escape(what)}</h2>\n"
        f'<figure><img alt="{escape(what)}" src="data:image/png;base64,{data}"></figure>\n'
    )

"""The report of a sweep: its table, its figures and one page with both, in its directory."""

from __future__ import annotations

import base64
import dataclasses
import importlib.resources
import itertools
import logging
import shlex
from array import array
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from ..figures.style import images
from ..figures.sweep import SEED, SWEEP_FIGURES
from ..results.files import COMPLETED, PAGE, ROWS, SWEEP, TABLE, parse_overrides
from ..results.reader import Collection, Value, collect, identity, read_record, read_rows
from ..results.run import MEANINGS, as_text
from ..results.run_directory import RunDirectory
from ..results.run_record import read
from ..tables import Layout, Style, Table, latex_text, tabulate
from ..tables.model import PrintedColumn, show

_log = logging.getLogger(__name__)
_MOST_ROWS = 1000  # of a table that have a line of their own in the report
_BOLD, _ON_THE_PAGE = Style(bold=True), Style(digits=4, bold=True)


def write_report(directory: Path, *, figures: bool = True) -> str:
    """Write `table.md`, `table.tex`, `table.csv`, `figures/` and `report.html` of the sweep in a directory;
    return the table in Markdown.

    The first two and the page have one row for all seeds, where more than one was swept; the CSV has one row
    a run and all metrics, its directory as seen from the sweep's. A figure that cannot be drawn is a warning
    in the log. Of a table with more than a thousand rows `table.md` and the page have the spread of each
    metric.

    Raises ValueError if there is no run in the directory, OSError if it cannot be written.
    """
    out = RunDirectory(directory)
    if (directory / ROWS).exists() and next(itertools.islice(read_rows(directory), _MOST_ROWS, None), None):
        return _write_spread(directory, out)
    found = collect(directory)
    inside = (dataclasses.replace(r, directory=r.directory.relative_to(directory)) for r in found.rows)
    found = dataclasses.replace(found, rows=tuple(inside))  # equal sweeps in two places have equal tables
    aggregates = ("mean", "std") if SEED in found.swept else ()
    table = tabulate(found, Layout(aggregates=aggregates, style=_BOLD))
    text = out.table(TABLE, tabulate(found, Layout(every_metric=True)), shown=table)
    out.text(f"{TABLE}.tex", latex_text(table))
    drawn = draw_sweep(found, out) if figures else {}
    title = f"Sweep {directory.resolve().name}"
    out.text(PAGE, page(found, table, drawn, title, facts=facts(directory, found)))
    return text


def _write_spread(directory: Path, out: RunDirectory) -> str:
    """Write the report of a table of many rows: least, median and largest number of each metric."""
    numbers: dict[str, array[float]] = {}
    ended, diverged = Counter[str](), 0
    for row in read_rows(directory):
        metrics = row["metrics"]
        ended[row["status"]] += 1
        diverged += bool(metrics.get("diverged_fraction"))
        for name, value in metrics.items():
            if value is not None:
                numbers.setdefault(name, array("d")).append(value)
    names = {name: name for name in ("metric", "least", "median", "most", "rows")}
    cells: list[dict[str, Value]] = [
        {
            "metric": name,
            "least": min(found),
            "median": float(np.median(found)),
            "most": max(found),
            "rows": len(found),
        }
        for name, found in numbers.items()
    ]
    table = Table.of(cells, names)
    shown = (
        f"{ended.total()} rows, {ended[COMPLETED]} completed, {diverged} diverged; `staf-table` shows each"
    )
    base = dataclasses.replace(read_record(directory), directory=Path())
    swept = parse_overrides(next(read_rows(directory))["overrides"])
    kept = {key: base.settings[key] for key in base.settings if not swept.keys() & {key, key.split(".")[0]}}
    found = Collection((dataclasses.replace(base, settings=kept),), ())
    text = f"{table.markdown()}\n{shown}\n"
    out.text(f"{TABLE}.md", text)
    title = f"Sweep {directory.resolve().name}"
    out.text(PAGE, page(found, table, {}, title, shown, facts(directory, found)))
    return text


def facts(directory: Path, found: Collection) -> dict[str, str]:
    """Return what makes runs repeatable: command, date, machine, versions, and the units of the plant."""
    sweep = read(directory / SWEEP) or {}
    typed = [part for name in ("overrides", "hydra") if isinstance(part := sweep.get(name), list)]
    words = [str(word) for part in typed for word in part if not str(word).startswith("hydra.mode=")]
    began = sorted(run.began for run in found.rows if run.began)
    builds = _all(run.build for run in found.rows) or _all(run.version for run in found.rows)
    python = _all(run.python for run in found.rows)
    own = _all(f"{name} {digits}" for run in found.rows for name, digits in sorted(run.modules.items()))
    told = {
        "command": f"staf -m {shlex.join(words)}" if words else "",
        "date": " to ".join(dict.fromkeys([*began[:1], *began[-1:]])),
        "machine": _all(run.machine for run in found.rows),
        "versions": ", ".join(
            filter(None, [builds and f"staf_torch {builds}", python and f"Python {python}", own])
        ),
        "units": _all(", ".join(f"{name} {unit}" for name, unit in run.units.items()) for run in found.rows),
    }
    return {
        name: text or ("none: the plant declares none" if name == "units" else "not recorded")
        for name, text in told.items()
    }


def _all(texts: Iterable[str | None]) -> str:
    """Return the texts that there are, each once."""
    return "; ".join(dict.fromkeys(text for text in texts if text))


def draw_sweep(found: Collection, out: RunDirectory) -> dict[str, bytes]:
    """Draw the figures that the swept settings allow; return what each shows, and its PNG."""
    drawn = {}
    for name, (what, draw) in SWEEP_FIGURES.items():
        try:
            figure = draw(found)
            if figure is not None:
                kinds = images(figure)
                out.figure(name, kinds)
                drawn[what] = kinds["png"]
        except Exception as error:  # the runs and their table are worth more than a picture of them
            _log.warning("no figure %s: %s: %s", name, type(error).__name__, error)
    return drawn


def page(
    found: Collection,
    table: Table,
    figures: Mapping[str, bytes],
    title: str,
    about: str | None = None,
    facts: Mapping[str, str] | None = None,
) -> str:
    """Return `report.html`: one file with the table, the figures and the settings, linked to the runs.

    ``figures`` has what each shows, and its PNG; ``about`` is the line below the title, by default how many
    runs of what there are.
    """
    import jinja2  # the callbacks of every run import this module

    source = importlib.resources.files(__package__) / "report.html"
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    columns = dataclasses.replace(table, style=_ON_THE_PAGE).printed()
    named = dict.fromkeys(column.name for column in columns if column.metric)
    skipped = [f"skipped {one.path}: {one.reason}" for one in found.skipped]
    return environment.from_string(source.read_text(encoding="utf-8")).render(
        title=title,
        about=about or _about(found),
        notes=[*table.notes, *skipped, *found.remarks],
        facts=facts or {},
        headings=[_heading(column, found) for column in columns],
        rows=[[_cell(column, row) for column in columns] for row in range(len(table.rows))],
        figures={what: base64.b64encode(png).decode() for what, png in figures.items()},
        meanings={name: MEANINGS[name] for name in named if name in MEANINGS},
        runs=[run.directory.as_posix() for run in found.rows if run.directory.parts],
        settings={key: as_text(value) for key, value in _common(found).items()},
    )


def _about(found: Collection) -> str:
    completed = sum(run.status == COMPLETED for run in found.rows)
    tasks = ", ".join(dict.fromkeys(run.task for run in found.rows if run.task))
    versions = ", ".join(dict.fromkeys(run.version for run in found.rows if run.version))
    by = f", staf_torch {versions}" if versions else ""
    ended = Counter(run.status for run in found.rows if run.status != COMPLETED)
    others = "".join(f", {count} {status}" for status, count in ended.items())
    return f"{tasks or 'runs'}: {len(found.rows)} runs, {completed} completed{others}{by}"


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


def _heading(column: PrintedColumn, found: Collection) -> dict[str, str]:
    text = ", ".join(filter(None, (column.over, column.heading)))
    unit = found.infos[column.name].unit if column.metric and column.name in found.infos else ""
    text = text if unit in ("", "1") else f"{text} ({unit})"
    return {"text": text, "kind": "number" if column.numeric else "text"}


def _cell(column: PrintedColumn, row: int) -> dict[str, str | None]:
    """The text, the value to sort by with every digit (None: missing), the classes of the style sheet."""
    cell, kind = column.cells[row], "number" if column.numeric else "text"
    if cell is None:
        return {"text": "-", "value": None, "kind": f"{kind} absent"}
    if isinstance(cell, str):
        return {"text": cell, "value": cell, "kind": kind}
    best = " best" if row in column.best else ""
    return {"text": show(cell, _ON_THE_PAGE.digits), "value": repr(cell.value), "kind": kind + best}

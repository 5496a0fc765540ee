"""What a sweep ends with: its table, its figures and one page with both, in its directory."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from . import series
from .collection import Collection, collect
from .files import write_text
from .formats import Style, csv_text, latex_text, markdown_text
from .page import page
from .tabulate import Layout, tabulate

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_log = logging.getLogger(__name__)
_STYLE = Style(bold=True)
TABLE, PAGE, FIGURES = "table", "report.html", "figures"


def write_report(directory: Path, *, figures: bool = True) -> str:
    """Write `table.md`, `table.tex`, `table.csv`, `figures/` and `report.html` of the sweep in a directory.

    The first two and the page have one row for all seeds, where more than one was swept; the CSV has one row
    a run and all metrics, its directory as seen from the sweep's. A figure that cannot be drawn is a warning
    in the log.

    Returns:
        The table in Markdown.

    Raises:
        ValueError: if there is no run in the directory.
        OSError: if it cannot be written.
    """
    found = _inside(collect(directory), directory)
    layout = Layout(aggregates=("mean", "std")) if series.SEED in found.swept else Layout()
    table = tabulate(found, layout)
    text = markdown_text(table, _STYLE)
    write_text(directory / f"{TABLE}.md", text)
    write_text(directory / f"{TABLE}.tex", latex_text(table, _STYLE))
    write_text(directory / f"{TABLE}.csv", csv_text(tabulate(found, Layout(every_metric=True))))
    drawn = draw_sweep(found, directory / FIGURES) if figures else {}
    write_text(directory / PAGE, page(found, table, drawn, f"Sweep {directory.resolve().name}"))
    return text


def _inside(found: Collection, directory: Path) -> Collection:
    """With paths as seen from the sweep: equal sweeps in two directories have equal tables."""
    rows = tuple(
        dataclasses.replace(run, directory=run.directory.relative_to(directory)) for run in found.rows
    )
    return dataclasses.replace(found, rows=rows)


def draw_sweep(found: Collection, folder: Path) -> dict[str, Path]:
    """The figures that the swept settings allow, PNG and PDF: what each shows, and its PNG."""
    drawn = {}
    for name, (what, make) in _FIGURES.items():
        try:
            figure = make(found)
            if figure is None:
                continue
            from . import plots

            folder.mkdir(exist_ok=True)
            plots.save(figure, folder / name)
        except Exception as error:  # the runs and their table are worth more than a picture of them
            _log.warning("no figure %s: %s: %s", name, type(error).__name__, error)
            continue
        drawn[what] = (folder / name).with_suffix(".png")
    return drawn


def _error_against_radius(found: Collection) -> Figure | None:
    panels = series.error_against_radius(found)
    if not panels:
        return None
    from . import plots_sweep  # matplotlib takes a second, which sweeps without figures need not pay

    return plots_sweep.draw_error_against_radius(panels, series.rounding_floor(found))


def _heat_maps(found: Collection) -> Figure | None:
    maps = series.heat_maps(found)
    if not maps:
        return None
    from . import plots_sweep

    return plots_sweep.draw_heat_maps(maps)


def _cost_against_accuracy(found: Collection) -> Figure | None:
    panels = series.cost_against_accuracy(found)
    if not panels:
        return None
    from . import plots_sweep

    return plots_sweep.draw_cost_against_accuracy(panels)


_FIGURES: dict[str, tuple[str, Callable[[Collection], Figure | None]]] = {
    "error_against_radius": ("Error against the radius", _error_against_radius),
    "error_map": ("Error over radius and number of centers", _heat_maps),
    "cost_against_accuracy": ("Cost against accuracy", _cost_against_accuracy),
}

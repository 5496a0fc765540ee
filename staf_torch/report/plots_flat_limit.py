"""The figure of the flat limit: error against radius."""

from __future__ import annotations

import importlib.resources
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from .plots import _COLOURS, _DASHES

_MARKERS = "osv^"
_TOP = 3.0  # of the error axis: all digits are lost at 1
_FAILED = 1.0  # where the marks of failures stand


class ErrorPanel(NamedTuple):
    """Relative errors of several methods in one dtype; inf where a method fails."""

    title: str
    rounding: float  # eps of the dtype
    radius: Sequence[float]
    error: Mapping[str, Sequence[float]]  # by the method's label, the most important one last


def draw_errors(panels: Sequence[ErrorPanel], rows: int) -> Figure:
    """Panels in ``rows`` rows, log-log, each row with one error axis; one legend above all."""
    columns = len(panels) // rows
    style = importlib.resources.files(__package__) / "staf.mplstyle"
    with importlib.resources.as_file(style) as path, matplotlib.rc_context(fname=path):
        figure = Figure(figsize=(max(3.6, 2.4 * columns), 2.3 * rows + 0.5), layout="constrained")
        grid = figure.subplots(rows, columns, sharex=True, sharey="row", squeeze=False)
        for axes, panel, letter in zip(grid.flat, panels, "abcdefghijklmnopqrstuvwxyz", strict=False):
            _panel(axes, panel)
            axes.set_title(f"({letter}) {panel.title}", loc="left")
        for axes in grid[:, 0]:
            axes.set_ylabel(r"relative error of $\hat V$")
        for axes in grid[-1]:
            axes.set_xlabel("radius $r$")
        handles, labels = grid[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=3 if columns < 3 else 6)
        figure.draw_without_rendering()  # lays out under this style, not under the caller's
        return figure


def _panel(axes: Axes, panel: ErrorPanel) -> None:
    radius = np.asarray(panel.radius)
    for i, (label, errors) in enumerate(panel.error.items()):
        error = np.asarray(errors)
        # An exact result cannot stand on a log axis: it is drawn at a tenth of the rounding unit.
        drawn = np.where(np.isfinite(error), np.maximum(error, 0.1 * panel.rounding), np.nan)
        # The later, the smaller: curves that lie on each other are all seen.
        axes.loglog(
            radius,
            drawn,
            _DASHES[i],
            marker=_MARKERS[i],
            markersize=3.8 - 0.6 * i,
            color=_COLOURS[i],
            label=label,
        )
        failed = radius[~np.isfinite(error)]
        # One row of marks a method, so that two that fail together are both seen.
        axes.plot(failed, np.full(len(failed), _FAILED * 4.0**i), "x", markersize=3, color=_COLOURS[i])
    axes.plot([], [], "kx", markersize=3, label="fails (in its colour)")
    axes.axhline(
        panel.rounding, color="0.4", linewidth=0.8, linestyle=(0, (1, 1)), label=r"$\varepsilon$ of the dtype"
    )
    axes.set_ylim(0.05 * panel.rounding, _TOP * 4.0)
    axes.margins(x=0.02)

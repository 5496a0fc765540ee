"""The figures of a sweep: error against the radius, over radius and count, and against the cost."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from .plots import _colour
from .plots_theory import _MARKERS, _style
from .series import Curve, HeatMap, Panel, Point

_ERROR = r"$\sup\,|V - \hat V|$ on the ball"
_ROUNDING = (0, (6, 2))  # dashes
_VISIBLE = 1.2  # a band this wide can be seen: it has an entry in the legend
_COLUMNS = 3
_WIDTH, _HEIGHT = 7.2, 2.5


def draw_error_against_radius(panels: Sequence[Panel], rounding: float | None) -> Figure:
    """Both axes logarithmic; a line a count with its 95 % band over the seeds, dotted with ideal weights.

    Args:
        panels: one a kernel.
        rounding: the error that rounding of V alone explains; a line, where it is not far below the data,
            and in the legend with its number.
    """

    def panel(axes: Axes, shown: Panel) -> None:
        for i, curve in enumerate(shown.curves):
            _line(axes, i, curve)
        if rounding is not None:
            axes.axhline(rounding, color="0.4", linestyle=_ROUNDING, linewidth=0.9)
        radii = sorted({point.x for curve in shown.curves for point in curve.points})
        axes.set_xticks(radii, [f"{radius:g}" for radius in radii])
        axes.xaxis.minorticks_off()
        axes.set_xlabel("radius $r$ of the ball")

    more = [Line2D([], [], color="0.3", linestyle=":", label="ideal weights, local basis")]
    if not any(curve.floor for shown in panels for curve in shown.curves):
        more = []
    if rounding is not None:
        floor = Line2D([], [], color="0.4", linestyle=_ROUNDING, linewidth=0.9)
        points = [point for shown in panels for curve in shown.curves for point in curve.points]
        far = ", below" if rounding <= _far_below(points) else ""
        floor.set_label(rf"rounding, $\varepsilon\,\max|V|$ = {rounding:.0e}{far}")
        more.append(floor)
    return _panels(panels, panel, more)


def draw_cost_against_accuracy(panels: Sequence[Panel]) -> Figure:
    """Both axes logarithmic; a line a law and predictor with its 95 % band over the seeds."""

    def panel(axes: Axes, shown: Panel) -> None:
        for i, curve in enumerate(shown.curves):
            _line(axes, i, curve)
        axes.set_xlabel("products with $K$ a second of trajectory")

    return _panels(panels, panel, [])


def _panels(panels: Sequence[Panel], draw: Callable[[Axes, Panel], None], more: list[Line2D]) -> Figure:
    with _style():
        figure, grid = _grid(len(panels))
        for axes, shown in zip(grid, panels, strict=True):
            axes.set_xscale("log")
            axes.set_yscale("log")
            draw(axes, shown)
            axes.set_title(shown.title, loc="left")
        _label_left(grid)
        points = [point for shown in panels for curve in shown.curves for point in curve.points]
        _frame(grid, points)
        # The same label has the same line in every panel: one legend serves them all.
        lines = {line.get_label(): line for axes in grid for line in axes.get_lines()}
        handles: list[Artist] = [line for label, line in lines.items() if not str(label).startswith("_")]
        handles += more
        if any(point.high > _VISIBLE * point.low for point in points):
            handles.append(Patch(color="0.4", alpha=0.25, linewidth=0, label="95 % over seeds"))
        lines_of_legend = -(-len(handles) // (6 if len(panels) > 1 else 3))
        columns = -(-len(handles) // lines_of_legend)
        figure.legend(handles=handles, loc="outside upper center", ncols=columns, handlelength=2.6)
        figure.draw_without_rendering()  # lays out under this style, not under the caller's
        return figure


def _line(axes: Axes, i: int, curve: Curve) -> None:
    x = [point.x for point in curve.points]
    (line,) = axes.plot(x, [point.middle for point in curve.points], color=_colour(i))
    line.set(marker=_MARKERS[i % len(_MARKERS)], markersize=3.5, label=curve.label)
    if any(point.low < point.high for point in curve.points):
        low, high = [point.low for point in curve.points], [point.high for point in curve.points]
        axes.fill_between(x, low, high, color=_colour(i), alpha=0.2, linewidth=0)
    if curve.floor:
        floor = [point.middle for point in curve.floor]
        axes.plot([point.x for point in curve.floor], floor, ":", color=_colour(i), linewidth=0.9)


def _frame(grid: Sequence[Axes], points: Sequence[Point]) -> None:
    """Half a decade around the errors, and what lies below only if it is near: wide bands are cut."""
    middle = [point.middle for point in points]
    bottom, top = min(middle) / 3, max(middle) * 3
    drawn = [y for axes in grid for line in axes.get_lines() for y in np.asarray(line.get_ydata(), float)]
    near = [y for y in drawn if np.isfinite(y) and y > _far_below(points)]
    grid[0].set_ylim(min([bottom, *(y / 4 for y in near)]), top)


def _far_below(points: Sequence[Point]) -> float:
    """What is not above this would squeeze the errors into the top of the picture: it is left out."""
    return 1e-9 / 3 * min(point.middle for point in points)


def draw_heat_maps(maps: Sequence[HeatMap]) -> Figure:
    """The error by colour and number over radius and count, one scale for all kernels; grey: no result."""
    with _style():
        figure, grid = _grid(len(maps), share=False, rows=max(len(m.counts) for m in maps))
        errors = [e for shown in maps for row in shown.errors for e in row if e is not None]
        norm = LogNorm(min(errors), max(errors) if max(errors) > min(errors) else 10 * min(errors))
        for axes, shown in zip(grid, maps, strict=True):
            values = np.array([[np.nan if e is None else e for e in row] for row in shown.errors])
            axes.set_facecolor("0.92")
            image = axes.imshow(values, norm=norm, cmap="viridis", origin="lower", aspect="auto")
            axes.grid(False)
            _numbers(axes, values, norm)
            axes.set_xticks(range(len(shown.radii)), [f"{radius:g}" for radius in shown.radii])
            axes.set_yticks(range(len(shown.counts)), [str(count) for count in shown.counts])
            axes.tick_params(length=0)
            axes.set_xlabel("radius $r$ of the ball")
            axes.set_title(shown.title, loc="left")
        _label_left(grid, "centers $M$")
        figure.colorbar(image, ax=list(grid), label=_ERROR, pad=0.01, aspect=30)
        figure.draw_without_rendering()
        return figure


def _numbers(axes: Axes, values: np.ndarray, norm: LogNorm) -> None:
    """Each cell's error, white on dark and black on light colours."""
    for (row, column), error in np.ndenumerate(values):
        lost = not np.isfinite(error)
        colour = "0.3" if lost else "white" if float(norm(error)) < 0.6 else "black"
        axes.text(column, row, "-" if lost else _short(error), ha="center", va="center", color=colour, size=6)


def _short(error: float) -> str:
    exponent = math.floor(math.log10(error))
    mantissa = round(error / 10.0**exponent, 1)
    if mantissa >= 10:
        mantissa, exponent = 1.0, exponent + 1
    return f"{error:.2g}" if -2 <= exponent <= 2 else f"{mantissa:.1f}e{exponent}"


def _grid(count: int, share: bool = True, rows: int = 0) -> tuple[Figure, list[Axes]]:
    columns = min(count, _COLUMNS)
    lines = -(-count // columns)
    width = _WIDTH if columns > 1 else 4.4
    height = _HEIGHT if rows == 0 else 0.9 + 0.33 * rows
    figure = Figure(figsize=(width, 0.5 + height * lines), layout="constrained")
    grid = list(figure.subplots(lines, columns, sharey=share, sharex=False, squeeze=False).flat)
    for axes in grid[count:]:
        axes.set_visible(False)
    return figure, grid[:count]


def _label_left(grid: Sequence[Axes], label: str = _ERROR) -> None:
    for axes in grid:
        spec = axes.get_subplotspec()
        if spec is not None and spec.is_first_col():
            axes.set_ylabel(label)

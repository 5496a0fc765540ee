"""The figures of a sweep: error against the radius, over radius and count, and against the cost.

First the curves that the swept settings allow, and their points; then the pictures of them.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..results.files import grouped
from ..results.reader import Collection, RecordedRun, identity
from ..results.run import CLASS_PATH, as_text, class_name
from ..tables.aggregate import half_width, mean, rank
from .style import at_left, colour, dash, legend, marker, panels, ticks

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

KERNEL, RADIUS, COUNT, SEED = "kernel", "centers.radius", "centers.count", "seed"
METRIC, FLOOR, ROUNDING = "ball_error", "ball_floor_error", "rounding_floor"
COST = "products_per_second"
_OF_COST = ("optimizer", "predictor", "optimizer.inner_steps", "dt", COUNT, SEED)
_NAMES = {"gaussian": "Gaussian", "matern": "Matérn", "inverse_multiquadric": "inverse multiquadric"}
_MOST_PANELS = 12
_ERROR = r"$\sup\,|V - \hat V|$"  # on the ball
_ROUNDING = (0, (6, 2))  # dashes
_VISIBLE = 1.2  # a band this wide can be seen: it has an entry in the legend
_IDEAL = "ideal weights"
_COLUMNS = 3
_FAR = 1e-4  # of the least error: what lies below is not drawn
_CELL = 0.26  # inches a row of a map is high


class Point(NamedTuple):
    """The errors of the runs that differ by their seed: on a logarithmic axis, so of their logarithms."""

    x: float
    middle: float  # geometric mean
    low: float  # of the 95 % confidence interval; the mean for a single run
    high: float


class Curve(NamedTuple):
    """A line of a panel."""

    label: str
    points: tuple[Point, ...]
    floor: tuple[Point, ...] = ()  # with the ideal weights


class Panel(NamedTuple):
    """A panel of a figure."""

    title: str
    curves: tuple[Curve, ...]


class HeatMap(NamedTuple):
    """The errors of one panel, radius by count."""

    title: str
    radii: tuple[float, ...]
    counts: tuple[int, ...]
    errors: tuple[tuple[float | None, ...], ...]  # a row a count


class TooManyError(Exception):
    """More panels than can be read."""


def error_against_radius(found: Collection) -> list[Panel]:
    """Return a panel a kernel (and other swept setting) with a line a count; nothing where not swept."""
    runs = _usable(found, METRIC)
    if not _several(runs, RADIUS):
        return []
    panels = []
    for title, group in _panels(found, runs, (RADIUS, COUNT, SEED)):
        curves = []
        for _, line in _split(group, lambda run: run.setting(COUNT)):
            count = line[0].setting(COUNT)
            label = f"{count} centers" if isinstance(count, int) else "all centers"
            curves.append(Curve(label, _points(line, RADIUS, METRIC), _points(line, RADIUS, FLOOR)))
        panels.append(Panel(title, tuple(curves)))
    return panels


def rounding_floor(found: Collection) -> float | None:
    """Return the largest error that rounding of V alone explains in any of the runs."""
    floors = (run.metrics.get(ROUNDING) for run in found.rows)
    return max((floor for floor in floors if floor is not None), default=None)


def heat_maps(found: Collection) -> list[HeatMap]:
    """Return the error over radius and count, a map a kernel; nothing where they were not both swept."""
    runs = _usable(found, METRIC)
    if not _several(runs, RADIUS) or not _several(runs, COUNT):
        return []
    radii, counts = _values(found.rows, RADIUS), _values(found.rows, COUNT)
    maps = []
    for title, group in _panels(found, runs, (RADIUS, COUNT, SEED)):
        cells = []
        for count in counts:
            row = _points([run for run in group if run.setting(COUNT) == count], RADIUS, METRIC)
            at = {point.x: point.middle for point in row}
            cells.append(tuple(at.get(radius) for radius in radii))
        maps.append(HeatMap(title, tuple(radii), tuple(map(int, counts)), tuple(cells)))
    return maps


def cost_against_accuracy(found: Collection) -> list[Panel]:
    """Return panels of the error against the work, a line a law and predictor; of one law a line a radius.

    The work is that of products with K a second: where M was swept their M^2 multiplications, else their
    number.
    """
    runs = [run for run in _usable(found, METRIC) if run.metrics.get(COST) is not None]
    by_count = _several(runs, COUNT)
    if len({_work(run, by_count) for run in runs}) < 2:
        return []
    of_radius = _several(runs, RADIUS) and len({_law(run) for run in runs}) == 1
    inside = (*_OF_COST, RADIUS) if of_radius else _OF_COST
    panels = []
    for title, group in _panels(found, runs, inside):
        order = (lambda run: run.setting(RADIUS)) if of_radius else _law
        curves = [
            Curve(f"$r$ = {value:g}" if of_radius else str(value), _costs(line, by_count))
            for value, line in _split(group, order)
        ]
        panels.append(Panel(title, tuple(curves)))
    return panels


def _law(run: RecordedRun) -> str:
    law, predictor = (str(run.setting(key)).replace("_", " ") for key in ("optimizer", "predictor"))
    return law if predictor in ("none", "None") else f"{law}, {predictor} predictor"


def _work(run: RecordedRun, by_count: bool) -> float:
    """Products with K a second, or the multiplications in them."""
    products, count = run.metrics[COST], run.setting(COUNT)
    assert products is not None
    return products * count**2 if by_count and isinstance(count, int) else products


def _usable(found: Collection, metric: str) -> list[RecordedRun]:
    """The runs with a number that a logarithmic axis can show."""
    return [run for run in found.rows if (run.metrics.get(metric) or 0) > 0]


def _several(runs: Sequence[RecordedRun], key: str) -> bool:
    return len(_values(runs, key)) > 1


def _values(runs: Sequence[RecordedRun], key: str) -> list[float]:
    """The numbers that a setting has, in order."""
    return sorted({value for run in runs if isinstance(value := run.setting(key), int | float)})


def _panels(
    found: Collection, runs: Sequence[RecordedRun], inside: Sequence[str]
) -> list[tuple[str, list[RecordedRun]]]:
    """The runs by all that was swept but what a panel shows, with a title each."""
    outside = [key for key in found.swept if key not in inside]
    groups = _split(runs, lambda run: _agreeing(run, outside))
    if len(groups) > _MOST_PANELS:
        raise TooManyError(f"{len(groups)} panels, by {', '.join(outside)}: too many to read")
    return [(_title(group[0], outside), group) for _, group in groups]


def _agreeing(run: RecordedRun, keys: Sequence[str]) -> str:
    """Equal texts for runs that agree in those settings."""
    return "|".join(identity(run.setting(key)) for key in keys)


def _title(run: RecordedRun, keys: Sequence[str]) -> str:
    kernel, own = as_text(run.setting(KERNEL)), run.setting(KERNEL + CLASS_PATH)
    named = {KERNEL, KERNEL + CLASS_PATH} & {*keys} or (not keys and run.setting(KERNEL))
    kernel = class_name(own) if isinstance(own, str) else _NAMES.get(kernel, kernel)
    parts = [f"{kernel} kernel"] if named else []
    for key in keys:
        if key not in (KERNEL, KERNEL + CLASS_PATH):
            value = as_text(run.setting(key))
            parts.append(f"{key} = {class_name(value) if key.endswith(CLASS_PATH) else value}")
    return ", ".join(parts)


def _split(
    runs: Sequence[RecordedRun], key: Callable[[RecordedRun], object]
) -> list[tuple[Any, list[RecordedRun]]]:
    """By a key: numbers in order, then the others as they came."""
    return sorted(grouped(runs, key).items(), key=lambda item: rank(item[0]))


def _points(runs: Sequence[RecordedRun], key: str, metric: str) -> tuple[Point, ...]:
    at: dict[float, list[float]] = {}
    for run in runs:
        x, error = run.setting(key), run.metrics.get(metric)
        if isinstance(x, int | float) and error is not None and error > 0:
            at.setdefault(float(x), []).append(error)
    return tuple(_point(x, errors) for x, errors in sorted(at.items()))


def _costs(runs: Sequence[RecordedRun], by_count: bool) -> tuple[Point, ...]:
    groups = grouped(runs, lambda run: _agreeing(run, _OF_COST[:-1])).values()
    errors = [[error for run in group if (error := run.metrics[METRIC]) is not None] for group in groups]
    works = [_work(group[0], by_count) for group in groups]
    return tuple(sorted(map(_point, works, errors)))


def _point(x: float, errors: Sequence[float]) -> Point:
    if len(set(errors)) == 1:  # one seed says nothing about the spread, and equal errors have none
        return Point(x, errors[0], errors[0], errors[0])
    logs = [math.log(error) for error in errors]
    middle, width = mean(logs), half_width(logs)
    assert width is not None
    return Point(x, math.exp(middle), math.exp(middle - width), math.exp(middle + width))


def draw_error_against_radius(shown_panels: Sequence[Panel], rounding: float | None) -> Figure:
    """Both axes logarithmic, a panel a kernel; a line a count with its 95 % band over the seeds, dotted with
    ideal weights, and one for the error that ``rounding`` of V alone explains, where it is not far below the
    data."""
    with _errors(shown_panels) as (figure, grid):
        for axes, shown in zip(grid, shown_panels, strict=True):
            ticks(axes, "x", sorted({point.x for curve in shown.curves for point in curve.points}))
            axes.set_xlabel("radius $r$ of the ball")
        if rounding is not None and rounding > min(_drawn(grid)) / 10:
            for axes in grid:
                floor = axes.axhline(rounding, color="0.4", linestyle=_ROUNDING, linewidth=0.9)
                floor.set_label(r"rounding of $V$")
    return figure


def draw_cost_against_accuracy(shown_panels: Sequence[Panel], work: str = "products with $K$") -> Figure:
    """Both axes logarithmic; a line a law and predictor, or a radius, with its 95 % band over the seeds;
    ``work`` is what the work is counted in."""
    with _errors(shown_panels) as (figure, grid):
        for axes in grid:
            axes.set_xlabel(f"{work} a simulated second")
    return figure


@contextlib.contextmanager
def _errors(shown_panels: Sequence[Panel]) -> Iterator[tuple[Figure, list[Axes]]]:
    """Yield a page with the lines of all panels; in the end it gets limits and one legend."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    labels = [curve.label for curve in shown_panels[0].curves]
    more, visible = [_IDEAL, "rounding of V", "95 % over seeds"], False
    spare = labels + more if len(shown_panels) > 1 else ()
    with panels(len(shown_panels), _COLUMNS, spare=spare, sharey=True) as (figure, grid):
        for axes, shown in zip(grid, shown_panels, strict=True):
            axes.set(xscale="log", yscale="log")
            axes.set_title(shown.title, loc="left")
            for i, curve in enumerate(shown.curves):
                x, middle, low, high = np.reshape(curve.points, (-1, 4)).T
                look = {"color": colour(i), "marker": marker(i), "markersize": 3.5, "linestyle": dash(i)}
                axes.plot(x, middle, label=curve.label, **look)
                if (low < high).any():
                    axes.fill_between(x, low, high, color=colour(i), alpha=0.2, linewidth=0)
                visible |= any(point.high > _VISIBLE * point.low for point in curve.points)
                if curve.floor:
                    x, middle, _, _ = np.array(curve.floor).T
                    label = "_" if i else _IDEAL
                    axes.plot(x, middle, ":", color=colour(i), linewidth=0.9, label=label)
        yield figure, grid
        _label_left(grid)
        drawn = _drawn(grid)
        grid[0].set_ylim(min(drawn) / 2, max(drawn) * 2)
        # The same label has the same line in every panel: one legend serves them all.
        lines: dict[str, Artist] = {str(line.get_label()): line for axes in grid for line in axes.get_lines()}
        if _IDEAL in lines:  # of every colour
            lines[_IDEAL] = Line2D([], [], color="0.4", linestyle=":", linewidth=0.9, label=_IDEAL)
        handles = [line for label, line in lines.items() if not label.startswith("_")]
        handles.sort(key=lambda line: line.get_marker() == "None")  # type: ignore[attr-defined]
        if visible:
            handles.append(Patch(color="0.4", alpha=0.25, linewidth=0, label="95 % over seeds"))
        legend(*grid, handles=handles)


def _drawn(grid: Sequence[Axes]) -> list[float]:
    """Return the numbers of all lines but those far below the errors."""
    lines = [line for axes in grid for line in axes.get_lines()]
    numbers = [(line, y) for line in lines for y in np.asarray(line.get_ydata(), float) if np.isfinite(y)]
    least = min(y for line, y in numbers if line.get_marker() != "None")
    return [y for _, y in numbers if y >= _FAR * least]


def draw_heat_maps(maps: Sequence[HeatMap]) -> Figure:
    """The error by colour and number over radius and count, one scale for all kernels; grey: no result."""
    from matplotlib.colors import LogNorm

    errors = [e for shown in maps for row in shown.errors for e in row if e is not None]
    norm = LogNorm(min(errors), max(errors) if max(errors) > min(errors) else 10 * min(errors))
    high = 0.75 + _CELL * max(len(shown.counts) for shown in maps)
    with panels(len(maps), min(2, len(maps)), high=high) as (figure, grid):
        for axes, shown in zip(grid, maps, strict=True):
            values = np.array(shown.errors, dtype=float)  # None: NaN
            axes.set_facecolor("0.92")
            image = axes.imshow(values, norm=norm, cmap="viridis", origin="lower", aspect="auto")
            axes.grid(False)
            for (row, column), error in np.ndenumerate(values):
                text, shade = "-", "0.3"
                if np.isfinite(error):  # two digits, no plus or zero in the exponent: a cell is narrow
                    mantissa, _, power = f"{error:.1e}".partition("e")
                    text = f"{error:.2g}" if 0.01 <= error < 1000 else f"{mantissa}e{int(power)}"
                    shade = "white" if float(norm(error)) < 0.6 else "black"  # on dark and light colours
                axes.text(column, row, text, ha="center", va="center", color=shade)
            axes.set_xticks(range(len(shown.radii)), [f"{radius:g}" for radius in shown.radii])
            axes.set_yticks(range(len(shown.counts)), [str(count) for count in shown.counts])
            axes.tick_params(length=0)
            axes.set_xlabel("radius $r$ of the ball")
            axes.set_title(shown.title, loc="left")
        _label_left(grid, "centers $M$")
        figure.colorbar(image, ax=grid, label=_ERROR, pad=0.01, aspect=30)
    return figure


def _label_left(grid: Sequence[Axes], label: str = _ERROR) -> None:
    for axes in grid:
        if at_left(axes):
            axes.set_ylabel(label)


def _radius_figure(found: Collection) -> Figure | None:
    panels = error_against_radius(found)
    return draw_error_against_radius(panels, rounding_floor(found)) if panels else None


def _map_figure(found: Collection) -> Figure | None:
    maps = heat_maps(found)
    return draw_heat_maps(maps) if maps else None


def _cost_figure(found: Collection) -> Figure | None:
    panels = cost_against_accuracy(found)
    work = "multiplications" if _several(found.rows, COUNT) else "products with $K$"
    return draw_cost_against_accuracy(panels, work) if panels else None


SWEEP_FIGURES: dict[str, tuple[str, Callable[[Collection], Figure | None]]] = {
    "error_against_radius": ("Error against the radius", _radius_figure),
    "error_map": ("Error over radius and number of centers", _map_figure),
    "cost_against_accuracy": ("Cost against accuracy", _cost_figure),
}
"""By the name of the file: what a figure shows, and the function that draws it; None where not swept."""

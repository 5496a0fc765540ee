"""Figures of the experiments on the theorems."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib.resources
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from .plots import _colour, _dash, _positive

_MARKERS = "osD^vP*X"
_FAMILIES = ("rings", "ball", "polygon", "simplex", "cross_polytope")
_SLOPES = 4  # layouts of a family: with more centers rounding takes over at small radii
_BOUNDS = {
    "count": "two polynomials (paper)",
    "one_polynomial_count": "one polynomial",
    "measured_count": "measured with ideal weights",
}


class Feasibility(NamedTuple):
    """How many centers are needed: T states, R radii, E values of epsilon; 0 where no layout does."""

    time: np.ndarray  # (T,) seconds
    state: np.ndarray  # (T, n)
    radius: float  # of `pointwise`
    radii: np.ndarray  # (R,)
    epsilons: np.ndarray  # (E,)
    counts: np.ndarray  # (L,) of the layouts that were tried
    pointwise: np.ndarray  # (E, T)
    overall: np.ndarray  # (R, E)


@dataclasses.dataclass(frozen=True)
class LayoutCurve:
    """The error that a layout leaves on the ball."""

    family: str
    count: int
    error: float  # at one radius
    errors: np.ndarray  # (R,) at all radii
    slope: float | None


@contextlib.contextmanager
def _style() -> Iterator[None]:
    path = importlib.resources.files(__package__) / "staf.mplstyle"
    with importlib.resources.as_file(path) as file, matplotlib.rc_context(fname=file):
        yield


def draw_exponential_bound(found: Mapping[tuple[float, float], Mapping[str, float | None]]) -> Figure:
    """Number of kernels against epsilon, a panel a radius: both bounds and what is needed.

    Args:
        found: by radius and epsilon, the counts by their names.
    """
    radii = sorted({radius for radius, _ in found})
    columns = min(len(radii), 4)
    lines = -(-len(radii) // columns)
    with _style():
        figure = Figure(figsize=(7.2, 0.5 + 2.1 * lines), layout="constrained")
        grid = figure.subplots(lines, columns, sharex=True, sharey=True, squeeze=False)
        for axes, radius in zip(grid.flat, radii, strict=False):
            _bounds(axes, {epsilon: row for (r, epsilon), row in found.items() if r == radius})
            axes.set_title(f"$r = {radius:g}$")
        for axes in list(grid.flat)[len(radii) :]:
            axes.set_visible(False)
        for axes in grid[:, 0]:
            axes.set_ylabel("kernels $M$")
        for axes in list(grid.flat)[max(0, len(radii) - columns) : len(radii)]:
            axes.set_xlabel(r"largest error $\epsilon$")
            axes.tick_params(labelbottom=True)
        _plain_ticks(grid[0, 0], found)
        handles, labels = grid[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), handlelength=3.2)
        figure.draw_without_rendering()  # lays out under this style, not under the caller's
        return figure


def _plain_ticks(axes: Axes, found: Mapping[tuple[float, float], Mapping[str, float | None]]) -> None:
    """Plain counts, and the values of epsilon that were computed; decades alone would be too few."""
    most = max((row[name] or 1 for row in found.values() for name in _BOUNDS), default=1)
    spread = [count for count in (1, 2, 3, 6, 10, 20, 50, 100, 200, 500, 1000) if count <= most]
    axes.set_yticks(spread, [str(count) for count in spread])
    epsilons = sorted({epsilon for _, epsilon in found})
    shown = epsilons[:: -(-len(epsilons) // 6)]
    axes.set_xticks(shown, [f"${_power(epsilon)}$" for epsilon in shown])
    axes.minorticks_off()


def _bounds(axes: Axes, rows: Mapping[float, Mapping[str, float | None]]) -> None:
    epsilon = list(rows)
    for i, (name, label) in enumerate(_BOUNDS.items()):
        values = [row[name] for row in rows.values()]
        counts = [np.nan if value is None else value for value in values]
        axes.loglog(
            epsilon, counts, _dash(i), color=_colour(i), marker=_MARKERS[i], markersize=4, label=label
        )
    axes.set_xlim(max(epsilon) * 1.5, min(epsilon) / 1.5)  # what is asked grows to the right


def draw_feasibility(found: Feasibility) -> Figure:
    """M that is needed along the trajectory at one radius, and for all of it against the radius."""
    with _style():
        figure = Figure(figsize=(7.2, 3.2), layout="constrained")
        left, right = figure.subplots(1, 2, sharey=True)
        place, label = _place(found)
        for i, epsilon in enumerate(found.epsilons):
            style = {"color": _colour(i), "label": f"$\\epsilon = {_power(epsilon)}$"}
            needed = np.where(found.pointwise[i] > 0, found.pointwise[i], np.nan)
            left.plot(place, needed, _dash(i), drawstyle="steps-mid", **style)
            needed = np.where(found.overall[:, i] > 0, found.overall[:, i], np.nan)
            right.plot(found.radii, needed, _dash(i), marker=_MARKERS[i % 8], markersize=4, **style)
        left.set_yscale("log")
        left.set_yticks(found.counts, [str(count) for count in found.counts])
        left.minorticks_off()
        left.set_ylabel("centers $M$")
        left.set_xlabel(label)
        left.set_title(f"(a) at each state, $r = {found.radius:g}$", loc="left")
        left.margins(x=0)
        right.set_xscale("log")
        right.set_xticks(found.radii, [f"{radius:g}" for radius in found.radii])
        right.minorticks_off()
        right.set_xlabel("radius $r$ of the ball")
        right.set_title("(b) along the whole trajectory", loc="left")
        handles, labels = right.get_legend_handles_labels()
        figure.legend(
            handles, labels, loc="outside upper center", ncols=min(len(labels), 6), handlelength=3.2
        )
        figure.draw_without_rendering()
        return figure


def _place(found: Feasibility) -> tuple[np.ndarray, str]:
    """Where on the trajectory: its angle where it is an arc around the origin of the plane, else time."""
    norm = np.linalg.norm(found.state, axis=-1)
    if found.state.shape[-1] == 2 and norm.max() < 1.01 * norm.min():
        angle = np.unwrap(np.arctan2(found.state[:, 1], found.state[:, 0]))
        return np.degrees(np.abs(angle - angle[0])), "angle passed on the circle (degrees)"
    return found.time, "time (s)"


def draw_layouts(curves: Sequence[LayoutCurve], radius: float, radii: np.ndarray) -> Figure:
    """The error against M at one radius, and against the radius with measured slopes."""
    with _style():
        figure = Figure(figsize=(7.2, 3.6), layout="constrained")
        left, right = figure.subplots(1, 2)
        for family in _FAMILIES:
            _family(left, [curve for curve in curves if curve.family == family])
        left.set_yscale("log")
        left.set_xscale("log")
        counts = sorted({curve.count for curve in curves if curve.family in ("rings", "ball")})
        left.set_xticks(counts, [str(count) for count in counts])
        left.minorticks_off()
        left.set_xlabel("centers $M$")
        left.set_ylabel(r"$\sup\,|V - \hat V|$ on the ball")
        left.set_title(f"(a) $r = {radius:g}$", loc="left")
        left.legend(loc="lower left", handlelength=3.2)
        slopes = [_against_radius(right, curve, radii) for curve in _drawn(curves)]
        right.set_xscale("log")
        right.set_yscale("log")
        right.set_xticks(radii, [f"{r:g}" for r in radii])
        right.minorticks_off()
        right.set_xlabel("radius $r$ of the ball")
        right.set_title("(b) slopes in $r$", loc="left")
        right.legend(
            handles=slopes,
            title="layout, $M$: slope",
            handlelength=3.2,
            loc="center left",
            bbox_to_anchor=(1.0, 0.5),
        )
        figure.draw_without_rendering()
        return figure


def _family(axes: Axes, curves: Sequence[LayoutCurve]) -> None:
    if not curves:
        return
    i = _FAMILIES.index(curves[0].family)
    counts, errors = [curve.count for curve in curves], np.array([curve.error for curve in curves])
    alone = len(curves) == 1  # a single point: an open marker, which hides none of the others
    axes.plot(
        counts,
        _positive(errors),
        linestyle="none" if alone else _dash(i),
        marker=_MARKERS[i],
        markersize=8 if alone else 4,
        markerfacecolor="none" if alone else _colour(i),
        color=_colour(i),
        label=curves[0].family.replace("_", "-"),
    )


def _drawn(curves: Sequence[LayoutCurve]) -> list[LayoutCurve]:
    """The curves of the right panel: rings in the plane, ball elsewhere, and the largest polygon."""
    family = "rings" if any(curve.family == "rings" for curve in curves) else "ball"
    kept = [curve for curve in curves if curve.family == family]
    return kept[:_SLOPES] + [curve for curve in curves if curve.family == "polygon"][-1:]


def _against_radius(axes: Axes, curve: LayoutCurve, radii: np.ndarray) -> Line2D:
    i = len(axes.get_lines())
    slope = "-" if curve.slope is None else f"{curve.slope:.2f}"
    (line,) = axes.plot(
        radii,
        _positive(curve.errors),
        _dash(i),
        marker=_MARKERS[i % len(_MARKERS)],
        markersize=4,
        color=_colour(i),
        label=f"{curve.family}, {curve.count}: {slope}",
    )
    return line


def _power(number: float) -> str:
    exponent = round(np.log10(number))
    return f"10^{{{exponent}}}" if np.isclose(number, 10.0**exponent) else f"{number:g}"

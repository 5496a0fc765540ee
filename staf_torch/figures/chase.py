"""Figures of the gradient chase, its laws, the memory, a learned kernel, the theorems, and the flat limit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from .loop import by_unit
from .style import (
    against_time,
    at_left,
    colour,
    dash,
    decades,
    legend,
    letter,
    marker,
    named,
    panels,
    positive,
    ticks,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


_DECADES = 6  # below its largest value, on the axis of errors: they dip to rounding where they change sign
_NAMED = 6  # weights that are told apart in a legend


class ChaseHistory(NamedTuple):
    """A trajectory of a gradient chase."""

    time: np.ndarray  # (T,) seconds
    state: np.ndarray  # (T, n)
    value: np.ndarray  # (T,)
    estimate: np.ndarray  # (T,)
    ideal_estimate: np.ndarray  # (T,)
    weights: np.ndarray  # (T, M)
    ideal_weights: np.ndarray  # (T, M)
    excess: np.ndarray  # (T,)
    units: tuple[str, ...] = ()  # of the states, "" for none


class ConvergenceCurve(NamedTuple):
    """The ultimate excess of one law and predictor against the step."""

    label: str
    step: np.ndarray  # seconds
    excess: np.ndarray
    slope: float | None


def draw_chase(history: ChaseHistory) -> Figure:
    """The four panels of the paper's simulation: state, V against V^, weights, error and excess.

    States of several units have a panel each unit.
    """
    states = by_unit("state $x$", "x", history.units or ("",) * history.state.shape[1])
    with panels(len(states) + 3) as (figure, grid):
        for axes, (name, entries) in zip(grid, states, strict=False):
            for k, i in enumerate(entries):
                look = {"linestyle": dash(k), "color": colour(k), "label": f"$x_{{{i + 1}}}$"}
                axes.plot(history.time, history.state[:, i], **look)
            axes.set_ylabel(name)
            if len(entries) > 1:
                legend(axes)
        values, weights, errors = grid[len(states) :]
        time = history.time
        values.plot(time, history.value, color="0.7", linewidth=3.0, label="$V(x)$")
        values.plot(time, history.estimate, "--", color=colour(0), label=r"$\hat V(x)$")
        values.set_ylabel("value")
        few = history.weights.shape[1] <= _NAMED
        for i, column in enumerate(history.weights.T):
            label = f"$a_{{{i + 1}}}$" if few else None if i else "weights $a$"
            weights.plot(time, column, linestyle=dash(i), color=colour(i), label=label)
        for i, ideal in enumerate(history.ideal_weights.T):
            weights.plot(time, ideal, ":", color="0.2", linewidth=0.9, label=None if i else "ideal $w$")
        weights.set_ylabel("weights")
        error, floor = (np.abs(history.value - v) for v in (history.estimate, history.ideal_estimate))
        errors.semilogy(time, positive(error), color=colour(0), label=r"$|V - \hat V|$")
        errors.semilogy(time, positive(floor), "--", color="0.4", label="of ideal $w$")
        errors.semilogy(time, positive(history.excess), "-.", color=colour(1), label="$F(a) - F(w)$")
        decades(errors, _DECADES)
        errors.set_ylabel("error at $x$; excess $F$")
        for axes in (values, weights, errors):
            legend(axes)
        letter(grid)
        against_time(grid, history.time)
    return figure


def draw_convergence(found: Sequence[ConvergenceCurve]) -> Figure:
    """Excess before the correction against the step, both logarithmic, with the slopes in the legend."""
    slopes = ("-" if curve.slope is None else f"{curve.slope:.1f}" for curve in found)
    labels = [f"{curve.label}: {slope}" for curve, slope in zip(found, slopes, strict=True)]
    with panels(1, 2, high=3.0, spare=labels) as (figure, (axes,)):
        for i, (curve, label) in enumerate(zip(found, labels, strict=True)):
            (line,) = axes.loglog(curve.step, positive(curve.excess), linestyle=dash(i), marker=marker(i))
            line.set(markersize=4, color=colour(i), label=label)
        ticks(axes, "x", np.unique(np.concatenate([curve.step for curve in found])))
        axes.minorticks_off()
        axes.set_xlabel("time step $\\Delta t$ (s)")
        axes.set_ylabel("largest excess before the correction")
        legend(axes, handles=axes.get_lines(), title="law, iterations, predictor: slope")
    return figure


def draw_memory(
    path: np.ndarray,  # (T, n), settled
    stored: np.ndarray,  # (N, n) states of the models
    radius: np.ndarray,  # (N,) of their centers
    time: np.ndarray,  # (K,) seconds
    errors: dict[str, np.ndarray],  # approximant -> max |V - V^| on the ball, (K,)
    excess: dict[str, np.ndarray],  # start -> largest excess over the revisits, (S,)
    settled: float,  # the largest excess of the settled chase
) -> Figure:
    """Draw the states of stored models, the error over the visited region, the excess after a revisit."""
    from matplotlib.collections import EllipseCollection

    with panels(3, 3, high=2.3) as (figure, (plane, region, revisits)):
        second = 1 if path.shape[1] > 1 else 0  # a single state against itself
        plane.plot(path[:, 0], path[:, second], color="0.6", label="path")
        points, diameter = stored[:, [0, second]], 2 * radius
        look: dict[str, Any] = {"facecolor": "none", "edgecolor": colour(0), "linewidth": 0.3, "alpha": 0.5}
        where: dict[str, Any] = {"units": "xy", "offsets": points, "transOffset": plane.transData}
        balls = EllipseCollection(diameter, diameter, np.zeros_like(diameter), **where, **look)
        plane.add_collection(balls)
        plane.plot(points[:, 0], points[:, 1], ".", color=colour(0), markersize=3, label="stored model")
        plane.margins(0.12)
        plane.set(xlabel="$x_1$", ylabel=f"$x_{second + 1}$")
        plane.set_aspect("equal", adjustable="datalim")
        named(region, time, errors, log=True)
        region.set(xlabel="time of the visit (s)", ylabel=r"$\max\,|V - \hat V|$ on the ball")
        region.margins(x=0)
        steps = len(next(iter(excess.values())))
        named(revisits, np.arange(1, steps + 1), excess, log=True)
        revisits.axhline(settled, color="0.2", linestyle=":", linewidth=0.8, label="settled chase")
        revisits.set(xscale="log", xlabel="steps after the revisit", ylabel="largest excess")
        for axes in (plane, region, revisits):
            legend(axes)
        letter((plane, region, revisits))
    return figure


def draw_learned_kernel(
    name: str,  # of the width, in words
    widths: np.ndarray,  # (W,)
    radii: np.ndarray,  # (R,)
    grid: np.ndarray,  # errors (R, W)
    path: np.ndarray,  # width and radius after each step, (S + 1, 2)
    errors: np.ndarray,  # (S + 1,)
) -> Figure:
    """Draw the path over the errors of the grid of widths and radii, and the error over the steps."""
    from matplotlib.colors import LogNorm

    best = int(np.nan_to_num(grid, nan=np.inf).argmin())
    least = int(np.nan_to_num(errors, nan=np.inf).argmin())
    known = grid[np.isfinite(grid) & (grid > 0)]
    norm = LogNorm(known.min(), known.max()) if known.size and known.max() > known.min() else None
    with panels(2, 2, high=2.6) as (figure, (plane, steps)):
        plane.set_facecolor("0.92")
        image = plane.pcolormesh(widths, radii, grid, norm=norm, cmap="viridis", shading="nearest")
        plane.set(xscale="log", yscale="log", xlabel=name, ylabel="radius $r$ of the centers")
        plane.grid(False)
        plane.plot(*path.T, ".-", color="white", markersize=2, linewidth=0.8)
        row, column = np.unravel_index(best, grid.shape)
        drawn = {
            "start": (path[0], "o", 5),
            "best of the grid": ((widths[column], radii[row]), "s", 5),
            "least of the way": (path[least], "*", 9),
        }
        look: dict[str, Any] = {"color": "white", "markeredgecolor": "black", "linestyle": "none"}
        marks = [
            plane.plot(*at, kind, markersize=size, label=label, **look)[0]
            for label, (at, kind, size) in drawn.items()
        ]
        for axis, values in (("x", widths), ("y", radii)):
            ticks(plane, axis, [t for t in _ROUND if values[0] <= t <= values[-1]])
        plane.minorticks_off()
        figure.colorbar(image, ax=plane, label="error on the ball")
        (line,) = steps.semilogy(errors, color=colour(0), label="gradient")
        floor = steps.axhline(grid.flat[best], color="0.2", linestyle=":", linewidth=0.8)
        floor.set_label("least of the grid")
        steps.set(xlabel="step of Adam", ylabel="root mean square error on the ball")
        steps.margins(x=0)
        legend(steps, handles=[line, floor, *marks])
        letter((plane, steps))
    return figure


_ROUND = [m * 10.0**e for e in range(-6, 7) for m in (1, 2, 5)]
_FAMILIES = ("rings", "ball", "polygon", "simplex", "cross_polytope")
_SLOPES = 4  # layouts of a family: with more centers rounding takes over at small radii
_BOUNDS = {
    "count": "two polynomials (paper)",
    "one_polynomial_count": "one polynomial",
    "measured_count": "measured with ideal weights",
}
_METHODS = "osv^"  # markers, the later the smaller: curves that lie on each other are all seen
_TOP = 12.0  # of the error axis of the flat limit: all digits are lost at 1
_FAILED = 1.0  # where the marks of failures stand
_FAILS, _DTYPE = "fails (in its colour)", r"$\varepsilon$ of the dtype"


class Feasibility(NamedTuple):
    """Numbers of centers that are needed: T states, R radii, E values of epsilon; 0 where no layout does."""

    time: np.ndarray  # (T,) seconds
    state: np.ndarray  # (T, n)
    radius: float  # of `pointwise`
    radii: np.ndarray  # (R,)
    epsilons: np.ndarray  # (E,)
    counts: np.ndarray  # (L,) of the layouts that were tried
    pointwise: np.ndarray  # (E, T)
    overall: np.ndarray  # (R, E)


class LayoutCurve(NamedTuple):
    """The error that a layout leaves on the ball."""

    family: str
    centers: int
    order: int  # k + 1: the error is O(r^{k+1})
    error: float  # at one radius
    errors: np.ndarray  # (R,) at all radii
    slope: float | None


class ErrorPanel(NamedTuple):
    """Relative errors of several methods in one dtype; inf where a method fails."""

    title: str
    rounding: float  # eps of the dtype
    radius: Sequence[float]
    error: Mapping[str, Sequence[float]]  # by the method's label, the most important one last


def draw_exponential_bound(found: Mapping[tuple[float, float], Mapping[str, float | None]]) -> Figure:
    """Number of kernels against epsilon, a panel a radius: both bounds and what is needed, by radius and
    epsilon."""
    radii, epsilons = (sorted(set(values)) for values in zip(*found, strict=True))
    most = max(row[name] or 1 for row in found.values() for name in _BOUNDS)
    with panels(len(radii), 3, sharex=True, sharey=True) as (figure, grid):
        for axes, radius in zip(grid, radii, strict=True):
            rows = {epsilon: row for (r, epsilon), row in found.items() if r == radius}
            for i, (name, label) in enumerate(_BOUNDS.items()):
                counts = np.array([row[name] for row in rows.values()], dtype=float)  # None: NaN
                look = {"linestyle": dash(i), "color": colour(i), "marker": marker(i), "markersize": 4}
                axes.loglog(list(rows), counts, label=label, **look)
            axes.set_xlim(max(rows) * 1.5, min(rows) / 1.5)  # what is asked grows to the right
            axes.set(title=f"$r = {radius:g}$", xlabel=r"largest error $\epsilon$")
            axes.set_ylabel("kernels $M$" if at_left(axes) else "")
        # Plain counts, and the values of epsilon that were computed; decades alone would be too few.
        counted = (1, 2, 3, 6, 10, 20, 50, 100, 200, 500, 1000)
        ticks(grid[0], "y", [count for count in counted if count <= most])
        shown = epsilons[:: -(-len(epsilons) // 6)]
        grid[0].set_xticks(shown, [f"${_power(epsilon)}$" for epsilon in shown])
        grid[0].minorticks_off()
        legend(*grid)
    return figure


def draw_feasibility(found: Feasibility) -> Figure:
    """M that is needed along the trajectory at one radius, and for all of it against the radius."""
    with panels(2, high=2.5, sharey=True) as (figure, (left, right)):
        place, label = found.time, "time (s)"
        norm = np.linalg.norm(found.state, axis=-1)
        if found.state.shape[-1] == 2 and norm.max() < 1.01 * norm.min():  # an arc around the origin
            angle = np.unwrap(np.arctan2(found.state[:, 1], found.state[:, 0]))
            place, label = np.degrees(np.abs(angle - angle[0])), "angle passed on the circle (degrees)"
        for i, epsilon in enumerate(found.epsilons):
            style = {"color": colour(i), "linestyle": dash(i), "label": f"$\\epsilon = {_power(epsilon)}$"}
            left.plot(place, positive(found.pointwise[i]), drawstyle="steps-mid", **style)
            overall = positive(found.overall[:, i])
            right.plot(found.radii, overall, marker=marker(i), markersize=4, **style)
        left.set_yscale("log")
        ticks(left, "y", found.counts)
        left.set_ylabel("centers $M$")
        right.set_ylabel("centers $M$" if at_left(right) else "")
        left.set_xlabel(label)
        left.margins(x=0)
        right.set_xscale("log")
        ticks(right, "x", found.radii)
        right.set_xlabel("radius $r$ of the ball")
        letter((left, right), f"at each state, $r = {found.radius:g}$", "along the whole trajectory")
        legend(right, left)
    return figure


def draw_layouts(found: Sequence[LayoutCurve], radius: float, radii: np.ndarray) -> Figure:
    """The error against M at one radius, and against the radius with measured slopes."""
    with panels(2, high=3.0) as (figure, (left, right)):
        for axes in (left, right):
            axes.set(xscale="log", yscale="log")
        families = {family: [curve for curve in found if curve.family == family] for family in _FAMILIES}
        for i, (family, curves) in enumerate(families.items()):
            if not curves:
                continue
            alone = len(curves) == 1  # a single point: an open marker, which hides none of the others
            errors = positive(np.array([curve.error for curve in curves]))
            (line,) = left.plot([curve.centers for curve in curves], errors, marker(i), color=colour(i))
            line.set(linestyle="none" if alone else dash(i), label=family.replace("_", "-"))
            line.set(markersize=8 if alone else 4, markerfacecolor="none" if alone else colour(i))
        ticks(left, "x", sorted({c.centers for c in (*families["rings"], *families["ball"])}))
        left.set(xlabel="centers $M$", ylabel=r"$\sup\,|V - \hat V|$ on the ball")
        legend(left)
        kept = families["rings"] or families["ball"]  # the one in the plane, the other elsewhere
        for i, curve in enumerate([*kept[:_SLOPES], *families["polygon"][-1:]]):
            slope = "-" if curve.slope is None else f"{curve.slope:.2f}"
            (line,) = right.plot(radii, positive(curve.errors), marker(i), linestyle=dash(i), markersize=4)
            line.set(color=colour(i), label=f"{curve.family}, {curve.centers}: {slope}")
        ticks(right, "x", radii)
        right.set_xlabel("radius $r$ of the ball")
        legend(right, title="layout, $M$: slope")
        right.set_ylabel(left.get_ylabel() if at_left(right) else "")
        letter((left, right), f"$r = {radius:g}$", "slopes in $r$")
    return figure


def _power(number: float) -> str:
    exponent = round(np.log10(number))
    return f"10^{{{exponent}}}" if np.isclose(number, 10.0**exponent) else f"{number:g}"


def draw_errors(panels_: Sequence[ErrorPanel], rows: int) -> Figure:
    """Error against radius: panels in ``rows`` rows, log-log, each row with one error axis; one legend."""
    failed = any(not np.isfinite(errors).all() for panel in panels_ for errors in panel.error.values())
    labels = [*panels_[0].error, *([_FAILS] if failed else []), _DTYPE]
    columns = len(panels_) // rows
    with panels(len(panels_), columns, spare=labels, sharex=True) as (figure, grid):
        for axes, panel in zip(grid, panels_, strict=True):
            _errors(axes, panel)
        letter(grid, *(panel.title for panel in panels_))
        drawn = {str(line.get_label()): line for axes in grid for line in axes.get_lines()}
        legend(*grid, handles=[drawn[label] for label in labels if label in drawn])
    return figure


def _errors(axes: Axes, panel: ErrorPanel) -> None:
    radius = np.asarray(panel.radius)
    for i, (label, errors) in enumerate(panel.error.items()):
        error = np.asarray(errors)
        # An exact result cannot stand on a log axis: it is drawn at a tenth of the rounding unit.
        drawn = np.where(np.isfinite(error), np.maximum(error, 0.1 * panel.rounding), np.nan)
        (line,) = axes.loglog(radius, drawn, linestyle=dash(i), color=colour(i), label=label)
        line.set(marker=_METHODS[i], markersize=3.8 - 0.6 * i)
        failed = radius[~np.isfinite(error)]
        if len(failed):  # one row of marks a method, so that two that fail together are both seen
            marks: dict[str, Any] = {"markersize": 3, "color": colour(i), "label": _FAILS}
            axes.plot(failed, np.full(len(failed), _FAILED * 4.0**i), "x", linestyle="none", **marks)
    floor = axes.axhline(panel.rounding, color="0.4", linewidth=0.8, linestyle=(0, (1, 1)))
    floor.set_label(_DTYPE)
    axes.set(ylim=(0.05 * panel.rounding, _TOP), xlabel="radius $r$")
    axes.set_ylabel(r"relative error of $\hat V$" if at_left(axes) else "")
    axes.margins(x=0.02)

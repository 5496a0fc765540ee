"""Figures of the experiments on the theorems and on the flat limit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from .style import at_left, colour, dash, legend, letter, marker, panels, positive, ticks

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

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
    radii = sorted({radius for radius, _ in found})
    with panels(len(radii), 3, sharex=True, sharey=True) as (figure, grid):
        for axes, radius in zip(grid, radii, strict=True):
            _bounds(axes, {epsilon: row for (r, epsilon), row in found.items() if r == radius})
            axes.set_title(f"$r = {radius:g}$")
            axes.set_xlabel(r"largest error $\epsilon$")
            if at_left(axes):
                axes.set_ylabel("kernels $M$")
        _plain_ticks(grid[0], found)
        legend(*grid)
    return figure


def _plain_ticks(axes: Axes, found: Mapping[tuple[float, float], Mapping[str, float | None]]) -> None:
    """Plain counts, and the values of epsilon that were computed; decades alone would be too few."""
    most = max(row[name] or 1 for row in found.values() for name in _BOUNDS)
    ticks(axes, "y", [count for count in (1, 2, 3, 6, 10, 20, 50, 100, 200, 500, 1000) if count <= most])
    epsilons = sorted({epsilon for _, epsilon in found})
    shown = epsilons[:: -(-len(epsilons) // 6)]
    axes.set_xticks(shown, [f"${_power(epsilon)}$" for epsilon in shown])
    axes.minorticks_off()


def _bounds(axes: Axes, rows: Mapping[float, Mapping[str, float | None]]) -> None:
    epsilon = list(rows)
    for i, (name, label) in enumerate(_BOUNDS.items()):
        counts = np.array([row[name] for row in rows.values()], dtype=float)  # None: NaN
        look = {"linestyle": dash(i), "color": colour(i), "marker": marker(i), "markersize": 4}
        axes.loglog(epsilon, counts, label=label, **look)
    axes.set_xlim(max(epsilon) * 1.5, min(epsilon) / 1.5)  # what is asked grows to the right


def draw_feasibility(found: Feasibility) -> Figure:
    """M that is needed along the trajectory at one radius, and for all of it against the radius."""
    with panels(2, high=2.5, sharey=True) as (figure, (left, right)):
        place, label = _place(found)
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


def _place(found: Feasibility) -> tuple[np.ndarray, str]:
    """Return the place on the trajectory: the angle of an arc around the origin of the plane, else time."""
    norm = np.linalg.norm(found.state, axis=-1)
    if found.state.shape[-1] == 2 and norm.max() < 1.01 * norm.min():
        angle = np.unwrap(np.arctan2(found.state[:, 1], found.state[:, 0]))
        return np.degrees(np.abs(angle - angle[0])), "angle passed on the circle (degrees)"
    return found.time, "time (s)"


def draw_layouts(found: Sequence[LayoutCurve], radius: float, radii: np.ndarray) -> Figure:
    """The error against M at one radius, and against the radius with measured slopes."""
    with panels(2, high=3.0) as (figure, (left, right)):
        for axes in (left, right):
            axes.set(xscale="log", yscale="log")
        for family in _FAMILIES:
            _family(left, [curve for curve in found if curve.family == family])
        ticks(left, "x", sorted({curve.centers for curve in found if curve.family in ("rings", "ball")}))
        left.set_xlabel("centers $M$")
        left.set_ylabel(r"$\sup\,|V - \hat V|$ on the ball")
        legend(left)
        for i, curve in enumerate(_drawn(found)):
            _against_radius(right, i, curve, radii)
        ticks(right, "x", radii)
        right.set_xlabel("radius $r$ of the ball")
        legend(right, title="layout, $M$: slope")
        right.set_ylabel(left.get_ylabel() if at_left(right) else "")
        letter((left, right), f"$r = {radius:g}$", "slopes in $r$")
    return figure


def _family(axes: Axes, found: Sequence[LayoutCurve]) -> None:
    if not found:
        return
    i = _FAMILIES.index(found[0].family)
    alone = len(found) == 1  # a single point: an open marker, which hides none of the others
    (line,) = axes.plot(
        [curve.centers for curve in found],
        positive(np.array([curve.error for curve in found])),
        linestyle="none" if alone else dash(i),
        markerfacecolor="none" if alone else colour(i),
        color=colour(i),
    )
    line.set(marker=marker(i), markersize=8 if alone else 4, label=found[0].family.replace("_", "-"))


def _drawn(found: Sequence[LayoutCurve]) -> list[LayoutCurve]:
    """The curves of the right panel: rings in the plane, ball elsewhere, and the largest polygon."""
    family = "rings" if any(curve.family == "rings" for curve in found) else "ball"
    kept = [curve for curve in found if curve.family == family]
    return kept[:_SLOPES] + [curve for curve in found if curve.family == "polygon"][-1:]


def _against_radius(axes: Axes, i: int, curve: LayoutCurve, radii: np.ndarray) -> None:
    slope = "-" if curve.slope is None else f"{curve.slope:.2f}"
    (line,) = axes.plot(radii, positive(curve.errors), linestyle=dash(i), marker=marker(i), markersize=4)
    line.set(color=colour(i), label=f"{curve.family}, {curve.centers}: {slope}")


def _power(number: float) -> str:
    exponent = round(np.log10(number))
    return f"10^{{{exponent}}}" if np.isclose(number, 10.0**exponent) else f"{number:g}"


def draw_errors(panels_: Sequence[ErrorPanel], rows: int) -> Figure:
    """Error against radius: panels in ``rows`` rows, log-log, each row with one error axis; one legend."""
    fails = "fails (in its colour)" if any(_fails(panel) for panel in panels_) else None
    labels = [*panels_[0].error, *filter(None, [fails]), r"$\varepsilon$ of the dtype"]
    columns = len(panels_) // rows
    with panels(len(panels_), columns, spare=labels, sharex=True) as (figure, grid):
        for axes, panel in zip(grid, panels_, strict=True):
            _errors(axes, panel)
            axes.set_xlabel("radius $r$")
            if at_left(axes):
                axes.set_ylabel(r"relative error of $\hat V$")
        letter(grid, *(panel.title for panel in panels_))
        drawn = {str(line.get_label()): line for axes in grid for line in axes.get_lines()}
        legend(*grid, handles=[drawn[label] for label in labels if label in drawn])
    return figure


def _fails(panel: ErrorPanel) -> bool:
    return not all(np.isfinite(np.asarray(errors)).all() for errors in panel.error.values())


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
            at = np.full(len(failed), _FAILED * 4.0**i)
            marks: dict[str, Any] = {"markersize": 3, "color": colour(i), "linestyle": "none", "marker": "x"}
            axes.plot(failed, at, label="fails (in its colour)", **marks)
    rounding = axes.axhline(panel.rounding, color="0.4", linewidth=0.8, linestyle=(0, (1, 1)))
    rounding.set_label(r"$\varepsilon$ of the dtype")
    axes.set_ylim(0.05 * panel.rounding, _TOP)
    axes.margins(x=0.02)

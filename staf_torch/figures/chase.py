"""Figures of the gradient chase, of the comparison of its laws, and of the experience memory."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from .style import WIDTH, colour, curves, dash, legend_above, letter, marker, named, page, positive, ticks

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_DECADES = 1e-6  # of its largest value a log axis shows at most


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


class ConvergenceCurve(NamedTuple):
    """The ultimate excess of one law and predictor against the step."""

    label: str
    step: np.ndarray  # seconds
    excess: np.ndarray
    slope: float | None


class MemoryPicture(NamedTuple):
    """A trajectory and its memory."""

    path: np.ndarray  # (T, n), settled
    stored: np.ndarray  # (N, n) states of the models
    radius: np.ndarray  # (N,) of their centers
    time: np.ndarray  # (K,) seconds
    errors: dict[str, np.ndarray]  # approximant -> max |V - V^| on the ball, (K,)
    excess: dict[str, np.ndarray]  # start -> largest excess over the revisits, (S,)
    settled: float  # the largest excess of the settled chase


def draw_chase(history: ChaseHistory) -> Figure:
    """The four panels of the paper's simulation: state, V against V^, weights, error and excess."""
    with page(WIDTH, 5.4) as figure:
        grid = figure.subplots(2, 2, sharex=True)
        for axes, panel in zip(grid.flat, (_states, _values, _weights, _errors), strict=True):
            panel(axes, history)
            axes.margins(x=0)
        letter(grid.flat)
        for axes in grid[1]:
            axes.set_xlabel("time (s)")
    return figure


def _states(axes: Axes, history: ChaseHistory) -> None:
    curves(axes, history.time, history.state, "$x_{%d}$")
    axes.set_ylabel("state $x$")
    legend_above(axes, history.state.shape[1])


def _values(axes: Axes, history: ChaseHistory) -> None:
    axes.plot(history.time, history.value, color="0.6", linewidth=3.0, label="$V(x)$")
    axes.plot(history.time, history.estimate, "--", color=colour(0), label=r"$\hat V(x)$")
    axes.set_ylabel("value")
    legend_above(axes, 2)


def _weights(axes: Axes, history: ChaseHistory) -> None:
    count = history.weights.shape[1]
    for i in range(count):
        axes.plot(history.time, history.weights[:, i], color=colour(i), label=f"$a_{{{i + 1}}}$")
        axes.plot(history.time, history.ideal_weights[:, i], ":", color=colour(i))
    axes.plot([], [], ":", color="0.3", label="ideal")
    axes.set_ylabel("weights")
    if count <= 6:
        legend_above(axes, count + 1)
    else:
        axes.legend(handles=axes.get_lines()[-1:], loc="lower right", bbox_to_anchor=(1.0, 1.0))


def _errors(axes: Axes, history: ChaseHistory) -> None:
    error = np.abs(history.value - history.estimate)
    floor = np.abs(history.value - history.ideal_estimate)
    axes.semilogy(history.time, positive(error), color=colour(0), label=r"$|V - \hat V|$")
    axes.semilogy(history.time, positive(floor), "--", color="0.5", label="ideal weights (floor)")
    excess = positive(history.excess)
    axes.semilogy(history.time, excess, "-.", color=colour(1), label="excess $F(a) - F(w)$")
    # Each curve dips to rounding error where it changes sign; those spikes would take up the panel.
    top = np.nanmax([np.nanmax(curve) for curve in (error, floor, history.excess)])
    axes.set_ylim(bottom=max(axes.get_ylim()[0], _DECADES * top))
    axes.set_ylabel("error at $x$; excess")
    legend_above(axes, 2)


def draw_convergence(found: Sequence[ConvergenceCurve]) -> Figure:
    """Excess before the correction against the step, both logarithmic, with the slopes in the legend."""
    with page(WIDTH, 3.6) as figure:
        axes = figure.subplots()
        for i, curve in enumerate(found):
            slope = "-" if curve.slope is None else f"{curve.slope:.1f}"
            (line,) = axes.loglog(curve.step, positive(curve.excess), dash(i), marker=marker(i), markersize=4)
            line.set(color=colour(i), label=f"{curve.label}: {slope}")
        ticks(axes, "x", np.unique(np.concatenate([curve.step for curve in found])))
        axes.minorticks_off()
        axes.set_xlabel("step $\\Delta t$ (s)")
        axes.set_ylabel("ultimate excess before the correction")
        axes.legend(title="law, iterations, predictor: slope", loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def draw_memory(picture: MemoryPicture) -> Figure:
    """Draw the states of stored models, the error over the visited region, the excess after a revisit."""
    with page(WIDTH, 3.1) as figure:
        grid = figure.subplots(1, 3)
        for axes, panel in zip(grid, (_map, _region, _revisits), strict=True):
            panel(axes, picture)
            legend_above(axes, 1)
        letter(grid)
    return figure


def _map(axes: Axes, picture: MemoryPicture) -> None:
    """The first two states; a single one against itself."""
    from matplotlib.collections import EllipseCollection

    second = 1 if picture.path.shape[1] > 1 else 0
    axes.plot(picture.path[:, 0], picture.path[:, second], color="0.6", label="path")
    points = picture.stored[:, [0, second]]
    diameter = 2 * picture.radius
    balls = EllipseCollection(
        *(diameter, diameter, np.zeros_like(diameter)),
        units="xy",
        offsets=points,
        transOffset=axes.transData,
        facecolor="none",
        edgecolor=colour(0),
        linewidth=0.3,
        alpha=0.5,
    )
    axes.add_collection(balls)
    axes.plot(points[:, 0], points[:, 1], ".", color=colour(0), markersize=3, label="stored model")
    (ball,) = axes.plot([], [], "o", color=colour(0), label="ball of its centers")
    ball.set(markerfacecolor="none", markersize=8)
    axes.margins(0.12)
    axes.set_xlabel("$x_1$")
    axes.set_ylabel(f"$x_{second + 1}$")
    axes.set_aspect("equal", adjustable="datalim")


def _region(axes: Axes, picture: MemoryPicture) -> None:
    named(axes, picture.time, picture.errors, log=True)
    axes.set_xlabel("time at which the ball was visited (s)")
    axes.set_ylabel(r"$\max\,|V - \hat V|$ on the ball")
    axes.margins(x=0)


def _revisits(axes: Axes, picture: MemoryPicture) -> None:
    steps = len(next(iter(picture.excess.values())))
    named(axes, np.arange(1, steps + 1), picture.excess, log=True)
    axes.set_xscale("log")
    axes.axhline(picture.settled, color="0.2", linestyle=":", linewidth=0.8, label="settled chase")
    axes.set_xlabel("steps after the revisit")
    axes.set_ylabel("largest excess $F(a) - F(w)$")

"""Figures of the gradient chase, its laws, the experience memory, and a kernel learned by gradient."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from .loop import by_unit
from .style import against_time, colour, dash, decades, legend, letter, marker, named, panels, positive, ticks

if TYPE_CHECKING:
    from matplotlib.artist import Artist
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
        for axes, panel in zip(grid[len(states) :], (_values, _weights, _errors), strict=True):
            panel(axes, history)
            legend(axes)
        letter(grid)
        against_time(grid, history.time)
    return figure


def _values(axes: Axes, history: ChaseHistory) -> None:
    axes.plot(history.time, history.value, color="0.7", linewidth=3.0, label="$V(x)$")
    axes.plot(history.time, history.estimate, "--", color=colour(0), label=r"$\hat V(x)$")
    axes.set_ylabel("value")


def _weights(axes: Axes, history: ChaseHistory) -> None:
    count = history.weights.shape[1]
    for i in range(count):
        label = f"$a_{{{i + 1}}}$" if count <= _NAMED else None if i else "weights $a$"
        axes.plot(history.time, history.weights[:, i], linestyle=dash(i), color=colour(i), label=label)
    for i in range(count):
        ideal = history.ideal_weights[:, i]
        axes.plot(history.time, ideal, ":", color="0.2", linewidth=0.9, label=None if i else "ideal $w$")
    axes.set_ylabel("weights")


def _errors(axes: Axes, history: ChaseHistory) -> None:
    error = np.abs(history.value - history.estimate)
    floor = np.abs(history.value - history.ideal_estimate)
    axes.semilogy(history.time, positive(error), color=colour(0), label=r"$|V - \hat V|$")
    axes.semilogy(history.time, positive(floor), "--", color="0.4", label="of ideal $w$")
    excess = positive(history.excess)
    axes.semilogy(history.time, excess, "-.", color=colour(1), label="$F(a) - F(w)$")
    decades(axes, _DECADES)
    axes.set_ylabel("error at $x$; excess $F$")


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


def draw_memory(picture: MemoryPicture) -> Figure:
    """Draw the states of stored models, the error over the visited region, the excess after a revisit."""
    with panels(3, 3, high=2.3) as (figure, grid):
        for axes, panel in zip(grid, (_map, _region, _revisits), strict=True):
            panel(axes, picture)
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
    legend(axes)
    axes.margins(0.12)
    axes.set_xlabel("$x_1$")
    axes.set_ylabel(f"$x_{second + 1}$")
    axes.set_aspect("equal", adjustable="datalim")


def _region(axes: Axes, picture: MemoryPicture) -> None:
    named(axes, picture.time, picture.errors, log=True)
    legend(axes)
    axes.set_xlabel("time of the visit (s)")
    axes.set_ylabel(r"$\max\,|V - \hat V|$ on the ball")
    axes.margins(x=0)


def _revisits(axes: Axes, picture: MemoryPicture) -> None:
    steps = len(next(iter(picture.excess.values())))
    named(axes, np.arange(1, steps + 1), picture.excess, log=True)
    axes.set_xscale("log")
    axes.axhline(picture.settled, color="0.2", linestyle=":", linewidth=0.8, label="settled chase")
    axes.set_xlabel("steps after the revisit")
    axes.set_ylabel("largest excess")
    legend(axes)


class LearnedKernel(NamedTuple):
    """The way of a kernel's width and its centers' radius over a grid of both."""

    name: str  # of the width, in words
    widths: np.ndarray  # (W,)
    radii: np.ndarray  # (R,)
    grid: np.ndarray  # errors (R, W)
    path: np.ndarray  # width and radius after each step, (S + 1, 2)
    errors: np.ndarray  # (S + 1,)


def draw_learned_kernel(picture: LearnedKernel) -> Figure:
    """Draw the path over the errors of the grid, and the error over the steps."""
    with panels(2, 2, high=2.6) as (figure, grid):
        marks = _learned(figure, grid[0], picture)
        _steps(grid[1], picture, marks)
        letter(grid)
    return figure


def _learned(figure: Figure, axes: Axes, picture: LearnedKernel) -> list[Artist]:
    """Draw the errors of the grid and the path; return its marks."""
    from matplotlib.colors import LogNorm

    known = picture.grid[np.isfinite(picture.grid) & (picture.grid > 0)]
    norm = LogNorm(known.min(), known.max()) if known.size and known.max() > known.min() else None
    axes.set_facecolor("0.92")
    image = axes.pcolormesh(
        *(picture.widths, picture.radii, picture.grid), norm=norm, cmap="viridis", shading="nearest"
    )
    axes.set(xscale="log", yscale="log", xlabel=picture.name, ylabel="radius $r$ of the centers")
    axes.grid(False)
    axes.plot(*picture.path.T, ".-", color="white", markersize=2, linewidth=0.8)
    row, column = np.unravel_index(_least(picture.grid), picture.grid.shape)
    drawn = {
        "start": (picture.path[0], "o"),
        "best of the grid": ((picture.widths[column], picture.radii[row]), "s"),
        "least of the way": (picture.path[_least(picture.errors)], "*"),
    }
    marks: list[Artist] = []
    for label, (at, kind) in drawn.items():
        size = 9 if kind == "*" else 5
        (mark,) = axes.plot(
            *at, kind, color="white", markeredgecolor="black", markersize=size, linestyle="none", label=label
        )
        marks.append(mark)
    for name, values in (("x", picture.widths), ("y", picture.radii)):
        ticks(axes, name, [t for t in _ROUND if values[0] <= t <= values[-1]])
    axes.minorticks_off()
    figure.colorbar(image, ax=axes, label="error on the ball")
    return marks


def _least(errors: np.ndarray) -> int:
    """The place of the least error that is known, the first where none is."""
    return int(np.nan_to_num(errors, nan=np.inf).argmin())


def _steps(axes: Axes, picture: LearnedKernel, marks: list[Artist]) -> None:
    (line,) = axes.semilogy(picture.errors, color=colour(0), label="gradient")
    best = picture.grid.flat[_least(picture.grid)]
    floor = axes.axhline(best, color="0.2", linestyle=":", linewidth=0.8, label="least of the grid")
    axes.set(xlabel="step of Adam", ylabel="root mean square error on the ball")
    axes.margins(x=0)
    legend(axes, handles=[line, floor, *marks])


_ROUND = [m * 10.0**e for e in range(-6, 7) for m in (1, 2, 5)]

"""Figures of constrained closed loops: the plane with the sets that must not be left or entered, and h(t)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from .style import WIDTH, colour, curves, dash, legend_above, legend_of_all, letter, page

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


class BoxHistory(NamedTuple):
    """One start under several methods, in a box."""

    time: np.ndarray  # (T,) seconds
    paths: Mapping[str, np.ndarray]  # method -> x, (T, n)
    margins: Mapping[str, np.ndarray]  # method -> distance to the nearest wall, (T,)
    costs: Mapping[str, np.ndarray]  # method -> cost so far, (T,)
    barrier_state: np.ndarray  # s of the first method, (T, n)
    low: np.ndarray  # (n,) -inf for none
    high: np.ndarray  # (n,)


def draw_box(history: BoxHistory) -> Figure:
    """The first two coordinates with their walls, the distance to the nearest wall, s and the cost."""
    with page(WIDTH, 4.6) as figure:
        plane, margin, barrier, cost = figure.subplots(2, 2).flat
        for i, (name, path) in enumerate(history.paths.items()):
            plane.plot(path[:, 0], path[:, 1], dash(i), color=colour(i), label=name)
            margin.plot(history.time, history.margins[name], dash(i), color=colour(i))
            cost.plot(history.time, history.costs[name], dash(i), color=colour(i), label=name)
        walls(plane, history.low, history.high)
        plane.set(xlabel="$x_1$", ylabel="$x_2$")
        legend_of_all(figure, plane, 3)
        margin.set_ylabel("distance to the nearest wall")
        margin.set_ylim(bottom=0)
        curves(barrier, history.time, history.barrier_state, "$s_{%d}$")
        barrier.set_ylabel("barrier coordinates")
        legend_above(barrier, history.barrier_state.shape[1])
        cost.set_ylabel("cost of $s$ so far")
        cost.set_ylim(bottom=0)
        for axes in (margin, barrier, cost):
            axes.set(xlabel="time (s)", xlim=(history.time[0], history.time[-1]))
        letter((plane, margin, barrier, cost))
    return figure


def walls(axes: Axes, low: np.ndarray, high: np.ndarray) -> None:
    """Draw the walls of the first two coordinates, and shade what lies beyond."""
    for k, ends in enumerate((axes.get_xlim(), axes.get_ylim())):
        reach = 0.06 * (ends[1] - ends[0])
        for wall, sign in ((low[k], -1), (high[k], 1)):
            if np.isfinite(wall):
                beyond = sorted((wall, wall + sign * reach))
                if k == 0:
                    axes.axvline(wall, color="0.2", linewidth=0.8)
                    axes.axvspan(beyond[0], beyond[1], color="0.85", linewidth=0)
                else:
                    axes.axhline(wall, color="0.2", linewidth=0.8)
                    axes.axhspan(beyond[0], beyond[1], color="0.85", linewidth=0)


class AvoidanceHistory(NamedTuple):
    """One scenario with moving discs under several methods, and the least distances of all scenarios."""

    time: np.ndarray  # (T,) seconds
    paths: Mapping[str, np.ndarray]  # method -> p, (T, 2)
    discs: np.ndarray  # (T, K, 2) their centers
    radius: float
    distances: Mapping[str, np.ndarray]  # method -> distance to the nearest edge, (T,)
    costs: Mapping[str, np.ndarray]  # method -> cost so far, (T,)
    nearest: Mapping[str, np.ndarray]  # method -> least distance of every scenario, (B,)


def draw_avoidance(history: AvoidanceHistory) -> Figure:
    """The plane with the discs at some times, the distance, the least distances of all, and the cost."""
    from matplotlib.patches import Circle

    with page(WIDTH, 4.8) as figure:
        plane, apart, share, cost = figure.subplots(2, 2).flat
        last = int(np.argmax(history.time >= 0.5 * history.time[-1]))
        shown = np.linspace(0, last, 5).round().astype(int)
        for shade, at in zip(np.linspace(0.92, 0.6, len(shown)), shown, strict=True):
            for center in history.discs[at]:
                disc = Circle(
                    tuple(center), history.radius, facecolor=f"{shade:.3f}", edgecolor="0.4", linewidth=0.4
                )
                plane.add_patch(disc)
        for i, (name, path) in enumerate(history.paths.items()):
            plane.plot(path[:, 0], path[:, 1], dash(i), color=colour(i), label=name)
            plane.plot(path[shown, 0], path[shown, 1], ".", color=colour(i), markersize=4)
            apart.plot(history.time, history.distances[name], dash(i), color=colour(i), label=name)
            cost.plot(history.time, history.costs[name], dash(i), color=colour(i), label=name)
            nearest = np.sort(history.nearest[name])
            steps = np.arange(1, len(nearest) + 1) / len(nearest)
            share.step(nearest, steps, dash(i), where="post", color=colour(i), label=name)
        plane.set(xlabel="$p_1$ (m)", ylabel="$p_2$ (m)", aspect="equal")
        legend_above(apart, 2)
        for axes in (apart, share):
            line = axes.axhline if axes is apart else axes.axvline
            line(0.0, color="0.2", linewidth=0.8)
        apart.set_ylabel("distance to the nearest disc (m)")
        share.set(xlabel="least distance on the way (m)", ylabel="share of the scenarios", ylim=(0, 1.02))
        cost.set_ylabel("cost so far")
        cost.set_ylim(bottom=0)
        for axes in (apart, cost):
            axes.set(xlabel="time (s)", xlim=(history.time[0], history.time[-1]))
        letter((plane, apart, share, cost))
    return figure

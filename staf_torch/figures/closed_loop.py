"""Figures of closed loops: one in the panels of the paper's section 8, a comparison, and tracking."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from .style import WIDTH, colour, curves, dash, legend_above, letter, page, positive, subplots

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_CRITIC = (r"critic $\hat W_c$", r"$\hat W_{c,%d}$")  # of the axis, of a line
_MARKED = 200  # times at most that are drawn with a marker each
_LEAST_EXCESS, _MOST_EXCESS = 1e-4, 1e2  # of the cost over the optimum, in the comparison


class AdpHistory(NamedTuple):
    """One trajectory of a closed loop."""

    time: np.ndarray  # (T,) seconds
    state: np.ndarray  # (T, n)
    control: np.ndarray  # (T, m)
    actor_weights: np.ndarray  # (T, M); M = 0 for a policy without weights
    critic_weights: np.ndarray  # (T, M)
    running_cost: np.ndarray  # (T,)
    control_error: np.ndarray | None  # (T,) |u - u*|
    value_error: np.ndarray | None  # (T,) |V - V^|
    optimal_cost: float | None  # V*(x(0))


class TrackingHistory(NamedTuple):
    """One trajectory, followed with an identified drift, and the errors of the other variants."""

    time: np.ndarray  # (T,) seconds
    state: np.ndarray  # (T, 4) of the identified run: e and xd
    errors: dict[str, np.ndarray]  # variant -> |e|, (T,); NaN once it diverged
    parameters: np.ndarray  # (T, 6) theta^ row by row
    truth: np.ndarray  # (6,) theta
    critic_weights: np.ndarray  # (T, M)


def draw_adp(history: AdpHistory) -> Figure:
    """State, actor weights, critic weights, |u - u*|, |V - V^| and the running cost.

    Without weights the control takes their place; without a known optimum the errors are left out.
    """
    lines = {"state $x$": (history.state, "$x_{%d}$")}
    if history.actor_weights.shape[1]:
        lines[r"actor $\hat W_a$"] = history.actor_weights, r"$\hat W_{a,%d}$"
        lines[_CRITIC[0]] = history.critic_weights, _CRITIC[1]
    else:
        lines["control $u$"] = history.control, "$u_{%d}$"
    errors = {r"$|u - u^*|$": history.control_error, r"$|V^* - \hat V|$": history.value_error}
    known = {name: error for name, error in errors.items() if error is not None}
    count = len(lines) + len(known) + 1
    with page(WIDTH, 2.1 * -(-count // 2)) as figure:
        grid = subplots(figure, count, 2)
        left = iter(grid)
        for name, (values, label) in lines.items():
            _lines(next(left), history.time, values, name, label)
        for name, error in known.items():
            _logarithmic(next(left), history.time, error, name)
        _cost(next(left), history)
        _against_time(grid, history.time)
    return figure


def _against_time(grid: list[Axes], time: np.ndarray) -> None:
    letter(grid)
    for axes in grid:
        axes.set_xlim(time[0], time[-1])
        axes.set_xlabel("time (s)")


def _lines(axes: Axes, time: np.ndarray, values: np.ndarray, name: str, label: str) -> None:
    count = values.shape[1]
    curves(axes, time, values, label)
    axes.set_ylabel(name)
    if count <= 5:
        legend_above(axes, count)
    else:  # two short rows, beside the letter of the panel and not over it
        tight = {"borderaxespad": 0.2, "handlelength": 1.3, "columnspacing": 0.8, "handletextpad": 0.4}
        axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=-(-count // 2), **tight)


def _logarithmic(axes: Axes, time: np.ndarray, values: np.ndarray, name: str) -> None:
    known = np.isfinite(values)  # an optimum found by shooting is known at some of the times alone
    marked = "" if known.sum() > _MARKED else "."
    axes.semilogy(time[known], positive(values[known]), color=colour(0), marker=marked, markersize=3)
    axes.set_ylabel(name)


def _cost(axes: Axes, history: AdpHistory) -> None:
    axes.plot(history.time, history.running_cost, color=colour(0), label="so far")
    if history.optimal_cost is not None:
        axes.axhline(history.optimal_cost, color="0.5", linestyle="--", label="optimal, $V^*(x(0))$")
    axes.set_ylim(bottom=0)
    axes.set_ylabel("cost")
    legend_above(axes, 2)


def draw_comparison(ratios: Mapping[str, np.ndarray]) -> Figure:
    """The share of initial states regulated at most at a multiple of the optimal cost, one curve a method.

    Args:
        ratios: method to cost / optimal cost, (B,); inf for trajectories that were not regulated.
    """
    with page(5.4, 3.2) as figure:
        axes = figure.subplots()
        for i, (name, values) in enumerate(ratios.items()):
            excess = np.sort(np.maximum(values - 1, _LEAST_EXCESS))
            share = np.arange(1, len(excess) + 1) / len(excess)
            finite = np.isfinite(excess)
            line = dash(i // 7)  # seven colours, then dashed
            axes.step(excess[finite], share[finite], line, where="post", color=colour(i), label=name)
        axes.set_xscale("log")
        axes.set_xlim(_LEAST_EXCESS, _MOST_EXCESS)
        axes.set_ylim(0, 1.02)
        axes.set_xlabel("excess cost $J/J^* - 1$")
        axes.set_ylabel("share of initial states regulated")
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def draw_tracking(history: TrackingHistory) -> Figure:
    """State against desired state, |e| of every variant, theta^ against theta, critic weights."""
    with page(WIDTH, 4.4) as figure:
        grid = list(figure.subplots(2, 2).flat)
        for axes, panel in zip(grid, (_followed, _tracking_errors, _parameters), strict=False):
            panel(axes, history)
        _lines(grid[3], history.time, history.critic_weights, *_CRITIC)
        _against_time(grid, history.time)
    return figure


def _followed(axes: Axes, history: TrackingHistory) -> None:
    for i in range(2):
        desired = history.state[:, 2 + i]
        axes.plot(history.time, history.state[:, i] + desired, color=colour(i), label=f"$x_{i + 1}$")
        axes.plot(history.time, desired, ":", color="0.2", label="desired" if i else None)
    axes.set_ylabel("state")
    legend_above(axes, 3)


def _tracking_errors(axes: Axes, history: TrackingHistory) -> None:
    for i, (name, error) in enumerate(history.errors.items()):
        axes.semilogy(history.time, positive(error), dash(i), color=colour(i), label=name)
    axes.set_ylabel("$|x - x_d|$")
    legend_above(axes, 3)


def _parameters(axes: Axes, history: TrackingHistory) -> None:
    for i in range(history.parameters.shape[1]):
        axes.plot(history.time, history.parameters[:, i], color=colour(i))
        axes.axhline(history.truth[i], color="0.2", linestyle=":", linewidth=0.8)
    axes.plot([], [], color="0.3", label=r"$\hat\theta$, one colour an entry")
    axes.plot([], [], ":", color="0.2", label=r"$\theta$")
    axes.set_ylabel("drift parameters")
    legend_above(axes, 2)

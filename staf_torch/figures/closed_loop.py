"""Figures of closed loops: the paper's panels, tracking, adaptation, constraints, comparisons."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from .style import (
    WIDTH,
    against_time,
    colour,
    curves,
    dash,
    estimates,
    legend_above,
    legend_of_all,
    letter,
    marker,
    named,
    page,
    positive,
    shares,
    subplots,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_CRITIC = (r"critic $\hat W_c$", r"$\hat W_{c,%d}$")  # of the axis, of a line
_MARKED = 200  # times at most that are drawn with a marker each
_LEAST_EXCESS, _MOST_EXCESS = 1e-4, 1e2  # of the cost over the optimum, in the comparison


class AdpHistory(NamedTuple):
    """A trajectory of a closed loop."""

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
    """A trajectory, followed with an identified drift, and the errors of the other variants."""

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
        letter(grid)
        against_time(grid, history.time)
    return figure


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
        _followed(grid[0], history)
        named(grid[1], history.time, history.errors, log=True)
        grid[1].set_ylabel("$|x - x_d|$")
        legend_above(grid[1], 3)
        _parameters(grid[2], history)
        _lines(grid[3], history.time, history.critic_weights, *_CRITIC)
        letter(grid)
        against_time(grid, history.time)
    return figure


def _followed(axes: Axes, history: TrackingHistory) -> None:
    for i in range(2):
        desired = history.state[:, 2 + i]
        axes.plot(history.time, history.state[:, i] + desired, color=colour(i), label=f"$x_{i + 1}$")
        axes.plot(history.time, desired, ":", color="0.2", label="desired" if i else None)
    axes.set_ylabel("state")
    legend_above(axes, 3)


def _parameters(axes: Axes, history: TrackingHistory) -> None:
    estimates(axes, history.time, history.parameters, history.truth)
    axes.plot([], [], color="0.3", label=r"$\hat\theta$, one colour an entry")
    axes.plot([], [], ":", color="0.2", label=r"$\theta$")
    axes.set_ylabel("drift parameters")
    legend_above(axes, 2)


_EARLY = 2.0  # s: what happens to the estimates later is not seen at the scale of the truth


class FaultPicture(NamedTuple):
    """A trajectory of a case, under every policy."""

    time: np.ndarray  # (T,) seconds
    norms: dict[str, np.ndarray]  # policy -> |x|, (T,)
    parameters: np.ndarray  # (T, p) theta^
    truth: np.ndarray  # (T, p) theta
    certain: np.ndarray  # (T,) bool: whether the redesigned policy had the control


def draw_faults(cases: Mapping[str, FaultPicture]) -> Figure:
    """A column a case: |x| under every policy above, the parameters below, shaded while uncertain."""
    with page(WIDTH, 4.2) as figure:
        grid = figure.subplots(2, len(cases), squeeze=False)
        letter([*grid[0], *grid[1]], *cases, *[""] * len(cases))
        for k, case in enumerate(cases.values()):
            above, below = grid[0, k], grid[1, k]
            named(above, case.time, case.norms, log=True)
            estimates(below, case.time, case.parameters, case.truth)
            low, high = _frame(case)
            below.set_ylim(low, high)
            below.fill_between(case.time, low, high, where=~case.certain, color="0.85", linewidth=0, zorder=0)
            against_time((above, below), case.time)
            below.set_xlim(case.time[0], min(case.time[-1], _EARLY))
        grid[0, 0].set_ylabel("$|x|$")
        grid[1, 0].set_ylabel(r"$\hat\theta$ and $\theta$ (dotted)")
        grid[0, 0].legend(loc="lower left")
    return figure


def _frame(case: FaultPicture) -> tuple[float, float]:
    """Limits around the true parameters that show how the estimates come in, and no excursion."""
    low, high = float(case.truth.min()), float(case.truth.max())
    room = 0.3 * max(high - low, 1.0)
    return low - room, high + room


class GainSets(NamedTuple):
    """Concurrent learning with many gains, from two sources of equations."""

    time: np.ndarray  # (T,) seconds
    parameters: np.ndarray  # (T, p) theta^ of one gain set
    truth: np.ndarray  # (p,)
    error: dict[str, np.ndarray]  # source -> RMS of e, (B,)
    parameter_error: dict[str, np.ndarray]  # source -> RMS of theta^ - theta, (B,)
    followed: dict[str, np.ndarray]  # source -> |e| of that gain set, (T,)


def draw_gain_sets(sets: GainSets) -> Figure:
    """theta^ and |e| of one gain set, and the RMS of both errors over all gain sets, sorted."""
    with page(WIDTH, 4.4) as figure:
        grid = list(figure.subplots(2, 2).flat)
        letter(grid)
        estimates(grid[0], sets.time, sets.parameters, sets.truth)
        grid[0].set_ylabel(r"$\hat\theta$ (integral), $\theta$ dotted")
        for i, (name, values) in enumerate(sets.followed.items()):
            grid[1].semilogy(sets.time, positive(values), color=colour(i), label=name, linewidth=0.7)
        grid[1].set_ylabel("$|x - x_d|$")
        legend_above(grid[1], 2)
        against_time(grid[:2], sets.time)
        shares(grid[2], sets.error)
        shares(grid[3], sets.parameter_error)
        labels = "RMS of $x - x_d$", r"RMS of $\hat\theta - \theta$"
        for axes, label in zip(grid[2:], labels, strict=True):
            axes.set(xscale="log", xlabel=label, ylabel="share of gain sets")
        legend_above(grid[2], 2)
    return figure


class BoxHistory(NamedTuple):
    """A start under several methods, in a box."""

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
        named(margin, history.time, history.margins)
        named(cost, history.time, history.costs)
        walls(plane, history.low, history.high)
        plane.set(xlabel="$x_1$", ylabel="$x_2$")
        legend_of_all(figure, plane, 3)
        margin.set_ylabel("distance to the nearest wall")
        curves(barrier, history.time, history.barrier_state, "$s_{%d}$")
        barrier.set_ylabel("barrier coordinates")
        legend_above(barrier, history.barrier_state.shape[1])
        cost.set_ylabel("cost of $s$ so far")
        for axes in (margin, cost):
            axes.set_ylim(bottom=0)
        against_time((margin, barrier, cost), history.time)
        letter((plane, margin, barrier, cost))
    return figure


def walls(axes: Axes, low: np.ndarray, high: np.ndarray) -> None:
    """Draw the walls of the first two coordinates, and shade what lies beyond."""
    for k, ends in enumerate((axes.get_xlim(), axes.get_ylim())):
        reach = 0.06 * (ends[1] - ends[0])
        line, span = (axes.axhline, axes.axhspan) if k else (axes.axvline, axes.axvspan)
        for wall, sign in ((low[k], -1), (high[k], 1)):
            if np.isfinite(wall):
                line(wall, color="0.2", linewidth=0.8)
                span(*sorted((wall, wall + sign * reach)), color="0.85", linewidth=0)


class AvoidanceHistory(NamedTuple):
    """A scenario with moving discs under several methods, and the least distances of all scenarios."""

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
                grey = {"facecolor": f"{shade:.3f}", "edgecolor": "0.4", "linewidth": 0.4}
                plane.add_patch(Circle(tuple(center), history.radius, **grey))
        for i, (name, path) in enumerate(history.paths.items()):
            plane.plot(path[:, 0], path[:, 1], dash(i), color=colour(i), label=name)
            plane.plot(path[shown, 0], path[shown, 1], ".", color=colour(i), markersize=4)
        named(apart, history.time, history.distances)
        named(cost, history.time, history.costs)
        shares(share, history.nearest)
        plane.set(xlabel="$p_1$ (m)", ylabel="$p_2$ (m)", aspect="equal")
        legend_above(apart, 2)
        apart.axhline(0.0, color="0.2", linewidth=0.8)
        share.axvline(0.0, color="0.2", linewidth=0.8)
        apart.set_ylabel("distance to the nearest disc (m)")
        share.set(xlabel="least distance on the way (m)", ylabel="share of the scenarios")
        cost.set_ylabel("cost so far")
        cost.set_ylim(bottom=0)
        against_time((apart, cost), history.time)
        letter((plane, apart, share, cost))
    return figure


_COLUMNS = 3
_LEAST = 1e-5  # excess cost that is drawn at the edge


def draw_rivals(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw a panel a plant: median excess cost over the best known against microseconds a control.

    A method that regulated some of the states alone is hollow; one that regulated none is not drawn.

    Args:
        rows: ``plant``, ``method``, ``ratio_median``, ``regulated``, ``us_median``; None where not measured.
    """
    plants = list(dict.fromkeys(row["plant"] for row in rows))
    methods = list(dict.fromkeys(row["method"] for row in rows))
    across = min(_COLUMNS, len(plants))
    down = -(-len(plants) // across)
    with page(2.4 * across + 1.6, 2.3 * down) as figure:
        grid = subplots(figure, len(plants), across, sharex=True, sharey=True)
        for axes, plant in zip(grid, plants, strict=True):
            for row in rows:
                if row["plant"] == plant and row["ratio_median"] is not None:
                    index = methods.index(row["method"])
                    excess = max(row["ratio_median"] - 1, _LEAST)
                    (point,) = axes.plot(row["us_median"], excess, marker(index), color=colour(index))
                    point.set(fillstyle="full" if row["regulated"] == 1 else "none", linestyle="none")
            axes.set(xscale="log", yscale="log")
            axes.set_title(plant.replace("_", " "), fontsize="small")
        for axes in grid[-across:]:  # with no panel below
            axes.set_xlabel(r"$\mu$s a control")
            axes.tick_params(labelbottom=True)
        for axes in grid[::across]:
            axes.set_ylabel("median excess cost")
        for index, method in enumerate(methods):
            grid[0].plot([], [], marker(index), color=colour(index), linestyle="none", label=method)
        figure.legend(loc="outside right center", title="hollow: not all regulated", title_fontsize="small")
    return figure

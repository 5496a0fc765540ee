"""Figures of closed loops: the paper's panels, tracking, adaptation, constraints, comparisons."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from .loop import bounds, by_unit, with_unit
from .style import (
    against_time,
    at_left,
    colour,
    curves,
    dash,
    decades,
    estimates,
    legend,
    letter,
    marker,
    named,
    panels,
    positive,
    shares,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

_NAMED = 6  # curves of a panel that a legend tells apart
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
    state_units: tuple[str, ...] = ()  # "" for none
    input_units: tuple[str, ...] = ()
    low: np.ndarray = np.empty(0)  # (m,) of the inputs, -inf for none
    high: np.ndarray = np.empty(0)


def draw_adp(history: AdpHistory) -> Figure:
    """State, actor weights, critic weights, |u - u*|, |V - V^| and the running cost; a panel a unit.

    Without weights the control takes their place; without a known optimum the errors are left out.
    """
    time, weights = history.time, history.actor_weights.shape[1]
    states = by_unit("state $x$", "x", history.state_units or ("",) * history.state.shape[1])
    inputs = by_unit("control $u$", "u", history.input_units or ("",) * history.control.shape[1])
    middle = [""] * 2 if weights else inputs  # the actor and the critic
    errors = {r"$|u - u^*|$": history.control_error, r"$|V^* - \hat V|$": history.value_error}
    known = {name: error for name, error in errors.items() if error is not None}
    with panels(len(states) + len(middle) + len(known) + 1) as (figure, grid):
        titles, left = [""] * len(grid), iter(grid)
        for name, entries in states:
            _lines(next(left), time, name, history.state[:, entries], [f"$x_{{{i + 1}}}$" for i in entries])
        if weights:
            actor = [rf"$\hat W_{{a,{i + 1}}}$" for i in range(weights)]
            _lines(next(left), time, r"actor $\hat W_a$", history.actor_weights, actor)
            _critic(next(left), time, history.critic_weights)
        else:
            for k, (name, entries) in enumerate(inputs, len(states)):
                names = [f"$u_{{{i + 1}}}$" for i in entries]
                _lines(next(left), time, name, history.control[:, entries], names)
                if len(history.low):
                    titles[k] = bounds(grid[k], history.low[entries], history.high[entries])
        for axes in grid[: len(states) + len(middle)]:
            if len(axes.get_legend_handles_labels()[0]) > 1:
                legend(axes)
        for name, error in known.items():
            axes, at = next(left), np.isfinite(error)  # one found by shooting is known at some times alone
            marked = "" if at.sum() > _MARKED else "."
            axes.semilogy(time[at], positive(error[at]), color=colour(0), marker=marked, markersize=3)
            decades(axes)
            axes.set_ylabel(name)
        cost = next(left)
        cost.plot(time, history.running_cost, color=colour(0), label="so far")
        if history.optimal_cost is not None:
            cost.axhline(history.optimal_cost, color="0.4", linestyle="--", label="optimal, $V^*(x(0))$")
            legend(cost)
        cost.set(ylim=(min(0.0, cost.get_ylim()[0]), None), ylabel="cost")
        letter(grid, *titles)
        against_time(grid, time)
    return figure


def _lines(axes: Axes, time: np.ndarray, name: str, values: np.ndarray, labels: Sequence[str]) -> None:
    for i, (column, label) in enumerate(zip(values.T, labels, strict=True)):
        shown = label if len(labels) <= _NAMED else None
        axes.plot(time, column, linestyle=dash(i), color=colour(i), label=shown)
    axes.set_ylabel(name)


def _critic(axes: Axes, time: np.ndarray, weights: np.ndarray) -> None:
    labels = [rf"$\hat W_{{c,{i + 1}}}$" for i in range(weights.shape[1])]
    _lines(axes, time, r"critic $\hat W_c$", weights, labels)


def draw_comparison(ratios: Mapping[str, np.ndarray]) -> Figure:
    """The share of initial states regulated at most at a multiple of the optimal cost, one curve a method, by
    cost / optimal cost (B,), inf for trajectories that were not regulated."""
    excess = {name: np.sort(np.maximum(values - 1, _LEAST_EXCESS)) for name, values in ratios.items()}
    known = np.concatenate([values[np.isfinite(values)] for values in excess.values()])
    with panels(1, 2, high=2.8, spare=list(ratios)) as (figure, (axes,)):
        for i, (name, values) in enumerate(excess.items()):
            share = np.arange(1, len(values) + 1) / len(values)
            finite = np.isfinite(values)
            if finite.any():
                look = {"linestyle": dash(i), "color": colour(i), "label": name}
                axes.step(values[finite], share[finite], where="post", **look)
        axes.set_xscale("log")
        if len(known):
            axes.set_xlim(known.min(), min(2 * known.max(), _MOST_EXCESS))
        else:
            axes.text(0.5, 0.5, "no state was regulated", transform=axes.transAxes, ha="center")
        axes.set_ylim(0, 1.02)
        axes.set_xlabel("excess cost $J/J^* - 1$")
        axes.set_ylabel("share of initial states regulated")
        if len(known):
            legend(axes, handles=axes.get_lines())
    return figure


def draw_initial_weights(weights: Sequence[float], found: Mapping[str, Sequence[float]]) -> Figure:
    """The share of initial states that each law regulates, against the initial weight of the critic."""
    order = np.argsort(weights)
    with panels(1, 1, high=2.2) as (figure, (axes,)):
        for i, (name, values) in enumerate(found.items()):
            look = {"linestyle": dash(i), "color": colour(i), "marker": marker(i), "label": name}
            axes.plot(np.asarray(weights)[order], np.asarray(values)[order], markersize=4, **look)
        axes.set(xlabel=r"initial critic weights $\hat W_c(0)$, all alike", ylim=(-0.02, 1.02))
        axes.set_ylabel("share of initial states regulated")
        legend(axes)
    return figure


def draw_tracking(
    time: np.ndarray,  # (T,) seconds
    state: np.ndarray,  # (T, 4) of the run with an identified drift: e and xd
    errors: Mapping[str, np.ndarray],  # variant -> |e|, (T,); NaN once it diverged
    parameters: np.ndarray,  # (T, 6) theta^ row by row
    truth: np.ndarray,  # (6,) theta
    critic_weights: np.ndarray,  # (T, M)
) -> Figure:
    """State against desired state, |e| of every variant, theta^ against theta, critic weights."""
    with panels(4) as (figure, grid):
        for i in range(2):
            desired = state[:, 2 + i]
            look = {"linestyle": dash(i), "color": colour(i), "label": f"$x_{i + 1}$"}
            grid[0].plot(time, state[:, i] + desired, **look)
            grid[0].plot(time, desired, ":", color="0.2", label="desired" if i else None)
        grid[0].set_ylabel("state")
        named(grid[1], time, errors, log=True)
        grid[1].set_ylabel("$|x - x_d|$")
        estimates(grid[2], time, parameters, truth)
        grid[2].set_ylabel(r"drift parameters $\hat\theta$")
        _critic(grid[3], time, critic_weights)
        for axes in grid:
            legend(axes)
        letter(grid)
        against_time(grid, time)
    return figure


_EARLY = 2.0  # s: what happens to the estimates later is not seen at the scale of the truth


class FaultPicture(NamedTuple):
    """A trajectory of a case, under every policy."""

    time: np.ndarray  # (T,) seconds
    norms: dict[str, np.ndarray]  # policy -> |x|, (T,)
    parameters: np.ndarray  # (T, p) theta^
    truth: np.ndarray  # (T, p) theta
    certain: np.ndarray  # (T,) bool: whether the redesigned policy had the control


def draw_faults(cases: Mapping[str, FaultPicture]) -> Figure:
    """A row a case: |x| under every policy, and the parameters at first, shaded while they are uncertain."""
    with panels(2 * len(cases)) as (figure, grid):
        titles = []
        for (name, case), norms, parameters in zip(cases.items(), grid[::2], grid[1::2], strict=True):
            named(norms, case.time, case.norms, log=True)
            norms.set_ylabel("$|x|$")
            estimates(parameters, case.time, case.parameters, case.truth)
            low, high = float(case.truth.min()), float(case.truth.max())
            room = 0.3 * max(high - low, 1.0)  # for how the estimates come in, and no excursion
            low, high = low - room, high + room
            grey: dict[str, Any] = {"color": "0.88", "linewidth": 0, "zorder": 0, "label": "uncertain"}
            parameters.fill_between(case.time, low, high, where=~case.certain, **grey)
            against_time((norms, parameters), case.time)
            end = min(case.time[-1], _EARLY)
            parameters.set(ylim=(low, high), xlim=(case.time[0], end), ylabel=r"parameters $\hat\theta$")
            titles += [name, f"{name}, first {end:g} s"]
        letter(grid, *titles)
        legend(*grid[::2])
        legend(*grid[1::2])
    return figure


def draw_gain_sets(
    time: np.ndarray,  # (T,) seconds
    parameters: np.ndarray,  # (T, p) theta^ of one gain set
    truth: np.ndarray,  # (p,)
    error: Mapping[str, np.ndarray],  # source of equations -> RMS of e, (B,)
    parameter_error: Mapping[str, np.ndarray],  # source -> RMS of theta^ - theta, (B,)
    followed: Mapping[str, np.ndarray],  # source -> |e| of that gain set, (T,)
) -> Figure:
    """theta^ and |e| of one gain set, and the RMS of both errors over all gain sets, sorted."""
    with panels(4) as (figure, grid):
        letter(grid)
        estimates(grid[0], time, parameters, truth)
        grid[0].set_ylabel(r"parameters $\hat\theta$")
        for i, (name, values) in enumerate(followed.items()):
            look = {"linestyle": dash(i), "color": colour(i), "label": name, "linewidth": 0.7}
            grid[1].semilogy(time, positive(values), **look)
        decades(grid[1])
        grid[1].set_ylabel("$|x - x_d|$")
        against_time(grid[:2], time)
        shares(grid[2], error)
        shares(grid[3], parameter_error)
        labels = "RMS of $x - x_d$", r"RMS of $\hat\theta - \theta$"
        for axes, label in zip(grid[2:], labels, strict=True):
            axes.set(xscale="log", xlabel=label, ylabel="share of gain sets")
        legend(grid[0])
        legend(*grid[1:])
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
    units: tuple[str, ...] = ("", "")  # of the coordinates


def draw_box(history: BoxHistory) -> Figure:
    """The first two coordinates with their walls, the distance to the nearest wall, s and the cost."""
    with panels(4, high=2.1) as (figure, grid):
        plane, margin, barrier, cost = grid
        for i, (name, path) in enumerate(history.paths.items()):
            plane.plot(path[:, 0], path[:, 1], linestyle=dash(i), color=colour(i), label=name)
        named(margin, history.time, history.margins)
        named(cost, history.time, history.costs)
        for k, ends in enumerate((plane.get_xlim(), plane.get_ylim())):  # walls, and what lies beyond
            reach = 0.06 * (ends[1] - ends[0])
            line, span = (plane.axhline, plane.axhspan) if k else (plane.axvline, plane.axvspan)
            for wall, beyond in ((history.low[k], -reach), (history.high[k], reach)):
                if np.isfinite(wall):
                    line(wall, color="0.2", linewidth=0.8)
                    span(*sorted((wall, wall + beyond)), color="0.85", linewidth=0)
        plane.set(xlabel=with_unit("$x_1$", history.units[0]), ylabel=with_unit("$x_2$", history.units[1]))
        legend(margin, plane, cost)
        margin.set_ylabel("distance to a wall")
        curves(barrier, history.time, history.barrier_state, "$s_{%d}$")
        barrier.set_ylabel("barrier coordinates $s$")
        legend(barrier)
        cost.set_ylabel("cost of $s$ so far")
        for axes in (margin, cost):
            axes.set_ylim(bottom=0)
        against_time((margin, barrier, cost), history.time)
        letter(grid)
    return figure


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

    with panels(4, high=2.2) as (figure, grid):
        plane, apart, share, cost = grid
        last = int(np.argmax(history.time >= 0.5 * history.time[-1]))
        shown = np.linspace(0, last, 5).round().astype(int)
        for shade, at in zip(np.linspace(0.92, 0.6, len(shown)), shown, strict=True):
            for center in history.discs[at]:
                grey = {"facecolor": f"{shade:.3f}", "edgecolor": "0.4", "linewidth": 0.4}
                plane.add_patch(Circle(tuple(center), history.radius, **grey))
        for i, (name, path) in enumerate(history.paths.items()):
            plane.plot(path[:, 0], path[:, 1], linestyle=dash(i), color=colour(i), label=name)
            plane.plot(path[shown, 0], path[shown, 1], ".", color=colour(i), markersize=4)
        named(apart, history.time, history.distances)
        named(cost, history.time, history.costs)
        shares(share, history.nearest)
        plane.set(xlabel="$p_1$ (m)", ylabel="$p_2$ (m)")
        plane.set_aspect("equal", adjustable="datalim")
        legend(apart, share, cost)
        apart.axhline(0.0, color="0.2", linewidth=0.8)
        share.axvline(0.0, color="0.2", linewidth=0.8)
        apart.set_ylabel("distance to a disc (m)")
        share.set(xlabel="least distance on the way (m)", ylabel="share of scenarios")
        cost.set_ylabel("cost so far")
        cost.set_ylim(bottom=0)
        against_time((apart, cost), history.time)
        letter(grid)
    return figure


_COLUMNS = 3
_LEAST = 1e-5  # excess cost that is drawn at the edge


def draw_rivals(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw a panel a plant: median excess cost over the best known against microseconds a control.

    A method that regulated some of the states alone is hollow; one that regulated none is not drawn. Rows
    have ``plant``, ``method``, ``ratio_median``, ``regulated`` and ``us_median``, None where not measured.
    """
    plants = list(dict.fromkeys(row["plant"] for row in rows))
    methods = list(dict.fromkeys(row["method"] for row in rows if row["ratio_median"] is not None))
    handles: dict[str, Line2D] = {}
    with panels(len(plants), _COLUMNS, spare=methods, high=2.0, sharex=True, sharey=True) as (figure, grid):
        for axes, plant in zip(grid, plants, strict=True):
            for row in rows:
                if row["plant"] == plant and row["ratio_median"] is not None:
                    index = methods.index(row["method"])
                    excess = max(row["ratio_median"] - 1, _LEAST)
                    (point,) = axes.plot(row["us_median"], excess, marker(index), color=colour(index))
                    point.set(fillstyle="full" if row["regulated"] == 1 else "none", linestyle="none")
                    point.set_label(row["method"])
                    if row["regulated"] == 1 or row["method"] not in handles:
                        handles[row["method"]] = point
            axes.set(xscale="log", yscale="log", xlabel=r"time a control ($\mu$s)")
            axes.set_title(plant.replace("_", " "))
            if at_left(axes):
                axes.set_ylabel("median excess cost")
        legend(*grid, handles=[handles[name] for name in methods], title="hollow: not all regulated")
    return figure

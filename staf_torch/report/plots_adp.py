"""The figure of a closed loop, in the panels of the paper's section 8."""

from __future__ import annotations

import importlib.resources
from typing import NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from .plots import _colour, _dash, _legend, _positive

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


def draw_adp(history: AdpHistory) -> Figure:
    """State, actor weights, critic weights, |u - u*|, |V - V^| and the running cost.

    Without weights the control takes their place; without a known optimum the errors are left out.
    """
    style = importlib.resources.files(__package__) / "staf.mplstyle"
    with importlib.resources.as_file(style) as path, matplotlib.rc_context(fname=path):
        panels = [_states]
        panels += [_actor, _critic] if history.actor_weights.shape[1] else [_control]
        panels += [_control_error] if history.control_error is not None else []
        panels += [_value_error] if history.value_error is not None else []
        panels += [_cost]
        rows = -(-len(panels) // 2)
        figure = Figure(figsize=(7.2, 2.1 * rows), layout="constrained")
        grid = figure.subplots(rows, 2, squeeze=False).flatten()
        for axes, panel, letter in zip(grid, panels, "abcdef", strict=False):
            panel(axes, history)
            axes.set_title(f"({letter})", loc="left")
            axes.set_xlim(history.time[0], history.time[-1])
            axes.set_xlabel("time (s)")
        for axes in grid[len(panels) :]:
            axes.set_visible(False)
        figure.draw_without_rendering()  # lays out under this style, not under the caller's
        return figure


def _lines(axes: Axes, time: np.ndarray, values: np.ndarray, name: str, label: str) -> None:
    count = values.shape[1]
    for i in range(count):
        axes.plot(time, values[:, i], _dash(i), color=_colour(i), label=label % (i + 1))
    axes.set_ylabel(name)
    if count <= 5:
        _legend(axes, count)
    else:  # two short rows, beside the letter of the panel and not over it
        columns = -(-count // 2)
        axes.legend(
            loc="lower right",
            bbox_to_anchor=(1.0, 1.0),
            ncols=columns,
            borderaxespad=0.2,
            handlelength=1.3,
            columnspacing=0.8,
            handletextpad=0.4,
        )


def _states(axes: Axes, history: AdpHistory) -> None:
    _lines(axes, history.time, history.state, "state $x$", "$x_{%d}$")


def _control(axes: Axes, history: AdpHistory) -> None:
    _lines(axes, history.time, history.control, "control $u$", "$u_{%d}$")


def _actor(axes: Axes, history: AdpHistory) -> None:
    _lines(axes, history.time, history.actor_weights, r"actor $\hat W_a$", r"$\hat W_{a,%d}$")


def _critic(axes: Axes, history: AdpHistory) -> None:
    _lines(axes, history.time, history.critic_weights, r"critic $\hat W_c$", r"$\hat W_{c,%d}$")


def _control_error(axes: Axes, history: AdpHistory) -> None:
    assert history.control_error is not None
    _logarithmic(axes, history.time, history.control_error, r"$|u - u^*|$")


def _value_error(axes: Axes, history: AdpHistory) -> None:
    assert history.value_error is not None
    _logarithmic(axes, history.time, history.value_error, r"$|V^* - \hat V|$")


def _logarithmic(axes: Axes, time: np.ndarray, values: np.ndarray, name: str) -> None:
    known = np.isfinite(values)  # an optimum found by shooting is known at some of the times alone
    marker = "" if known.sum() > _MARKED else "."
    axes.semilogy(time[known], _positive(values[known]), color=_colour(0), marker=marker, markersize=3)
    axes.set_ylabel(name)


def _cost(axes: Axes, history: AdpHistory) -> None:
    axes.plot(history.time, history.running_cost, color=_colour(0), label="so far")
    if history.optimal_cost is not None:
        axes.axhline(history.optimal_cost, color="0.5", linestyle="--", label="optimal, $V^*(x(0))$")
    axes.set_ylim(bottom=0)
    axes.set_ylabel("cost")
    _legend(axes, 2)


def draw_comparison(ratios: dict[str, np.ndarray]) -> Figure:
    """The share of initial states regulated at most at a multiple of the optimal cost, one curve a method.

    Args:
        ratios: method to cost / optimal cost, (B,); inf for trajectories that were not regulated.
    """
    style = importlib.resources.files(__package__) / "staf.mplstyle"
    with importlib.resources.as_file(style) as path, matplotlib.rc_context(fname=path):
        figure = Figure(figsize=(5.4, 3.2), layout="constrained")
        axes = figure.subplots()
        for i, (name, values) in enumerate(ratios.items()):
            excess = np.sort(np.maximum(values - 1, _LEAST_EXCESS))
            share = np.arange(1, len(excess) + 1) / len(excess)
            finite = np.isfinite(excess)
            dash = _dash(i // 7)  # seven colours, then dashed
            axes.step(excess[finite], share[finite], dash, where="post", color=_colour(i), label=name)
        axes.set_xscale("log")
        axes.set_xlim(_LEAST_EXCESS, _MOST_EXCESS)
        axes.set_ylim(0, 1.02)
        axes.set_xlabel("excess cost $J/J^* - 1$")
        axes.set_ylabel("share of initial states regulated")
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
        figure.draw_without_rendering()
        return figure

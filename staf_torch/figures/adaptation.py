"""Figures of plants that are identified while they are controlled."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from .style import WIDTH, colour, dash, legend_above, letter, page, positive

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_EARLY = 2.0  # s: what happens to the estimates later is not seen at the scale of the truth


class FaultPicture(NamedTuple):
    """One trajectory of a case, under every policy."""

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
            for i, (policy, norm) in enumerate(case.norms.items()):
                above.semilogy(case.time, positive(norm), dash(i), color=colour(i), label=policy)
            for i in range(case.parameters.shape[1]):
                below.plot(case.time, case.parameters[:, i], color=colour(i))
                below.plot(case.time, case.truth[:, i], ":", color="0.2", linewidth=0.8)
            low, high = _frame(case)
            below.set_ylim(low, high)
            below.fill_between(case.time, low, high, where=~case.certain, color="0.85", linewidth=0, zorder=0)
            above.set_xlim(case.time[0], case.time[-1])
            below.set_xlim(case.time[0], min(case.time[-1], _EARLY))
            for axes in (above, below):
                axes.set_xlabel("time (s)")
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
        for i in range(sets.parameters.shape[1]):
            grid[0].plot(sets.time, sets.parameters[:, i], color=colour(i))
            grid[0].axhline(sets.truth[i], color="0.2", linestyle=":", linewidth=0.8)
        grid[0].set_ylabel(r"$\hat\theta$ (integral), $\theta$ dotted")
        for i, (name, values) in enumerate(sets.followed.items()):
            grid[1].semilogy(sets.time, positive(values), color=colour(i), label=name, linewidth=0.7)
        grid[1].set_ylabel("$|x - x_d|$")
        legend_above(grid[1], 2)
        for axes in grid[:2]:
            axes.set_xlabel("time (s)")
            axes.set_xlim(sets.time[0], sets.time[-1])
        panels = (
            (grid[2], sets.error, "RMS of $x - x_d$"),
            (grid[3], sets.parameter_error, r"RMS of $\hat\theta - \theta$"),
        )
        for axes, errors, label in panels:
            for i, (name, values) in enumerate(errors.items()):
                share = np.arange(1, len(values) + 1) / len(values)
                axes.step(np.sort(values), share, dash(i), where="post", color=colour(i), label=name)
            axes.set_xscale("log")
            axes.set_ylim(0, 1.02)
            axes.set_xlabel(label)
            axes.set_ylabel("share of gain sets")
        legend_above(grid[2], 2)
    return figure

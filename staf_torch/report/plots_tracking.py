"""The figure of the tracking problem."""

from __future__ import annotations

import importlib.resources
from typing import NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from .plots import _colour, _dash, _legend, _positive


class TrackingHistory(NamedTuple):
    """One trajectory, followed with an identified drift, and the errors of the other variants."""

    time: np.ndarray  # (T,) seconds
    state: np.ndarray  # (T, 4) of the identified run: e and xd
    errors: dict[str, np.ndarray]  # variant -> |e|, (T,); NaN once it diverged
    parameters: np.ndarray  # (T, 6) theta^ row by row
    truth: np.ndarray  # (6,) theta
    critic_weights: np.ndarray  # (T, M)


def draw_tracking(history: TrackingHistory) -> Figure:
    """State against desired state, |e| of every variant, theta^ against theta, critic weights."""
    style = importlib.resources.files(__package__) / "staf.mplstyle"
    with importlib.resources.as_file(style) as path, matplotlib.rc_context(fname=path):
        figure = Figure(figsize=(7.2, 4.4), layout="constrained")
        grid = figure.subplots(2, 2).flatten()
        for axes, panel, letter in zip(grid, (_states, _errors, _parameters, _critic), "abcd", strict=True):
            panel(axes, history)
            axes.set_title(f"({letter})", loc="left")
            axes.set_xlim(history.time[0], history.time[-1])
            axes.set_xlabel("time (s)")
        figure.draw_without_rendering()  # lays out under this style, not under the caller's
        return figure


def _states(axes: Axes, history: TrackingHistory) -> None:
    for i in range(2):
        desired = history.state[:, 2 + i]
        axes.plot(history.time, history.state[:, i] + desired, color=_colour(i), label=f"$x_{i + 1}$")
        axes.plot(history.time, desired, ":", color="0.2", label="desired" if i else None)
    axes.set_ylabel("state")
    _legend(axes, 3)


def _errors(axes: Axes, history: TrackingHistory) -> None:
    for i, (name, error) in enumerate(history.errors.items()):
        axes.semilogy(history.time, _positive(error), _dash(i), color=_colour(i), label=name)
    axes.set_ylabel("$|x - x_d|$")
    _legend(axes, 3)


def _parameters(axes: Axes, history: TrackingHistory) -> None:
    for i in range(history.parameters.shape[1]):
        axes.plot(history.time, history.parameters[:, i], color=_colour(i))
        axes.axhline(history.truth[i], color="0.2", linestyle=":", linewidth=0.8)
    axes.plot([], [], color="0.3", label=r"$\hat\theta$")
    axes.plot([], [], ":", color="0.2", label=r"$\theta$")
    axes.set_ylabel("drift parameters")
    _legend(axes, 2)


def _critic(axes: Axes, history: TrackingHistory) -> None:
    for i in range(history.critic_weights.shape[1]):
        weights = history.critic_weights[:, i]
        axes.plot(history.time, weights, _dash(i), color=_colour(i), label=rf"$\hat W_{{c,{i + 1}}}$")
    axes.set_ylabel(r"critic $\hat W_c$")
    _legend(axes, min(history.critic_weights.shape[1], 5))

"""Figures. Only modules named `plots*` import matplotlib; never through pyplot, which keeps global state."""

from __future__ import annotations

import importlib.resources
from pathlib import Path
from typing import NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

_DPI = 200
_DECADES = 1e-6  # of its largest value a log axis shows at most
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")
_MARKERS = "osD^vP*X"
_DASHES = ("-", "--", "-.", ":")  # so that the curves can be told apart in grey


class ChaseHistory(NamedTuple):
    """One trajectory of a gradient chase."""

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


def save(figure: Figure, stem: Path) -> None:
    """One PNG and one PDF beside each other, the same bytes on every run."""
    figure.savefig(stem.with_suffix(".png"), dpi=_DPI)
    figure.savefig(stem.with_suffix(".pdf"), metadata={"CreationDate": None})


def draw_chase(history: ChaseHistory) -> Figure:
    """The four panels of the paper's simulation: state, V against V^, weights, error and excess."""
    style = importlib.resources.files(__package__) / "staf.mplstyle"
    with importlib.resources.as_file(style) as path, matplotlib.rc_context(fname=path):
        figure = Figure(figsize=(7.2, 5.4), layout="constrained")
        (top_left, top_right), (low_left, low_right) = figure.subplots(2, 2, sharex=True)
        _states(top_left, history)
        _values(top_right, history)
        _weights(low_left, history)
        _errors(low_right, history)
        for axes, letter in zip((top_left, top_right, low_left, low_right), "abcd", strict=True):
            axes.set_title(f"({letter})", loc="left")
            axes.margins(x=0)
        for axes in (low_left, low_right):
            axes.set_xlabel("time (s)")
        figure.draw_without_rendering()  # lays out under this style, not under the caller's
        return figure


def draw_convergence(curves: list[ConvergenceCurve]) -> Figure:
    """Excess before the correction against the step, both logarithmic, with the slopes in the legend."""
    style = importlib.resources.files(__package__) / "staf.mplstyle"
    with importlib.resources.as_file(style) as path, matplotlib.rc_context(fname=path):
        figure = Figure(figsize=(7.2, 3.6), layout="constrained")
        axes = figure.subplots()
        for i, curve in enumerate(curves):
            slope = "-" if curve.slope is None else f"{curve.slope:.1f}"
            axes.loglog(
                curve.step,
                _positive(curve.excess),
                _dash(i),
                marker=_MARKERS[i % len(_MARKERS)],
                markersize=4,
                color=_colour(i),
                label=f"{curve.label}: {slope}",
            )
        steps = np.unique(np.concatenate([curve.step for curve in curves]))
        axes.set_xticks(steps, [f"{step:g}" for step in steps])
        axes.minorticks_off()
        axes.set_xlabel("step $\\Delta t$ (s)")
        axes.set_ylabel("ultimate excess before the correction")
        axes.legend(title="law, iterations, predictor: slope", loc="center left", bbox_to_anchor=(1.0, 0.5))
        figure.draw_without_rendering()
        return figure


def _states(axes: Axes, history: ChaseHistory) -> None:
    for i in range(history.state.shape[1]):
        axes.plot(history.time, history.state[:, i], _dash(i), color=_colour(i), label=f"$x_{i + 1}$")
    axes.set_ylabel("state $x$")
    _legend(axes, history.state.shape[1])


def _values(axes: Axes, history: ChaseHistory) -> None:
    axes.plot(history.time, history.value, color="0.6", linewidth=3.0, label="$V(x)$")
    axes.plot(history.time, history.estimate, "--", color=_COLOURS[0], label=r"$\hat V(x)$")
    axes.set_ylabel("value")
    _legend(axes, 2)


def _weights(axes: Axes, history: ChaseHistory) -> None:
    count = history.weights.shape[1]
    for i in range(count):
        axes.plot(history.time, history.weights[:, i], color=_colour(i), label=f"$a_{{{i + 1}}}$")
        axes.plot(history.time, history.ideal_weights[:, i], ":", color=_colour(i))
    axes.plot([], [], ":", color="0.3", label="ideal")
    axes.set_ylabel("weights")
    if count <= 6:
        _legend(axes, count + 1)
    else:
        axes.legend(handles=axes.get_lines()[-1:], loc="lower right")


def _errors(axes: Axes, history: ChaseHistory) -> None:
    error = np.abs(history.value - history.estimate)
    floor = np.abs(history.value - history.ideal_estimate)
    axes.semilogy(history.time, _positive(error), color=_COLOURS[0], label=r"$|V - \hat V|$")
    axes.semilogy(history.time, _positive(floor), "--", color="0.5", label="ideal weights (floor)")
    axes.semilogy(
        history.time,
        _positive(history.excess),
        "-.",
        color=_COLOURS[1],
        label="excess $F(a) - F(w)$",
    )
    # Each curve dips to rounding error where it changes sign; those spikes would take up the panel.
    top = np.nanmax([np.nanmax(curve) for curve in (error, floor, history.excess)])
    axes.set_ylim(bottom=max(axes.get_ylim()[0], _DECADES * top))
    axes.set_ylabel("error at $x$; excess")
    _legend(axes, 2)


def _positive(values: np.ndarray) -> np.ndarray:
    """Zeros cannot stand on a log axis: leave a gap there."""
    return np.where(values > 0, values, np.nan)


def _legend(axes: Axes, columns: int) -> None:
    """Above the axes, where no data can be under it."""
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=min(columns, 5), borderaxespad=0.2)


def _colour(index: int) -> str:
    return _COLOURS[index % len(_COLOURS)]


def _dash(index: int) -> str:
    return _DASHES[index % len(_DASHES)]

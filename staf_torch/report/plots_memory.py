"""The figure of the experience memory."""

from __future__ import annotations

import importlib.resources
from typing import NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection
from matplotlib.figure import Figure

from .plots import _colour, _dash, _legend, _positive


class MemoryPicture(NamedTuple):
    """One trajectory and its memory."""

    path: np.ndarray  # (T, n), settled
    stored: np.ndarray  # (N, n) states of the models
    radius: np.ndarray  # (N,) of their centers
    time: np.ndarray  # (K,) seconds
    errors: dict[str, np.ndarray]  # approximant -> max |V - V^| on the ball, (K,)
    excess: dict[str, np.ndarray]  # start -> largest excess over the revisits, (S,)
    settled: float  # the largest excess of the settled chase


def draw_memory(picture: MemoryPicture) -> Figure:
    """Where models are stored, the error over the visited region, the excess after a revisit."""
    style = importlib.resources.files(__package__) / "staf.mplstyle"
    with importlib.resources.as_file(style) as path, matplotlib.rc_context(fname=path):
        figure = Figure(figsize=(7.2, 3.1), layout="constrained")
        left, middle, right = figure.subplots(1, 3)
        for axes, panel, letter in zip((left, middle, right), (_map, _errors, _excess), "abc", strict=True):
            panel(axes, picture)
            axes.set_title(f"({letter})", loc="left")
        figure.draw_without_rendering()  # lays out under this style, not under the caller's
        return figure


def _map(axes: Axes, picture: MemoryPicture) -> None:
    """The first two states; a single one against the radius of its centers alone."""
    second = 1 if picture.path.shape[1] > 1 else 0
    axes.plot(picture.path[:, 0], picture.path[:, second], color="0.6", label="path")
    points = picture.stored[:, [0, second]]
    diameter = 2 * picture.radius
    axes.add_collection(
        EllipseCollection(
            diameter,
            diameter,
            np.zeros_like(diameter),
            units="xy",
            offsets=points,
            transOffset=axes.transData,
            facecolor="none",
            edgecolor=_colour(0),
            linewidth=0.3,
            alpha=0.5,
        )
    )
    axes.plot(points[:, 0], points[:, 1], ".", color=_colour(0), markersize=3, label="stored model")
    axes.plot(
        [], [], "o", color=_colour(0), markerfacecolor="none", markersize=8, label="ball of its centers"
    )
    axes.margins(0.12)
    axes.set_xlabel("$x_1$")
    axes.set_ylabel(f"$x_{second + 1}$")
    axes.set_aspect("equal", adjustable="datalim")
    _legend(axes, 1)


def _errors(axes: Axes, picture: MemoryPicture) -> None:
    for i, (name, error) in enumerate(picture.errors.items()):
        axes.semilogy(picture.time, _positive(error), _dash(i), color=_colour(i), label=name)
    axes.set_xlabel("time at which the ball was visited (s)")
    axes.set_ylabel(r"$\max\,|V - \hat V|$ on the ball")
    axes.margins(x=0)
    _legend(axes, 1)


def _excess(axes: Axes, picture: MemoryPicture) -> None:
    for i, (name, excess) in enumerate(picture.excess.items()):
        steps = np.arange(1, len(excess) + 1)
        axes.loglog(steps, _positive(excess), _dash(i), color=_colour(i), label=name)
    axes.axhline(picture.settled, color="0.2", linestyle=":", linewidth=0.8, label="settled chase")
    axes.set_xlabel("steps after the revisit")
    axes.set_ylabel("largest excess $F(a) - F(w)$")
    _legend(axes, 1)

"""Figures of what is learned by gradient."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from .style import colour, legend, letter, panels, ticks

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


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
        marks = _map(figure, grid[0], picture)
        _steps(grid[1], picture, marks)
        letter(grid)
    return figure


def _map(figure: Figure, axes: Axes, picture: LearnedKernel) -> list[Artist]:
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

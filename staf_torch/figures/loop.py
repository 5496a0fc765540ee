"""States, controls and cost of a closed loop over time, with units and bounds, another loop beside it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ..results.pictures import LoopPicture
from .style import FigurePaper, against_time, colour, dash, legend, letter, panels, printed_on, size

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_BOUND = (0, (7, 2))  # dashes
_MOST_TIMES = 4000  # more are thinned out
_NAMED = 3  # entries that the name of an axis lists
_IN_A_LEGEND = 8
_APART = 10.0  # times the size of a state, from which on another one of its unit has its own axis
_SEEN = 5.0  # times the range of a control, up to which an axis is stretched to its bounds

Group = tuple[str, list[int]]
"""Name of an axis, and the entries of a vector that it shows."""


def with_unit(name: str, unit: str) -> str:
    """Return `name (unit)`, the name alone of what has no unit."""
    return name if unit in ("", "1") else f"{name} ({unit})"


def by_unit(
    whole: str, letter: str, units: Sequence[str], sizes: Sequence[float] | None = None
) -> list[Group]:
    """Group the entries of a vector by their units, "" for none: an axis has one, of entries of one size.

    ``whole`` names an axis that shows all entries, as ``state $x$``, ``letter`` an entry; entries with a unit
    whose ``sizes`` differ tenfold have axes of their own.
    """
    found: dict[tuple[str, int], list[int]] = {}
    for i, unit in enumerate(units):
        size, first = (sizes[i], 0) if sizes is not None and unit else (0.0, 0)
        while (unit, first) in found and sizes is not None and size > 0:
            other = sizes[found[unit, first][0]]
            if max(size, other) < _APART * min(size, other) or not other > 0:
                break
            first += 1
        found.setdefault((unit, first), []).append(i)
    if len(found) == 1:
        return [(with_unit(whole, units[0]), list(range(len(units))))]
    groups = []
    for (unit, _), entries in found.items():
        names = [f"${letter}_{{{i + 1}}}$" for i in entries]
        short = ", ".join(names) if len(names) <= _NAMED else f"{names[0]} to {names[-1]}"
        groups.append((with_unit(short, unit), entries))
    return groups


def draw_loop(picture: LoopPicture, width: object = None, font: object = None) -> Figure:
    """A panel for the states of each unit, for the inputs of each, and the cost so far.

    The first row has strong lines, the others thin ones; the other loop is a broad grey line behind. A row
    ends where it diverged.
    """
    thinned = slice(None, None, -(-len(picture.time) // _MOST_TIMES))
    time = picture.time[thinned]
    sizes = [_range(picture.state[..., i]) for i in range(len(picture.state_units))]
    states = by_unit("state $x$", "x", picture.state_units, sizes)
    inputs = by_unit("control $u$", "u", picture.input_units) if picture.input_units else []
    beside = [None] * 3 if picture.beside is None else [each[:, thinned] for each in picture.beside]
    with (
        printed_on(FigurePaper.chosen("LoopResult.figure", "", width, font)),
        panels(len(states) + len(inputs) + 1) as (figure, grid),
    ):
        left, titles = iter(grid), [""] * len(states)
        for name, entries in states:
            axes = next(left)
            _vector(axes, time, picture.state[:, thinned], beside[0], entries, "x")
            if picture.wanted is not None:
                for k, entry in enumerate(entries):
                    line = picture.wanted[thinned, entry]
                    axes.plot(time, line, ":", color="0.2", label=None if k else "wanted")
            axes.set_ylabel(name)
        for name, entries in inputs:
            axes = next(left)
            _vector(axes, time, picture.control[:, thinned], beside[1], entries, "u", held=True)
            titles.append(bounds(axes, picture.low[entries], picture.high[entries]))
            axes.set_ylabel(name)
        axes = next(left)
        other = None if beside[2] is None else beside[2][..., None]
        _vector(axes, time, picture.cost[:, thinned, None], other, [0], "")
        axes.set_ylabel("cost so far")
        against_time(grid, time)
        letter(grid, *titles, "")
        most = int(130 * grid[0].get_position().width * figure.get_size_inches()[0] / size())
        title = picture.title if len(picture.title) <= most else f"{picture.title[: most - 3]}..."
        grid[0].set_title(f"(a) {title}", loc="left")
        for axes in grid:
            if 1 < len(axes.get_legend_handles_labels()[0]) <= _IN_A_LEGEND:
                legend(axes)
    return figure


def _range(values: np.ndarray) -> float:
    """The largest size of an entry at any time in any row; 0 where none is a number."""
    return float(np.abs(values[np.isfinite(values)]).max(initial=0.0))


def _vector(
    axes: Axes,
    time: np.ndarray,
    values: np.ndarray,
    beside: np.ndarray | None,
    entries: Sequence[int],
    letter: str,
    held: bool = False,
) -> None:
    """Draw entries of vectors (R, T, n) of all rows, those of the other loop behind; held ones as steps."""
    steps: dict[str, Any] = {"drawstyle": "steps-post"} if held else {}
    if beside is not None:
        broad: dict[str, Any] = {"color": "0.7", "linewidth": 2.4, "solid_capstyle": "butt", **steps}
        for row in beside:
            axes.plot(time, row[:, entries], **broad)
        axes.get_lines()[-1].set_label("LQR")
    for k, entry in enumerate(entries):
        look = {"linestyle": dash(k), "color": colour(k), **steps}
        for row in values[1:, :, entry]:
            axes.plot(time, row, linewidth=0.5, alpha=0.6, **look)
        several = values.shape[-1] > 1
        name = (f"${letter}_{{{entry + 1}}}$" if several else f"${letter}$") if letter else "this loop"
        axes.plot(time, values[0, :, entry], label=name, **look)


def bounds(axes: Axes, low: np.ndarray, high: np.ndarray) -> str:
    """Draw the bounds of inputs, (m,) each; of those far from all that is drawn, return a word."""
    limits = {float(each) for each in (*low, *high) if np.isfinite(each)}
    bottom, top = axes.get_ylim()
    reach = _SEEN * max(top - bottom, 0.5 * abs(top), 0.5 * abs(bottom))  # a control may rest at a bound
    seen = {each for each in limits if top - reach < each < bottom + reach}
    for each in sorted(limits):
        line = axes.axhline(each, color="0.25", linewidth=0.9, linestyle=_BOUND)
        if each == min(seen, default=None):
            line.set_label("bounds" if len(seen) > 1 else "bound")
    ends = [bottom, top, *seen]
    room = 0.05 * (max(ends) - min(ends)) if seen else 0.0
    axes.set_ylim(min(bottom, min(ends) + (-room if min(ends) in seen else 0)), max(top, max(ends) + room))
    beyond = sorted(limits - seen)
    return f"beyond: bounds {', '.join(f'{each:g}' for each in beyond)}" if beyond else ""

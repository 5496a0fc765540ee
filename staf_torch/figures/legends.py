"""Legends inside the axes: where nothing is drawn, else above the data on an axis that is made longer."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.legend import Legend

SPARE = "<legend>"
"""Label of axes that hold a legend and nothing else."""
_CORNERS: dict[Any, tuple[float, float]] = {  # and the share of the free room that is left and below
    "upper right": (1.0, 1.0),
    "upper left": (0.0, 1.0),
    "lower right": (1.0, 0.0),
    "lower left": (0.0, 0.0),
    "upper center": (0.5, 1.0),
    "lower center": (0.5, 0.0),
    "center right": (1.0, 0.5),
    "center left": (0.0, 0.5),
    "center": (0.5, 0.5),
}
_PAD = 3.0  # points of the screen around a legend
_FINE = 500  # places of a line that must not be covered
_HIGHEST = 0.7  # of the axes, that a legend takes in a free place


class Wanted(NamedTuple):
    """A legend that a figure asks for."""

    panels: Sequence[Axes]  # of the first that has a free place
    handles: Sequence[Artist]  # in place of the labelled lines
    title: str | None


def place(wanted: Wanted) -> bool:
    """Draw the legend, and return whether an axis became longer for it."""
    handles = {str(each.get_label()): each for each in wanted.handles} or _labelled(wanted.panels)
    if not handles:
        return False
    figure = wanted.panels[0].figure
    spare = [axes for axes in figure.axes if axes.get_label() == SPARE and axes.get_legend() is None]
    if spare and (len(wanted.panels) > 1 or wanted.handles):
        _flattest(spare[0], handles, wanted.title, "center")
        return False
    for axes in wanted.panels:
        if _in_a_free_place(axes, handles, wanted.title):
            return False
    axes = max(wanted.panels, key=lambda each: float(each.get_window_extent().height))
    drawn = _flattest(axes, handles, wanted.title, "upper right")
    share = (drawn.get_window_extent().height + 2 * _PAD) / axes.get_window_extent().height
    _lengthen(axes, min(share, 0.8))
    return True


def _labelled(panels: Sequence[Axes]) -> dict[str, Artist]:
    """Return the lines with a label by it, in their order."""
    found: dict[str, Artist] = {}
    for axes in panels:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            found.setdefault(label, handle)
    return found


def _in_a_free_place(axes: Axes, handles: dict[str, Artist], title: str | None) -> bool:
    frame, taken = axes.get_window_extent(), _taken(axes)
    room = np.array([frame.width, frame.height])
    for columns in _columns(len(handles)):
        legend = _legend(axes, handles, title, columns, "upper right")
        box = legend.get_window_extent()
        needed = np.array([box.width, box.height]) + 3 * _PAD
        if needed[0] < room[0] and needed[1] < _HIGHEST * room[1]:
            for corner, share in _CORNERS.items():
                low = np.array([frame.x0, frame.y0]) + np.array(share) * (room - needed)
                if not bool(((taken > low) & (taken < low + needed)).all(1).any()):
                    legend.set_loc(corner)
                    return True
        legend.remove()
    return False


def _flattest(axes: Axes, handles: dict[str, Artist], title: str | None, at: Any) -> Legend:
    """Draw it with as many columns as the axes are wide."""
    for columns in reversed(_columns(len(handles))):
        legend = _legend(axes, handles, title, columns, at)
        if legend.get_window_extent().width + 2 * _PAD < axes.get_window_extent().width:
            break
    return legend


def _columns(count: int) -> list[int]:
    """Return the numbers of columns of which each has fewer rows than the one before."""
    rows = dict.fromkeys(-(-count // columns) for columns in range(1, count + 1))
    return [-(-count // each) for each in rows]


def _legend(axes: Axes, handles: dict[str, Artist], title: str | None, columns: int, at: Any) -> Legend:
    legend: Legend = axes.legend(
        list(handles.values()), list(handles), title=title, ncols=columns, loc=at, borderaxespad=0.3
    )
    legend.set_in_layout(False)
    return legend


def _taken(axes: Axes) -> np.ndarray:
    """Return points on all that is drawn, (K, 2), on the screen."""
    lines = (_along(line.get_transform().transform(line.get_xydata())) for line in axes.get_lines())
    patches = (patch.get_transform().transform(patch.get_path().vertices) for patch in axes.patches)
    bands = (outline for each in axes.collections for outline in _outlines(each))
    return np.concatenate([np.empty((0, 2)), *lines, *patches, *bands])


def _outlines(collection: Any) -> Iterator[np.ndarray]:
    """Yield the outlines of a band, or the middles of marks."""
    offsets = np.asarray(collection.get_offsets(), float).reshape(-1, 2)
    if offsets.any():
        yield collection.get_offset_transform().transform(offsets)
    else:
        for path in collection.get_paths():
            yield _along(collection.get_transform().transform(path.vertices))


def _along(points: np.ndarray) -> np.ndarray:
    """Return points and places between them, without those that are nowhere."""
    if len(points) < 2:
        return points
    steps = np.linspace(0, 1, -(-_FINE // len(points)), endpoint=False)[:, None, None]
    between = (points[:-1] + steps * (points[1:] - points[:-1])).reshape(-1, 2)
    found: np.ndarray = between[np.isfinite(between).all(1)]
    return found


def _lengthen(axes: Axes, share: float) -> None:
    """Let the data, and the numbers at the axis, end so much below the top of the vertical axis."""
    if axes.get_aspect() != "auto":  # a plane: it grows in both directions
        left, right = axes.get_xlim()
        room = 0.5 * share / (1 - share) * (right - left)
        axes.set_xlim(left - room, right + room)
    scale, ends = axes.yaxis.get_transform(), axes.get_ylim()
    low, high = scale.transform(np.array(ends))
    ticks = [tick for tick in axes.get_yticks() if ends[0] <= tick <= ends[1]]
    small = [tick for tick in axes.get_yticks(minor=True) if ends[0] <= tick <= ends[1]]
    axes.set_yticks(ticks)
    axes.set_yticks(small, minor=True)  # else those of the room above stand there without a number
    top = low + (high - low) / (1 - share)
    axes.set_ylim(ends[0], float(scale.inverted().transform(np.array([top]))[0]))

"""The style of all figures: page, type, colours, dashes, legends, and the images of a finished figure.

matplotlib is imported when the first figure is drawn and not before: it takes a second, which runs without
figures need not pay. pyplot, which keeps global state, is never used.
"""

from __future__ import annotations

import contextlib
import io
import logging
from collections.abc import Iterable, Iterator, Mapping
from contextvars import ContextVar
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

STYLE: dict[Any, Any] = {  # a two-column paper's figure: small sans-serif type, thin lines, bare legends
    "font.family": "sans-serif",
    "font.size": 8,
    "axes.titlesize": 8,
    "axes.labelsize": 8,
    "axes.linewidth": 0.6,
    "axes.grid": True,
    "grid.color": "0.9",
    "grid.linewidth": 0.5,
    "axes.axisbelow": True,
    "lines.linewidth": 1.1,
    "legend.fontsize": 7,
    "legend.frameon": False,
    "legend.handlelength": 1.8,
    "legend.columnspacing": 1.0,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "xtick.direction": "in",
    "ytick.direction": "in",
    "pdf.fonttype": 42,
    "figure.autolayout": False,  # or a figure of the user's would be laid out once more
    "figure.constrained_layout.use": False,
}
WIDTH = 7.2  # inches: both columns of a paper
_DPI = 200
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")
_MARKERS = "osD^vP*X"
_KEPT: ContextVar[list[Any] | None] = ContextVar("_KEPT", default=None)
_DASHES = ("-", "--", "-.", ":")  # so that the curves can be told apart in grey


@contextlib.contextmanager
def page(width: float, height: float) -> Iterator[Figure]:
    """Yield an empty figure under `STYLE`, whatever the caller's is, and lay it out in the end.

    Example:
        >>> with page(WIDTH, 3.0) as figure:
        ...     axes = figure.subplots()

    Args:
        width: inches.
        height: inches.
    """
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(width, height), layout="constrained")
        yield figure
        engine = figure.get_layout_engine()
        assert engine is not None
        engine.execute(figure)
        # Laid out once; while a figure has an engine, even an empty one, each file is drawn twice.
        figure.set_layout_engine(None)


@contextlib.contextmanager
def keep_figures() -> Iterator[list[tuple[Figure, bytes]]]:
    """Yield a list that takes every figure that `images` is given meanwhile, with its PNG."""
    kept: list[tuple[Figure, bytes]] = []
    token = _KEPT.set(kept)
    try:
        yield kept
    finally:
        _KEPT.reset(token)


def subplots(
    figure: Figure, count: int, columns: int, *, sharex: bool = False, sharey: bool = False
) -> list[Axes]:
    """Return so many axes in rows of ``columns``, the last row maybe shorter."""
    rows = -(-count // columns)
    grid = list(figure.subplots(rows, columns, sharex=sharex, sharey=sharey, squeeze=False).flat)
    for axes in grid[count:]:
        axes.set_visible(False)
    return grid[:count]


def images(figure: Figure) -> dict[str, bytes]:
    """Return a figure as PNG and PDF, by their endings: the same bytes on every run."""
    import matplotlib

    options: dict[str, dict[str, Any]] = {"png": {"dpi": _DPI}, "pdf": {"metadata": {"CreationDate": None}}}
    drawn = {}
    logging.getLogger("fontTools.subset").setLevel(logging.WARNING)  # else a line for each table of a font
    with matplotlib.rc_context(STYLE):
        for kind, chosen in options.items():
            buffer = io.BytesIO()
            figure.savefig(buffer, format=kind, **chosen)
            drawn[kind] = buffer.getvalue()
    kept = _KEPT.get()
    if kept is not None:
        kept.append((figure, drawn["png"]))
    return drawn


def colour(index: int) -> str:
    """Return the colour of the curve of that number; they repeat after seven."""
    return _COLOURS[index % len(_COLOURS)]


def dash(index: int) -> str:
    """Return the line style of the curve of that number; they repeat after four."""
    return _DASHES[index % len(_DASHES)]


def marker(index: int) -> str:
    """Return the marker of the curve of that number; they repeat after eight."""
    return _MARKERS[index % len(_MARKERS)]


def letter(grid: Iterable[Axes], *titles: str) -> None:
    """Write (a), (b), ... above panels, with a title each where there are titles."""
    for i, axes in enumerate(grid):
        title = f" {titles[i]}" if titles else ""
        axes.set_title(f"({chr(ord('a') + i)}){title}", loc="left")


def legend_above(axes: Axes, columns: int) -> None:
    """Put the legend above the axes, where no data can be under it."""
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=min(columns, 5), borderaxespad=0.2)


def legend_of_all(figure: Figure, axes: Axes, most: int) -> None:
    """Put one legend above all panels, with the lines of one of them, ``most`` in a row."""
    handles, labels = axes.get_legend_handles_labels()
    columns = min(len(labels), most)
    figure.legend(handles, labels, loc="outside upper center", ncols=columns, handlelength=3.2)


def positive(values: np.ndarray) -> np.ndarray:
    """Leave a gap at zeros, which cannot stand on a logarithmic axis."""
    return np.where(values > 0, values, np.nan)


def curves(axes: Axes, x: np.ndarray, values: np.ndarray, label: str) -> None:
    """Draw each column of values (T, k) against x (T,); ``label % i`` names column i, from 1 on."""
    for i, column in enumerate(values.T):
        axes.plot(x, column, dash(i), color=colour(i), label=label % (i + 1))


def named(axes: Axes, x: np.ndarray, values: Mapping[str, np.ndarray], *, log: bool = False) -> None:
    """Draw a labelled curve a name against x (T,); ``log``: on a logarithmic axis, with gaps at zeros."""
    for i, (name, curve) in enumerate(values.items()):
        axes.plot(x, positive(curve) if log else curve, dash(i), color=colour(i), label=name)
    if log:
        axes.set_yscale("log")


def shares(axes: Axes, values: Mapping[str, np.ndarray]) -> None:
    """Draw the share of the values (B,) up to each, a labelled step function a name."""
    for i, (name, each) in enumerate(values.items()):
        share = np.arange(1, len(each) + 1) / len(each)
        axes.step(np.sort(each), share, dash(i), where="post", color=colour(i), label=name)
    axes.set_ylim(0, 1.02)


def estimates(axes: Axes, time: np.ndarray, found: np.ndarray, truth: np.ndarray) -> None:
    """Draw parameters (T, p), a colour each, and the true ones dotted, (p,) or (T, p)."""
    for i, (estimate, true) in enumerate(zip(found.T, np.broadcast_to(truth, found.shape).T, strict=True)):
        axes.plot(time, estimate, color=colour(i))
        axes.plot(time, true, ":", color="0.2", linewidth=0.8)


def against_time(grid: Iterable[Axes], time: np.ndarray) -> None:
    """Give the axes of panels the whole of a time, (T,) seconds."""
    for axes in grid:
        axes.set(xlabel="time (s)", xlim=(time[0], time[-1]))


def ticks(axes: Axes, name: str, values: Iterable[float]) -> None:
    """Label exactly these values on the logarithmic axis ``name`` ("x" or "y"), as plain numbers."""
    at = list(values)
    axis = axes.xaxis if name == "x" else axes.yaxis
    axis.set_ticks(at, [f"{value:g}" for value in at])
    axis.set_ticks([], minor=True)

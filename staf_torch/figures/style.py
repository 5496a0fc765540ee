"""The style of all figures: paper, page, type, colours, dashes, legends, and the images of a finished figure.

matplotlib is imported when the first figure is drawn and not before: it takes a second, which runs without
figures need not pay. pyplot, which keeps global state, is never used.
"""

from __future__ import annotations

import contextlib
import io
import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextvars import ContextVar
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..numerics import COMMAND_LINE, fail
from .legends import SPARE, Wanted, place

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_STYLE: dict[str, Any] = {  # thin lines, small type, legends in the axes
    "axes.linewidth": 0.6,
    "axes.grid": True,
    "grid.color": "0.9",
    "grid.linewidth": 0.5,
    "axes.axisbelow": True,
    "lines.linewidth": 1.1,
    "legend.frameon": True,
    "legend.framealpha": 0.85,
    "legend.edgecolor": "none",
    "legend.borderpad": 0.2,
    "legend.labelspacing": 0.25,
    "legend.handlelength": 2.2,
    "legend.columnspacing": 1.0,
    "xtick.direction": "in",
    "ytick.direction": "in",
    "pdf.fonttype": 42,
    "figure.autolayout": False,  # or a figure of the user's would be laid out once more
    "figure.constrained_layout.use": False,
}
_TEXTS = ("font.size", "axes.titlesize", "axes.labelsize", "legend.fontsize", "legend.title_fontsize")
_GENERIC = ("sans-serif", "serif", "monospace")
_LEAST_WIDTH, _MOST_WIDTH = 2.0, 40.0  # inches
_LEAST_SIZE, _MOST_SIZE = 3.0, 40.0  # pt
_DPI = 200
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")
_MARKERS = "osD^vP*X"
_DASHES: tuple[Any, ...] = (
    "-",
    "--",
    "-.",
    (0, (4, 1, 1, 1, 1, 1)),
)  # dotted is what is ideal, true or wanted
_PANEL = 2.2  # inches that a panel is wide, at least, with type of 8 pt
_ROUNDING = 1e-6  # of the numbers at an axis: less is no difference
_ROOM = 0.12  # of an axis, between two numbers on it
_HIGHEST = 9.0  # inches of all panels: a page
_STRIP, _TALL = 1.35, 2.0  # inches that it is high, in one column and in several


AUTO = "auto"  # of `figures.draw`


class FigurePaper(NamedTuple):
    """The column that a figure is printed in: its width and the type of all its texts."""

    width: float = 7.2  # inches: both columns of a paper; one is 3.4
    size: float = 8.0  # pt
    family: str = "sans-serif"

    @classmethod
    def of(cls, figures: object) -> FigurePaper:
        """Return the paper of the setting `figures`: true, false, or `draw` (or `auto`), `width` and `font`.

        Raises:
            ValueError: if the setting breaks its rule.
        """
        if isinstance(figures, bool):
            return cls()
        if not isinstance(figures, Mapping) or not set(figures) <= {"draw", "width", "font"}:
            rule = "must be true or false, or have draw, width and font"
            raise fail(COMMAND_LINE, "figures", rule, figures)
        if not isinstance(drawn := figures.get("draw", True), bool) and drawn != AUTO:
            raise fail(COMMAND_LINE, "figures.draw", f"must be true, false or {AUTO}", drawn)
        return cls.chosen(COMMAND_LINE, "figures.", figures.get("width"), figures.get("font"))

    @classmethod
    def chosen(cls, name: str, prefix: str, width: object = None, font: object = None) -> FigurePaper:
        """Return the paper of a width in inches (2 to 40, 7.2 by default) and a font: `9`, `serif`, or `9
        Times New Roman`.

        A font is a size in pt, from 3 to 40, a family (`serif`, `sans-serif`, `monospace` or one that
        matplotlib finds), or both; 8 pt and sans-serif by default. ``name`` and ``prefix`` are of who was
        given them and of the arguments, for messages.

        Raises:
            ValueError: if one breaks its rule.
        """
        wide = cls().width if width is None else _number(width)
        if wide is None or not _LEAST_WIDTH <= wide <= _MOST_WIDTH:
            rule = f"must be inches, from {_LEAST_WIDTH:g} to {_MOST_WIDTH:g}"
            raise fail(name, f"{prefix}width", rule, width)
        words = [] if font is None else str(font).split()
        size = _number(words[0].removesuffix("pt")) if words else None
        family = " ".join(words[size is not None :]).removeprefix("pt ")
        size = cls().size if size is None else size
        if isinstance(font, bool) or not _LEAST_SIZE <= size <= _MOST_SIZE:
            rule = f"must be a size in pt, from {_LEAST_SIZE:g} to {_MOST_SIZE:g}, a family, or both"
            raise fail(name, f"{prefix}font", rule, font)
        if family and family not in _GENERIC:
            from matplotlib import font_manager

            if family not in font_manager.get_font_names():
                rule = f"must name a font that is installed, or {', '.join(_GENERIC)}"
                raise fail(name, f"{prefix}font", rule, font)
        return cls(wide, size, family or cls().family)

    def style(self) -> dict[Any, Any]:
        """Return matplotlib's settings."""
        sizes = dict.fromkeys((*_TEXTS, "xtick.labelsize", "ytick.labelsize"), self.size)
        found = {**_STYLE, **sizes, "font.family": self.family}
        if self.family == "serif":  # the Times that matplotlib brings along
            found |= {"font.serif": ["STIXGeneral", "DejaVu Serif"], "mathtext.fontset": "stix"}
        return found

    def across(self, most: int) -> int:
        """Return how many panels, up to ``most``, stand side by side."""
        return max(1, min(most, int(self.width / (_PANEL * self.size / 8) + 1e-9)))


def draws(figures: object) -> bool:
    """Return whether the setting `figures` asks for figures: `auto` does but in a job of a sweep.

    Raises:
        ValueError: as `FigurePaper.of`.
    """
    FigurePaper.of(figures)
    asked = figures.get("draw", True) if isinstance(figures, Mapping) else figures
    return not _SWEPT.get() if asked == AUTO else asked is True


@contextlib.contextmanager
def in_a_sweep(swept: bool = True) -> Iterator[None]:
    """Draw no figures of jobs meanwhile, unless they are asked for: the sweep's report has its own."""
    token = _SWEPT.set(swept)
    try:
        yield
    finally:
        _SWEPT.reset(token)


_DEFAULT = FigurePaper()
_SWEPT: ContextVar[bool] = ContextVar("_SWEPT", default=False)
_PAPER: ContextVar[FigurePaper] = ContextVar("_PAPER", default=_DEFAULT)
_KEPT: ContextVar[list[Any] | None] = ContextVar("_KEPT", default=None)
_WANTED: ContextVar[list[Wanted]] = ContextVar("_WANTED")


def _number(value: object) -> float | None:
    try:
        return None if isinstance(value, bool) else float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        return None


@contextlib.contextmanager
def printed_on(paper: FigurePaper) -> Iterator[None]:
    """Print all figures that are drawn meanwhile on this paper."""
    token = _PAPER.set(paper)
    try:
        yield
    finally:
        _PAPER.reset(token)


@contextlib.contextmanager
def page(height: float) -> Iterator[Figure]:
    """Yield an empty figure as wide as the paper, whatever the caller's style is, and lay it out in the end.

    Example:
        >>> with page(3.0) as figure:
        ...     axes = figure.subplots()

    Args:
        height: inches.
    """
    import matplotlib
    from matplotlib.figure import Figure

    paper, wanted = _PAPER.get(), list[Wanted]()
    token = _WANTED.set(wanted)
    try:
        with matplotlib.rc_context(paper.style()):
            figure = Figure(figsize=(paper.width, height), layout="constrained")
            yield figure
            engine = figure.get_layout_engine()
            assert engine is not None
            for axes in figure.axes:  # else numbers are chosen by the type of whoever prints the figure
                axes.tick_params(labelsize=paper.size)
            _widen_the_constant(figure)
            _short_decades(figure)
            _label_the_lowest(figure)
            engine.execute(figure)
            if sum(map(place, wanted)) or any(axes.get_aspect() != "auto" for axes in figure.axes):
                for _ in range(2):  # an axis is longer than it was, or a plane wider: other numbers on it
                    engine.execute(figure)
            # Laid out once; while a figure has an engine, even an empty one, each file is drawn twice.
            figure.set_layout_engine(None)
    finally:
        _WANTED.reset(token)


@contextlib.contextmanager
def panels(
    count: int, most: int = 2, *, high: float | None = None, spare: Sequence[str] = (), **shared: Any
) -> Iterator[tuple[Figure, list[Axes]]]:
    """Yield a page and so many axes, ``most`` in a row where the paper is wide enough.

    A panel is so many inches ``high`` with type of 8 pt, by default by the number of columns. ``spare`` are
    the lines of a legend that gets a place of its own, the last; ``shared`` are `sharex` and `sharey`.
    """
    paper = _PAPER.get()
    columns = paper.across(min(most, count + bool(spare)))
    tall = (high or (_STRIP if columns == 1 and count > 1 else _TALL)) * paper.size / 8
    rows = -(-count // columns)
    heights = [min(tall, _HIGHEST / rows)] * rows
    if spare and len(heights) * columns == count:  # no panel is left over
        line = 0.55 * paper.size / 72 * max(map(len, spare)) + 0.5  # inches, about
        lines = -(-len(spare) // max(1, int(paper.width / line)))
        heights.append((lines + 1) * 1.6 * paper.size / 72)
    with page(sum(heights) + 0.15) as figure:
        yield figure, subplots(figure, count, columns, heights, **shared)


def subplots(
    figure: Figure, count: int, columns: int, heights: Sequence[float] = (), **shared: Any
) -> list[Axes]:
    """Return so many axes in rows of ``columns``; what is left over is a place for legends."""
    rows = -(-count // columns)
    heights = heights or [1.0] * rows
    grid = figure.subplots(len(heights), columns, squeeze=False, height_ratios=heights, **shared)
    spare = list(grid.flat[count:])
    if len(heights) > rows:
        spare = [figure.add_subplot(spare[-1].get_gridspec()[rows, :])]
        for axes in grid[rows]:
            axes.remove()
    for axes in spare:
        axes.set_label(SPARE)
        axes.set_axis_off()
    for axes in grid.flat[:count]:
        axes.tick_params(labelbottom=True)  # also where axes are shared: `page` leaves it to the lowest
    return list(grid.flat[:count])


@contextlib.contextmanager
def keep_figures() -> Iterator[list[tuple[Figure, bytes]]]:
    """Yield a list that takes every figure that `images` is given meanwhile, with its PNG."""
    kept: list[tuple[Figure, bytes]] = []
    token = _KEPT.set(kept)
    try:
        yield kept
    finally:
        _KEPT.reset(token)


def images(figure: Figure) -> dict[str, bytes]:
    """Return a figure as PNG and PDF, by their endings: the same bytes on every run."""
    import matplotlib

    options: dict[str, dict[str, Any]] = {"png": {"dpi": _DPI}, "pdf": {"metadata": {"CreationDate": None}}}
    drawn = {}
    logging.getLogger("fontTools.subset").setLevel(logging.WARNING)  # else a line for each table of a font
    with matplotlib.rc_context(_PAPER.get().style()):
        for kind, chosen in options.items():
            buffer = io.BytesIO()
            figure.savefig(buffer, format=kind, **chosen)
            drawn[kind] = buffer.getvalue()
    kept = _KEPT.get()
    if kept is not None:
        kept.append((figure, drawn["png"]))
    return drawn


def _widen_the_constant(figure: Figure) -> None:
    """Give a vertical axis whose numbers differ by rounding alone a twentieth of them on both sides."""
    for axes in figure.axes:
        low, high = axes.get_ylim()
        largest = max(abs(low), abs(high))
        if axes.get_yscale() == "linear" and high - low < _ROUNDING * largest:
            axes.set_ylim(low - 0.05 * largest, high + 0.05 * largest)


def _short_decades(figure: Figure) -> None:
    """Name 1, 2 and 5 of a logarithmic axis of at most two decades, plainly: matplotlib's names overlap."""
    from matplotlib.ticker import FuncFormatter, LogFormatterSciNotation

    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            low, high = sorted(map(abs, axis.get_view_interval()))
            if axis.get_scale() != "log" or not 1e-4 <= low <= high <= 1e5:
                continue
            decades, inside = (
                [f"{at:e}"[0] for at in axis.get_ticklocs(minor=minor) if low <= at <= high]
                for minor in (False, True)
            )
            if len(decades) > 2 or not isinstance(axis.get_minor_formatter(), LogFormatterSciNotation):
                continue
            inside += decades
            choices = ("125", "12357", "123456789")
            wanted = next((each for each in choices if sum(at in each for at in inside) > 1), choices[-1])
            names = FuncFormatter(lambda at, _, wanted=wanted: f"{at:g}" if f"{at:e}"[0] in wanted else "")
            axis.set_major_formatter(names)
            axis.set_minor_formatter(names)


def _label_the_lowest(figure: Figure) -> None:
    """Leave the name and the numbers of equal horizontal axes to the lowest of a column."""
    below: dict[int, Axes] = {}
    for axes in reversed(figure.axes):
        spec = axes.get_subplotspec()
        if spec is None or not axes.get_visible() or axes.get_label() == SPARE:
            continue
        lower = below.get(spec.colspan.start)
        below[spec.colspan.start] = axes
        if lower is None:
            continue
        looks = [(each.get_xlabel(), each.get_xscale(), each.get_xlim()) for each in (axes, lower)]
        if looks[0] == looks[1]:
            axes.xaxis.label.set_visible(False)
            axes.tick_params(labelbottom=False, which="both")


def size() -> float:
    """Return the size of all type, pt."""
    return _PAPER.get().size


def colour(index: int) -> str:
    """Return the colour of the curve of that number; they repeat after seven."""
    return _COLOURS[index % len(_COLOURS)]


def dash(index: int) -> Any:
    """Return the line style of the curve of that number, told apart in grey; they repeat after four."""
    return _DASHES[index % len(_DASHES)]


def marker(index: int) -> str:
    """Return the marker of the curve of that number; they repeat after eight."""
    return _MARKERS[index % len(_MARKERS)]


def letter(grid: Iterable[Axes], *titles: str) -> None:
    """Write (a), (b), ... above panels, with a title each where there are titles."""
    for i, axes in enumerate(grid):
        title = f" {titles[i]}" if titles else ""
        axes.set_title(f"({chr(ord('a') + i)}){title}", loc="left")


def legend(*grid: Axes, handles: Sequence[Artist] = (), title: str | None = None) -> None:
    """Put one legend of the labelled lines of these panels into the first that has a free place for it.

    Where none has, the vertical axis of one becomes so long that the legend is above the data. A label that
    several panels have stands there once; a spare place comes first. ``handles`` take the place of those
    lines.
    """
    _WANTED.get().append(Wanted(grid, tuple(handles), title))


def positive(values: np.ndarray) -> np.ndarray:
    """Leave a gap at zeros, which cannot stand on a logarithmic axis."""
    return np.where(values > 0, values, np.nan)


def decades(axes: Axes, most: int = 8) -> None:
    """End a logarithmic axis so many decades below its largest value: what is less is rounding."""
    drawn = [np.asarray(line.get_ydata(), float) for line in axes.get_lines()]
    known = np.concatenate([values[np.isfinite(values) & (values > 0)] for values in drawn] or [np.empty(0)])
    if len(known) and known.min() < 10.0**-most * known.max():
        axes.set_ylim(10.0**-most * known.max(), 2 * known.max())


def curves(axes: Axes, x: np.ndarray, values: np.ndarray, label: str) -> None:
    """Draw each column of values (T, k) against x (T,); ``label % i`` names column i, from 1 on."""
    for i, column in enumerate(values.T):
        axes.plot(x, column, linestyle=dash(i), color=colour(i), label=label % (i + 1))


def named(axes: Axes, x: np.ndarray, values: Mapping[str, np.ndarray], *, log: bool = False) -> None:
    """Draw a labelled curve a name against x (T,); ``log``: on a logarithmic axis, with gaps at zeros."""
    for i, (name, curve) in enumerate(values.items()):
        axes.plot(x, positive(curve) if log else curve, linestyle=dash(i), color=colour(i), label=name)
    if log:
        axes.set_yscale("log")
        decades(axes)


def shares(axes: Axes, values: Mapping[str, np.ndarray]) -> None:
    """Draw the share of the values (B,) up to each, a labelled step function a name."""
    for i, (name, each) in enumerate(values.items()):
        share = np.arange(1, len(each) + 1) / len(each)
        axes.step(np.sort(each), share, linestyle=dash(i), where="post", color=colour(i), label=name)
    axes.set_ylim(0, 1.02)


def estimates(axes: Axes, time: np.ndarray, found: np.ndarray, truth: np.ndarray) -> None:
    """Draw parameters (T, p), a look each, and the true ones dotted, (p,) or (T, p); both have a label."""
    true = np.broadcast_to(truth, found.shape)
    for i, values in enumerate(found.T):
        label = "estimates" if i == 0 else None
        axes.plot(time, values, linestyle=dash(i), color=colour(i), label=label)
    for i, values in enumerate(true.T):
        axes.plot(time, values, ":", color="0.2", linewidth=0.9, label="true" if i == 0 else None)


def against_time(grid: Iterable[Axes], time: np.ndarray) -> None:
    """Give the axes of panels the whole of a time, (T,) seconds."""
    for axes in grid:
        axes.set(xlabel="time (s)", xlim=(time[0], time[-1]))


def at_left(axes: Axes) -> bool:
    """Return whether a panel stands at the left edge."""
    spec = axes.get_subplotspec()
    return spec is not None and spec.is_first_col()


def ticks(axes: Axes, name: str, values: Iterable[float]) -> None:
    """Give the logarithmic axis ``name`` ("x" or "y") these values alone, numbers where there is room."""
    at = sorted(values)
    room = _ROOM * (np.log(at[-1] / at[0]) if at else 0.0)
    labels, last = [], -np.inf
    for value in at:
        fits = np.log(value) - last >= room
        labels.append(f"{value:g}" if fits else "")
        last = np.log(value) if fits else last
    axis = axes.xaxis if name == "x" else axes.yaxis
    axis.set_ticks(at, labels)
    axis.set_ticks([], minor=True)

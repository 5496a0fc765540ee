"""The idea in motion: a state, its centers, V and V^ in the ball, and the weights, as a GIF or as a page."""

from __future__ import annotations

import base64
import io
import json
import tempfile
from collections.abc import Callable
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from .loop import with_unit
from .style import FigurePaper, colour

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

KINDS = ("gif", "html")
FRAMES = 60
_FRAMES_PER_SECOND, _DPI = 10, 84
_LEVELS = 14
_LEGEND = 0.25  # of a vertical axis, for the legend above what moves
_PAGE_DPI, _COLOURS = 125, 64  # 900 points across
_PAGE = Path(__file__).with_name("animation.html")


class Curves(NamedTuple):
    """Curves over time in the third panel."""

    title: str
    values: np.ndarray  # (F, K), drawn up to the present
    ideal: np.ndarray | None  # (F, K), dotted, drawn whole


class Scene(NamedTuple):
    """Content of an animation at F times; of a state in R^n, the first two coordinates."""

    title: str  # of the first panel
    time: np.ndarray  # (F,) seconds
    state: np.ndarray  # (F, 2)
    centers: np.ndarray  # (F, M, 2); M = 0 where none follow the state
    radius: np.ndarray  # (F,); 0 where there is no ball
    curves: Curves
    along: np.ndarray  # (S,) places on the way through the ball, from -1 to 1 in radii
    value: np.ndarray | None  # (F, S) V there; None where V is not known
    estimate: np.ndarray | None  # (F, S) V^ there
    grid: tuple[np.ndarray, np.ndarray, np.ndarray] | None  # x1 (G,), x2 (G,) and V (G, G), rows along x2
    followed: np.ndarray | None = None  # (F, 2) the state that is to be tracked
    discs: np.ndarray | None = None  # (F, K, 3) centers and radii of sets that must not be entered
    units: tuple[str, ...] = ("", "")  # of the states
    relative: bool = False  # V is an optimal value; V and V^ as shares of its largest in a ball that shrinks


def animate(scene: Scene, kind: str) -> dict[str, bytes]:
    """Return the animation of a scene by its ending: ``gif``, or ``html``, one page that plays in a browser,
    with the frames inside and no server."""
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context(FigurePaper().style()):
        figure = Figure(figsize=(FigurePaper().width, 3.3), layout="constrained")
        stage = AnimationStage(figure, scene)
        stage.show(0)
        figure.draw_without_rendering()
        figure.set_layout_engine("none")  # laid out once: nothing but the content moves
        write = {"gif": _gif, "html": _page}[kind]
        return {kind: write(figure, stage.show, len(scene.time))}


def _gif(figure: Figure, show: Callable[[int], None], frames: int) -> bytes:
    from matplotlib.animation import PillowWriter

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "animation.gif"
        writer = PillowWriter(fps=_FRAMES_PER_SECOND)
        writer.setup(figure, str(path), dpi=_DPI)
        for frame in range(frames):
            show(frame)
            writer.grab_frame()
        writer.finish()
        return path.read_bytes()


def _page(figure: Figure, show: Callable[[int], None], frames: int) -> bytes:
    """Return a page of its own: matplotlib's loads its buttons from a server, and is many times as large.

    The first picture is whole; of the others the points that differ are kept, the rest is transparent.
    """
    from PIL import Image

    pictures, whole = [], None
    for frame in range(frames):
        show(frame)
        raw, packed = io.BytesIO(), io.BytesIO()
        figure.savefig(raw, format="rgba", dpi=_PAGE_DPI)
        width, height = (round(inches * _PAGE_DPI) for inches in figure.get_size_inches())
        points = np.frombuffer(raw.getvalue(), np.uint8).reshape(height, width, 4)
        if whole is None:
            whole = points
        else:
            points = np.where((points != whole).any(-1, keepdims=True), points, 0).astype(np.uint8)
        few = Image.fromarray(points).quantize(_COLOURS, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
        few.save(packed, format="png", optimize=True)
        pictures.append(base64.b64encode(packed.getvalue()).decode())
    text = Template(_PAGE.read_text(encoding="utf-8"))
    return text.substitute(pictures=json.dumps(pictures), milliseconds=1000 // _FRAMES_PER_SECOND).encode()


class AnimationStage:
    """The three panels, and what of them moves."""

    def __init__(self, figure: Figure, scene: Scene) -> None:
        self._scene = scene
        self._plane, across, curves = figure.subplot_mosaic(
            [["plane", "across"], ["plane", "curves"]], width_ratios=[1.15, 1.0]
        ).values()
        self._draw_plane(self._plane)
        across.set_visible(scene.value is not None or scene.estimate is not None)
        self._draw_across(across)
        self._draw_curves(curves)

    def _draw_plane(self, axes: Axes) -> None:
        from matplotlib.patches import Circle

        scene = self._scene
        if scene.grid is not None:
            axes.contour(*scene.grid, levels=_LEVELS, colors="0.75", linewidths=0.7)
        names = (with_unit(f"$x_{i + 1}$", unit) for i, unit in enumerate(scene.units[:2]))
        axes.set(**dict(zip(("xlabel", "ylabel"), names, strict=True)), aspect="equal")
        axes.set_title(scene.title, loc="left")
        (self._path,) = axes.plot([], [], color="0.45", linewidth=0.8)
        self._goal = None
        if scene.followed is not None:
            axes.plot(*scene.followed.T, ":", color="0.2", linewidth=0.8)
            (self._goal,) = axes.plot([], [], "x", color="0.2", markersize=5)
        discs = () if scene.discs is None else scene.discs[0]
        self._discs = [Circle((0, 0), 1.0, facecolor="0.8", edgecolor="0.4") for _ in discs]
        for disc in self._discs:
            axes.add_patch(disc)
        self._ball = Circle((0, 0), 1.0, facecolor=colour(4), alpha=0.35, edgecolor=colour(0))
        axes.add_patch(self._ball)
        (self._centers,) = axes.plot([], [], "o", color=colour(0), markersize=3)
        (self._state,) = axes.plot([], [], "o", color=colour(1), markersize=4)
        if scene.grid is None:
            seen = scene.state if scene.followed is None else np.concatenate([scene.state, scene.followed])
            across, up = (_limits(column, float(scene.radius.max())) for column in seen.T)
            axes.set(xlim=across, ylim=up)

    def _draw_across(self, axes: Axes) -> None:
        scene = self._scene
        self._lines = []
        styles = (
            (scene.value, "-", "0.6", 3.0, "$V^*$" if scene.relative else "$V$"),
            (scene.estimate, "--", colour(0), 1.1, r"$\hat V$"),
        )
        for values, line, hue, width, label in styles:
            if values is not None:
                drawn = axes.plot([], [], line, color=hue, linewidth=width, label=label)[0]
                self._lines.append((drawn, values))
        axes.set(xlim=(-1, 1), xlabel="place in the ball (radii, along the way)")
        if scene.relative:
            axes.set_ylim(-0.15 if scene.value is not None else -1.15, 1.15 + _LEGEND)
            axes.set_ylabel("share of the largest")
        elif self._lines:
            low, high = _limits(self._lines[0][1])
            axes.set_ylim(low, high + _LEGEND * (high - low))
        if self._lines:
            axes.legend(loc="upper right", ncols=len(self._lines))

    def _draw_curves(self, axes: Axes) -> None:
        scene, (title, values, ideal) = self._scene, self._scene.curves
        if ideal is not None:
            for i, column in enumerate(ideal.T):
                axes.plot(scene.time, column, ":", color=colour(i), linewidth=0.8)
        self._curves = [axes.plot([], [], color=colour(i))[0] for i in range(values.shape[1])]
        axes.set(xlabel="time (s)", xlim=(scene.time[0], scene.time[-1]))
        axes.set_ylim(*_limits(values if ideal is None or scene.relative else ideal))
        axes.set_title(title, loc="left")

    def show(self, frame: int) -> None:
        """Put everything where it is at that frame."""
        scene = self._scene
        self._path.set_data(scene.state[: frame + 1, 0], scene.state[: frame + 1, 1])
        if scene.discs is not None:
            for disc, (x, y, radius) in zip(self._discs, scene.discs[frame], strict=True):
                disc.set(center=(x, y), radius=radius)
        self._ball.set(center=tuple(scene.state[frame]), radius=float(scene.radius[frame]))
        self._centers.set_data(scene.centers[frame, :, 0], scene.centers[frame, :, 1])
        self._state.set_data(scene.state[frame, :1], scene.state[frame, 1:])
        if self._goal is not None and scene.followed is not None:
            self._goal.set_data(scene.followed[frame, :1], scene.followed[frame, 1:])
        unit = 1.0
        if scene.relative and self._lines:
            unit = float(np.abs(self._lines[0][1][frame]).max()) or 1.0
        for line, values in self._lines:
            line.set_data(scene.along, values[frame] / unit)
        for line, column in zip(self._curves, scene.curves.values.T, strict=True):
            line.set_data(scene.time[: frame + 1], column[: frame + 1])


def _limits(values: np.ndarray, more: float = 0.0) -> tuple[float, float]:
    low, high = float(np.nanmin(values)) - more, float(np.nanmax(values)) + more
    margin = 0.08 * (high - low) or 1.0
    return low - margin, high + margin

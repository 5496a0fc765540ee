"""The idea in motion: a state, its centers and the weights that chase their ideal values, as a GIF."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from .style import STYLE, WIDTH, colour, legend_above

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_FRAMES_PER_SECOND, _DPI = 10, 84
_LEVELS = 14


class ChaseScene(NamedTuple):
    """What an animation of a gradient chase in the plane shows, at F times."""

    time: np.ndarray  # (F,) seconds
    state: np.ndarray  # (F, 2)
    centers: np.ndarray  # (F, M, 2)
    radius: np.ndarray  # (F,)
    weights: np.ndarray  # (F, M)
    ideal_weights: np.ndarray  # (F, M)
    along: np.ndarray  # (S,) places on the way through the ball, from -1 to 1 in radii
    value: np.ndarray  # (F, S) V there
    estimate: np.ndarray  # (F, S) V^ there
    grid: tuple[np.ndarray, np.ndarray, np.ndarray]  # x1 (G,), x2 (G,) and V (G, G), rows along x2


def animate_chase(scene: ChaseScene) -> bytes:
    """Return a GIF: the ball over the level lines of V, V and V^ across the ball, the weights over time."""
    import matplotlib
    from matplotlib.animation import PillowWriter
    from matplotlib.figure import Figure

    with matplotlib.rc_context(STYLE), tempfile.TemporaryDirectory() as folder:
        figure = Figure(figsize=(WIDTH, 3.3), layout="constrained")
        path = Path(folder) / "chase.gif"
        writer = PillowWriter(fps=_FRAMES_PER_SECOND)
        writer.setup(figure, str(path), dpi=_DPI)
        stage = _Stage(figure, scene)
        for frame in range(len(scene.time)):
            stage.show(frame)
            writer.grab_frame()
        writer.finish()
        return path.read_bytes()


class _Stage:
    """The three panels, and what of them moves."""

    def __init__(self, figure: Figure, scene: ChaseScene) -> None:
        from matplotlib.patches import Circle

        self._scene = scene
        plane, across, weights = figure.subplot_mosaic(
            [["plane", "across"], ["plane", "weights"]], width_ratios=[1.15, 1.0]
        ).values()
        plane.contour(*scene.grid, levels=_LEVELS, colors="0.75", linewidths=0.7)
        plane.set(xlabel="$x_1$", ylabel="$x_2$", aspect="equal")
        plane.set_title("level lines of $V$; the centers move with the state", loc="left")
        (self._path,) = plane.plot([], [], color="0.45", linewidth=0.8)
        self._ball = Circle((0, 0), 1.0, facecolor=colour(4), alpha=0.35, edgecolor=colour(0))
        plane.add_patch(self._ball)
        (self._centers,) = plane.plot([], [], "o", color=colour(0), markersize=3)
        (self._state,) = plane.plot([], [], "o", color=colour(1), markersize=4)
        (self._value,) = across.plot([], [], color="0.6", linewidth=3.0, label="$V$")
        (self._estimate,) = across.plot([], [], "--", color=colour(0), label=r"$\hat V$")
        across.set(xlim=(-1, 1), xlabel="place in the ball (radii, along the way)")
        across.set_ylim(*_limits(scene.value))
        legend_above(across, 2)
        self._draw_weights(weights)

    def _draw_weights(self, axes: Axes) -> None:
        scene = self._scene
        for i, ideal in enumerate(scene.ideal_weights.T):
            axes.plot(scene.time, ideal, ":", color=colour(i), linewidth=0.8)
        self._weights = [axes.plot([], [], color=colour(i))[0] for i in range(scene.weights.shape[1])]
        axes.set(xlabel="time (s)", xlim=(scene.time[0], scene.time[-1]))
        axes.set_ylim(*_limits(scene.ideal_weights))
        axes.set_title("weights, and the ideal ones (dotted)", loc="left")

    def show(self, frame: int) -> None:
        """Put everything where it is at that frame."""
        scene = self._scene
        self._path.set_data(scene.state[: frame + 1, 0], scene.state[: frame + 1, 1])
        self._ball.set(center=tuple(scene.state[frame]), radius=float(scene.radius[frame]))
        self._centers.set_data(scene.centers[frame, :, 0], scene.centers[frame, :, 1])
        self._state.set_data(scene.state[frame, :1], scene.state[frame, 1:])
        self._value.set_data(scene.along, scene.value[frame])
        self._estimate.set_data(scene.along, scene.estimate[frame])
        for line, column in zip(self._weights, scene.weights.T, strict=True):
            line.set_data(scene.time[: frame + 1], column[: frame + 1])


def _limits(values: np.ndarray) -> tuple[float, float]:
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    margin = 0.08 * (high - low) or 1.0
    return low - margin, high + margin

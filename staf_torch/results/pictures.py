"""Pictures of objects of the library as plain arrays, and the function that draws them.

The library knows no matplotlib: it describes a picture, and `figures` draws it, which the package registers
here when it is imported.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    import numpy as np


class LoopPicture(NamedTuple):
    """Rows of a closed loop over time; states and inputs with their units, "" where there is none."""

    title: str
    time: np.ndarray  # (T,) seconds
    state: np.ndarray  # (R, T, n); NaN where a line is broken: an angle jumps by a turn, a row is frozen
    control: np.ndarray  # (R, T, m) held from that time on
    cost: np.ndarray  # (R, T) so far
    state_units: tuple[str, ...]
    input_units: tuple[str, ...]
    low: np.ndarray  # (m,) -inf for none
    high: np.ndarray  # (m,)
    wanted: np.ndarray | None  # (T, n) set-point or path, of which states are drawn; None where it is 0
    beside: tuple[np.ndarray, np.ndarray, np.ndarray] | None  # state, control and cost of the LQR


Drawer = Callable[[LoopPicture, object, object], Any]
"""A matplotlib Figure of a picture, a width and a font."""
_DRAWERS: list[Callable[[], Drawer]] = []


def drawn_by(load: Callable[[], Drawer]) -> None:
    """Register a function that imports and returns what draws a closed loop."""
    _DRAWERS[:] = [load]


def draw(picture: LoopPicture, width: object, font: object) -> Any:
    """Return the picture as a matplotlib Figure of a width in inches and a font, None for the defaults."""
    return _DRAWERS[-1]()(picture, width, font)

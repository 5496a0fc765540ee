"""Reading a figure back from its axes, for the tests of what is drawn."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

T = np.linspace(0.5, 4.5, 9)


Curve = tuple[str | None, Any, Any]  # name in the legend, x, y


def wave(*shape: int, low: float = 0.2) -> np.ndarray:
    """Positive numbers, no two alike, with the times first."""
    size = int(np.prod(shape))
    return low + np.abs(np.sin(1.7 * np.arange(1, size + 1))).reshape(shape)


def visible(figure: Figure) -> list[Axes]:
    """The panels."""
    return [axes for axes in figure.axes if axes.get_visible() and axes.get_label() != "<legend>"]


def lines(axes: Axes) -> list[Curve]:
    """Name, x and y of every line of a panel."""
    found = []
    for line in axes.get_lines():
        name = str(line.get_label())
        x, y = (np.asarray(part, dtype=float) for part in line.get_data())
        found.append((None if name.startswith("_") else name, x, y))
    return found


def holds(axes: Axes, curves: Sequence[Curve], names: tuple[str, str], **more: Any) -> None:
    """The panel has these curves in this order, these names of its axes, and what else is told."""
    assert (axes.get_xlabel(), axes.get_ylabel()) == names
    scales = more.pop("scales", ("linear", "linear"))
    assert (axes.get_xscale(), axes.get_yscale()) == scales
    found = lines(axes)
    assert [curve[0] for curve in found] == [curve[0] for curve in curves]
    for (_, x, y), (name, want_x, want_y) in zip(found, curves, strict=True):
        np.testing.assert_allclose(x, want_x, err_msg=str(name))
        np.testing.assert_allclose(y, want_y, err_msg=str(name))
    for limit, want in more.items():
        np.testing.assert_allclose(getattr(axes, f"get_{limit}")(), want)
    named = [line for line in axes.get_lines() if not str(line.get_label()).startswith("_")]
    looks = [(line.get_color(), str(line.get_linestyle()), line.get_marker()) for line in named]
    assert len(set(looks)) == len(looks)  # no two of one look


def legend(figure: Figure) -> list[str]:
    """The entries of the legends of a figure."""
    found = [axes.get_legend() for axes in figure.axes]
    return [text.get_text() for each in found if each is not None for text in each.get_texts()]


def span(along: np.ndarray) -> tuple[float, float]:
    return float(along[0]), float(along[-1])


LINEAR_LOG, LOG, LOG_LINEAR = ("linear", "log"), ("log", "log"), ("log", "linear")
EMPTY = ([], [])

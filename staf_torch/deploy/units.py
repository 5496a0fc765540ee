"""Units of the plants' states and inputs, for the sheet of an export."""

from __future__ import annotations

from typing import NamedTuple

from torch import nn


class Units(NamedTuple):
    """Of the state and of the input."""

    state: str
    input: str


_UNITS = {
    "Pendulum": Units("rad, rad/s", "N m"),
    "PlanarQuadrotor": Units("m, m, rad, m/s, m/s, rad/s", "N above hover, N m"),
}


def units_of(plant: nn.Module) -> Units:
    """The units of a plant's state and input; the examples of the papers have none."""
    return _UNITS.get(type(plant).__name__, Units("1", "1"))

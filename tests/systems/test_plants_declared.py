"""What plants say of themselves: sizes, units, angles, where episodes begin, their usual parameters."""

from __future__ import annotations

import inspect
from typing import Any

import pytest
import torch

from staf_torch import systems

NONE = (None, 0, 1.0, (), ("1", "1"))
DECLARED: dict[str, tuple[Any, ...]] = {
    "Plant": NONE,
    "Linear": NONE,
    "Barrier": NONE,
    "Clocked": NONE,
    "StepPlant": NONE,
    "RatePlant": NONE,
    "CartPole": (4, 1, 0.2, (1,), ("m, rad, m/s, rad/s", "N")),
    "Oscillator": (2, 0, 1.0, (), ("1", "1")),
    "Pendulum": (2, 1, 0.5, (), ("rad, rad/s", "N m")),
    "PlanarQuadrotor": (6, 2, 0.2, (), ("m, m, rad, m/s, m/s, rad/s", "N above hover, N m")),
    "ThreeState": (3, 2, 0.5, (), ("1", "1")),
    "TwoLinkRobot": (4, 2, 1.0, (), ("rad, rad, rad/s, rad/s", "N m")),
    "TwoState": (2, 1, 1.0, (), ("1", "1")),
    "TwoStateChain": (2, 1, 1.0, (), ("1", "1")),
    "VanDerPol": (2, 1, 1.0, (), ("1", "1")),
}
USUAL: dict[str, dict[str, Any]] = {
    "CartPole": {"cart": 1.0, "pole": 0.1, "half_length": 0.5, "gravity": 9.81},
    "Oscillator": {"frequency": 1.0},
    "Pendulum": {"mass": 1.0, "length": 1.0, "damping": 0.1, "gravity": 9.81},
    "PlanarQuadrotor": {"mass": 1.0, "inertia": 0.1, "gravity": 9.81},
    "TwoLinkRobot": {"inertia": (3.473, 0.196, 0.242), "friction": (5.3, 1.1, 8.45, 2.35)},
    "TwoState": {"as_printed": False},
    "VanDerPol": {"damping": 1.0},
}


@pytest.mark.parametrize("name", DECLARED)
def test_a_plant_says_what_it_is(name: str) -> None:
    kind = getattr(systems, name)
    dim, inputs, spread, periodic, units = DECLARED[name]
    assert (kind.dim, kind.inputs, kind.spread, kind.periodic, tuple(kind.units)) == (
        dim,
        inputs,
        spread,
        periodic,
        units,
    )
    assert kind.bounds is None
    assert kind.period is None
    if dim is not None:
        plant = kind()
        assert plant.traceable is True
        assert plant.equilibrium().tolist() == [0.0] * dim
        assert plant.resting_input().tolist() == [0.0] * inputs
        assert plant.equilibrium().dtype == plant.resting_input().dtype == torch.float64
        assert plant.step_limit(plant.equilibrium(), plant.resting_input()) is None


@pytest.mark.parametrize("name", USUAL)
def test_usual_parameters_are_those_of_the_page(name: str) -> None:
    found = inspect.signature(getattr(systems, name)).parameters
    assert {key: found[key].default for key in USUAL[name]} == USUAL[name]


def test_units_are_one_unless_said() -> None:
    assert tuple(systems.Units()) == ("1", "1")
    assert tuple(systems.Units("m", "N")) == ("m", "N")

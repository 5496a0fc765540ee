"""A plant with a clock: the same motion, and a time that no control touches."""

from __future__ import annotations

import pytest
import torch
from helpers import uniform

from staf_torch import systems


def test_motion_is_that_of_the_plant_and_a_second_each_second() -> None:
    plant = systems.Clocked(inner := systems.Pendulum())
    x, u = torch.tensor([[0.3, -0.2], [1.0, 0.5]]).double(), torch.tensor([[0.1], [-0.4]]).double()
    moved = plant.motion(plant.at(x, time=3.0), u)
    torch.testing.assert_close(moved[:, :2], inner.rate(x, u), rtol=0, atol=0)
    assert moved[:, 2].tolist() == [1.0, 1.0]
    assert (plant.dim, plant.inputs, plant.units.state) == (3, 1, f"{inner.units.state}, s")
    assert plant.at(x, time=3.0)[:, 2].tolist() == [3.0, 3.0]
    assert plant.equilibrium().tolist() == [0.0, 0.0, 0.0]


def test_plant_in_discrete_time_steps_with_its_period() -> None:
    inner = systems.StepPlant(
        lambda x, u: 0.9 * x + u, dim=1, inputs=1, dt=0.25, periodic=[-1], low=-1.0, high=2.0
    )
    plant = systems.Clocked(inner)
    x, u = torch.tensor([[2.0, 1.0]]).double(), torch.tensor([[0.5]]).double()
    assert plant.step(x, u).tolist() == [[2.3, 1.25]]
    torch.testing.assert_close(x + plant.motion(x, u), plant.step(x, u))
    assert (plant.period, plant.periodic, plant.bounds) == (0.25, (0,), inner.bounds)
    f, g = plant.linearisation()
    torch.testing.assert_close(f, torch.tensor([[0.9, 0.0], [0.0, 1.0]]).double())
    assert g.tolist() == [[1.0], [0.0]]


def test_clock_is_apart_in_the_linearisation() -> None:
    plant = systems.Clocked(inner := systems.Pendulum())
    at = torch.tensor([0.2, 0.0]).double()
    f, g = plant.linearisation(plant.at(at), torch.zeros(1).double())
    torch.testing.assert_close(f[:2, :2], inner.linearisation(at, torch.zeros(1).double()).matrix)
    assert not f[2].any()
    assert not f[:, 2].any()
    assert g[2].tolist() == [0.0]


def test_plant_without_a_size_is_refused() -> None:
    class Any(systems.ControlAffineSystem):
        def drift(self, x: torch.Tensor) -> torch.Tensor:
            return -x

    with pytest.raises(ValueError, match=r"`Clocked\(plant=...\)` must say its `dim`"):
        systems.Clocked(Any())


def test_a_step_takes_any_leading_dimensions() -> None:
    plant = systems.Clocked(systems.StepPlant(lambda x, u: x.sin() + u, dim=3, inputs=1, dt=0.1))
    x, u = uniform(3, 5, 4, seed=1), uniform(3, 5, 1, seed=2)
    torch.testing.assert_close(plant.step(x, u), torch.cat((x[..., :3].sin() + u, x[..., 3:] + 0.1), dim=-1))
    f, g = plant.linearisation()
    torch.testing.assert_close(f, torch.eye(4, dtype=torch.float64))  # the clock's as well
    torch.testing.assert_close(g, torch.tensor([[1.0], [1.0], [1.0], [0.0]]).double())

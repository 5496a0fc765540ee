"""Plants with inputs: their equilibria, linearisations and known optima."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from variants import PLANTS, over

from staf_torch import adp, systems

KNOWN = ("two_state", "linear", "linear_of_two_inputs")


def states(dim: int, count: int = 100, seed: int = 0, box: float = 2.0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return box * (2 * torch.rand(count, dim, dtype=torch.float64, generator=generator) - 1)


def unit_cost(plant: systems.ControlAffineSystem) -> adp.QuadraticCost:
    assert plant.dim is not None
    return adp.QuadraticCost(1.0, 1.0, plant.dim, plant.inputs)


@over(PLANTS)
def test_every_plant_rests_at_its_equilibrium(name: str) -> None:
    plant = PLANTS[name]()
    assert torch.equal(plant.drift(plant.equilibrium()).abs(), torch.zeros(plant.dim, dtype=torch.float64))


@over(PLANTS)
def test_a_batch_gives_what_its_rows_give(name: str) -> None:
    plant = PLANTS[name]()
    x = states(plant.dim, 12).reshape(3, 4, plant.dim)
    for method in (plant.drift, plant.effectiveness):
        whole = method(x)
        rows = torch.stack([torch.stack([method(row) for row in block]) for block in x])
        torch.testing.assert_close(whole, rows, rtol=1e-14, atol=1e-15)
    assert plant.effectiveness(x).shape == (3, 4, plant.dim, plant.inputs)


@over(PLANTS)
def test_linearisation_is_the_difference_quotient_of_the_smooth_drift(name: str) -> None:
    plant = PLANTS[name]()
    a, b = plant.linearisation()
    step = 1e-6 * torch.eye(plant.dim, dtype=torch.float64)
    quotient = (plant.smooth_drift(step) - plant.smooth_drift(-step)).mT / 2e-6
    torch.testing.assert_close(a, quotient, rtol=1e-8, atol=1e-8)
    torch.testing.assert_close(b, plant.effectiveness(plant.equilibrium()))


@over(KNOWN)
def test_known_optimal_value_solves_the_hjb_equation(name: str) -> None:
    plant = PLANTS[name]()
    cost = unit_cost(plant)
    residual = adp.hjb_residual(
        plant, cost, lambda x: plant.optimal_value(x, cost.q, cost.r), states(plant.dim)
    )
    assert residual.abs().max() < 1e-11


def test_plant_that_does_not_rest_at_the_origin_is_refused() -> None:
    class Pushed(systems.VanDerPol):
        def drift(self, x: Tensor) -> Tensor:
            return super().drift(x) + 1.0

    with pytest.raises(ValueError, match=r"`Pushed.drift` must be 0 at the origin.*got \[1.0, 1.0\]"):
        adp.LQR(Pushed(), unit_cost(Pushed()))


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

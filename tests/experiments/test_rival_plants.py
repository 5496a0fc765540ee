"""The plants of `rivals` by formulas of their own, and what is made of a case."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from helpers import tensor, uniform
from helpers_experiments import made_of
from recorded import Record

from staf_torch import adp, systems
from staf_torch.experiments.rival_plants import CASES, Case, TorchMath

SINE, COSINE = math.sin, math.cos


def mass(x: np.ndarray, u: np.ndarray) -> list[float]:
    return [x[1], u[0]]


def pendulum(x: np.ndarray, u: np.ndarray) -> list[float]:
    """A rod of 1 kg and 1 m in steps of 50 ms, its rate within 8 rad/s."""
    rate = min(max(x[1] + 0.05 * (3 * 10 / 2 * SINE(x[0]) + 3 * u[0]), -8), 8)
    return [x[0] + 0.05 * rate, rate]


def cart_pole(x: np.ndarray, u: np.ndarray) -> list[float]:
    """The two equations of motion as a linear system in the accelerations."""
    heavy, light, half = 1.0, 0.1, 0.5
    matrix = np.array([[heavy + light, light * half * COSINE(x[1])], [COSINE(x[1]), 4 / 3 * half]])
    right = [u[0] + light * half * x[3] ** 2 * SINE(x[1]), 9.8 * SINE(x[1])]
    return [x[2], x[3], *np.linalg.solve(matrix, right)]


def quadrotor(x: np.ndarray, u: np.ndarray) -> list[float]:
    thrust = u[0] + 9.81
    return [*x[3:], -thrust * SINE(x[2]), thrust * COSINE(x[2]) - 9.81, 10 * u[1]]


def small_quadrotor(x: np.ndarray, u: np.ndarray) -> list[float]:
    pushed = sum(u) / 0.027
    turned = (u[1] - u[0]) * 0.0397 / math.sqrt(2) / 1.4e-5
    return [x[1], pushed * SINE(x[4]), x[3], pushed * COSINE(x[4]) - 9.81, x[5], turned]


BY_HAND: dict[str, Callable[[np.ndarray, np.ndarray], list[float]]] = {
    "double_integrator": mass,
    "pendulum": pendulum,
    "cart_pole_10N": cart_pole,
    "cart_pole_5N": cart_pole,
    "cart_pole_to_1m": cart_pole,
    "cart_pole_swing_up": cart_pole,
    "quadrotor": quadrotor,
    "figure_eight": small_quadrotor,
}


@pytest.mark.parametrize("name", CASES)
def test_the_equations_of_a_plant_are_those_that_are_written_by_hand(name: str) -> None:
    case = CASES[name]
    x, u = uniform(6, case.dim, low=-3, high=3, seed=1), uniform(6, case.inputs, low=-2, high=2, seed=2)
    x[:2, 1] *= 3.5  # where the pendulum is at its limits
    expected = tensor([BY_HAND[name](*row) for row in zip(x.numpy(), u.numpy(), strict=True)])
    found = torch.stack(tuple(case.equations(TorchMath, x.unbind(-1), u.unbind(-1))), -1)
    torch.testing.assert_close(found, expected, rtol=1e-11, atol=1e-11)
    if case.path is None:
        moved = case.plant().motion(x, u)
        torch.testing.assert_close(moved, expected - x if case.discrete else expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", CASES)
def test_a_case_is_the_recorded_one(name: str, record: Record) -> None:
    case = CASES[name]
    fields = {field.name: getattr(case, field.name) for field in dataclasses.fields(case)}
    plant, cost, problem = case.plant(), case.cost(), case.problem()
    record(
        made_of({"fields": fields, "plant": plant, "cost": cost, "states": case.states(5, seed=3)})
        | {"goal": problem.goal, "rest": problem.rest, "low": problem.bounds.low, "tick": problem.tick},
        rtol=1e-6,
    )
    kinds = (
        systems.StepPlant if case.discrete else systems.RatePlant if case.path is None else systems.Clocked
    )
    assert isinstance(plant, kinds)
    assert plant.period == (case.dt if case.discrete else None)
    assert isinstance(cost, adp.TrackingCost) == (case.path is not None)
    assert torch.equal(case.states(5, seed=3), case.states(5, seed=3))
    assert not torch.equal(case.states(5, seed=3), case.states(5, seed=4))


def test_the_defaults_of_a_case_ask_for_nothing() -> None:
    case = Case(
        "mine",
        CASES["double_integrator"].equations,
        0.1,
        10,
        ((1.0, 1.0), (1.0,)),
        (-1.0,),
        (1.0,),
        (1.0, 2.0),
    )
    assert (case.periodic, case.discrete, case.swing, case.horizon, case.left) == ((), False, False, 50, 1e-3)
    assert case.target is case.path is case.rest is None
    assert (case.dim, case.inputs) == (2, 1)
    assert case.goal().tolist() == [0.0, 0.0]
    assert case.goal().dtype == torch.float64
    moved = dataclasses.replace(case, target=(0.5, 0.0))
    assert moved.goal().tolist() == [0.5, 0.0]
    assert moved.plant().equilibrium().tolist() == [0.5, 0.0]
    spread = moved.states(400, seed=0)
    assert spread.dtype == torch.float64
    assert spread.amin(0).tolist() == pytest.approx([-0.5, -2.0], abs=0.02)
    assert spread.amax(0).tolist() == pytest.approx([1.5, 2.0], abs=0.02)
    with pytest.raises(dataclasses.FrozenInstanceError):
        case.dt = 1.0  # type: ignore[misc]


def test_what_equations_ask_of_torch_is_what_they_would_ask_of_casadi() -> None:
    x = tensor([-3.0, 0.5, 3.0])
    assert TorchMath.fmin(x, 1.0).tolist() == [-3.0, 0.5, 1.0]
    assert TorchMath.fmax(x, -1.0).tolist() == [-1.0, 0.5, 3.0]
    torch.testing.assert_close(TorchMath.sin(x).square() + TorchMath.cos(x).square(), torch.ones(3).double())

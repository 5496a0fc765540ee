"""One difference of states: angles by the shorter way around, in plans, costs, feedback, filters, metrics."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from helpers import tensor, uniform
from helpers_adp import Yaw
from torch import Tensor

from staf_torch import adp, systems
from staf_torch.metrics.closed_loop import regulated

TURN = 2 * math.pi


def arms() -> systems.Linear:
    """Two wheels, each pushed by an input of its own: both angles are periodic."""
    zero, one = torch.zeros(2, 2), torch.eye(2)
    a, b = torch.cat((torch.cat((zero, one), 1), torch.cat((zero, -one), 1))), torch.cat((zero, one))
    plant = systems.Linear(a.tolist(), b.tolist())
    plant.periodic = (0, 1)
    return plant


def path(rate: float, wrapped: bool):  # type: ignore[no-untyped-def]
    def at(t: Tensor) -> Tensor:
        angle = rate * t
        angle = torch.atan2(angle.sin(), angle.cos()) if wrapped else angle
        return torch.stack((angle, 0 * t + rate), -1)

    return at


@pytest.mark.parametrize(("rate", "wrapped"), [(5.0, True), (100.0, False)])
def test_a_path_that_turns_by_more_than_half_a_turn_is_followed_at_no_cost(
    rate: float, wrapped: bool
) -> None:
    plant = systems.Clocked(Yaw())
    cost = adp.TrackingCost(1.0, 0.1, dim=2, inputs=1, path=path(rate, wrapped))
    problem = adp.SampledProblem.of(plant, cost, dt=0.1)
    x0 = plant.at(tensor([[0.0, rate], [3 * TURN, rate]]))
    found = adp.BoxDDP(problem, steps=8, compile=False).solve(x0)
    assert bool(found.converged.all())
    assert float(found.cost.max()) < 1e-20
    follower = adp.RecedingHorizon(problem, steps=3, compile=False)
    run = adp.simulate(follower, plant, cost, x0, steps=2, dt=0.1)
    assert float(run.cost.max()) < 1e-20


def test_a_black_box_that_wraps_its_own_angle_is_linearised_planned_and_improved_across_the_jump() -> None:
    def step(x: np.ndarray, u: np.ndarray) -> np.ndarray:  # rests at pi, where it jumps
        rate = x[:, 1] + 0.1 * u[:, 0]
        angle = x[:, 0] + 0.1 * rate
        return np.stack((np.arctan2(np.sin(angle), np.cos(angle)), rate), axis=1)

    plant = systems.StepPlant(step, dim=2, inputs=1, dt=0.1, periodic=[0], equilibrium=[math.pi, 0.0])
    found = plant.linearisation()
    torch.testing.assert_close(found.matrix, tensor([[1.0, 0.1], [0.0, 1.0]]), rtol=1e-6, atol=1e-8)
    cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
    policy = adp.near_optimal(plant, cost)
    around = tensor([[0.2, 0.0], [-0.2, 0.0], [TURN + 0.2, 0.0]])
    u = policy(tensor([[math.pi, 0.0]]) + around)
    torch.testing.assert_close(u[:2], -u[:2].flip(0), rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(u[0], u[2], rtol=1e-6, atol=1e-8)

    def wraps(x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        rate = x[:, 1] + 0.1 * u[:, 0]
        angle = x[:, 0] + 0.1 * rate
        away = torch.atan2((x[:, 0] - math.pi).sin(), (x[:, 0] - math.pi).cos())
        paid = 0.1 * (away.square() + x[:, 1].square() + u[:, 0].square())
        return torch.stack((torch.atan2(angle.sin(), angle.cos()), rate), -1), paid

    jumps = adp.SampledProblem(wraps, dim=2, inputs=1, periodic=[0], goal=tensor([math.pi, 0.0]))
    both = adp.BoxDDP(jumps, steps=12, compile=False).solve(tensor([[3.0, 1.0], [-3.0, -1.0]]))
    assert bool(both.converged.all())
    torch.testing.assert_close(both.cost[0], both.cost[1], rtol=1e-6, atol=0)  # mirror images, both across pi


def test_rows_at_other_turns_have_the_cost_and_the_control_of_the_first() -> None:
    plant, cost = arms(), adp.QuadraticCost(1.0, 1.0, dim=4, inputs=2)
    x = tensor([[0.4, -2.5, 0.1, 0.0]])
    turns = TURN * tensor([[0.0, 0.0], [1.0, 0.0], [-2.0, 3.0], [0.0, 40.0]])
    rows = torch.cat((x[:, :2] + turns, x[:, 2:].expand(4, 2)), -1)
    problem = adp.SampledProblem.of(plant, cost, dt=0.1)
    basis = adp.QuadraticBasis(4)
    points = adp.QuadraturePoints(2, 4, half_width=0.2)
    weights = [1.0 if i == j else 0.0 for i in range(4) for j in range(i, 4)]
    learner = adp.ActorCritic(basis, plant, cost, points, critic=weights, actor=weights)
    for controller in (
        adp.Feedback(adp.LQR(plant, cost)),
        adp.RecedingHorizon(problem, steps=4, compile=False),
        learner,
    ):
        run = adp.simulate(controller, plant, cost, rows, dt=0.1, steps=2, compile=False)
        torch.testing.assert_close(run.cost, run.cost[:1].expand(4), rtol=1e-9, atol=0)
        torch.testing.assert_close(
            run.control, run.control[:1].expand(4, -1, -1), rtol=0, atol=1e-8, equal_nan=True
        )


def test_the_distance_at_the_end_and_the_limit_know_angles() -> None:
    plant, cost = Yaw(), adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
    x0 = tensor([[0.1, 0.0], [TURN + 0.1, 0.0], [TURN * 2e5 + 0.1, 0.0]])  # the last beyond the limit of 1e6
    run = adp.simulate(adp.Feedback(adp.LQR(plant, cost)), plant, cost, x0, dt=0.1, steps=120)
    assert not bool(run.diverged.any())
    final = cost.around(plant).deviation(run.state[:, -1])
    assert regulated(run, final).tolist() == [True, True, True]
    assert regulated(run).tolist() == [True, False, False]


@pytest.mark.parametrize(
    "output",
    [
        lambda x: 180 / math.pi * x[..., :1],  # degrees
        lambda x: x[..., :1] + x[..., 1:2],  # turns with both
        lambda x: x[..., :1].sin(),
        lambda x: 0.5 * x[..., :1],  # no angle, but of one
        lambda x: x[..., 2:3],
    ],
)
def test_an_output_of_an_angle_is_paid_by_the_shorter_way_around(output: Callable[[Tensor], Tensor]) -> None:
    cost = adp.QuadraticCost(1.0, 1.0, dim=4, inputs=2, output=output).around(arms())
    x = uniform(6, 4, seed=1) * 0.9
    turned = x + TURN * torch.cat((torch.randint(-3, 4, (6, 2)), torch.zeros(6, 2)), -1).double()
    torch.testing.assert_close(cost.state_rate(turned), cost.state_rate(x), rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(cost.state_rate(x)[:, None], output(x).square(), rtol=1e-9, atol=1e-12)
    sum_of = adp.QuadraticCost(1.0, 1.0, dim=4, inputs=2, output=lambda x: x[..., :1] + x[..., 1:2])
    at = tensor([[3.0, 3.0, 0.0, 0.0]])
    torch.testing.assert_close(sum_of.around(arms()).state_rate(at), tensor([(TURN - 6) ** 2]))


def test_shooting_from_the_set_point_some_turns_away_stays_there() -> None:
    cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
    x0 = tensor([[3 * TURN, 0.0], [1e-170, 0.0], [0.5, 0.0], [0.5 - 7 * TURN, 0.0]])
    found = adp.DirectShooting(Yaw(), cost, horizon=6.0, intervals=10).solve(x0)
    assert bool(found.converged.all())
    assert found.value[:2].tolist() == [0.0, 0.0]
    torch.testing.assert_close(found.value[2], found.value[3], rtol=1e-8, atol=0)

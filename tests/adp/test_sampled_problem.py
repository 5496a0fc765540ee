"""Problems in steps: of a plant and a cost, and at the edges of what is allowed."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from helpers import tensor
from helpers_plans import pushed
from helpers_swingup import double_integrator
from torch import Tensor

from staf_torch import adp, systems


def slow(x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    """One state that decays, in steps."""
    return 0.9 * x + 0.1 * u, 0.1 * (x.square() + u.square()).sum(-1)


def clocked(tick: float) -> Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]:
    """One state and the time, which moves by a tick."""

    def step(x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        after = torch.cat((0.9 * x[..., :1] + 0.1 * u, x[..., 1:] + tick), dim=-1)
        return after, 0.1 * (x[..., 0].square() + u.square().sum(-1))

    return step


def test_every_coordinate_of_a_problem_may_be_an_angle_from_either_end() -> None:
    problem = adp.SampledProblem(slow, dim=1, inputs=1, periodic=[0, -1])
    assert problem.periodic == (0,)
    assert float(problem.offset(tensor([[3.0]]), tensor([[-3.0]]))) == pytest.approx(6 - 2 * math.pi)
    for wrong in (1, -2):
        with pytest.raises(ValueError, match="periodic"):
            adp.SampledProblem(slow, dim=1, inputs=1, periodic=[wrong])


@pytest.mark.parametrize(("low", "high"), [(0.0, 1.0), (-1.0, 0.0), (0.1, 1.0)])
def test_the_input_at_rest_lies_between_the_bounds_and_not_at_one(low: float, high: float) -> None:
    with pytest.raises(ValueError, match="must lie between the bounds"):
        adp.SampledProblem(slow, dim=1, inputs=1, low=low, high=high)
    inside = adp.SampledProblem(slow, dim=1, inputs=1, low=-1e-9, high=1e-9)
    assert inside.levels().flatten().tolist() == [-1e-9, 0.0, 1e-9]


def test_a_path_needs_a_time_that_moves() -> None:
    def path(t: Tensor) -> Tensor:
        return 0 * t.unsqueeze(-1)

    made = adp.SampledProblem(clocked(0.25), dim=2, inputs=1, path=path)
    assert made.tick == 0.25
    assert made.goals(tensor([[0.3, 2.0]]), 2)[0].tolist() == [[0.0, 2.0], [0.0, 2.25], [0.0, 2.5]]
    for tick in (0.0, -0.25):
        with pytest.raises(ValueError, match="must move the time"):
            adp.SampledProblem(clocked(tick), dim=2, inputs=1, path=path)


def test_a_step_of_other_shapes_is_shown_beside_those_of_two_rows() -> None:
    wrong: list[Any] = [
        (lambda x, u: (x[:, :1], x.sum(-1)), r"x \(2, 2\) and u \(2, 2\) to x\+ .*got \(2, 1\) and \(2,\)"),
        (lambda x, u: (x, x), r"costs \(2,\); got \(2, 2\) and \(2, 2\)"),
    ]
    for step, said in wrong:
        with pytest.raises(ValueError, match=said):
            adp.SampledProblem(step, dim=2, inputs=2)


def test_a_problem_rests_within_a_millionth_and_costs_no_more() -> None:
    for moved, paid, fits in (
        (0.9e-6, 0.0, True),
        (1.1e-6, 0.0, False),
        (0, 0.9e-6, True),
        (0, 1.1e-6, False),
    ):

        def step(x: Tensor, u: Tensor, moved: float = moved, paid: float = paid) -> tuple[Tensor, Tensor]:
            after, cost = pushed(x, u)
            return after + moved, cost + paid

        if fits:
            adp.SampledProblem(step, dim=2, inputs=2)
        else:
            with pytest.raises(ValueError, match="must be a state of rest at no cost"):
                adp.SampledProblem(step, dim=2, inputs=2)


def test_problem_of_a_plant_and_a_cost_pays_what_the_simulation_pays() -> None:
    plant = systems.Pendulum()
    cost = adp.QuadraticCost(1.0, 0.1, dim=2, inputs=1, low=-3.0, high=5.0)
    problem = adp.SampledProblem.of(plant, cost, dt=0.05)
    x = torch.tensor([[0.3, -0.2]], dtype=torch.float64)
    run = adp.simulate(adp.Feedback(problem.linear_feedback), plant, cost, x, dt=0.05, steps=20)
    spent = torch.zeros(1, dtype=torch.float64)
    for _ in range(20):
        x, paid = problem.advance(x, problem.linear_feedback(x))
        spent = spent + paid
    torch.testing.assert_close(run.cost, spent, rtol=1e-12, atol=0)
    torch.testing.assert_close(run.state[:, -1], x, rtol=1e-12, atol=1e-14)


def cart(x: Tensor, u: Tensor) -> Tensor:
    return torch.stack((x[:, 0] + 0.1 * x[:, 1], x[:, 1] + 0.1 * u[:, 0]), dim=-1)


def test_plant_in_steps_pays_its_period_times_the_rate() -> None:
    plant = systems.StepPlant(cart, dim=2, inputs=1, dt=0.1, low=-1.0, high=1.0)
    problem = adp.SampledProblem.of(plant, adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1))
    x, u = tensor([[5.0, 0.0], [-1.0, 2.0]]), tensor([[0.5], [-1.0]])
    for mine, known in zip(problem.advance(x, u), double_integrator(-1.0, 1.0).advance(x, u), strict=True):
        torch.testing.assert_close(mine, known)
    torch.testing.assert_close(problem.p, double_integrator(-1.0, 1.0).p)
    assert problem.bounds.high.tolist() == [1.0]

"""Sampled plans around a feedback: they never cost more than it, and find what it does not know."""

from __future__ import annotations

import pytest
import torch
from helpers_swingup import cost_of, double_integrator, pendulum
from torch import Tensor

from staf_torch import adp
from staf_torch.adp.path_integral import _hats

X0 = torch.tensor([[4.0, 0.0], [-2.0, 3.0]], dtype=torch.float64)


def sampler(problem: adp.SampledProblem, **more: object) -> adp.PathIntegral:
    return adp.PathIntegral(problem, steps=30, samples=64, compile=False, **more)  # type: ignore[arg-type]


def uniform(mpc: adp.PathIntegral, rows: int, seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return 2 * torch.rand(rows, mpc.draws, 2, generator=generator, dtype=torch.float64) - 1


def test_plan_costs_no_more_than_the_feedback_and_less_where_it_does_not_know_the_way() -> None:
    problem = pendulum()
    x = torch.tensor([[3.0, 0.2], [-2.5, 0.5]], dtype=torch.float64)
    mpc = sampler(problem)
    alone = mpc.costs(x, torch.zeros(2, 1, 30, 1, dtype=torch.float64))[:, 0]
    carried = mpc.init(x)
    for seed in range(3):  # at the same state: the plan, which moves on a step each time, is moved back
        _, carried = mpc.step(x, carried, uniform(mpc, 2, seed), 0.1)
        plan = carried.identifier.view(2, 30, 1).roll(1, dims=1)
        carried = carried._replace(identifier=plan.flatten(1))
    found = mpc.costs(x, plan.unsqueeze(1))[:, 0]
    assert bool((found <= alone).all())
    assert float((found / alone).min()) < 0.95


def test_linear_plant_without_bounds_keeps_its_regulator() -> None:
    problem = double_integrator()
    mpc = sampler(problem, noise=0.5)
    x, carried, controls = X0, mpc.init(X0), []
    for seed in range(4):
        u, carried = mpc.step(x, carried, uniform(mpc, 2, seed), 0.1)
        torch.testing.assert_close(u, problem.linear_feedback(x))
        x, _ = problem.advance(x, u)
        controls.append(u)
    torch.testing.assert_close(cost_of(problem, X0, torch.stack(controls, dim=1)), problem.terminal(X0))


def test_rows_do_not_see_each_other() -> None:
    problem = double_integrator(-1.0, 1.0)
    mpc = sampler(problem)
    numbers = uniform(mpc, 2, 0)
    both, _ = mpc.step(X0, mpc.init(X0), numbers, 0.1)
    one, _ = mpc.step(X0[1:], mpc.init(X0[1:]), numbers[1:], 0.1)
    torch.testing.assert_close(both[1:], one, rtol=0, atol=1e-12)


def test_states_from_which_nothing_is_finite_get_the_feedback() -> None:
    def step(x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        after = x + 0.1 * u + torch.where(x.abs() > 5, torch.inf, 0.0)
        return after, x.square().sum(-1) + u.square().sum(-1)

    problem = adp.SampledProblem(step, dim=1, inputs=1, low=-1.0, high=1.0)
    mpc = adp.PathIntegral(problem, steps=4, samples=8, knots=2, compile=False)
    x = torch.tensor([[9.0], [0.5]], dtype=torch.float64)
    u, _ = mpc.step(x, mpc.init(x), torch.zeros(2, mpc.draws, 1, dtype=torch.float64), 0.1)
    torch.testing.assert_close(u, problem.linear_feedback(x))


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"noise": -1.0}, r"`PathIntegral\(noise=...\)` must be positive"),
        ({"knots": 31}, r"`PathIntegral\(knots=...\)` must be at most the 30 steps; got 31"),
        ({}, r"`PathIntegral\(noise=...\)` must be given where an input has no bounds"),
    ],
)
def test_wrong_arguments_are_named(more: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        sampler(double_integrator(), **more)


@pytest.mark.parametrize(("steps", "knots"), [(11, 2), (30, 4), (7, 7), (101, 13)])
def test_between_knots_a_line_is_a_line(steps: int, knots: int) -> None:
    hats = _hats(steps, knots)
    torch.testing.assert_close(hats.sum(1), torch.ones(steps, dtype=torch.float64), rtol=0, atol=1e-14)
    line = 0.3 + 0.7 * torch.linspace(0, 1, knots, dtype=torch.float64)
    wanted = 0.3 + 0.7 * torch.linspace(0, 1, steps, dtype=torch.float64)
    torch.testing.assert_close(hats @ line, wanted, rtol=0, atol=1e-14)

"""Sampled plans around a feedback: they never cost more than it, and find what it does not know."""

from __future__ import annotations

import math
from statistics import NormalDist
from typing import Any

import pytest
import torch
from helpers import tensor
from helpers_plans import BOX, pushed
from helpers_swingup import cost_of, double_integrator, pendulum
from torch import Tensor

from staf_torch import adp, lanes

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
        plan = carried = carried.roll(1, dims=1)
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
        ({"knots": 31}, r"`PathIntegral\(knots=...\)` must be at most the 30 steps; got 31"),
        ({}, r"`PathIntegral\(noise=...\)` must be given where an input has no bounds"),
    ],
)
def test_wrong_arguments_are_named(more: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        sampler(double_integrator(), **more)


def sampled(**more: Any) -> adp.PathIntegral:
    given = {"steps": 6, "samples": 5, "knots": 3, "noise": [0.4, 0.7], "temperature": 0.3, "compile": False}
    return adp.PathIntegral(BOX, **{**given, **more})


def test_between_knots_a_line_is_a_line() -> None:
    steps, knots = 30, 4
    spread = sampled(steps=steps, knots=knots).spread
    torch.testing.assert_close(spread.sum(1), torch.ones(steps).double(), rtol=0, atol=1e-14)
    line = 0.3 + 0.7 * torch.linspace(0, 1, knots, dtype=torch.float64)
    wanted = 0.3 + 0.7 * torch.linspace(0, 1, steps, dtype=torch.float64)
    torch.testing.assert_close(spread @ line, wanted, rtol=0, atol=1e-14)
    assert bool((spread >= 0).all())


@pytest.mark.parametrize("temperature", [0.01, 1e3])
def test_a_plan_is_the_mean_of_its_samples_by_what_they_cost_or_the_cheapest(temperature: float) -> None:
    mpc, rows = sampled(temperature=temperature), 4
    assert mpc.draws == 15  # 5 samples, 3 knots and 2 inputs in states of two numbers
    assert adp.PathIntegral(double_integrator(-1.0, 0.5), steps=9).noise.tolist() == [0.75]  # half the range
    generator = torch.Generator().manual_seed(1)
    numbers = 1.98 * torch.rand(rows, 15, 2, generator=generator, dtype=torch.float64) - 0.99
    x = 2 * torch.rand(rows, 2, generator=generator, dtype=torch.float64) - 1
    before = 0.1 * torch.rand(rows, 6, 2, generator=generator, dtype=torch.float64)
    u, after = mpc.step(x, before, numbers, 0.1)
    scales = tensor([10 ** (-2 * k / 4) for k in range(5)])
    for row in range(rows):
        flat = numbers[row].flatten().tolist()
        normal = tensor([NormalDist().inv_cdf(0.5 + 0.5 * v) for v in flat])
        change = torch.einsum("tk,skm->stm", mpc.spread, normal.view(5, 3, 2))
        tried = before[row] + change * scales[:, None, None] * tensor([0.4, 0.7])
        tried[0], tried[1] = before[row], 0.0  # the plan itself and the feedback alone
        costs = mpc.costs(x[row : row + 1], tried.unsqueeze(0))[0]
        excess = costs - costs.min()
        weight = (-excess / (temperature * excess.mean())).exp()
        blended = (weight[:, None, None] * tried).sum(0) / weight.sum()
        mixed = mpc.costs(x[row : row + 1], blended[None, None])[0, 0] < costs.min()
        plan = blended if mixed else tried[costs.argmin()]
        wanted = torch.minimum(torch.maximum(plan[0] - x[row] @ BOX.k.mT, BOX.bounds.low), BOX.bounds.high)
        torch.testing.assert_close(u[row], wanted, rtol=1e-7, atol=1e-9)
        ahead = after[row]
        torch.testing.assert_close(ahead[:-1], plan[1:], rtol=1e-7, atol=1e-9)
        assert ahead[-1].tolist() == [0.0, 0.0]


@pytest.mark.needs_compiler
def test_a_sample_costs_what_following_it_pays_in_plain_torch_and_in_a_program() -> None:
    mpc, x = sampled(), tensor([[0.4, -0.3], [1e200, 0.1]])
    change = torch.rand(2, 3, 6, 2, generator=torch.Generator().manual_seed(2), dtype=torch.float64) - 0.5
    program = lanes.Program(lambda carry, now, row: (carry, mpc.costs(*row)))
    for found in (mpc.costs(x, change), program((), (), (x, change), steps=1)[1][:, 0]):
        for k in range(3):
            at, spent = x[:1], 0.0
            for step in range(6):
                at, now = pushed(at, BOX.steered(at, change[:1, k, step]))
                spent += float(now)
            assert float(found[0, k]) == pytest.approx(spent + float(BOX.terminal(at)))
            assert float(found[1, k]) == math.inf


def test_numbers_at_the_end_of_their_range_give_a_finite_plan() -> None:
    mpc, x = sampled(), tensor([[0.3, -0.2]])
    ends = torch.ones(1, 15, 2).double()
    ends[0, ::2] = -1.0
    u, after = mpc.step(x, mpc.init(x), ends, 0.1)
    assert bool(torch.isfinite(torch.cat((u, after[:, 0]), dim=-1)).all())

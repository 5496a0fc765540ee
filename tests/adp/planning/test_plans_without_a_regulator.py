"""Goals without a linear regulator are planned over a horizon; the log says what the end of a plan lacks."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from typing import Any

import pytest
import torch
from helpers import tensor
from torch import Tensor

from staf_torch import adp, lanes, systems

KINK = systems.RatePlant(lambda x, u: u.abs(), dim=1, inputs=1)
ONE = adp.QuadraticCost(1.0, 0.1, dim=1, inputs=1, low=-1.0, high=1.0)


@pytest.fixture(autouse=True)
def _nothing_is_compiled() -> Iterator[None]:
    """Plans are short, and each is searched for once: a compiler takes longer."""
    with lanes.compiling("never"):
        yield


class Unicycle(systems.ControlAffineSystem):
    """(x, y, heading) moved by speed and turn rate: no linear feedback brings it to a pose."""

    dim, inputs, periodic = 3, 2, (2,)

    def drift(self, x: Tensor) -> Tensor:
        return torch.zeros_like(x)

    def effectiveness(self, x: Tensor) -> Tensor:
        zero, one = torch.zeros_like(x[..., 2]), torch.ones_like(x[..., 2])
        columns = (x[..., 2].cos(), x[..., 2].sin(), zero), (zero, zero, one)
        return torch.stack([torch.stack(column, dim=-1) for column in columns], dim=-1)


class Profit(adp.QuadraticCost):
    """What is gained is the state itself: there is no set-point."""

    def state_rate(self, x: Tensor) -> Tensor:
        return -x[..., 0]


def three(plant: systems.Plant, cost: adp.Cost, x0: Tensor, steps: int, **more: Any) -> list[Tensor]:
    """Cost of a plan by each planner, and of its first quarter in a loop."""
    problem = adp.SampledProblem.of(plant, cost, dt=0.1, **more)
    plan = adp.BoxDDP(problem, steps=steps, iterations=25, compile=False).solve(x0)
    assert torch.isfinite(plan.cost).all()
    loops = (
        adp.RecedingHorizon(problem, steps=steps, compile=False),
        adp.PathIntegral(problem, steps=steps, samples=100, compile=False),
    )
    ran = [adp.simulate(loop, plant, cost, x0, steps=steps // 4, dt=0.1, compile=False) for loop in loops]
    assert not any(run.diverged.any() for run in ran)
    return [plan.cost, ran[0].cost, ran[1].cost]


def test_a_rate_with_a_kink_at_rest_is_planned_as_its_smooth_half(caplog: pytest.LogCaptureFixture) -> None:
    """x' = |u| from -1 with u > 0 is x' = u: that one has a regulator, and the same optimum."""
    x0 = tensor([[-1.0], [-0.4]])
    with caplog.at_level("WARNING"):
        costs = three(KINK, ONE, x0, 14)
    assert "no linear regulator at the goal" in caplog.text
    assert "Give `terminal`" in caplog.text
    smooth = systems.RatePlant(lambda x, u: u, dim=1, inputs=1)
    problem = adp.SampledProblem.of(smooth, ONE, dt=0.1, terminal=0.0)
    best = adp.BoxDDP(problem, steps=14, compile=False).solve(x0)
    torch.testing.assert_close(costs[0], best.cost, rtol=1e-3, atol=0.0)
    assert (costs[1] <= 1.001 * best.cost).all()
    assert (costs[2] <= 1.5 * best.cost).all()


def test_a_unicycle_parks_sideways() -> None:
    cost = adp.QuadraticCost([1.0, 1.0, 0.1], 0.1, dim=3, inputs=2, low=-1.0, high=1.0, terminal=5.0)
    x0 = tensor([[0.0, 0.4, 0.0]])
    still = 1.4 * 0.4**2 + 5 * 0.4**2  # what standing where it is costs
    problem = adp.SampledProblem.of(Unicycle(), cost, dt=0.1)
    plan = adp.BoxDDP(problem, steps=14, iterations=12, compile=False).solve(x0)
    assert float(plan.cost) < 0.6 * still


def test_an_economic_cost_is_planned_from_everywhere_to_the_same_by_all() -> None:
    plant = systems.RatePlant(lambda x, u: u - x * x, dim=1, inputs=1)
    cost = Profit(1.0, 1.0, dim=1, inputs=1, low=0.0, high=2.0)
    x0 = tensor([[0.5], [0.0]])
    plan, *_ = three(plant, cost, x0, 12)
    shot = adp.DirectShooting(plant, cost, horizon=1.2, intervals=8).solve(x0)
    assert shot.converged.all()
    assert (shot.value < -0.1).all()
    torch.testing.assert_close(plan, shot.value, rtol=0.01, atol=0.0)
    with pytest.raises(ValueError, match=r"DirectShooting\(horizon=...\)` must be given.*cost.*must be 0 at"):
        adp.DirectShooting(plant, cost)


def test_a_cost_that_is_linear_in_state_and_input_switches_once() -> None:
    def step(x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        return x + 0.1 * (u - x), (0.05 * u - 0.1 * x)[:, 0]

    problem = adp.SampledProblem(step, dim=1, inputs=1, low=0.0, high=2.0)
    plan = adp.BoxDDP(problem, steps=40, compile=False).solve(tensor([[0.5]]))
    assert plan.converged.all()
    worth = 0.1 * (1 - 0.9 ** torch.arange(39, -1, -1).double())  # of a unit of u, later
    assert torch.equal(plan.control[0, :, 0], torch.where(worth > 0.05, 2.0, 0.0).double())


@functools.cache
def short_plan(**terminal: float) -> Tensor:
    """Cost of a plan of half a second for a pendulum that ends with a number times e'e."""
    cost, x0 = adp.QuadraticCost(1.0, 0.5, 2, 1), tensor([[0.3, 0.0], [-0.2, 0.1]])
    problem = adp.SampledProblem.of(systems.Pendulum(), cost, dt=0.05, **terminal)
    return adp.BoxDDP(problem, steps=10, compile=False).solve(x0).cost


@pytest.mark.parametrize(
    ("of", "terminal"), [("problem", torch.eye(2).double()), ("cost", lambda x: x.square().sum(-1))]
)
def test_a_terminal_cost_is_a_matrix_a_number_or_a_function_everywhere(of: str, terminal: Any) -> None:
    plant, x0 = systems.Pendulum(), tensor([[0.3, 0.0], [-0.2, 0.1]])
    plain = adp.QuadraticCost(1.0, 0.5, 2, 1)
    ended = adp.QuadraticCost(1.0, 0.5, 2, 1, terminal=terminal)
    given = (plant, plain) if of == "problem" else (plant, ended)
    more = {"terminal": terminal} if of == "problem" else {}
    plan = adp.BoxDDP(adp.SampledProblem.of(*given, dt=0.05, **more), steps=10, compile=False).solve(x0)
    shot = adp.DirectShooting(*given, horizon=0.5, intervals=10, **more).solve(x0)
    torch.testing.assert_close(plan.cost, short_plan(terminal=1.0))
    torch.testing.assert_close(shot.value, plan.cost, rtol=2e-3, atol=0.0)


def test_doors_that_lead_to_a_goal_refuse_a_problem_without_one() -> None:
    problem = adp.SampledProblem.of(KINK, ONE, dt=0.1, terminal=0.0)
    with pytest.raises(ValueError, match=r"learn_global_value\(problem=...\)` must have a linear regulator"):
        adp.learn_global_value(problem, [1.0], steps=10)
    with pytest.raises(ValueError, match="no input reaches"):
        adp.near_optimal(KINK, ONE, dt=0.1)


def test_a_terminal_that_does_not_depend_on_the_state_has_the_slope_0() -> None:
    def two(x: Tensor) -> Tensor:
        return torch.full(x.shape[:-1], 2.0, dtype=x.dtype)

    plant, cost = systems.Pendulum(), adp.QuadraticCost(1.0, 0.5, 2, 1)
    x0 = tensor([[0.3, 0.0]])
    shot = adp.DirectShooting(plant, cost, horizon=0.5, intervals=10, terminal=two).solve(x0)
    plan = adp.BoxDDP(adp.SampledProblem.of(plant, cost, dt=0.05, terminal=two), steps=10, compile=False)
    none = short_plan(terminal=0.0)[:1]
    torch.testing.assert_close(plan.solve(x0).cost - 2, none)
    torch.testing.assert_close(shot.value - 2, none, rtol=2e-3, atol=0.0)


def test_set_points_out_of_bounds_and_bounds_that_end_at_one_are_told(
    caplog: pytest.LogCaptureFixture,
) -> None:
    plant = systems.Pendulum()
    aside = adp.QuadraticCost(1.0, 1.0, 2, 1, target=[0.5, 0.0], low=-1.0, high=1.0)
    for door in (adp.LQR, lambda plant, cost: adp.near_optimal(plant, cost, dt=0.05)):
        with pytest.raises(ValueError, match=r"must hold the plant at the set-point with an input within"):
            door(plant, aside)
    with caplog.at_level("WARNING"):
        problem = adp.SampledProblem.of(plant, aside, dt=0.05)
        adp.simulate(lambda x: 0 * x[..., :1], plant, aside, tensor([[0.5, 0.0]]), dt=0.05, steps=2)
    assert "within the bounds" in problem.unregulated
    assert "`simulate`: nothing holds the plant at the set-point" in caplog.text
    caplog.clear()
    with caplog.at_level("WARNING"):
        adp.LQR(plant, adp.QuadraticCost(1.0, 1.0, 2, 1, low=0.0, high=3.0))
    assert "lies on a bound" in caplog.text


def test_a_set_point_at_the_origin_is_kept_where_the_plant_rests_elsewhere() -> None:
    plant = systems.RatePlant(lambda x, u: 1.0 - x + u, dim=1, inputs=1, equilibrium=[1.0])
    cost = adp.QuadraticCost(1.0, 1.0, 1, 1, target=[0.0])
    lqr = adp.LQR(plant, cost)
    run = adp.simulate(lqr, plant, cost, tensor([[0.0]]), dt=0.1, steps=10, compile=False)
    torch.testing.assert_close(run.cost, torch.zeros(1).double())

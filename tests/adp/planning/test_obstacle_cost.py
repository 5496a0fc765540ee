"""Obstacles in the cost: the published penalty, the log barrier, and plans whose weight shrinks."""

from __future__ import annotations

import pytest
import torch
from helpers import tensor, uniform
from helpers_swingup import cost_of as cost_along
from torch import Tensor

from staf_torch import adp, systems
from staf_torch.adp.planning.obstacles import AvoidancePlans

LINE = systems.Linear([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])


def beside(x: Tensor) -> Tensor:
    """|x - z|^2 - r_a^2 with z = (1, 0) and r_a = 0.5."""
    return (x[..., 0] - 1).square() + x[..., 1].square() - 0.25


def cost_of(**more: object) -> adp.AvoidanceCost:
    given = {"obstacles": beside, "reach": 0.8**2 - 0.5**2, **more}
    return adp.AvoidanceCost(1.0, 1.0, dim=2, inputs=1, **given)  # type: ignore[arg-type]


def test_the_penalty_is_that_of_the_papers_outside_the_radius_of_avoidance() -> None:
    cost = cost_of(weight=2.0)
    angle, size = uniform(100, low=0.0, high=6.0, seed=1), uniform(100, low=0.51, high=1.2, seed=2)
    x = torch.stack((1 + size * angle.cos(), size * angle.sin()), dim=-1)
    square = size.square()
    published = torch.minimum(torch.zeros(()), (square - 0.64) / (square - 0.25)).square()
    torch.testing.assert_close(cost.state_rate(x), x.square().sum(-1) + 2 * published, rtol=1e-9, atol=1e-9)


FORMULAS = {"penalty": lambda q: (1 / q - 1) ** 2, "log": lambda q: q.log() ** 2}


@pytest.mark.parametrize("kind", FORMULAS)
def test_the_penalty_is_its_formula_and_its_taylor_series_below_a_hundredth_of_the_reach(kind: str) -> None:
    cost, formula, at = cost_of(kind=kind, reach=0.5), FORMULAS[kind], tensor(0.01)
    q = torch.linspace(0.01, 1.0, 50, dtype=torch.float64)
    torch.testing.assert_close(cost.penalty(0.5 * q), formula(q))
    slope, bend = torch.func.grad(formula)(at), torch.func.grad(torch.func.grad(formula))(at)
    below = torch.linspace(-2.0, 0.00999, 50, dtype=torch.float64)
    wanted = formula(at) + slope * (below - at) + 0.5 * bend * (below - at) ** 2
    torch.testing.assert_close(cost.penalty(0.5 * below), wanted)
    assert not bool(cost.penalty(torch.linspace(0.5, 4.5, 20).double()).any())
    assert cost.penalty((0.5 * q).float()).dtype == torch.float32


def test_every_obstacle_counts_with_the_weight_for_any_leading_dimensions() -> None:
    x = uniform(4, 3, 2, seed=1)
    several = [beside, lambda x: x[..., 0] + 0.7, lambda x: 0.9 - x[..., 0]]
    for weight in (1.0, 3.0):
        cost = cost_of(obstacles=several, weight=weight)
        paid = x.square().sum(-1) + weight * sum(cost.penalty(h(x)) for h in several)
        torch.testing.assert_close(cost.state_rate(x), paid)
        torch.testing.assert_close(cost.outside(x), torch.stack([h(x) for h in several]).amin(0))


def slow(x: Tensor) -> Tensor:
    """A speed limit on the way home, which the optimum would exceed."""
    return x[..., 1] + 0.4


@pytest.fixture(scope="module")
def plans() -> tuple[adp.AvoidanceCost, dict[tuple[float, ...], AvoidancePlans]]:
    """From two starts, by what their weights shrink."""
    limited = {"low": -1.0, "high": 1.0, "obstacles": slow, "reach": 0.3, "kind": "log"}
    cost = adp.AvoidanceCost(1.0, 1.0, dim=2, inputs=1, **limited)  # type: ignore[arg-type]
    x0, given = tensor([[2.0, 0.0], [-1.5, 0.5]]), {"dt": 0.3, "steps": 16, "iterations": 8, "compile": False}
    return cost, {
        shrink: adp.plan_around(LINE, cost, x0, shrink=shrink, **given)  # type: ignore[arg-type]
        for shrink in ((1.0,), (1.0, 0.01))
    }


def test_plans_touch_what_they_may_and_pay_as_their_weight_vanishes(
    plans: tuple[adp.AvoidanceCost, dict[tuple[float, ...], AvoidancePlans]],
) -> None:
    cost, found = plans
    heavy, light = found[1.0,], found[1.0, 0.01]
    assert bool((light.margin[:1] > 0).all())
    assert bool((light.margin[:1] < 0.03).all())
    assert float(cost.weight) == 1.0
    assert float(light.trajectories.control.abs().max()) <= 1
    assert bool((light.cost <= heavy.cost).all())
    assert bool((light.cost < 0.99 * heavy.cost).any())


def test_a_plan_is_paid_without_its_obstacles_and_is_that_of_its_start_alone(
    plans: tuple[adp.AvoidanceCost, dict[tuple[float, ...], AvoidancePlans]],
) -> None:
    cost, several = plans
    found = several[1.0,]
    state, control = found.trajectories.state, found.trajectories.control
    free = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1, low=-1.0, high=1.0)
    problem = adp.SampledProblem.of(LINE, free, dt=0.3)
    torch.testing.assert_close(found.cost, cost_along(problem, state[:, 0], control))
    torch.testing.assert_close(found.margin, slow(state).amin(-1))
    given = {"dt": 0.3, "steps": 16, "iterations": 8, "compile": False, "shrink": (1.0,)}
    alone = adp.plan_around(LINE, cost, state[1:, 0], **given)  # type: ignore[arg-type]
    torch.testing.assert_close(alone.trajectories.state[0], state[1], rtol=1e-9, atol=1e-9)


def test_of_two_ways_around_a_disc_the_cheaper_one_is_found() -> None:
    """One start lies above the middle of the disc, seen from the goal, and one below."""
    plane = systems.Linear(torch.zeros(2, 2).tolist(), torch.eye(2).tolist())
    disc = {"obstacles": lambda x: (x - tensor([1.0, 0.1])).square().sum(-1) - 0.16, "reach": 0.2}
    cost = adp.AvoidanceCost(1.0, 1.0, dim=2, inputs=2, low=-1.0, high=1.0, **disc)  # type: ignore[arg-type]
    given = {"dt": 0.25, "steps": 10, "iterations": 8, "compile": False, "shrink": (1.0,)}
    found = adp.plan_around(plane, cost, tensor([[2.0, 0.5], [2.0, -0.1]]), **given)  # type: ignore[arg-type]
    assert bool((found.margin >= 0).all())
    x, y = found.trajectories.state.unbind(-1)
    passed = y.gather(1, (x - 1).abs().argmin(1, keepdim=True))[:, 0]
    assert float(passed[0]) > 0.4
    assert float(passed[1]) < -0.2


def test_what_breaks_a_rule_is_refused() -> None:
    refused: list[tuple[dict[str, object], str]] = [
        ({"reach": 0.0}, r"`AvoidanceCost\(reach=...\)` must be positive"),
        ({"weight": -1.0}, r"`AvoidanceCost\(weight=...\)` must be positive"),
        ({"kind": "wall"}, "must be one of 'penalty', 'log'; got 'wall'"),
        ({"obstacles": [beside, 1.0]}, r"must be h\(x\) or a list of them"),
    ]
    for given, message in refused:
        with pytest.raises(ValueError, match=message):
            cost_of(**given)
    for more, message in (({"steps": 3}, r"steps=...\)` must be at least 4"), ({"shrink": ()}, "one share")):
        with pytest.raises(ValueError, match=message):
            adp.plan_around(LINE, cost_of(), tensor([[3.0, 0.0]]), **{"dt": 0.1, "steps": 4} | more)

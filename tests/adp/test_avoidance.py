"""Obstacles in the cost: the published penalty, the log barrier, and plans whose weight shrinks."""

from __future__ import annotations

import pytest
import torch
from helpers import tensor, uniform
from torch import Tensor

from staf_torch import adp, systems
from staf_torch.adp.plans import Trajectories

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


@pytest.mark.parametrize("kind", ["penalty", "log"])
def test_the_rate_is_smooth_grows_inward_and_is_nothing_beyond_the_reach(kind: str) -> None:
    cost = cost_of(kind=kind)
    h = torch.linspace(-0.3, 0.6, 4001, dtype=torch.float64)
    paid = cost.penalty(h)
    assert bool((paid[h >= cost.reach] == 0).all())
    assert bool((paid.diff()[h[1:] < cost.reach - 1e-3] < 0).all())
    edge = tensor([0.01 * cost.reach])
    slope = torch.func.grad(lambda h: cost.penalty(h).sum())
    torch.testing.assert_close(slope(edge * (1 - 1e-9)), slope(edge * (1 + 1e-9)), rtol=1e-6, atol=0)
    half = tensor([0.5 * cost.reach])
    assert float(cost.penalty(half)) == pytest.approx(1.0 if kind == "penalty" else 0.480453, abs=1e-6)


def test_plans_touch_what_they_may_and_pay_as_their_weight_vanishes() -> None:
    """A speed limit on the way home, which the optimum would exceed."""

    def slow(x: Tensor) -> Tensor:
        return x[..., 1] + 0.4

    cost = adp.AvoidanceCost(
        1.0, 1.0, dim=2, inputs=1, low=-1.0, high=1.0, obstacles=slow, reach=0.3, kind="log"
    )
    x0 = tensor([[2.0, 0.0]])
    found = adp.plan_around(LINE, cost, x0, dt=0.3, steps=16, shrink=(1.0, 0.01), iterations=8, compile=False)
    assert bool((found.margin > 0).all())
    assert bool((found.margin < 0.03).all())
    assert float(cost.weight) == 1.0
    assert float(found.trajectories.control.abs().max()) <= 1


def test_the_cheapest_plan_that_touches_nothing_stands_whatever_its_weight() -> None:
    def plans(name: float, cost: list[float]) -> adp.AvoidancePlans:
        rows = torch.full((4,), name, dtype=torch.float64)
        parts = [rows[:, None, None], rows[:, None, None], rows[:, None], rows[:, None], rows, rows, rows > 0]
        return adp.AvoidancePlans(Trajectories(*parts), tensor(cost), rows)

    heavy, light = plans(1.0, [1.0, torch.inf, 3.0, torch.inf]), plans(2.0, [2.0, 5.0, torch.inf, torch.inf])
    found = heavy.or_cheaper(light)
    assert found.cost.tolist() == [1.0, 5.0, 3.0, torch.inf]
    assert found.margin.tolist() == found.trajectories.state.flatten().tolist() == [1.0, 2.0, 1.0, 2.0]


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"reach": 0.0}, r"`AvoidanceCost\(reach=...\)` must be positive"),
        ({"weight": -1.0}, r"`AvoidanceCost\(weight=...\)` must be positive"),
        ({"kind": "wall"}, "must be one of 'penalty', 'log'; got 'wall'"),
        ({"obstacles": []}, r"must be h\(x\) or a list of them"),
    ],
)
def test_what_breaks_a_rule_is_refused(given: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        cost_of(**given)
    with pytest.raises(ValueError, match=r"`plan_around\(steps=...\)` must be at least 4; got 3"):
        adp.plan_around(LINE, cost_of(), tensor([[3.0, 0.0]]), dt=0.1, steps=3)
    with pytest.raises(ValueError, match=r"`plan_around\(shrink=...\)` must be positive; got 0"):
        adp.plan_around(LINE, cost_of(), tensor([[3.0, 0.0]]), dt=0.1, steps=4, shrink=(0.0,), compile=False)
    with pytest.raises(ValueError, match=r"`plan_around\(shrink=...\)` must have at least one share"):
        adp.plan_around(LINE, cost_of(), tensor([[3.0, 0.0]]), dt=0.1, steps=4, shrink=())


def test_the_nearest_obstacle_is_found_for_any_leading_dimensions() -> None:
    cost = adp.AvoidanceCost(
        1.0, 1.0, dim=2, inputs=2, obstacles=[lambda x: x[..., 0], lambda x: x[..., 1] + 0.1], reach=1.0
    )
    x = uniform(3, 4, 2, seed=1)
    assert torch.equal(cost.outside(x), torch.minimum(x[..., 0], x[..., 1] + 0.1))

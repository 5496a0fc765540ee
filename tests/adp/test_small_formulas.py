"""Small formulas of closed loops beside sums and integrals that are written out."""

from __future__ import annotations

import math

import pytest
import torch
from helpers import tensor, uniform

from staf_torch import adp, systems
from staf_torch.adp.adaptation.measured import gaussian
from staf_torch.adp.path_integral import _hats
from staf_torch.adp.sampling import exact_hold, linear_hold, periods
from staf_torch.adp.walls import walls

INF = math.inf


def test_numbers_of_box_and_muller_have_the_moments_of_a_normal_one_and_do_not_see_each_other() -> None:
    side = (torch.arange(400, dtype=torch.float64) + 0.5) / 200 - 1
    grid = torch.cartesian_prod(side, side)
    z = gaussian(grid, 2)
    for k, moment in ((1, 0.0), (2, 1.0), (3, 0.0), (4, 3.0), (6, 15.0)):
        torch.testing.assert_close((z**k).mean(0), torch.full((2,), moment).double(), rtol=3e-2, atol=1e-9)
    assert abs(float(z.prod(-1).mean())) < 1e-9
    assert abs(float((z[:, 0] ** 2 * z[:, 1] ** 2).mean()) - 1) < 1e-2
    assert torch.equal(gaussian(grid, 1), z[:, :1])


@pytest.mark.parametrize(("low", "high"), [(2.0, 5.0), (-3.0, -1.0), (-1.0, 1.0), (2.0, INF), (-INF, -2.0)])
def test_a_wall_is_crossed_at_the_rate_of_the_coordinate(low: float, high: float) -> None:
    (h,) = walls([-INF, low], [INF, high])
    for wall, inward in ((low, 1.0), (high, -1.0)):
        if math.isinf(wall):
            continue
        at = torch.tensor([[9.0, wall]], dtype=torch.float64, requires_grad=True)
        value = h(at, 0.0)
        (slope,) = torch.autograd.grad(value.sum(), at)
        assert value.item() == pytest.approx(0.0, abs=1e-15)
        assert slope[0].tolist() == pytest.approx([0.0, inward])
    inside = tensor(
        [[9.0, 0.5 * (low + high) if math.isfinite(high - low) else (low + 1 if high > 0 else high - 1)]]
    )
    assert float(h(inside, 0.0)) > 0


@pytest.mark.parametrize(("steps", "knots"), [(10, 4), (7, 7), (50, 2)])
def test_knots_are_joined_by_straight_lines(steps: int, knots: int) -> None:
    hats = _hats(steps, knots)
    place = torch.arange(knots, dtype=torch.float64)
    torch.testing.assert_close(hats.sum(-1), torch.ones(steps).double())
    torch.testing.assert_close(hats @ place, torch.linspace(0, knots - 1, steps, dtype=torch.float64))
    assert bool((hats >= 0).all())
    assert bool(((hats > 0).sum(-1) <= 2).all())


@pytest.mark.parametrize("discount", [0.0, 0.7])
@pytest.mark.parametrize("period", [0.05, 1.5])
def test_what_a_held_input_costs_is_the_integral_along_its_way(discount: float, period: float) -> None:
    f, g = tensor([[0.1, 1.0], [-2.0, -0.3]]), tensor([[0.0], [1.0]])
    q, r = tensor([[2.0, 0.5], [0.5, 1.0]]), tensor([[0.3]])
    hold = exact_hold(f, g, q, r, period, discount=discount)
    start = uniform(4, 3, seed=1)  # x and u
    whole = torch.zeros(3, 3, dtype=torch.float64)
    whole[:2, :2], whole[:2, 2:] = f, g
    count = 400  # of Simpson's rule
    times = torch.linspace(0, period, count + 1, dtype=torch.float64)
    way = torch.linalg.matrix_exp(times[:, None, None] * whole) @ start.mT  # (T, 3, B)
    paid = (way[:, :2] * (q @ way[:, :2])).sum(1) + r[0, 0] * way[:, 2] ** 2
    paid = paid * (-discount * times).exp()[:, None]
    weight = (
        torch.tensor([1.0, *[4.0, 2.0] * (count // 2 - 1), 4.0, 1.0], dtype=torch.float64)
        * period
        / count
        / 3
    )
    torch.testing.assert_close((start * (start @ hold.paid)).sum(-1), weight @ paid, rtol=1e-9, atol=1e-12)
    ahead = start[:, :2] @ hold.a.mT + start[:, 2:] @ hold.b.mT
    torch.testing.assert_close(ahead, math.exp(-0.5 * discount * period) * way[-1, :2].mT)


@pytest.mark.parametrize("discount", [0.0, 0.7])
def test_what_a_plant_in_steps_costs_is_the_sum_over_its_steps(discount: float) -> None:
    a, b = tensor([[1.0, 0.1], [-0.2, 0.9]]), tensor([[0.0], [0.1]])
    plant = systems.StepPlant(
        lambda x, u: x @ a.mT + u @ b.mT, dim=2, inputs=1, dt=0.1, equilibrium=[0.0, 0.0]
    )
    cost = adp.QuadraticCost([[2.0, 0.5], [0.5, 1.0]], 0.3, 2, 1, discount=discount)
    hold = linear_hold(plant, cost, 0.4)
    x, u, spent = uniform(4, 2, seed=1), uniform(4, 1, seed=2), torch.zeros(4, dtype=torch.float64)
    first = x
    for k in range(4):
        spent = spent + math.exp(-discount * 0.1 * k) * 0.1 * cost.rate(x, u)
        x = x @ a.mT + u @ b.mT
    z = torch.cat((first, u), -1)
    torch.testing.assert_close((z * (z @ hold.paid)).sum(-1), spent)
    share = math.exp(-0.5 * discount * 0.4)
    torch.testing.assert_close(first @ hold.a.mT + u @ hold.b.mT, share * x)
    assert [periods("call", plant, dt) for dt in (0.1, 0.3, 1.0)] == [1, 3, 10]
    for wrong in (0.15, 0.04, 0.1 * (1 + 1e-6)):
        with pytest.raises(ValueError, match="multiple of the plant's period"):
            periods("call", plant, wrong)

"""Control that is held for a period: the exact step, the LQR made for it, and how stable the loop is."""

from __future__ import annotations

import math

import pytest
import torch
from helpers import tensor, uniform
from torch import Tensor

from staf_torch import adp, systems
from staf_torch.adp.problem.held_linear import exact_hold, held_riccati, linear_hold

INF = math.inf
SCALAR = systems.Linear([[0.0]], [[1.0]])
FALLING = systems.Linear([[0.0, 1.0], [20.0, 0.0]], [[0.0], [1.0]])  # an inverted pendulum of half a metre
COST = adp.QuadraticCost(1.0, 0.1, dim=2, inputs=1)
SCALAR_COST = adp.QuadraticCost(1.0, 1.0, dim=1, inputs=1)


@pytest.mark.parametrize(("discount", "period"), [(0.0, 0.05), (0.7, 1.5)])
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
    weight = tensor([1.0, *[4.0, 2.0] * (count // 2 - 1), 4.0, 1.0]) * period / count / 3
    torch.testing.assert_close((start * (start @ hold.paid)).sum(-1), weight @ paid, rtol=1e-9, atol=1e-12)
    ahead = start[:, :2] @ hold.a.mT + start[:, 2:] @ hold.b.mT
    torch.testing.assert_close(ahead, math.exp(-0.5 * discount * period) * way[-1, :2].mT)


@pytest.mark.parametrize("period", [1e-3, 0.3, 20.0])
def test_what_a_hold_pays_is_exact_however_long_it_is(period: float) -> None:
    rates = torch.tensor([-30.0, -1.0], dtype=torch.float64)
    held = exact_hold(
        rates.diag(), torch.zeros(2, 1).double(), torch.eye(2).double(), torch.ones(1, 1).double(), period
    )
    rounding = 1e-14 * (1 + 30 * period)  # the exponent's own
    torch.testing.assert_close(held.a, (rates * period).exp().diag(), rtol=rounding, atol=1e-300)
    wanted = (1 - (2 * rates * period).exp()) / (-2 * rates)  # of x1^2 + x2^2 from one
    torch.testing.assert_close(held.paid[:2, :2], wanted.diag(), rtol=1e-12, atol=1e-300)
    assert float(held.paid[2, 2]) == pytest.approx(period)


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


CHAIN = systems.Linear([[0.0, 1.0], [3.0, -0.5]], [[0.0], [1.0]])


def in_steps(a: Tensor, b: Tensor, dt: float = 0.1) -> systems.StepPlant:
    return systems.StepPlant(
        lambda x, u: x @ a.mT + u @ b.mT, dim=len(a), inputs=b.shape[1], dt=dt, equilibrium=[0.0] * len(a)
    )


@pytest.mark.parametrize("discount", [0.0, 0.7])
@pytest.mark.parametrize("steps", [False, True])
def test_a_held_regulator_is_the_fixed_point_of_its_recursion(steps: bool, discount: float) -> None:
    plant: systems.Plant = (
        in_steps(tensor([[1.0, 0.1], [0.3, 0.95]]), tensor([[0.0], [0.1]])) if steps else CHAIN
    )
    cost = adp.QuadraticCost([2.0, 1.0], 0.3, 2, 1, discount=discount)
    p, k = held_riccati(plant, cost, 0.3)
    hold = linear_hold(plant, cost, 0.3)
    closed = torch.cat((torch.eye(2).double(), -k))
    ahead = hold.a - hold.b @ k
    torch.testing.assert_close(p, closed.mT @ hold.paid @ closed + ahead.mT @ p @ ahead)
    for other in (k + 1e-3 * tensor([[1.0, 0.0]]), k - 1e-3 * tensor([[0.0, 1.0]])):  # and K the best
        around = torch.cat((torch.eye(2).double(), -other))
        after = hold.a - hold.b @ other
        worse = around.mT @ hold.paid @ around + after.mT @ p @ after - p
        assert float(torch.linalg.eigvalsh(worse)[-1]) > 0
        assert float(torch.linalg.eigvalsh(worse)[0]) > -1e-12
    assert torch.equal(p, p.mT)


def test_a_rotation_that_is_sampled_at_half_a_turn_cannot_be_regulated() -> None:
    turning = systems.Linear([[0.0, 1.0], [-1.0, 0.0]], [[0.0], [1.0]])
    with pytest.raises(ValueError, match=r"held for 3\.14159 s, is not stabilisable"):
        adp.LQR(turning, COST, period=math.pi)


@pytest.mark.parametrize("steps", [False, True])
def test_a_mode_that_grows_slower_than_the_discount_need_not_be_stabilised(steps: bool) -> None:
    """exp(-rho t / 2) x decays: 0.2 1/s beside a half of the discount."""
    growth = math.exp(0.02) if steps else 0.2
    f, g = tensor([[growth, 0.0], [0.0, 0.5 if steps else -1.0]]), tensor([[0.0], [1.0]])
    plant: systems.Plant = in_steps(f, g) if steps else systems.Linear(f.tolist(), g.tolist())
    p, _ = held_riccati(plant, adp.QuadraticCost(1.0, 1.0, 2, 1, discount=0.5), 0.1)
    assert bool(torch.isfinite(p).all())
    with pytest.raises(ValueError, match="not stabilisable"):
        held_riccati(plant, adp.QuadraticCost(1.0, 1.0, 2, 1, discount=0.3), 0.1)


def test_stability_of_the_held_integrator_is_known() -> None:
    # x+ = (1 - k dt) x with k = 1: stable up to 2 s.
    stability = adp.held_stability(adp.LQR(SCALAR, SCALAR_COST), SCALAR, 0.5)
    assert stability.spectral_radius == pytest.approx(0.5)
    assert stability.largest_period == pytest.approx(2.0, rel=1e-5)
    assert adp.held_stability(adp.LQR(SCALAR, SCALAR_COST), SCALAR, 3.0).spectral_radius == pytest.approx(2.0)
    steep = adp.held_stability(lambda x: -40 * x, SCALAR, 0.1).largest_period
    assert steep == pytest.approx(0.05, rel=2e-6)
    stable = systems.Linear([[-1.0]], [[1.0]])
    assert adp.held_stability(lambda x: 0 * x, stable, 0.5).largest_period == math.inf
    assert adp.held_stability(lambda x: 0 * x[..., :1], FALLING, 0.5) == (
        pytest.approx(math.exp(0.5 * 20**0.5)),
        None,
    )


def test_loop_that_is_said_to_be_unstable_diverges_and_the_held_lqr_regulates_it() -> None:
    period = 0.4
    x0 = torch.tensor([[0.1, 0.0]], dtype=torch.float64)
    for given, stable in ((None, False), (period, True)):
        lqr = adp.LQR(FALLING, COST, period=given)
        stability = adp.held_stability(lqr, FALLING, period)
        assert (stability.spectral_radius < 1) is stable
        run = adp.simulate(lqr, FALLING, COST, x0, dt=period, steps=30, every=30)
        assert (float(run.state[:, -1].norm()) < 1e-2) is stable


def test_others_that_move_by_themselves_do_not_make_a_loop_unstable() -> None:
    """A mass, and beside it a disc that moves at its own speed: only a mode that grows is told."""

    def policy(x: Tensor) -> Tensor:
        return -x[..., :1] - 2 * x[..., 1:2]

    def beside(growth: float) -> systems.Linear:
        f = torch.zeros(4, 4).double()
        f[0, 1], f[2, 3], f[3, 3] = 1.0, 1.0, growth
        return systems.Linear(f.tolist(), [[0.0], [1.0], [0.0], [0.0]])

    alone = systems.Linear([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])
    found, mass = (adp.held_stability(policy, plant, 0.1) for plant in (beside(0.0), alone))
    assert found == (pytest.approx(mass.spectral_radius), pytest.approx(mass.largest_period, rel=1e-4))
    assert found.spectral_radius < 1 < adp.held_stability(policy, beside(0.5), 0.1).spectral_radius


def test_a_clocked_loop_is_stable_around_the_state_that_is_told() -> None:
    """x' = sin(x) + u is unstable at 0 and stable at pi without any control."""
    plant = systems.Clocked(systems.RatePlant(lambda x, u: x.sin() + u, dim=1, inputs=1))
    found = [
        adp.held_stability(lambda x: 0 * x[..., :1], plant, 0.5, at=torch.tensor([at]).double())
        for at in (0.0, math.pi)
    ]
    assert found[0].spectral_radius == pytest.approx(math.exp(0.5), rel=1e-4)
    assert found[1].spectral_radius == pytest.approx(math.exp(-0.5), rel=1e-4)


def test_a_loop_in_steps_is_stable_up_to_a_number_of_its_periods() -> None:
    """Whatever the period is that it is asked for."""
    plant = in_steps(tensor([[1.0]]), tensor([[0.1]]))
    for period in (0.1, 0.3, 0.7):
        wanted = pytest.approx(abs(1 - 3 * period)), pytest.approx(0.6)
        assert adp.held_stability(lambda x: -3 * x, plant, period) == wanted
    assert adp.held_stability(lambda x: -2 / 99.95 * x, plant, 0.1).largest_period == pytest.approx(99.9)
    assert adp.held_stability(lambda x: -2 / 100.05 * x, plant, 0.1).largest_period == INF  # of 1000 tried
    assert adp.held_stability(lambda x: 3 * x, plant, 0.1) == (pytest.approx(1.3), None)
    assert adp.held_stability(lambda x: 0 * x, plant, 0.1) == (1.0, None)


def test_a_loop_that_overflows_within_a_period_is_unstable_and_told(caplog: pytest.LogCaptureFixture) -> None:
    plant, stepped = systems.Linear([[1000.0]], [[1.0]]), in_steps(tensor([[1.5e4]]), tensor([[1.0]]))
    for each, gain in ((plant, -1001.0), (stepped, -1.5e4)):
        assert adp.held_stability(lambda x, gain=gain: gain * x, each, 1.0).spectral_radius > 1
    assert adp.held_stability(lambda x: -1001 * x, plant, 1.0).spectral_radius == INF
    cost = adp.QuadraticCost(1.0, 1.0, dim=1, inputs=1)
    adp.simulate(lambda x: -1.5e4 * x, stepped, cost, tensor([[1.0]]), dt=10.0, steps=1)
    assert "has the spectral radius inf" in caplog.text


def test_a_loop_at_its_edge_and_one_without_a_slope_are_not_said_to_be_stable() -> None:
    line = systems.Linear([[0.0]], [[1.0]])
    assert adp.held_stability(lambda x: 0 * x, line, 0.5) == (1.0, None)
    broken = adp.held_stability(lambda x: math.nan * x, line, 0.5)
    assert math.isnan(broken.spectral_radius)
    assert broken.largest_period is None

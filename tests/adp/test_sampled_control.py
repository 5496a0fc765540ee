"""Control that is held for a period: the exact step, the LQR made for it, and how stable the loop is."""

from __future__ import annotations

import math

import pytest
import torch
from helpers import uniform

from staf_torch import adp, systems
from staf_torch.adp.holding import Holding
from staf_torch.adp.sampling import exact_hold

SCALAR = systems.Linear([[0.0]], [[1.0]])
FALLING = systems.Linear([[0.0, 1.0], [20.0, 0.0]], [[0.0], [1.0]])  # an inverted pendulum of half a metre
COST = adp.QuadraticCost(1.0, 0.1, dim=2, inputs=1)
SCALAR_COST = adp.QuadraticCost(1.0, 1.0, dim=1, inputs=1)


@pytest.mark.parametrize("period", [0.01, 0.3, 2.0])
def test_hold_of_the_double_integrator_is_its_polynomial(period: float) -> None:
    t = period
    f, g = torch.tensor([[0.0, 1.0], [0.0, 0.0]]).double(), torch.tensor([[0.0], [1.0]]).double()
    hold = exact_hold(f, g, torch.eye(2).double(), torch.eye(1).double(), t)
    a = torch.tensor([[1, t], [0, 1]], dtype=torch.float64)
    b = torch.tensor([[t**2 / 2], [t]], dtype=torch.float64)
    torch.testing.assert_close(hold.a, a, rtol=1e-13, atol=0)
    torch.testing.assert_close(hold.b, b, rtol=1e-12, atol=0)
    paid = [
        [t, t**2 / 2, t**3 / 6],
        [t**2 / 2, t + t**3 / 3, t**2 / 2 + t**4 / 8],
        [t**3 / 6, t**2 / 2 + t**4 / 8, t + t**3 / 3 + t**5 / 20],
    ]
    torch.testing.assert_close(hold.paid, torch.tensor(paid, dtype=torch.float64), rtol=1e-10, atol=0)


def test_value_of_the_held_lqr_is_the_cost_that_its_loop_pays() -> None:
    lqr = adp.LQR(FALLING, COST, period=0.2)
    x0 = torch.tensor([[0.3, -0.1]], dtype=torch.float64)
    hold = exact_hold(*FALLING.linearisation(), COST.q, COST.r, 0.2)
    x, paid = x0, 0.0
    for _ in range(200):
        z = torch.cat((x, lqr(x)), dim=-1)
        paid += float(z @ hold.paid @ z.mT)
        x = x @ hold.a.mT + lqr(x) @ hold.b.mT
    assert float(lqr.value(x0)) == pytest.approx(paid, rel=1e-10)
    continuous = adp.LQR(FALLING, COST)
    assert float(lqr.value(x0)) > float(continuous.value(x0))


def test_a_short_period_gives_the_gains_of_continuous_time() -> None:
    held, continuous = adp.LQR(FALLING, COST, period=1e-4), adp.LQR(FALLING, COST)
    torch.testing.assert_close(held.k, continuous.k, rtol=1e-3, atol=0)


def test_stability_of_the_held_integrator_is_known() -> None:
    # x+ = (1 - k dt) x with k = 1: stable up to 2 s.
    stability = adp.held_stability(adp.LQR(SCALAR, SCALAR_COST), SCALAR, 0.5)
    assert stability.spectral_radius == pytest.approx(0.5)
    assert stability.largest_period == pytest.approx(2.0, rel=1e-5)
    assert adp.held_stability(adp.LQR(SCALAR, SCALAR_COST), SCALAR, 3.0).spectral_radius == pytest.approx(2.0)
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
        # Runge-Kutta on 10 steps a period, the control held by hand.
        x = x0
        for _ in range(30):
            u = lqr(x)
            hold = adp.Feedback(lambda _, u=u: u)
            x = adp.simulate(hold, FALLING, COST, x, dt=period / 10, steps=10, every=10).state[:, -1]
        assert (float(x.norm()) < 1e-2) is stable


def test_period_reaches_the_loop_of_a_feedback() -> None:
    assert adp.Feedback(adp.LQR(FALLING, COST, period=0.2)).period == 0.2
    assert adp.Feedback(adp.LQR(FALLING, COST)).period is None


def test_bad_periods_are_refused_by_name() -> None:
    with pytest.raises(ValueError, match=r"`exact_hold\(period=...\)` must be positive; got 0.0"):
        adp.LQR(FALLING, COST, period=0.0)
    # The rotation repeats itself after half a turn: sampled then, its input moves one line alone.
    turning = systems.Linear([[0.0, 1.0], [-1.0, 0.0]], [[0.0], [1.0]])
    with pytest.raises(ValueError, match=r"held for 3\.14159 s, is not stabilisable"):
        adp.LQR(turning, COST, period=math.pi)


def test_others_that_move_by_themselves_do_not_make_a_loop_unstable() -> None:
    """A mass, and beside it a disc that moves at its own speed: only a mode that grows is told."""
    for growth, stable in ((0.0, True), (0.5, False)):
        f = torch.zeros(4, 4).double()
        f[0, 1] = f[2, 3] = 1.0
        f[3, 3] = growth
        both = systems.Linear(f.tolist(), [[0.0], [1.0], [0.0], [0.0]])
        found = adp.held_stability(lambda x: -x[..., :1] - 2 * x[..., 1:2], both, 0.1)
        assert (found.spectral_radius < 1) == stable
        alone = systems.Linear([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])
        mass = adp.held_stability(lambda x: -x[..., :1] - 2 * x[..., 1:2], alone, 0.1)
        if stable:
            assert found.spectral_radius == pytest.approx(mass.spectral_radius, abs=1e-9)
            assert found.largest_period == pytest.approx(mass.largest_period, rel=1e-4)


@pytest.mark.parametrize("discount", [0.0, 0.7])
@pytest.mark.parametrize("substeps", [5, (3, 9)])
def test_a_control_that_is_asked_again_and_stays_costs_what_a_held_one_costs(
    discount: float, substeps: int | tuple[int, int]
) -> None:
    plant = systems.Linear([[0.0, 1.0], [-1.0, 0.2]], [[0.0], [1.0]])
    cost = adp.QuadraticCost(1.0, 0.5, dim=2, inputs=1, discount=discount)
    x, u = uniform(4, 2, seed=1), uniform(4, 1, seed=2)
    held = Holding("simulate", plant, cost, 0.3, substeps)
    after, paid = held(x, u)
    again, spent = held(x, u, lambda now: u)
    torch.testing.assert_close(again, after, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(spent, paid, rtol=1e-4, atol=1e-5)


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


def test_a_clocked_loop_is_stable_around_the_state_that_is_told() -> None:
    """x' = sin(x) + u is unstable at 0 and stable at pi without any control."""
    plant = systems.Clocked(systems.RatePlant(lambda x, u: x.sin() + u, dim=1, inputs=1))
    found = [
        adp.held_stability(lambda x: 0 * x[..., :1], plant, 0.5, at=torch.tensor([at]).double())
        for at in (0.0, math.pi)
    ]
    assert found[0].spectral_radius == pytest.approx(math.exp(0.5), rel=1e-4)
    assert found[1].spectral_radius == pytest.approx(math.exp(-0.5), rel=1e-4)

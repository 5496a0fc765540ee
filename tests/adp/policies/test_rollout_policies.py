"""Rollout policies, one Newton step on the HJB equation, and the swing-up by energy."""

from __future__ import annotations

import copy
from typing import Any

import pytest
import torch
from helpers import tensor
from helpers import uniform as unit
from helpers_adp import COST, PLANT, uniform
from torch import Tensor

import staf_torch as st
from staf_torch import (
    ExponentialKernel,
    Kernel,
    StaFBasis,
    StateFollowingCenters,
    StateRadius,
    adp,
    ball,
    rings,
    systems,
)
from staf_torch.adp.critic.laws import value_gradient

LQR = adp.LQR(PLANT, COST)
X = unit(3, 2, seed=1)


def rollout(
    plant: systems.ControlAffineSystem = PLANT, kernel: Kernel | None = None, **settings: Any
) -> adp.RolloutPolicy:
    cost = settings.pop("cost", COST)
    lqr = adp.LQR(plant, cost)
    directions = settings.pop("directions", rings(6))
    basis = StaFBasis(
        kernel or ExponentialKernel(), StateFollowingCenters(directions, settings.pop("radius", 0.1))
    )
    return adp.RolloutPolicy(basis, plant, cost, settings.pop("base", lqr), lqr.value, **settings)


@torch.no_grad()
def test_rollout_of_the_optimal_policy_returns_the_optimal_value() -> None:
    basis = StaFBasis(ExponentialKernel(), StateFollowingCenters(rings(6), 0.1))

    def value(x: torch.Tensor) -> torch.Tensor:
        return PLANT.optimal_value(x, COST.q, COST.r)

    def best(x: torch.Tensor) -> torch.Tensor:
        return COST.policy(PLANT.effectiveness(x), value_gradient(value, x))

    policy = adp.RolloutPolicy(basis, PLANT, COST, best, value, horizon=0.5, steps=20)
    x = uniform(30, 2.0)
    torch.testing.assert_close(policy.rollout(x), value(x), rtol=2e-5, atol=1e-6)
    torch.testing.assert_close(policy(x), best(x), rtol=0, atol=0.02)


def test_a_rollout_costs_the_integral_along_its_way_and_the_end() -> None:
    """Of a linear plant under a linear policy, whose integral is known."""
    plant = systems.Linear([[0.0, 1.0], [-1.0, -0.5]], [[0.0], [1.0]])
    gain = tensor([[0.3, 0.4]])
    basis = st.StaFBasis(st.GaussianKernel(), st.StateFollowingCenters(st.rings(6), 0.2))
    cost = adp.QuadraticCost(2.0, 0.5, dim=2, inputs=1)
    end = tensor([[3.0, 0.5], [0.5, 1.0]])
    policy = adp.RolloutPolicy(
        basis, plant, cost, lambda x: -x @ gain.mT, lambda x: ((x @ end) * x).sum(-1), horizon=0.8, steps=9
    )
    closed = plant.matrix - plant.input_matrix @ gain
    paid = torch.eye(2).double() * 2.0 + 0.5 * gain.mT @ gain
    times = torch.linspace(0, 0.8, 4001, dtype=torch.float64)
    flows = torch.linalg.matrix_exp(times[:, None, None] * closed)
    kernel = torch.trapezoid(flows.mT @ paid @ flows, dx=0.8 / 4000, dim=0) + flows[-1].mT @ end @ flows[-1]
    x = unit(3, 4, 2, seed=1)
    torch.testing.assert_close(policy.rollout(x), ((x @ kernel) * x).sum(-1), rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(policy.rollout(x[0, 0]), policy.rollout(x)[0, 0])
    at = x[0]
    torch.testing.assert_close(policy.value(at), ((at @ kernel) * at).sum(-1), rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(policy.gradient(at), 2 * at @ kernel, rtol=2e-2, atol=2e-2)
    torch.testing.assert_close(policy.control(at), -policy.gradient(at) @ plant.input_matrix / (2 * 0.5))


@torch.no_grad()
def test_two_state_is_regulated_at_almost_the_optimal_cost() -> None:
    x0 = uniform(40, 2.0, seed=1)
    optimal = PLANT.optimal_value(x0, COST.q, COST.r)
    policy = rollout(horizon=0.5, steps=5)
    run = adp.simulate(adp.Feedback(policy), PLANT, COST, x0, dt=0.01, steps=400, every=400, compile=True)
    # From here on the LQR: all states are so near to the origin that the rest costs less than 1e-6.
    rest = adp.simulate(
        adp.Feedback(LQR), PLANT, COST, run.state[:, -1], dt=0.05, steps=120, every=120, compile=False
    )
    ratio = (run.cost + rest.cost) / optimal
    assert (rest.state[:, -1].norm(dim=-1) < 1e-3).all()
    assert float(ratio.mean()) <= 1.01
    assert float(ratio.max()) <= 1.06
    assert float(ratio.min()) >= 1 - 1e-6


@torch.no_grad()
def test_three_state_beats_the_lqr_and_the_published_cost() -> None:
    plant, cost = systems.ThreeState(), adp.QuadraticCost(10.0, 1.0, 3, 2)
    x0 = torch.tensor([[-0.5, 0.5, -0.25]], dtype=torch.float64)
    # The radius shrinks: the plant has no derivative at 0, and a constant ball around the state would hold 0.
    radius = StateRadius(0.1, 1e-5)
    policy = rollout(plant, directions=ball(10, 3), radius=radius, cost=cost, horizon=1.0, steps=10)
    run = adp.simulate(adp.Feedback(policy), plant, cost, x0, dt=0.02, steps=400, every=400, compile=True)
    lqr = adp.simulate(
        adp.Feedback(adp.LQR(plant, cost)), plant, cost, x0, dt=0.005, steps=2000, every=2000, compile=True
    )
    assert float(lqr.cost) == pytest.approx(2.786, abs=2e-3)
    assert 2.7047 <= float(run.cost) <= 2.7055  # the optimum is 2.70471
    assert run.state[0, -1].norm() < 1e-3


@torch.no_grad()
def test_improved_policy_under_hard_bounds_costs_less_than_the_clipped_lqr() -> None:
    plant = systems.Pendulum()
    cost = adp.QuadraticCost(1.0, 0.1, 2, 1, low=-6.0, high=9.0)
    x0 = uniform(16, 0.5, seed=2)
    paid = {}
    for policy in (adp.LQR(plant, cost), adp.RolloutPolicy.of_lqr(plant, cost)):
        run = adp.simulate(adp.Feedback(policy), plant, cost, x0, dt=0.1, steps=40, every=40, compile=True)
        assert (run.state[:, -1].norm(dim=-1) < 1e-2).all()
        paid[type(policy).__name__] = run.cost
    ratio = paid["RolloutPolicy"] / paid["LQR"]
    assert ratio.mean() < 1.0
    assert ratio.max() < 1.01


def test_in_barrier_coordinates_rollouts_move_the_distances_to_the_walls() -> None:
    """Steps of 50 ms in s itself overflow from the published start, and left no control at all."""
    box = systems.Barrier(systems.TwoStateChain(), [-7.0, -5.0], [5.0, 7.0])
    cost = adp.QuadraticCost(10.0, 0.1, dim=2, inputs=1)
    s0 = box.transform(torch.tensor([[-6.5, 6.5]], dtype=torch.float64))
    coarse, fine = (adp.RolloutPolicy.of_lqr(box, cost, steps=steps).rollout(s0) for steps in (10, 50))
    torch.testing.assert_close(coarse, fine, rtol=0.05, atol=0)
    assert float(fine) == pytest.approx(70.78, rel=0.05)  # of the LQR of s, here 0.5 s of it and its value


def test_beside_a_wall_the_slope_of_a_rollout_policy_is_that_of_what_its_rollouts_cost() -> None:
    box = systems.Barrier(systems.TwoStateChain(), (-7, -5), (5, 7))
    cost = adp.QuadraticCost(10.0, 0.1, dim=2, inputs=1)
    policy = adp.RolloutPolicy.of_lqr(box, cost, steps=30)
    s = box.transform(torch.tensor([-6.5, 6.5], dtype=torch.float64))
    apart = 0.01 * torch.eye(2, dtype=torch.float64)
    wanted = (policy.rollout(s + apart) - policy.rollout(s - apart)) / 0.02
    torch.testing.assert_close(policy.gradient(s), wanted, rtol=0.01, atol=0.02)


# --- arguments ----------------------------------------------------------------------------------------------


def test_a_rollout_ends_with_the_value_of_the_lqr_or_the_terminal_cost() -> None:
    ended = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1, terminal=7.0)
    free, end = (adp.RolloutPolicy.of_lqr(PLANT, cost, horizon=1e-9, steps=1) for cost in (COST, ended))
    torch.testing.assert_close(free.rollout(X), LQR.value(X), rtol=1e-6, atol=0)
    torch.testing.assert_close(end.rollout(X), 7 * X.square().sum(-1), rtol=1e-6, atol=0)


def test_a_policy_that_is_improved_twice_rolls_the_first_improvement_out() -> None:
    twice, once = rollout(depth=2, steps=2, horizon=0.2), rollout(steps=2, horizon=0.2)
    by_hand = rollout(base=once.control, steps=2, horizon=0.2)
    torch.testing.assert_close(twice.control(X[:1]), by_hand.control(X[:1]))


def test_a_copy_asks_for_itself() -> None:
    other = copy.deepcopy(rollout(steps=2))
    other.horizon = 0.1
    torch.testing.assert_close(other(X), rollout(steps=2, horizon=0.1)(X))


# --- energy -------------------------------------------------------------------------------------------------


class Turning(systems.Pendulum):
    """The pendulum whose angle is one."""

    periodic = (0,)


TURNING = Turning(damping=0.0)
LIMITED = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1, low=-5.0, high=5.0)


def energy(x: Tensor) -> Tensor:
    return 0.5 * x[..., 1].square() + 9.81 * x[..., 0].cos()


def pump(**more: object) -> adp.EnergyShaping:
    return adp.EnergyShaping(TURNING, LIMITED, energy, **{"gain": 1.0, "capture": 0.5, "period": 0.02} | more)


@torch.no_grad()
def test_pendulum_swings_up_from_everywhere_within_its_bounds_where_the_lqr_does_not() -> None:
    x0 = torch.tensor([[3.1, 0.0], [2.0, -1.0], [-1.0, 0.5], [0.0, 7.0]], dtype=torch.float64)
    policy = pump()
    ours, lqr = (
        adp.simulate(adp.Feedback(one), TURNING, LIMITED, x0, dt=0.02, steps=steps, compile=True)
        for one, steps in ((policy, 260), (policy.lqr, 60))
    )
    assert (policy.lqr.cost.deviation(ours.state[:, -1]).norm(dim=-1) < 1e-3).all()
    assert (policy.lqr.cost.deviation(lqr.state[:, -1]).norm(dim=-1) > 0.1).any()
    assert ours.control[:, :-1].abs().max() <= 5
    # Where it pumps, the energy comes nearer to that of the goal at every step.
    x = torch.tensor([[2.5, 1.0]], dtype=torch.float64)
    after = systems.runge_kutta_step(lambda z: TURNING.rate(z, policy(x)), x, 0.02)
    top = energy(torch.zeros(1, 2, dtype=torch.float64))
    assert (energy(after) - top).abs() < (energy(x) - top).abs()


def test_energy_is_pumped_far_from_the_goal_and_the_lqr_regulates_near_it() -> None:
    plant = systems.Pendulum()
    cost = adp.QuadraticCost(1.0, 0.3, dim=2, inputs=1, low=-2.0, high=1.5)

    pump = adp.EnergyShaping(plant, cost, energy, gain=0.05, capture=0.5, period=0.02)
    x = unit(40, 2, low=-3, high=3, seed=1)
    x[:20] *= 0.05
    g, lqr = plant.effectiveness(x)[..., 0], adp.LQR(plant, cost, period=0.02)
    slope = torch.stack((-9.81 * x[:, 0].sin(), x[:, 1]), -1)
    push = 0.05 * (9.81 - energy(x)) * (g * slope).sum(-1)
    near = lqr.value(x) < 0.5
    assert 0 < int(near.sum()) < 40
    torch.testing.assert_close(pump(x)[:, 0], torch.where(near, lqr(x)[:, 0], push.clamp(-2.0, 1.5)))
    assert pump.period == 0.02


def test_bad_arguments_of_the_swing_up_are_refused_by_name() -> None:
    free = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
    with pytest.raises(ValueError, match=r"`EnergyShaping\(cost=...\)` or the plant must have bounds"):
        adp.EnergyShaping(TURNING, free, energy, gain=1.0, capture=1.0)
    with pytest.raises(ValueError, match=r"`EnergyShaping\(gain=...\)` must be"):
        pump(gain=0.0)
    step = systems.StepPlant(lambda x, u: x + 0.1 * u, dim=1, inputs=1, dt=0.1)
    with pytest.raises(ValueError, match=r"`EnergyShaping\(system=...\)` must be a ControlAffineSystem"):
        adp.EnergyShaping(step, LIMITED, energy, gain=1.0, capture=1.0)

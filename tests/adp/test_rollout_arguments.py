"""What policies are made of: rollouts, supervised and pumped ones, and costs along a path."""

from __future__ import annotations

import copy
import pickle
from typing import Any

import pytest
import torch
from helpers import tensor, uniform
from torch import Tensor

import staf_torch as st
from staf_torch import adp, systems

PLANT, COST = systems.TwoState(), adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
LQR = adp.LQR(PLANT, COST)
X = uniform(3, 2, seed=1)
BASIS = st.StaFBasis(st.ExponentialKernel(), st.StateFollowingCenters(st.rings(6), 0.1))


def rollout(**given: Any) -> adp.RolloutPolicy:
    settings: dict[str, Any] = {
        "basis": BASIS,
        "model": PLANT,
        "cost": COST,
        "base": LQR,
        "terminal": LQR.value,
    }
    return adp.RolloutPolicy(**(settings | given))


def test_a_policy_of_the_lqr_is_that_of_its_parts() -> None:
    found = adp.RolloutPolicy.of_lqr(PLANT, COST)
    assert (found.horizon, found.steps, found.depth, found.period) == (0.5, 10, 1, None)
    assert isinstance(found.base, adp.LQR)
    torch.testing.assert_close(found(X), rollout()(X))
    more = {"horizon": 0.3, "steps": 4, "depth": 2, "period": 0.05}
    given = adp.RolloutPolicy.of_lqr(PLANT, COST, centers=3, radius=0.2, kernel=st.GaussianKernel(), **more)  # type: ignore[arg-type]
    wide = st.StaFBasis(st.GaussianKernel(), st.StateFollowingCenters(st.ball(3, 2), 0.2))
    torch.testing.assert_close(given.control(X[:1]), rollout(basis=wide, **more).control(X[:1]))
    assert (given.horizon, given.steps, given.depth, given.period) == (0.3, 4, 2, 0.05)


def test_a_kernel_is_exponential_and_in_a_box_gaussian() -> None:
    box = systems.Barrier(PLANT, -3.0, 3.0)
    for plant, kind in ((PLANT, st.ExponentialKernel), (box, st.GaussianKernel)):
        assert isinstance(adp.RolloutPolicy.of_lqr(plant, COST, steps=1).basis.kernel, kind)
        kept = adp.RolloutPolicy.of_lqr(plant, COST, steps=1, kernel=st.MaternKernel()).basis.kernel
        assert isinstance(kept, st.MaternKernel)


def test_a_rollout_ends_with_the_value_of_the_lqr_or_the_terminal_cost() -> None:
    ended = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1, terminal=7.0)
    free, end = (adp.RolloutPolicy.of_lqr(PLANT, cost, horizon=1e-9, steps=1) for cost in (COST, ended))
    torch.testing.assert_close(free.rollout(X), LQR.value(X), rtol=1e-6, atol=0)
    torch.testing.assert_close(end.rollout(X), 7 * X.square().sum(-1), rtol=1e-6, atol=0)


def test_a_policy_that_is_improved_twice_rolls_the_first_improvement_out() -> None:
    twice, once = rollout(depth=2, steps=2, horizon=0.2), rollout(steps=2, horizon=0.2)
    assert isinstance(twice.base, adp.RolloutPolicy)
    assert (twice.base.depth, twice.base.steps, twice.base.horizon) == (1, 2, 0.2)
    assert twice.base.base is LQR
    by_hand = rollout(base=once.control, steps=2, horizon=0.2)
    torch.testing.assert_close(twice.control(X[:1]), by_hand.control(X[:1]))
    assert rollout(depth=3).base.base.base is LQR  # type: ignore[union-attr]
    assert rollout().base is LQR


def test_a_copy_asks_for_itself() -> None:
    policy = rollout(steps=2)
    for other in (copy.deepcopy(policy), pickle.loads(pickle.dumps(rollout(base=LQR, steps=2)))):
        torch.testing.assert_close(other(X), policy(X))
        other.horizon = 0.1
        torch.testing.assert_close(other(X), rollout(steps=2, horizon=0.1)(X))


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (
            {"model": systems.StepPlant(lambda x, u: 0.9 * x + u, dim=2, inputs=1, dt=0.1)},
            r"`RolloutPolicy\(model=...\)` must be a ControlAffineSystem",
        ),
        (
            {"model": systems.ThreeState()},
            r"`RolloutPolicy\(basis=...\)` must have the plant's 3 states; got 2",
        ),
        ({"horizon": 0.0}, r"`RolloutPolicy\(horizon=...\)` must be positive"),
        ({"steps": 0}, r"`RolloutPolicy\(steps=...\)` must be at least 1"),
        ({"depth": 0}, r"`RolloutPolicy\(depth=...\)` must be at least 1"),
        ({"period": 0.0}, r"`RolloutPolicy\(period=...\)` must be positive"),
    ],
)
def test_rollouts_refuse_what_they_cannot_take(given: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        rollout(**given)


def test_another_base_than_an_lqr_is_measured_by_the_cost_that_is_given() -> None:
    cost = adp.QuadraticCost(1.0, [[4.0, 0.0], [0.0, 1.0]], 2, 2)
    guard = adp.Supervised(adp.Feedback(lambda x: x), lambda x: 0 * x + 1.0, cost, 0.5)  # type: ignore[arg-type]
    u = tensor([[3.0, 1.0], [1.0, 1.5], [1.0, 9.0]])
    base = torch.ones(3, 2).double()
    found = guard.restrain(0 * u, u)  # |u_LQR| = sqrt 5, half of it is allowed
    for row, share in enumerate((5**0.5 / 8, 1.0, 5**0.5 / 16)):
        torch.testing.assert_close(found[row], base[row] + share * (u[row] - base[row]))
    assert adp.Supervised(adp.Feedback(LQR), LQR, COST).trust == 0.5


def test_energy_is_pumped_far_from_the_goal_and_the_lqr_regulates_near_it() -> None:
    plant = systems.Pendulum()
    cost = adp.QuadraticCost(1.0, 0.3, dim=2, inputs=1, low=-2.0, high=1.5)

    def energy(x: Tensor) -> Tensor:
        return 0.5 * x[..., 1].square() + 9.81 * x[..., 0].cos()

    pump = adp.EnergyShaping(plant, cost, energy, gain=0.05, capture=0.5, period=0.02)
    x = uniform(40, 2, low=-3, high=3, seed=1)
    x[:20] *= 0.05
    g, lqr = plant.effectiveness(x)[..., 0], adp.LQR(plant, cost, period=0.02)
    slope = torch.stack((-9.81 * x[:, 0].sin(), x[:, 1]), -1)
    push = 0.05 * (9.81 - energy(x)) * (g * slope).sum(-1)
    near = lqr.value(x) < 0.5
    assert 0 < int(near.sum()) < 40
    torch.testing.assert_close(pump(x)[:, 0], torch.where(near, lqr(x)[:, 0], push.clamp(-2.0, 1.5)))
    assert pump.period == 0.02


# --- costs along a path -------------------------------------------------------------------------------------


def test_a_cost_along_a_path_takes_bounds_angles_and_rest_from_its_plant() -> None:
    pendulum = systems.Pendulum()
    pendulum.periodic, pendulum.bounds = (0,), systems.Bounds(-3.0, 4.0, 1)
    plant = systems.Clocked(pendulum)
    cost = adp.TrackingCost([2.0, 0.5], 0.3, 2, 1, path=lambda t: torch.stack((t, 0 * t), -1))
    placed = cost.around(plant)
    assert cost.bounds is None
    assert cost.periodic == ()
    assert placed.bounds is pendulum.bounds
    assert placed.periodic == (0,)
    assert placed.regulated(plant) == (pendulum, placed.still)
    x, u = tensor([[0.3, -0.2, 1.5], [6.5, 0.1, 0.2]]), tensor([[0.5], [-1.0]])
    away = tensor([[0.3 - 1.5, -0.2], [6.3 - 2 * torch.pi, 0.1]])
    torch.testing.assert_close(placed.deviation(x), torch.cat((away, torch.zeros(2, 1).double()), -1))
    wanted = (away.square() * tensor([2.0, 0.5])).sum(-1) + 0.3 * u[:, 0].square()
    torch.testing.assert_close(placed.rate(x, u), wanted)
    narrow = placed.bounded(-0.1, 0.2)
    assert narrow.bounds is not None
    assert narrow.still.bounds is not None
    for limits in (narrow.bounds, narrow.still.bounds):
        assert (limits.low.tolist(), limits.high.tolist()) == ([-0.1], [0.2])
    assert placed.bounded(None, None) is placed
    assert placed.still.bounds is pendulum.bounds
    own = adp.TrackingCost(1.0, 1.0, 2, 1, path=cost.path, low=-1.0, high=1.5, target_input=[0.0])
    assert own.around(plant).bounds is not None
    assert own.around(plant).bounds.high.tolist() == [1.5]  # type: ignore[union-attr]
    for wrong, shown in (
        (lambda t: t, r"\(2,\)"),
        (lambda t: 3.0, "3.0"),
        (lambda t: torch.ones(3, 2), r"\(3, 2\)"),
    ):
        with pytest.raises(ValueError, match=rf"must map times \(2,\) to states \(2, 2\); got {shown}"):
            adp.TrackingCost(1.0, 1.0, 2, 1, path=wrong)  # type: ignore[arg-type]

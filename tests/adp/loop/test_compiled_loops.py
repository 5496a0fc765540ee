"""A closed loop compiled by lanes takes the steps of the definition; where it cannot be, that runs."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable
from typing import Any

import pytest
import torch
from helpers_adp import BOX, COST, PLANT, learner, staf_basis, uniform
from torch import Tensor

from staf_torch import (
    AnchoredKernel,
    ExponentialKernel,
    GaussianKernel,
    StaFBasis,
    StateFollowingCenters,
    StateRadius,
    adp,
    ball,
    lanes,
    rings,
    systems,
)
from staf_torch.lanes.tree import flatten

Case = tuple[Any, systems.ControlAffineSystem, adp.Cost]
CLOSE = 1e-11  # of a number's size, after a few steps from equal states


class Foreign(systems.ControlAffineSystem):
    """A plant of a user's own, with a friction that has a corner."""

    dim, inputs = 2, 1

    def drift(self, x: Tensor) -> Tensor:
        angle, rate = x.unbind(-1)
        friction = 0.1 * torch.tanh(20 * rate) + 0.2 * rate.abs() * rate
        return torch.stack((rate, angle.sin() - friction), dim=-1)

    def effectiveness(self, x: Tensor) -> Tensor:
        one = torch.ones_like(x[..., 0])
        return torch.stack((0 * one, one / (1 + x[..., 0].square())), dim=-1).unsqueeze(-1)


def rollout() -> adp.Controller:
    lqr = adp.LQR(PLANT, COST)  # as in `test_rollout_policies.py`, whose program serves here too
    basis = StaFBasis(ExponentialKernel(), StateFollowingCenters(rings(6), 0.1))
    return adp.Feedback(adp.RolloutPolicy(basis, PLANT, COST, lqr, lqr.value, horizon=0.5, steps=5))


def three_states() -> adp.Controller:
    centers = StateFollowingCenters(ball(8, 3), StateRadius(0.7, 0.0, 2.0))
    basis = adp.StaFValueBasis(StaFBasis(AnchoredKernel(ExponentialKernel()), centers))
    return adp.ActorCritic(basis, systems.ThreeState(), WIDE, adp.RandomPoints(1, 0.24))


def bounded() -> adp.Controller:
    basis = staf_basis("partial", AnchoredKernel(GaussianKernel(2.0)))
    points, law = adp.RandomPoints(2, BOX, "fixed"), adp.Information(bound=2.0)
    return adp.ActorCritic(basis, PLANT, COST, points, law)


def published() -> adp.Controller:
    points = adp.RandomPoints(1, 2.0, around="origin")
    return adp.ActorCritic(adp.RBFGridBasis(2, 2, 2.0), PLANT, COST, points, adp.Published())


def policy_iteration() -> adp.Controller:
    basis = staf_basis("total", AnchoredKernel(GaussianKernel(4.0)))  # as in `test_actor_critic.py`
    points, start = adp.QuadraturePoints(3, 2, half_width=0.2), basis.weights_near_square()
    return adp.ActorCritic(basis, PLANT, COST, points, adp.PolicyIteration(), critic=start, actor=start)


WIDE = adp.QuadraticCost(1.0, 1.0, 3, 2)
CASES: dict[str, Callable[[], Case]] = {
    "information": lambda: (learner(adp.Information()), PLANT, COST),
    "policy iteration": lambda: (policy_iteration(), PLANT, COST),
    "bounded, two fixed points, a kernel without closed form": lambda: (bounded(), PLANT, COST),
    "published, a grid around the origin": lambda: (published(), PLANT, COST),
    "three states": lambda: (three_states(), systems.ThreeState(), WIDE),
    "foreign plant": lambda: (adp.LQR(Foreign(), COST), Foreign(), COST),
    "rollout": lambda: (rollout(), PLANT, COST),
}


def run(case: Case, x0: Tensor, compile: bool, **given: Any) -> adp.LoopResult:
    controller, plant, cost = case
    settings = {"dt": 0.001, "steps": 5} | given
    return adp.simulate(controller, plant, cost, x0, compile=compile, **settings)


def states(case: Case, rows: int) -> Tensor:
    dim = case[2].dim
    return uniform(rows * dim, 0.5).reshape(-1, dim)[:rows]


def fields(result: adp.LoopResult) -> list[Tensor]:
    return flatten([getattr(result, field.name) for field in dataclasses.fields(result)])[0]


@pytest.mark.needs_compiler
@pytest.mark.parametrize("name", CASES)
def test_compiled_steps_are_those_of_the_definition(name: str, caplog: pytest.LogCaptureFixture) -> None:
    case = CASES[name]()
    dt, x0 = 0.02 if name == "policy iteration" else 0.001, states(case, 9)
    fast, plain = (run(case, x0, compile, dt=dt) for compile in (True, False))
    assert not caplog.text
    for got, want in zip(fields(fast), fields(plain), strict=True):
        torch.testing.assert_close(got, want, rtol=CLOSE, atol=CLOSE, equal_nan=True)


@pytest.mark.needs_compiler
def test_a_row_has_the_same_bits_at_every_batch_and_beside_every_neighbour() -> None:
    case = CASES["information"]()
    x0 = states(case, 200)
    whole = fields(run(case, x0, True))[1:]
    for few in (1, 7, 64):
        for one, every in zip(fields(run(case, x0[:few], True))[1:], whole, strict=True):
            assert torch.equal(one.nan_to_num(), every[:few].nan_to_num())
    lost = x0.clone()
    lost[1::2] = torch.tensor([float("nan"), 1e300], dtype=torch.float64)
    beside = run(case, lost, True)
    for one, every in zip(fields(beside)[1:], whole, strict=True):
        assert torch.equal(one[::2].nan_to_num(), every[::2].nan_to_num())
    assert beside.diverged.tolist() == [False, True] * 100


@pytest.mark.needs_compiler
def test_a_compiled_rollout_policy_is_its_definition_and_sees_what_changes() -> None:
    policy, x = adp.RolloutPolicy.of_lqr(PLANT, COST, steps=4), uniform(9, 0.5)
    assert lanes.ready(policy, x)
    for change in (lambda: None, lambda: setattr(policy, "horizon", 0.3), lambda: policy.base.k.mul_(1.1)):
        change()
        for one in (x, x[:1], x[3]):  # of one state a lane has a center, of several a state
            torch.testing.assert_close(policy(one), policy.control(one), rtol=CLOSE, atol=CLOSE)


def test_a_loop_that_runs_again_sees_what_has_changed_since(caplog: pytest.LogCaptureFixture) -> None:
    """From the third run on its checks and its linearisation are those of the second."""
    gain, x0 = torch.tensor([[30.0, 10.0]], dtype=torch.float64), uniform(3, 0.5)
    plant, cost = systems.Pendulum(), adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)

    def policy(x: Tensor) -> Tensor:
        return -(x @ gain.mT)

    def looped(*case: Any, dt: float = 0.01) -> adp.LoopResult:
        return adp.simulate(*case, x0, dt=dt, steps=2, compile=False)

    changes: tuple[Callable[[], Any], ...] = (
        lambda: gain.mul_(1.5),
        lambda: cost.q.mul_(2.0),
        lambda: gain.requires_grad_(),
    )
    for change in changes:
        for _ in range(3):
            looped(policy, plant, cost)
        change()
        fresh = looped(lambda x: policy(x), copy.deepcopy(plant), copy.deepcopy(cost))
        again = looped(policy, plant, cost)
        assert again.state.equal(fresh.state)
        assert again.cost.equal(fresh.cost)
    assert again.cost.requires_grad
    caplog.clear()
    for _ in range(4):
        looped(policy, plant, cost, dt=0.5)
    assert sum("is unstable" in line for line in caplog.messages) == 4

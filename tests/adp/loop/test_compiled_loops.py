"""A closed loop compiled by lanes takes the steps of the definition; where it cannot be, that runs."""

from __future__ import annotations

import copy
import dataclasses
import logging
from collections.abc import Callable
from pathlib import Path
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
    rows,
    systems,
)
from staf_torch.lanes.tree import flatten

PLAIN = "runs in plain torch, slower:"
Case = tuple[adp.Controller, systems.ControlAffineSystem, adp.Cost]
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


def quadratic(plant: systems.ControlAffineSystem) -> adp.QuadraticCost:
    return adp.QuadraticCost(1.0, 1.0, plant.dim or 2, plant.inputs)


def of_lqr(
    plant: systems.ControlAffineSystem,
) -> Case:
    cost = quadratic(plant)
    return adp.Feedback(adp.LQR(plant, cost)), plant, cost


def rollout() -> Case:
    lqr = adp.LQR(PLANT, COST)  # as in `test_adp_rollout.py`, whose program serves here too
    basis = StaFBasis(ExponentialKernel(), StateFollowingCenters(rings(6), 0.1))
    policy = adp.RolloutPolicy(basis, PLANT, COST, lqr, lqr.value, horizon=0.5, steps=5)
    return adp.Feedback(policy), PLANT, COST


def three_states() -> Case:
    plant = systems.ThreeState()
    centers = StateFollowingCenters(ball(8, 3), StateRadius(0.7, 0.0, 2.0))  # as in `test_adp_laws.py`
    basis = adp.StaFValueBasis(StaFBasis(AnchoredKernel(ExponentialKernel()), centers))
    cost = quadratic(plant)
    return adp.ActorCritic(basis, plant, cost, adp.RandomPoints(1, 0.24)), plant, cost


def policy_iteration() -> Case:
    basis = staf_basis("total", AnchoredKernel(GaussianKernel(4.0)))  # as in `test_policy_iteration.py`
    points, start = adp.QuadraturePoints(3, 2, half_width=0.2), basis.weights_near_square()
    law = adp.PolicyIteration()
    return adp.ActorCritic(basis, PLANT, COST, points, law, critic=start, actor=start), PLANT, COST


def of_basis(basis: adp.ValueBasis, points: adp.Extrapolation, law: adp.ActorCriticLaw | None = None) -> Case:
    return adp.ActorCritic(basis, PLANT, COST, points, law), PLANT, COST


def learned(law: adp.ActorCriticLaw, points: adp.Extrapolation | None = None) -> Case:
    return learner(law, points), PLANT, COST


CASES: dict[str, Callable[[], Case]] = {
    "information": lambda: learned(adp.Information()),
    "frozen, partial gradient": lambda: of_basis(
        staf_basis("partial"), adp.RandomPoints(1, BOX), adp.Frozen()
    ),
    "policy iteration": policy_iteration,
    "bounded, two fixed points, a kernel without closed form": lambda: of_basis(
        staf_basis("total", AnchoredKernel(GaussianKernel(2.0))),
        adp.RandomPoints(2, BOX, "fixed"),
        adp.Information(bound=2.0),
    ),
    "published, a grid around the origin": lambda: of_basis(
        adp.RBFGridBasis(2, 2, 2.0), adp.RandomPoints(1, 2.0, around="origin"), adp.Published()
    ),
    "supervised": lambda: (
        adp.Supervised(learner(adp.Information()), adp.LQR(PLANT, COST), COST),
        PLANT,
        COST,
    ),
    "three states": three_states,
    "quadrotor": lambda: of_lqr(systems.PlanarQuadrotor()),
    "foreign plant": lambda: of_lqr(Foreign()),
    "rollout": rollout,
}


def run(case: Case, x0: Tensor, compile: bool, **given: Any) -> adp.LoopResult:
    controller, plant, cost = case
    settings = {"dt": 0.001, "steps": 10} | given
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
    dt, x0 = 0.02 if name == "policy iteration" else 0.001, states(case, 33)
    fast, plain = (run(case, x0, compile, dt=dt) for compile in (True, False))
    assert PLAIN not in caplog.text
    for got, want in zip(fields(fast), fields(plain), strict=True):
        torch.testing.assert_close(got, want, rtol=CLOSE, atol=CLOSE, equal_nan=True)


@pytest.mark.needs_compiler
@pytest.mark.parametrize("name", ["information", "rollout"])
def test_a_row_has_the_same_bits_at_every_batch_and_beside_every_neighbour(name: str) -> None:
    case = CASES[name]()
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


def test_a_compiled_run_in_pieces_is_that_of_the_definition() -> None:
    case, x0 = of_lqr(Foreign()), uniform(2, 1.0)
    fast = run(case, x0, True, dt=0.01, steps=1100, every=55)
    for first in (0, 18):  # from the start, and over the end of the first piece
        plain = run(case, fast.state[:, first], False, dt=0.01, steps=110, every=55)
        for name in ("state", "control"):
            got, want = getattr(fast, name)[:, first : first + 2], getattr(plain, name)[:, :2]
            torch.testing.assert_close(got, want, rtol=1e-8, atol=1e-12)
        spent = fast.running_cost[:, first : first + 3] - fast.running_cost[:, first : first + 1]
        torch.testing.assert_close(spent, plain.running_cost, rtol=1e-8, atol=1e-10)
        torch.testing.assert_close(fast.state[:, first + 2], plain.state[:, 2], rtol=1e-8, atol=1e-12)


@pytest.mark.needs_compiler
def test_loops_that_differ_in_gains_and_tensors_share_one_program(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Own(systems.TwoState):
        """A plant that no other test compiles."""

        def drift(self, x: Tensor) -> Tensor:
            return 1.01 * super().drift(x)

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    built, x0 = [], uniform(3, 1.0)
    for gain in (0.7, 0.5, 1.0, 2.0):  # 1 and powers of two, which a text may spell out
        law = adp.Information(adp.Gains(critic=gain, critic_extrapolated=gain, forgetting=0.01 * gain))
        basis = staf_basis()
        basis.basis.centers.directions.mul_(gain)
        case = adp.ActorCritic(basis, Own(), COST, adp.RandomPoints(1, BOX), law), Own(), COST
        fast, plain = (run(case, x0, compile) for compile in (True, False))
        torch.testing.assert_close(fast.actor_weights, plain.actor_weights, rtol=1e-9, atol=1e-12)
        built.append(sorted(path.name for path in tmp_path.rglob("*.so")))
    assert built[0]
    assert built[1:] == built[:1] * 3


class Branching(systems.TwoState):
    def drift(self, x: Tensor) -> Tensor:
        return super().drift(x) * (2.0 if bool(x.sum() > 1e9) else 1.0)


class Another(systems.TwoState):
    """A plant that no other test compiles."""

    def drift(self, x: Tensor) -> Tensor:
        return 1.0 * super().drift(x) + 0.0 * x.sin()


@pytest.mark.needs_compiler
@pytest.mark.parametrize("reason", ["is on the path", "reads a value of a row"])
def test_what_cannot_be_compiled_runs_in_plain_torch_with_one_line(
    reason: str, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    plant: systems.ControlAffineSystem = Branching()
    if reason == "is on the path":
        plant = Another()
        for name, value in (("PATH", tmp_path), ("CXX", tmp_path / "none"), ("XDG_CACHE_HOME", tmp_path)):
            monkeypatch.setenv(name, str(value))
    lqr, x0 = adp.Feedback(adp.LQR(PLANT, COST)), uniform(2, 1.0)
    settings = {"dt": 0.013, "steps": 40, "every": 20}
    with caplog.at_level(logging.WARNING):
        fast = run((lqr, plant, COST), x0, True, **settings)
    plain = run((lqr, plant, COST), x0, False, **settings)
    torch.testing.assert_close(fast.state, plain.state, rtol=0, atol=0)
    (line,) = [record.getMessage() for record in caplog.records]
    assert line.startswith(f"the closed loop {PLAIN}")
    assert reason in line


@pytest.mark.needs_compiler
def test_rows_with_gains_of_their_own_are_compiled_and_are_those_rows_alone(
    caplog: pytest.LogCaptureFixture,
) -> None:
    x0, critic = uniform(3, 1.0), torch.tensor([0.1, 0.2, 0.4], dtype=torch.float64)

    def learned(gain: float | Tensor, at: slice, compile: bool) -> adp.LoopResult:
        law = adp.Information(adp.Gains(critic=gain))
        controller = adp.ActorCritic(adp.QuadraticBasis(2), PLANT, COST, adp.RandomPoints(1, 1.0), law)
        return run((controller, PLANT, COST), x0[at], compile, steps=20, seed=range(3)[at])

    whole = learned(rows(critic), slice(0, 3), True)
    assert PLAIN not in caplog.text
    plain = learned(rows(critic), slice(0, 3), False)
    torch.testing.assert_close(whole.actor_weights, plain.actor_weights, rtol=CLOSE, atol=CLOSE)
    for k in range(3):
        alone = learned(float(critic[k]), slice(k, k + 1), False)
        torch.testing.assert_close(whole.state[k : k + 1], alone.state, rtol=CLOSE, atol=CLOSE)


@pytest.mark.needs_compiler
def test_a_compiled_rollout_policy_is_its_definition_and_sees_what_changes() -> None:
    policy = adp.RolloutPolicy.of_lqr(PLANT, COST, steps=4)
    x = uniform(50, 0.5)
    assert lanes.ready(policy, x)
    torch.testing.assert_close(policy(x), policy.control(x), rtol=CLOSE, atol=CLOSE)
    for one in (x[:2], x[:1], x[3]):  # of one state a lane has a center, of several a state
        for _ in range(2):
            torch.testing.assert_close(policy(one), policy.control(one), rtol=CLOSE, atol=CLOSE)
    for change in (lambda: setattr(policy, "horizon", 0.3), lambda: policy.base.k.mul_(1.1)):
        change()
        torch.testing.assert_close(policy(x), policy.control(x), rtol=CLOSE, atol=CLOSE)
    again = copy.deepcopy(policy)
    torch.testing.assert_close(again(x), policy.control(x), rtol=CLOSE, atol=CLOSE)
    at = x.clone().requires_grad_()
    assert policy(at).requires_grad


def test_a_trajectory_is_compiled_where_it_is_long() -> None:
    plant, x0 = systems.VanDerPol(), uniform(3, 1.0)
    states = systems.simulate(plant, x0, dt=0.001, steps=12_000)
    few = systems.simulate(plant, x0, dt=0.001, steps=100)
    torch.testing.assert_close(states[:, :101], few, rtol=CLOSE, atol=CLOSE)


def test_a_loop_that_runs_again_sees_what_has_changed_since(caplog: pytest.LogCaptureFixture) -> None:
    """From the third run on its checks and its linearisation are those of the second."""
    gain, x0 = torch.tensor([[30.0, 10.0]], dtype=torch.float64), uniform(3, 0.5)
    plant, cost = systems.Pendulum(), adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)

    def policy(x: Tensor) -> Tensor:
        return -(x @ gain.mT)

    def looped(*case: Any, dt: float = 0.01) -> adp.LoopResult:
        return adp.simulate(*case, x0, dt=dt, steps=5, compile=False)

    changes: tuple[Callable[[], Any], ...] = (
        lambda: gain.mul_(1.5),
        lambda: cost.q.mul_(2.0),
        lambda: setattr(plant, "damping", 0.7),
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

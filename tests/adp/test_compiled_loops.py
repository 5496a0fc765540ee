"""A closed loop compiled by lanes takes the steps of the definition; where it cannot be, that runs."""

from __future__ import annotations

import copy
import dataclasses
import logging
from collections.abc import Callable

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
    rings,
    systems,
)
from staf_torch.adp.closed_loop import ClosedLoop, LoopState, program, row_gains
from staf_torch.lanes import compiler
from staf_torch.lanes import program as programs

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
) -> tuple[adp.Controller, systems.ControlAffineSystem, adp.Cost]:
    cost = quadratic(plant)
    return adp.Feedback(adp.LQR(plant, cost)), plant, cost


def rollout() -> tuple[adp.Controller, systems.ControlAffineSystem, adp.Cost]:
    lqr = adp.LQR(PLANT, COST)  # as in `test_adp_rollout.py`, whose program serves here too
    basis = StaFBasis(ExponentialKernel(), StateFollowingCenters(rings(6), 0.1))
    policy = adp.RolloutPolicy(basis, PLANT, COST, lqr, lqr.value, horizon=0.5, steps=5)
    return adp.Feedback(policy), PLANT, COST


def three_states() -> tuple[adp.Controller, systems.ControlAffineSystem, adp.Cost]:
    plant = systems.ThreeState()
    centers = StateFollowingCenters(ball(8, 3), StateRadius(0.7, 0.0, 2.0))  # as in `test_adp_laws.py`
    basis = adp.StaFValueBasis(StaFBasis(AnchoredKernel(ExponentialKernel()), centers))
    cost = quadratic(plant)
    return adp.ActorCritic(basis, plant, cost, adp.RandomPoints(1, 0.24)), plant, cost


def policy_iteration() -> tuple[adp.Controller, systems.ControlAffineSystem, adp.Cost]:
    basis = staf_basis("total", AnchoredKernel(GaussianKernel(4.0)))  # as in `test_policy_iteration.py`
    points, start = adp.QuadraturePoints(3, 2, half_width=0.2), basis.weights_near_square()
    law = adp.PolicyIteration()
    return adp.ActorCritic(basis, PLANT, COST, points, law, critic=start, actor=start), PLANT, COST


def of_basis(
    basis: adp.ValueBasis, points: adp.Extrapolation, law: adp.ActorCriticLaw | None = None
) -> tuple[adp.Controller, systems.ControlAffineSystem, adp.Cost]:
    return adp.ActorCritic(basis, PLANT, COST, points, law), PLANT, COST


def learned(
    law: adp.ActorCriticLaw, points: adp.Extrapolation | None = None
) -> tuple[adp.Controller, systems.ControlAffineSystem, adp.Cost]:
    return learner(law, points), PLANT, COST


CASES: dict[str, Callable[[], tuple[adp.Controller, systems.ControlAffineSystem, adp.Cost]]] = {
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


def start(case: str, rows: int) -> tuple[ClosedLoop, LoopState, Tensor]:
    controller, plant, cost = CASES[case]()
    loop = ClosedLoop(controller, plant, cost, dt=0.02 if case == "policy iteration" else 0.001)
    dim = cost.q.shape[0]
    x0 = uniform(rows * dim, 0.5).reshape(-1, dim)[:rows]
    generator = torch.Generator().manual_seed(1)
    draws = 2 * torch.rand(rows, 10, controller.draws, dim, dtype=torch.float64, generator=generator) - 1
    return loop, loop.init(x0), draws


def leaves(state: LoopState) -> list[Tensor]:
    return [*state[:4], *state.carried]


@pytest.mark.needs_compiler
@pytest.mark.parametrize("case", CASES)
def test_compiled_steps_are_those_of_the_definition(case: str) -> None:
    loop, state, draws = start(case, 65)
    steps = program(loop, True)
    assert steps.compiles(state, draws)
    after, out = steps(state, draws)
    wanted, recorded = steps.definition(state, draws)
    for got, want in zip((*leaves(after), *out), (*leaves(wanted), *recorded), strict=True):
        torch.testing.assert_close(got, want, rtol=CLOSE, atol=CLOSE, equal_nan=True)


@pytest.mark.needs_compiler
@pytest.mark.parametrize("case", ["information", "rollout"])
def test_a_row_has_the_same_bits_at_every_batch_and_beside_every_neighbour(case: str) -> None:
    loop, state, draws = start(case, 1000)
    steps = program(loop, True)
    whole = leaves(steps(state, draws)[0])
    for rows in (1, 7, 64):
        part = loop.init(state.x[:rows])
        for one, all_ in zip(leaves(steps(part, draws[:rows])[0]), whole, strict=True):
            assert torch.equal(one, all_[:rows])
    x0 = state.x.clone()
    x0[1::2] = torch.tensor([float("nan"), 1e300], dtype=torch.float64)
    beside = leaves(steps(loop.init(x0), draws)[0])
    for one, all_ in zip(beside, whole, strict=True):
        assert torch.equal(one[::2], all_[::2])
    assert not beside[2][1::2].any()


def test_a_compiled_run_is_that_of_the_definition(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("staf_torch.adp.simulation._DRAWN_AHEAD", 170)  # a piece of 165 steps, and the rest
    x0 = uniform(3, 1.0)
    settings = {"dt": 0.01, "steps": 220, "every": 55}
    fast = adp.simulate(learner(adp.Information()), PLANT, COST, x0, compile=True, **settings)
    plain = adp.simulate(learner(adp.Information()), PLANT, COST, x0, compile=False, **settings)
    for field in dataclasses.fields(fast):
        got, want = getattr(fast, field.name), getattr(plain, field.name)
        torch.testing.assert_close(got, want, rtol=1e-9, atol=1e-12, equal_nan=True)


@pytest.mark.needs_compiler
def test_loops_that_differ_in_gains_and_tensors_share_one_text(monkeypatch: pytest.MonkeyPatch) -> None:
    loop, state, draws = start("information", 5)
    first = program(loop, True)
    assert first.compiles(state, draws)
    assert program(loop, True) is first
    monkeypatch.setattr(programs, "trace", None)
    monkeypatch.setattr(compiler, "_build", None)
    for gain in (0.5, 1.0, 2.0, 0.3):  # 1 and powers of two, which a text may spell out
        other = copy.deepcopy(loop)
        other.controller.law.gains = adp.Gains(critic_extrapolated=gain, actor=gain)
        other.controller.basis.basis.centers.directions.mul_(gain)
        steps = program(other, True)
        assert steps is not first
        assert steps.compiles(state, draws)
        for got, want in zip(steps(state, draws)[1], steps.definition(state, draws)[1], strict=True):
            torch.testing.assert_close(got, want, rtol=1e-9, atol=1e-12, equal_nan=True)


class Branching(systems.TwoState):
    def drift(self, x: Tensor) -> Tensor:
        return super().drift(x) * (2.0 if bool(x.sum() > 1e9) else 1.0)


@pytest.mark.needs_compiler
@pytest.mark.parametrize("reason", ["no compiler", "reads a value of a row"])
def test_what_cannot_be_compiled_runs_in_plain_torch_with_one_line(
    reason: str, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(_: str) -> object:
        raise OSError("no compiler")

    plant: systems.ControlAffineSystem = Branching()
    if reason == "no compiler":
        plant = systems.TwoState()
        monkeypatch.setattr(compiler, "function", refuse)
    lqr, x0 = adp.Feedback(adp.LQR(PLANT, COST)), uniform(2, 1.0)
    settings = {"dt": 0.013, "steps": 40, "every": 20}
    with caplog.at_level(logging.WARNING):
        run = adp.simulate(lqr, plant, COST, x0, compile=True, **settings)
    plain = adp.simulate(lqr, PLANT, COST, x0, compile=False, **settings)
    torch.testing.assert_close(run.state, plain.state, rtol=0, atol=0)
    (line,) = [record.getMessage() for record in caplog.records]
    assert line.startswith("the closed loop runs in plain torch, slower:")
    assert reason in line


@pytest.mark.needs_compiler
def test_rows_with_gains_of_their_own_are_compiled_and_are_those_rows_alone() -> None:
    x0, critic = uniform(3, 1.0), torch.tensor([[0.1], [0.2], [0.4]], dtype=torch.float64)

    def run(gain: float | Tensor, rows: slice, compile: bool) -> adp.LoopResult:
        law = adp.Information(adp.Gains(critic=gain))
        controller = adp.ActorCritic(adp.QuadraticBasis(2), PLANT, COST, adp.RandomPoints(1, 1.0), law)
        settings = {"dt": 1e-3, "steps": 20, "seed": range(3)[rows], "compile": compile}
        return adp.simulate(controller, PLANT, COST, x0[rows], **settings)

    whole = run(critic, slice(0, 3), True)
    torch.testing.assert_close(
        whole.actor_weights, run(critic, slice(0, 3), False).actor_weights, rtol=CLOSE, atol=CLOSE
    )
    for k in range(3):
        alone = run(float(critic[k]), slice(k, k + 1), False)
        torch.testing.assert_close(whole.state[k : k + 1], alone.state, rtol=CLOSE, atol=CLOSE)
    law = adp.Information(adp.Gains(critic=critic))
    controller = adp.ActorCritic(adp.QuadraticBasis(2), PLANT, COST, adp.RandomPoints(1, 1.0), law)
    loop = ClosedLoop(controller, PLANT, COST, dt=1e-3)
    draws = x0.new_zeros(3, 2, loop.controller.draws, 2)
    assert program(loop, True).compiles(loop.init(x0), draws, row_gains(loop))


def test_a_sweep_over_gains_needs_no_other_program() -> None:
    basis, x0 = adp.QuadraticBasis(2), uniform(1, 1.0)

    def text(critic: float, beta: float) -> str:
        law = adp.Information(adp.Gains(critic=critic, forgetting=beta))
        loop = ClosedLoop(
            adp.ActorCritic(basis, PLANT, COST, adp.RandomPoints(1, 1.0), law), PLANT, COST, dt=1e-3
        )
        given = loop.init(x0), x0.new_zeros(1, 2, 1, 2)
        return program(loop, True).text(*given)

    assert text(0.3, 0.003) == text(0.7, 0.009)


@pytest.mark.needs_compiler
def test_a_rollout_policy_that_is_asked_often_compiles_itself_and_sees_what_changes() -> None:
    policy = adp.RolloutPolicy.of_lqr(PLANT, COST, steps=4)
    x = uniform(50, 0.5)
    policy._compiled._asked = float("inf")
    torch.testing.assert_close(policy(x), policy.control(x), rtol=CLOSE, atol=CLOSE)
    assert policy._compiled.compiled
    assert torch.equal(policy(x[3]), policy(x)[3])
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

"""Controllers of a user, what they carry, and the supervisor."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from helpers import tensor, uniform
from helpers_adp import BOX, COST, learner, staf_basis
from helpers_adp import PLANT as TWO_STATE
from helpers_adp import uniform as drawn
from torch import Tensor, nn

from staf_torch import adp, systems

LQR = adp.LQR(TWO_STATE, COST)
X0 = tensor([[1.0, 0.0], [-0.5, 0.8], [0.2, -0.3]])


class Hysteresis(adp.Controller):
    """A relay with a dead zone beside a feedback; it counts its switches."""

    def init(self, x0: Tensor) -> Any:
        mode = torch.zeros_like(x0[:, 0])
        return {"mode": mode, "switches": mode.long(), "past": (x0, mode > 0)}

    def step(self, x: Tensor, carried: Any, uniform: Tensor, dt: float) -> tuple[Tensor, Any]:
        mode = torch.where(x[:, 0] > 0.2, 1.0, torch.where(x[:, 0] < -0.2, -1.0, carried["mode"]))
        changed = mode != carried["mode"]
        u = -(0.3 * mode + x.sum(-1) + 0.1 * (x - carried["past"][0]).sum(-1))
        kept = {"mode": mode, "switches": carried["switches"] + changed.long(), "past": (x, changed)}
        return u.unsqueeze(-1), kept

    def recorded(self, carried: Any) -> dict[str, Tensor]:
        return {"switches": carried["switches"], "before": carried["past"][0]}


@pytest.mark.needs_compiler
@pytest.mark.compiled
def test_a_state_of_ones_own_is_carried_row_by_row_and_recorded_by_name(
    caplog: pytest.LogCaptureFixture,
) -> None:
    x0 = torch.randn(18, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    x0[4] = torch.nan
    runs = [
        adp.simulate(Hysteresis(), TWO_STATE, COST, x0, dt=0.05, steps=40, compile=compile)
        for compile in (True, False)
    ]
    assert not caplog.text
    torch.testing.assert_close(runs[0].state, runs[1].state, rtol=1e-10, atol=1e-10, equal_nan=True)
    assert runs[0].diverged.tolist() == [row == 4 for row in range(18)]
    assert runs[0].critic_weights.shape == (18, 41, 0)
    assert torch.equal(runs[0]["switches"], runs[1]["switches"])
    assert torch.equal(runs[0]["before"][:4, 2:-1], runs[0].state[:4, 1:-2])
    torch.testing.assert_close(runs[0].carried, runs[1].carried, rtol=1e-10, atol=1e-10, equal_nan=True)
    first, rest = runs[0].split([5, 13])
    assert torch.equal(rest["switches"], runs[0]["switches"][5:])
    assert torch.equal(first.carried["mode"], runs[0].carried["mode"][:5])
    alone = adp.simulate(Hysteresis(), TWO_STATE, COST, x0[2:11], dt=0.05, steps=40, compile=True)
    assert torch.equal(alone.state[0], runs[0].state[2])
    assert torch.equal(alone.state[3:], runs[0].state[5:11])


class Misfit(Hysteresis):
    def __init__(self, initial: Any, after: Any) -> None:
        super().__init__()
        self.initial, self.after = initial, after

    def init(self, x0: Tensor) -> Any:
        return self.initial

    def step(self, x: Tensor, carried: Any, uniform: Tensor, dt: float) -> tuple[Tensor, Any]:
        return -x[:, :1], self.after


@pytest.mark.parametrize(
    ("initial", "after", "message"),
    [
        (torch.tensor(0.0), None, r"`Misfit.init` must return tensors \(B, ...\), .* B = 3; got .* \(\)"),
        (torch.zeros(3), torch.zeros(3, 1), r"`Misfit.step` must return .* \[\(3,\)\]; got \[\(3, 1\)\]"),
    ],
)  # fmt: skip
def test_what_is_carried_keeps_its_form(initial: Any, after: Any, message: str) -> None:
    x0 = torch.ones(3, 2, dtype=torch.float64)
    with pytest.raises(ValueError, match=message):
        adp.simulate(Misfit(initial, after), TWO_STATE, COST, x0, dt=0.1, steps=2)


class Integral(nn.Module):
    def __init__(self, way: str, buffer: bool) -> None:
        super().__init__()
        zero = torch.zeros(3, 1, dtype=torch.float64)
        if buffer:
            self.register_buffer("total", zero)
        else:
            self.total = zero
        self.way, self.calls = way, 0

    def forward(self, x: Tensor) -> Tensor:
        self.calls += 1
        if self.way == "in place":
            self.total += 0.01 * x[:, :1]
        elif self.way == ".data":
            self.total.data.add_(0.01 * x[:, :1])
        elif self.way == "another tensor":
            self.total = self.total + 0.01 * x[:, :1]
        return -3 * x[:, 1:] - self.total


@pytest.mark.parametrize(
    ("way", "buffer"), [("another tensor", False), ("in place", True), (".data", False), (".data", True)]
)
def test_a_policy_with_a_memory_is_refused(way: str, buffer: bool) -> None:
    policy = adp.Feedback(Integral(way, buffer))
    with pytest.raises(ValueError, match=r"changed its `total`.*as a `Controller`"):
        adp.simulate(policy, TWO_STATE, COST, X0, dt=0.01, steps=6, compile=False)


def test_a_policy_that_counts_its_calls_has_no_memory() -> None:
    policy = Integral("nothing", False)
    assert not adp.simulate(policy, TWO_STATE, COST, X0, dt=0.01, steps=6, compile=False).diverged.any()
    assert policy.calls >= 6


# --- the supervisor -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("trust", [0.5, 1.0])
def test_a_supervised_control_is_drawn_to_the_lqr_by_the_norm_of_its_cost(trust: float) -> None:
    r = tensor([[1.0, 0.3], [0.3, 2.0]])
    plant = systems.Linear([[0.0, 1.0], [1.0, 0.0]], [[1.0, 0.0], [0.0, 1.0]])
    cost = adp.QuadraticCost(1.0, r, 2, 2, target=[0.5, 0.0])
    lqr = adp.LQR(plant, cost)
    guard = adp.Supervised(adp.Feedback(lambda x: 9 * x), lqr, cost, trust)
    x, u = uniform(6, 2, seed=1), 3 * uniform(6, 2, seed=2)
    u[0] = lqr(x[0]) * 1.01
    rest = tensor([0.0, -0.5])  # holds the plant at (0.5, 0)
    found = guard.restrain(x, u)
    for row in range(6):
        base = lqr(x[row])
        apart, effort = u[row] - base, base - rest
        allowed, wanted = trust * math.sqrt(effort @ r @ effort), math.sqrt(apart @ r @ apart)
        share = min(1.0, allowed / wanted)
        torch.testing.assert_close(found[row], base + share * apart)
    assert guard.label == "supervised <lambda>"
    carried = guard.init(x)
    torch.testing.assert_close(guard.step(x, carried, x.new_zeros(6, 0, 2), 0.1)[0], guard.restrain(x, 9 * x))
    for wrong in (0.0, 1.0 + 1e-9):
        with pytest.raises(ValueError, match=r"`Supervised\(trust=...\)` must be in \(0, 1\]"):
            adp.Supervised(adp.Feedback(lqr), lqr, cost, wrong)


def test_supervised_linear_plant_is_stable_for_any_weights() -> None:
    plant, x = systems.Linear([[0.0, 1.0], [2.0, -1.0]], [[0.0], [1.0]]), drawn(500, 3.0)
    lqr = adp.LQR(plant, COST)
    guard = adp.Supervised(learner(adp.Information()), lqr, COST, trust=0.5)
    u = guard.restrain(x, 300 * uniform(500, 1, seed=1))
    fall = 2 * ((x @ lqr.p) * plant.motion(x, u)).sum(-1)
    assert (fall <= -COST.state_rate(x) + 1e-9).all()


def test_supervisor_regulates_a_grid_of_initial_weights() -> None:
    critic = tensor([0.1, 0.4, 1.0, 2.0]).repeat_interleave(40).unsqueeze(-1).expand(-1, 3)
    points = adp.RandomPoints(1, BOX)
    inner = adp.ActorCritic(staf_basis(), TWO_STATE, COST, points, critic=critic, actor=0.7 * critic)
    x0, guarded = drawn(40, 2.0, seed=11).repeat(4, 1), adp.Supervised(inner, LQR, COST)
    run = adp.simulate(guarded, TWO_STATE, COST, x0, dt=0.01, steps=1000, every=1000, compile=True)
    regulated = ~run.diverged & (run.state[:, -1].norm(dim=-1) < 1e-3)
    assert float(regulated.double().mean()) >= 0.95


def test_bounds_that_a_controller_was_made_with_are_those_of_its_loop() -> None:
    plant, cost = systems.Pendulum(), adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
    policy = adp.LQR(plant, cost.bounded(-6.0, 8.0))
    for controller in (policy, adp.Supervised(adp.Feedback(policy), policy, cost)):
        loop = adp.simulate(controller, plant, cost, tensor([[0.3, 0.0]]), dt=0.05, steps=1)
        assert "bounds -6 to 8" in repr(loop)

"""How far `near_optimal` leads from the box of its plant, and what it says where that is not far enough."""

from __future__ import annotations

import logging
import math
import pickle
import time

import pytest
import torch
from helpers import tensor
from helpers_swingup import GRID, RESETS
from torch import Tensor

from staf_torch import adp, deploy, lanes, systems
from staf_torch.adp.near_optimal_policy import NearOptimal


def turn(x: Tensor, u: Tensor) -> Tensor:
    """A step of Gymnasium's Pendulum-v1."""
    rate = (x[..., 1] + 0.05 * (15.0 * x[..., 0].sin() + 3.0 * u[..., 0])).clamp(-8.0, 8.0)
    return torch.stack((x[..., 0] + 0.05 * rate, rate), dim=-1)


def pendulum(torque: float) -> systems.StepPlant:
    return systems.StepPlant(turn, dim=2, inputs=1, dt=0.05, periodic=[0], low=-torque, high=torque)


REWARD = adp.QuadraticCost([[20.0, 0.0], [0.0, 2.0]], 0.02, dim=2, inputs=1)  # a second; a step is 50 ms


@pytest.fixture(scope="module")
def swing() -> NearOptimal:
    return adp.near_optimal(pendulum(2.0), REWARD)


@torch.no_grad()
def test_pendulum_of_gymnasium_costs_what_dynamic_programming_costs(swing: NearOptimal) -> None:
    assert swing.reach.way == "global"
    assert swing.reach.box == (math.pi, 1.0)
    assert swing.reach.regulated == 1.0
    assert swing.reach.base is not None
    assert swing.reach.base < 0.5
    assert swing.reach.over_best is not None
    assert 0.99 <= swing.reach.over_best <= 1.02
    run = adp.simulate(swing, swing.plant, swing.cost, RESETS, dt=0.05, steps=200, compile=False)
    assert float(run.cost.mean()) <= 1.02 * float(GRID.mean())
    assert bool((swing.cost.deviation(run.state[:, -1]).abs() < 0.05).all())


@torch.no_grad()
def test_global_policy_is_a_policy_like_any_other(swing: NearOptimal) -> None:
    assert lanes.ready(swing, RESETS[:1])
    u = swing(RESETS)
    assert u.shape == (8, 1)
    assert bool((u.abs() <= 2).all())
    for row in range(3):
        torch.testing.assert_close(swing(RESETS[row]), u[row], rtol=0, atol=1e-12)
    assert swing(RESETS.view(2, 4, 2)).shape == (2, 4, 1)
    assert swing(RESETS.float()).dtype == torch.float32
    ends = tensor([[math.pi, 1.0], [-math.pi, -1.0], [math.pi, -1.0]])
    torch.testing.assert_close(swing(ends), swing(ends + tensor([2 * math.pi, 0.0])), rtol=0, atol=1e-6)
    assert isinstance(swing.controller(), adp.Feedback)
    torch.testing.assert_close(pickle.loads(pickle.dumps(swing))(RESETS), u, rtol=0, atol=0)
    torch.testing.assert_close(deploy.policy_of(swing)(RESETS), u, rtol=0, atol=1e-9)
    assert swing.value(RESETS[3:5]).tolist() == pytest.approx(GRID[3:5].tolist(), rel=0.01)
    assert bool((swing(tensor([[0.0, 900.0], [50.0, -8.0]])).abs() <= 2).all())


def test_where_the_lqr_regulates_the_box_the_policy_is_as_before(caplog: pytest.LogCaptureFixture) -> None:
    cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
    for plant, given in (
        (systems.TwoState(), {"dt": 0.1}),
        (systems.Linear([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]]), {"dt": 0.1, "low": -1.0, "high": 1.0}),
    ):
        local = adp.near_optimal(plant, cost, reach="local", **given)  # type: ignore[arg-type]
        began = time.thread_time()
        policy = adp.near_optimal(plant, cost, **given)  # type: ignore[arg-type]
        assert time.thread_time() - began < 2
        assert policy.reach.way == "local"
        assert policy.reach.regulated == policy.reach.base == 1.0
        assert local.reach.regulated is None
        x = tensor([[0.2, -0.1], [1.0, 0.5]])
        assert torch.equal(policy.control(x), local.control(x))
    assert not caplog.text


def test_a_base_that_does_not_reach_is_one_warning_with_its_share(caplog: pytest.LogCaptureFixture) -> None:
    discounted = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1, discount=0.1)
    policy = adp.near_optimal(pendulum(2.0), discounted)
    (said,) = [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]
    share = policy.reach.regulated
    assert share is not None
    assert share < 1
    assert f"the LQR regulates {100 * share:.0f} % of 28 states of the box +-(3.14, 1)" in said
    assert "no discount" in said
    assert policy.reach.way == "local"
    assert policy.reach.note in said
    with pytest.raises(ValueError, match=r"`near_optimal\(reach=...\)` must be local here: .* no discount"):
        adp.near_optimal(pendulum(2.0), discounted, reach="global")
    with pytest.raises(ValueError, match=r"`near_optimal\(reach=...\)` must be one of"):
        adp.near_optimal(pendulum(2.0), discounted, reach="far")

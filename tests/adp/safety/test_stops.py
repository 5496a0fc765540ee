"""Where the barrier's condition promises nothing: what can be stopped is, what cannot is said."""

from __future__ import annotations

import logging
import math

import pytest
import torch
from helpers import tensor
from torch import Tensor

from staf_torch import adp, systems

LINE = systems.Linear([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])
COST = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)


def wall(x: Tensor, t: Tensor) -> Tensor:
    return 1 - x[:, 0]


def pushing(x: Tensor) -> Tensor:
    """For 5, far behind the wall."""
    return 5 * (5 - x[..., :1]) - 2 * x[..., 1:]


@pytest.mark.parametrize("decay", [None, 2.0, 50.0])
def test_what_the_brakes_can_stop_stops_before_the_wall_and_the_rest_is_named(decay: float | None) -> None:
    """Field 8: h = 1 - x1, |u| <= 20; v^2 <= 40 h can stop."""
    x0 = tensor([[0.9, 1.0], [0.0, 3.0], [0.5, 2.0], [-1.0, 4.5], [-19.0, 26.0], [0.0, 6.3], [0.9, 2.5]])
    stops = x0[:, 1].square() <= 40 * (1 - x0[:, 0])
    guard = adp.SafetyFilter(pushing, LINE, wall, dt=0.02, low=-20.0, high=20.0, decay=decay)
    run = adp.simulate(guard, LINE, COST, x0, steps=100, compile=True)
    report, reached = guard.report(run), run.state[:, :, 0].amax(1)
    assert bool((reached[stops] <= 1).all())
    assert report["infeasible"] == (~stops).nonzero().flatten().tolist()
    beyond = x0[:, 0] + x0[:, 1].square() / 40  # the hardest brake from the beginning on
    torch.testing.assert_close(reached[~stops], beyond[~stops], rtol=0, atol=2e-3)
    assert report["largest_slack"] > 0


def test_the_brakes_may_have_two_sides_and_a_moving_wall() -> None:
    x0 = tensor([[0.9, 1.0], [0.0, -3.0], [0.5, 2.0], [-0.9, -1.5]])
    sides = [lambda x, t: 1.5 - 0.3 * t - x[:, 0], lambda x, t: 1 + x[:, 0]]
    guard = adp.SafetyFilter(pushing, LINE, sides, dt=0.02, low=-20.0, high=20.0)
    report = guard.report(adp.simulate(guard, LINE, COST, x0, steps=40, compile=True))
    assert report["minimum_margin"] >= 0
    assert report["infeasible"] == []


class Drag(systems.ControlAffineSystem):
    """v' = u - v / 2: brakes of 15 stop v within 2 (v - 30 ln(1 + v / 30))."""

    dim, inputs = 2, 1

    def drift(self, x: Tensor) -> Tensor:
        return torch.stack((x[..., 1], -0.5 * x[..., 1]), dim=-1)

    def effectiveness(self, x: Tensor) -> Tensor:
        return torch.tensor([[0.0], [1.0]]).to(x).expand(*x.shape, 1)


def test_brakes_that_vary_are_followed_until_they_stop() -> None:
    speed = tensor([2.0, 4.0, 2.0, 4.0, 6.0])
    way = 2 * (speed - 30 * torch.log1p(speed / 30))
    x0 = torch.stack((1 - way * tensor([1.01, 1.01, 0.9, 0.9, 1.01]), speed), dim=-1)
    guard = adp.SafetyFilter(pushing, Drag(), wall, dt=0.02, low=-15.0, high=15.0)
    run = adp.simulate(guard, Drag(), COST, x0, steps=80, compile=True)
    report, reached = guard.report(run), run.state[:, :, 0].amax(1)
    assert report["infeasible"] == [2, 3]
    assert bool((reached[[0, 1, 4]] <= 1).all())
    torch.testing.assert_close(reached[2:4], 1 + 0.1 * way[2:4], rtol=0, atol=2e-3)


def test_two_inputs_brake_before_a_disc() -> None:
    plane = systems.Linear(torch.eye(4).roll(2, dims=1).triu().tolist(), torch.eye(4)[:, 2:].tolist())
    cost = adp.QuadraticCost(1.0, 1.0, dim=4, inputs=2)

    def through(x: Tensor) -> Tensor:
        return torch.cat((3 * (3 - x[..., :1]) - x[..., 2:3], -3 * x[..., 1:2] - x[..., 3:]), dim=-1)

    def disc(x: Tensor, t: Tensor) -> Tensor:
        return x[:, :2].square().sum(-1) - 0.25

    x0 = tensor([[-2.0, 0.05, 3.0, 0.0], [-2.0, 0.0, 1.0, 0.0], [-1.5, 0.0, 2.4, 0.0], [-1.0, 0.0, 3.0, 0.0]])
    guard = adp.SafetyFilter(through, plane, disc, dt=0.02, low=-4.0, high=4.0)
    report = guard.report(run := adp.simulate(guard, plane, cost, x0, steps=80, compile=True))
    assert report["infeasible"] == [3]  # heading for the middle at 3 m/s, half a metre before it
    assert float(guard.margins(run.state[:3], 0.0).min()) >= 0


def test_a_drift_stronger_than_the_brakes_is_kept_out_of() -> None:
    """x' = x + u, |u| <= 1: beyond 1 nothing holds it, though the wall at 2 is far."""
    guard = adp.SafetyFilter(
        lambda x: 0 * x + 3, systems.Linear([[1.0]], [[1.0]]), lambda x, t: 2 - x[:, 0],
        dt=0.02, low=-1.0, high=1.0,
    )  # fmt: skip
    cost = adp.QuadraticCost(1.0, 1.0, dim=1, inputs=1)
    run = adp.simulate(guard, guard.plant, cost, tensor([[0.0], [0.9], [1.1]]), steps=100, compile=True)
    assert float(run.state[:2].max()) <= 1
    assert guard.report(run)["infeasible"] == [2]


def test_outside_is_never_well() -> None:
    guard = adp.SafetyFilter(pushing, LINE, wall, dt=0.02, low=-20.0, high=20.0)
    free = adp.SafetyFilter(pushing, LINE, wall, dt=0.02)
    x = tensor([[1.1, -3.0], [1.1, 3.0], [1.0001, 0.0], [0.0, 0.0]])
    for each in (guard, free):
        assert (each.restrain(x, pushing(x)).slack > 1e-6).tolist() == [True, True, True, False]
    assert guard(x)[1].item() == -20.0


def test_the_default_decay_is_that_of_brakes_and_period() -> None:
    def decay(bound: float | None, dt: float) -> float:
        limits = {} if bound is None else {"low": -bound, "high": bound}
        return float(adp.SafetyFilter(pushing, LINE, wall, dt=dt, **limits).decay)

    assert decay(20.0, 1e-3) == pytest.approx(2 * decay(5.0, 1e-3))
    assert decay(20.0, 1e-3) == decay(20.0, 1e-2)
    assert decay(None, 0.02) == pytest.approx(10.0)
    assert decay(20.0, 0.5) == pytest.approx(0.4)


class Balancer(systems.ControlAffineSystem):
    """A two-wheeled inverted pendulum (p, angle, p', angle'): wheels of 1 kg, 2 kg at half a metre."""

    dim, inputs = 4, 1

    def drift(self, x: Tensor) -> Tensor:
        sine, cosine, rate = x[..., 1].sin(), x[..., 1].cos(), x[..., 3]
        push, fall, size = sine * rate.square(), 9.81 * sine, 1.5 - cosine.square()
        along = (0.5 * push - fall * cosine) / size
        return torch.stack((x[..., 2], rate, along, (3 * fall - push * cosine) / size), dim=-1)

    def effectiveness(self, x: Tensor) -> Tensor:
        cosine, none = x[..., 1].cos(), torch.zeros_like(x[..., 0])
        size = 1.5 - cosine.square()
        return torch.stack((none, none, 0.5 / size, -cosine / size), dim=-1).unsqueeze(-1)


def test_a_plant_that_must_first_move_the_wrong_way_is_left_to_its_policy(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Field 24."""
    plant, weights = Balancer(), torch.diag(tensor([10.0, 1.0, 1.0, 0.1]))
    cost = adp.QuadraticCost(weights, 0.05, dim=4, inputs=1, low=-30.0, high=30.0)
    lqr = adp.LQR(plant, cost, period=0.02)
    x0 = tensor([[0.5, 0.0, 0.0, 0.0], [0.3, 0.1, 0.2, 0.0], [0.52, 0.0, 0.1, 0.0], [-0.4, -0.1, -0.4, 0.0]])
    with caplog.at_level(logging.WARNING):
        guard = adp.SafetyFilter(lqr, plant, lambda x, t: 0.55**2 - x[:, 0].square(), dt=0.02)
    (said,) = [record.getMessage() for record in caplog.records]
    assert "constraint 0 drives the rest of the plant away, at 4.43 1/s" in said  # sqrt(g / l)
    assert math.sqrt(9.81 / 0.5) == pytest.approx(4.43, abs=5e-3)
    assert "`AvoidanceCost` with `RecedingHorizon`" in said
    run = adp.simulate(guard, plant, cost, x0, steps=150, compile=True)
    bare = adp.simulate(adp.Feedback(lqr), plant, cost, x0, dt=0.02, steps=150, compile=True)
    report, far, alone = guard.report(run), *(each.state[:, :, 0].abs().amax(1) for each in (run, bare))
    torch.testing.assert_close(run.state[:2], bare.state[:2], rtol=0, atol=1e-9)
    assert bool((far[:2] < 0.55).all())
    assert report["infeasible"] == [2, 3]
    assert set(report["astray"]) >= {2, 3}
    assert bool((far[2:] < alone[2:]).all())  # less of a violation than the policy's, and upright
    assert float(run.state[:, -1].abs().max()) < 0.3

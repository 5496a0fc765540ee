"""Control barrier functions of a held control: the program, where the filter acts, what it keeps."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from helpers import tensor, uniform
from torch import Tensor

from staf_torch import adp, systems

LINE = systems.Linear([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])
PLANE = systems.Linear(
    np.kron([[0.0, 1.0], [0.0, 0.0]], np.eye(2)).tolist(), np.kron([[0.0], [1.0]], np.eye(2)).tolist()
)
COST = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
COST4 = adp.QuadraticCost(1.0, 1.0, dim=4, inputs=2)


def wall(x: Tensor, t: Tensor) -> Tensor:
    return x[:, 0] + 0.1


def disc(x: Tensor, t: Tensor) -> Tensor:
    return (x[:, 0] - 1).square() + x[:, 1].square() - 0.25


def passing(x: Tensor, t: Tensor) -> Tensor:
    """A disc that moves, and is not there before 0.2 s."""
    return torch.where(t < 0.2, 10.0, (x[:, 0] - 0.5 * t).square() + (x[:, 1] - 0.8).square() - 0.09)


def test_far_from_the_edge_not_a_bit_changes_and_rows_are_alone() -> None:
    guard = adp.SafetyFilter(lambda x: -x[..., 2:], PLANE, [disc, passing], dt=0.02)
    x, u = uniform(24, 4, seed=1, low=-2.0, high=2.0), uniform(24, 2, seed=2, low=-0.9, high=0.9)
    t = uniform(24, low=0.0, high=2.0, seed=3)
    found = guard.restrain(x, u, t)
    far = (found.margin > 2.5).all(-1)
    assert 3 < int(far.sum()) < 21
    assert torch.equal(found.control[far], u[far])
    assert bool((found.control[~far] != u[~far]).any())
    alone = guard.restrain(x[23:], u[23:], t[23:])
    assert all(torch.equal(a[0], b[23]) for a, b in zip(alone, found, strict=True))
    assert torch.equal(found.margin, guard.margins(x, t))


def test_policies_of_all_kinds_stand_behind_it() -> None:
    x0 = tensor([[1.0, -0.3], [0.4, 0.0]])
    learner = adp.ActorCritic(adp.QuadraticBasis(2), LINE, COST, adp.RandomPoints(1, half_width=0.5))
    near = adp.near_optimal(LINE, COST, dt=0.05, low=-2.0, high=2.0)
    for policy in (
        adp.RolloutPolicy.of_lqr(LINE, COST),
        near,
        learner,
        adp.Supervised(learner, adp.LQR(LINE, COST), COST),
    ):
        guard = adp.SafetyFilter(policy, LINE, wall, dt=0.05)
        run = adp.simulate(guard, LINE, COST, x0, steps=2, compile=False)
        assert not bool(run.diverged.any())
        assert guard.report(run)["minimum_margin"] > 0
    with pytest.raises(ValueError, match="must be a function of x alone"):
        adp.SafetyFilter(learner, LINE, wall, dt=0.05)(x0)
    with pytest.raises(ValueError, match=r"must be that of the loop, 0\.1 s; got 0\.05"):
        adp.simulate(guard, LINE, COST, x0, dt=0.1, steps=1)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (
            {"plant": systems.StepPlant(lambda x, u: x + u, dim=1, inputs=1, dt=0.1)},
            "must be in continuous time",
        ),
        ({"constraints": []}, r"must be h\(x, t\) or a list of them"),
        (
            {"constraints": lambda x, t: x},
            r"number 0 `h\(x, t\)` must map rows \(7, 2\) to \(7,\), .*; got \(7, 2\)",
        ),
        ({"constraints": lambda x, t: 1 + 0 * x[:, 0]}, "neither first nor second derivative of number 0"),
        ({"decay": [200.0]}, r"must be at most 1/dt = 100 where the relative degree is two; got"),
        ({"decay": [1.0, 2.0]}, "must be one number or a list of 1"),
        ({"weight": [1.0, 1.0]}, "must be one number or a list of 1"),
        ({"degree": [1, 3]}, r"`SafetyFilter\(degree=...\)` must be 1 or 2, one a constraint"),
    ],
)
def test_what_breaks_a_rule_is_refused(given: dict[str, object], message: str) -> None:
    usual: dict[str, object] = {"policy": lambda x: x, "plant": LINE, "constraints": wall, "dt": 0.01}
    with pytest.raises(ValueError, match=message):
        adp.SafetyFilter(**{**usual, **given})  # type: ignore[arg-type]


def test_a_condition_that_no_control_moves_leaves_a_finite_slack_and_the_others_kept() -> None:
    still = systems.Linear([[0.0, 0.0], [0.0, 0.0]], [[0.0], [1.0]])  # x1 moves by nothing
    walls = [lambda x, t: 0.5 - x[:, 0], lambda x, t: 0.4 - x[:, 1]]
    guard = adp.SafetyFilter(lambda x: torch.ones_like(x[..., :1]), still, walls, dt=0.1, decay=1.0, degree=1)
    x = tensor([[0.7, 0.39], [0.2, 0.39], [0.7, 0.0]])
    u, margin, slack, _ = guard.restrain(x, torch.ones(3, 1).double())
    assert bool(torch.isfinite(slack).all())
    torch.testing.assert_close(margin, torch.stack((0.5 - x[:, 0], 0.4 - x[:, 1]), dim=-1))
    assert float((0.4 - x[:, 1] - 0.1 * u[:, 0] - 0.9 * (0.4 - x[:, 1])).min()) > -1e-9


# What is asked of a control, beside the same written out -------------------------------------------------


def stiff(x: Tensor, u: Tensor) -> Tensor:
    """A rate that bends within a hold, and of which the input moves the second state alone."""
    return torch.stack(
        (x[..., 1] - 0.3 * x[..., 0] ** 3, 4 * x[..., 0].sin() - x[..., 1] + 2 * u[..., 0]), -1
    )


PLANT = systems.RatePlant(stiff, dim=2, inputs=1)


def near(x: Tensor, t: Tensor) -> Tensor:
    """Of degree two, and moving."""
    return 0.8 - x[:, 0] - 0.2 * x[:, 0] ** 2 + 0.1 * (3 * t).sin()


def slow(x: Tensor, t: Tensor) -> Tensor:
    """Of degree one, and moving."""
    return 1.5 - x[:, 1] + 0.2 * x[:, 0] ** 2 - 0.3 * t


def advanced(x: Tensor, u: Tensor, hold: float) -> Tensor:
    """Classical Runge-Kutta, once."""
    a = stiff(x, u)
    b = stiff(x + hold / 2 * a, u)
    c = stiff(x + hold / 2 * b, u)
    d = stiff(x + hold * c, u)
    return x + hold * (a / 6 + b / 3 + c / 3 + d / 6)


def level(h: Any, degree: int, decay: float, margin: float, x: Tensor, t: Tensor) -> Tensor:
    """phi: h less the margin, or its rate at rest and decay times that."""
    if degree == 1:
        return h(x, t) - margin
    x, t = x.detach().requires_grad_(), t.detach().requires_grad_()
    value = h(x, t)
    along_x, along_t = torch.autograd.grad(value.sum(), (x, t))
    rate = (along_x * stiff(x, torch.zeros_like(x[:, :1]))).sum(-1) + along_t
    return (rate + decay * (value - margin)).detach()


def missing(given: dict[str, Any], x: Tensor, u: Tensor, t: Tensor, hold: float) -> Tensor:
    """By how much a held control misses what is asked at its end."""
    middle = advanced(x, u, hold / 2)
    end = advanced(middle, u, hold / 2)
    now, half, last = (
        level(x=at, t=t + later, **given) for at, later in ((x, 0.0), (middle, hold / 2), (end, hold))
    )
    dip = ((now + last) / 2 - half).clamp(min=0)
    missed = dip + math.exp(-given["decay"] * hold) * (now - dip) - last
    if given["degree"] == 1:
        return missed
    # Nearer and faster than decay allows: the deceleration that stops at the edge, less a thousandth.
    value, rate = level(given["h"], 1, 0.0, given["margin"], x, t), level(given["h"], 2, 0.0, 0.0, x, t)
    after = level(given["h"], 2, 0.0, 0.0, end, t + hold)
    room = 0.999 * torch.maximum(value, 1e-3 * hold * rate.abs())
    asked = torch.where(value > 0, rate + hold * rate.square() / (2 * room), 0.0)
    return torch.where((now < 0) & (rate < 0), torch.maximum(missed, asked - after), missed)


@pytest.mark.parametrize(("h", "degree", "margin"), [(near, 2, 0.3), (slow, 1, 0.2)])
def test_the_control_is_the_nearest_that_meets_the_condition_written_out(
    h: Any, degree: int, margin: float
) -> None:
    hold, decay = 0.12, 3.0
    given = {"h": h, "degree": degree, "decay": decay, "margin": margin}
    guard = adp.SafetyFilter(lambda x: x[..., :1], PLANT, h, dt=hold, decay=decay, margin=margin)
    assert guard.degree == (degree,)
    assert guard.moving
    x, t = uniform(60, 2, seed=1), uniform(60, low=0.0, high=2.0, seed=2)
    wanted = 3 + uniform(60, 1, seed=3)
    found = guard.restrain(x, wanted, t)
    asked = missing(given, x, wanted, t, hold)
    assert torch.equal((found.control != wanted)[:, 0], asked > 0)
    assert 10 < int((asked > 0).sum()) < 55
    low, high = wanted - 60, wanted.clone()  # one is safe, the other is not
    for _ in range(60):
        middle = (low + high) / 2
        safe = (missing(given, x, middle, t, hold) <= 0).unsqueeze(-1)
        low, high = torch.where(safe, middle, low), torch.where(safe, high, middle)
    nearest = torch.where((asked > 0).unsqueeze(-1), low, wanted)
    torch.testing.assert_close(found.control, nearest, rtol=2e-5, atol=2e-5)
    torch.testing.assert_close(found.margin[:, 0], h(x, t))
    outside = found.margin[:, 0] < 0
    assert float(found.slack[~outside].max()) < 1e-6
    assert bool((found.slack[outside] > 1e-6).all())


def test_the_slack_is_how_much_further_a_control_would_have_to_reach() -> None:
    def fast(x: Tensor, t: Tensor) -> Tensor:
        return 0.5 - x[:, 1]

    for weight in (1.0, 4.0):
        guard = adp.SafetyFilter(
            lambda x: x[..., :1], LINE, fast, dt=0.1, decay=2.0, low=-1.0, high=1.0, weight=[weight]
        )
        x = tensor([[0.0, 0.45], [0.0, 0.9], [0.0, 0.0]])
        found = guard.restrain(x, tensor([[1.0], [1.0], [1.0]]))
        # x2 + 0.1 u <= 0.5 - e^-0.2 (0.5 - x2)
        most = (0.5 - math.exp(-0.2) * (0.5 - x[:, 1]) - x[:, 1]) / 0.1
        torch.testing.assert_close(found.control[:, 0], most.clamp(-1, 1))
        slack = (-1 - most).clamp(min=0) * weight**0.5
        slack[1] = 0.4 / 0.1 * weight**0.5  # outside now, however well it comes back
        torch.testing.assert_close(found.slack, slack, rtol=1e-9, atol=1e-12)


def test_rows_of_any_dimensions_are_rows_with_a_time_of_their_own() -> None:
    guard = adp.SafetyFilter(lambda x: 3 + x[..., :1], PLANT, [near, slow], dt=0.1, decay=[2.0, 5.0])
    x, t = uniform(12, 2, seed=4), uniform(12, low=0.0, high=2.0, seed=5)
    flat, margins = guard.restrain(x, 3 + x[:, :1], t), guard.margins(x, t)
    assert flat.control.shape == (12, 1)
    torch.testing.assert_close(margins, torch.stack((near(x, t), slow(x, t)), dim=-1))
    deep, at = x.reshape(3, 2, 2, 2), t.reshape(3, 2, 2)
    found = guard.restrain(deep, 3 + deep[..., :1], at)
    assert [part.shape[3:] for part in found[:3]] == [(1,), (2,), ()]
    for one, other in zip(found, flat, strict=True):
        torch.testing.assert_close(one.reshape(other.shape), other, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(guard.margins(deep, at).reshape(12, 2), margins)
    torch.testing.assert_close(guard(deep, at), found.control)
    torch.testing.assert_close(guard(x[3], float(t[3])), flat.control[3])
    assert guard.margins(x[3], float(t[3])).shape == (2,)
    with pytest.raises(ValueError, match=r"`SafetyFilter\(u=...\)`"):
        guard.restrain(x, x, 0.0)


def test_a_report_is_that_of_every_step_of_the_loop() -> None:
    def rising(x: Tensor, t: Tensor) -> Tensor:
        return 0.6 - x[:, 0] + 0.1 * t

    given: dict[str, Any] = {"dt": 0.1, "decay": 3.0, "low": -1.0, "high": 1.0}
    want = lambda x: 2 - x[..., :1] - x[..., 1:]  # noqa: E731
    guard = adp.SafetyFilter(want, LINE, [rising, lambda x, t: 1.5 - x[:, 1]], **given)
    x0 = tensor([[0.0, 0.0], [0.3, 1.4], [0.5, 1.6], [-1.0, 0.2], [-9.0, 0.0]])
    run = adp.simulate(guard, LINE, COST, x0, steps=2, every=2, compile=False)
    report = guard.report(run)
    x, least, most, acted = x0, [], [], 0
    for k in range(2):
        t = torch.full((5,), 0.1 * k, dtype=torch.float64)
        found = guard.restrain(x, want(x), t)
        least.append(torch.minimum(rising(x, t), 1.5 - x[:, 1]))
        most.append(found.slack)
        acted += int((found.control != want(x).clamp(-1, 1)).sum())
        x = x + 0.1 * torch.cat((x[:, 1:] + 0.05 * found.control, found.control), dim=-1)
    torch.testing.assert_close(x, run.state[:, -1], rtol=1e-9, atol=1e-9)
    least.append(torch.minimum(rising(x, tensor(0.2)), 1.5 - x[:, 1]))
    smallest, largest = torch.stack(least).amin(0), torch.stack(most).amax(0)
    assert report["minimum_margin"] == pytest.approx(float(smallest.min()), abs=1e-9)
    assert report["constraint_violations"] == int((smallest < 0).sum())
    assert report["infeasible"] == (largest > 1e-6).nonzero().flatten().tolist()
    assert report["largest_slack"] == pytest.approx(float(largest.max()), rel=1e-6)
    assert report["acted"] == pytest.approx(acted / 10)
    assert 0 < report["constraint_violations"] < 5
    assert 0 < len(report["infeasible"]) < 5
    assert 0 < acted < 10


def test_a_filter_behind_a_filter_is_a_policy_like_any_other() -> None:
    inner = adp.SafetyFilter(adp.LQR(LINE, COST), LINE, lambda x, t: x[:, 0] + 9.0, dt=0.05)
    outer = adp.SafetyFilter(inner, LINE, wall, dt=0.05)
    alone = adp.SafetyFilter(adp.LQR(LINE, COST), LINE, wall, dt=0.05)
    x0 = tensor([[1.0, -1.0], [0.2, -0.5]])
    run, other = (adp.simulate(guard, LINE, COST, x0, steps=2, compile=False) for guard in (outer, alone))
    assert torch.equal(run.state, other.state)
    assert outer.report(run) == alone.report(other)


def test_degrees_may_be_stated_for_all_or_each() -> None:
    both = [lambda x, t: 1 - x[:, 0], lambda x, t: 1 - x[:, 1]]
    for degree, found in ((1, (1, 1)), ([2, 1], (2, 1)), ([1, 2], (1, 2))):
        assert adp.SafetyFilter(lambda x: x[..., :1], LINE, both, dt=0.1, degree=degree).degree == found


@pytest.mark.parametrize("begin", [0.05, 50.0])
def test_what_depends_on_the_time_is_found_whenever_it_begins_to(begin: float) -> None:
    guard = adp.SafetyFilter(
        lambda x: x[..., :1], LINE, lambda x, t: 1 - x[:, 1] + (t - begin).clamp(min=0), dt=0.1
    )
    assert guard.moving
    assert not adp.SafetyFilter(lambda x: x[..., :1], LINE, lambda x, t: 1 - x[:, 1] + 0 * t, dt=0.1).moving


@pytest.mark.parametrize(
    ("stated", "most"), [({}, 0.3), ({"low": -0.2, "high": 0.2}, 0.2), ({"low": -1.0}, 5.0)]
)
def test_bounds_of_the_plant_hold_where_the_filter_states_none(stated: dict[str, float], most: float) -> None:
    plant = systems.Linear([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])
    plant.bounds = systems.Bounds(-0.3, 0.3, 1)
    shield = adp.SafetyFilter(lambda x: 5.0 + 0 * x[..., :1], plant, wall, dt=0.01, **stated)
    assert shield(tensor([[1.0, 0.0]])).tolist() == [[most]]


def test_a_constraint_that_is_not_a_number_somewhere_says_so(caplog: pytest.LogCaptureFixture) -> None:
    plant = systems.Linear([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])
    lqr = adp.LQR(plant, adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1))
    walls = [lambda x, t: x[:, 0] + 0.5, lambda x, t: (x[:, 0] + 0.5).sqrt()]
    adp.SafetyFilter(lqr, plant, walls[:1], dt=0.01, low=-3.0, high=3.0)
    assert "NaN" not in caplog.text
    adp.SafetyFilter(lqr, plant, walls, dt=0.01, low=-3.0, high=3.0)
    assert "constraint 1 is NaN at some of the states" in caplog.text

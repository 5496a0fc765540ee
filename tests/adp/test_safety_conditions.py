"""What a safety filter asks of a control, beside the same written out, and what it says of a loop."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import pytest
import torch
from helpers import tensor, uniform
from torch import Tensor

from staf_torch import adp, systems

COST = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
LINE = systems.Linear([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])


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
    return dip + math.exp(-given["decay"] * hold) * (now - dip) - last


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
    assert float(found.slack.max()) < 1e-6
    # The line at a control has the slope of phi at the end, and its value.
    normal, least, h_now = guard.inequalities(x, wanted, t)
    ends = []
    for other in (wanted - 1e-4, wanted + 1e-4):
        end = advanced(advanced(x, other, hold / 2), other, hold / 2)
        ends.append(level(h, degree, decay, margin, end, t + hold))
    torch.testing.assert_close(normal[:, 0, 0] * hold, (ends[1] - ends[0]) / 2e-4, rtol=1e-5, atol=1e-6)
    off = least[:, 0] - normal[:, 0, 0] * wanted[:, 0]
    torch.testing.assert_close(off, asked / hold, rtol=1e-9, atol=1e-9)
    assert torch.equal(h_now[:, 0], found.margin[:, 0])


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
        torch.testing.assert_close(found.slack, (-1 - most).clamp(min=0) * weight**0.5, rtol=1e-9, atol=1e-12)


def test_rows_of_any_dimensions_are_rows_with_a_time_of_their_own() -> None:
    guard = adp.SafetyFilter(lambda x: 3 + x[..., :1], PLANT, [near, slow], dt=0.1, decay=[2.0, 5.0])
    x, t = uniform(12, 2, seed=4), uniform(12, low=0.0, high=2.0, seed=5)
    flat, margins = guard.restrain(x, 3 + x[:, :1], t), guard.margins(x, t)
    assert flat.control.shape == (12, 1)
    torch.testing.assert_close(margins, torch.stack((near(x, t), slow(x, t)), dim=-1))
    for shape in ((3, 2, 2), (4, 3)):
        deep, at = x.reshape(*shape, 2), t.reshape(shape)
        found = guard.restrain(deep, 3 + deep[..., :1], at)
        assert found.control.shape == (*shape, 1)
        assert found.margin.shape == (*shape, 2)
        assert found.slack.shape == shape
        for one, other in zip(found, flat, strict=True):
            torch.testing.assert_close(one.reshape(other.shape), other, rtol=1e-12, atol=1e-12)
        torch.testing.assert_close(guard.margins(deep, at).reshape(12, 2), margins)
        torch.testing.assert_close(guard(deep, at), found.control)
    torch.testing.assert_close(guard(x[3], float(t[3])), flat.control[3])
    torch.testing.assert_close(guard.margins(x, 0.0), guard.margins(x))
    assert guard.margins(x[3], float(t[3])).shape == (2,)
    for wrong in ({"x": x[:, :1]}, {"u": x}):
        with pytest.raises(ValueError, match=rf"`SafetyFilter\({next(iter(wrong))}=...\)`"):
            guard.restrain(**{"x": x, "u": x[:, :1], "t": 0.0} | wrong)


class Counted(adp.SafetyFilter):
    """How often its conditions are made straight."""

    count = 0

    def inequalities(self, x: Tensor, u: Tensor, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        self.count += 1
        return super().inequalities(x, u, t)


@pytest.mark.parametrize(("state", "count"), [([0.0, -3.0], 0), ([0.0, 0.49], 2)])
def test_a_condition_that_is_a_line_is_made_straight_twice_and_none_that_is_met(
    state: list[float], count: int
) -> None:
    guard = Counted(lambda x: x[..., :1], LINE, lambda x, t: 0.5 - x[:, 1], dt=0.1)
    guard._definition(tensor([[*state, 0.5, 0.0]]))
    assert guard.count == count
    guard._definition(tensor([[0.0, 0.5, 0.0, 0.0]]))  # what is met exactly is met
    assert guard.count == count


def test_a_condition_that_is_never_met_is_made_straight_eight_times() -> None:
    guard = Counted(lambda x: x[..., :1], LINE, lambda x, t: 0.5 - x[:, 0], dt=0.1, low=-1.0, high=1.0)
    found = guard._definition(tensor([[0.4, 9.0, 0.5, 0.0]]))
    assert guard.count == 8
    assert float(found[0, 0]) == -1.0


def test_a_report_is_that_of_every_step_of_the_loop() -> None:
    def rising(x: Tensor, t: Tensor) -> Tensor:
        return 0.6 - x[:, 0] + 0.1 * t

    given: dict[str, Any] = {"dt": 0.1, "decay": 3.0, "low": -1.0, "high": 1.0}
    want = lambda x: 2 - x[..., :1] - x[..., 1:]  # noqa: E731
    guard = adp.SafetyFilter(want, LINE, [rising, lambda x, t: 1.5 - x[:, 1]], **given)
    x0 = tensor([[0.0, 0.0], [0.3, 1.4], [0.5, 1.6], [-1.0, 0.2], [-9.0, 0.0]])
    run = adp.simulate(guard, LINE, COST, x0, steps=4, every=2, compile=False)
    report = guard.report(run)
    x, least, most, acted = x0, [], [], 0
    for k in range(4):
        t = torch.full((5,), 0.1 * k, dtype=torch.float64)
        found = guard.restrain(x, want(x), t)
        least.append(torch.minimum(rising(x, t), 1.5 - x[:, 1]))
        most.append(found.slack)
        acted += int((found.control != want(x).clamp(-1, 1)).sum())
        x = x + 0.1 * torch.cat((x[:, 1:] + 0.05 * found.control, found.control), dim=-1)
    torch.testing.assert_close(x, run.state[:, -1], rtol=1e-9, atol=1e-9)
    least.append(torch.minimum(rising(x, tensor(0.4)), 1.5 - x[:, 1]))
    smallest, largest = torch.stack(least).amin(0), torch.stack(most).amax(0)
    assert report["minimum_margin"] == pytest.approx(float(smallest.min()), abs=1e-9)
    assert report["constraint_violations"] == int((smallest < 0).sum())
    assert report["infeasible"] == (largest > 1e-6).nonzero().flatten().tolist()
    assert report["largest_slack"] == pytest.approx(float(largest.max()), rel=1e-6)
    assert report["acted"] == pytest.approx(acted / 20)
    assert 0 < report["constraint_violations"] < 5
    assert 0 < len(report["infeasible"]) < 5
    assert 0 < acted < 20


def test_a_millionth_of_slack_is_rounding_and_more_is_none() -> None:
    guard = adp.SafetyFilter(lambda x: x[..., :1], LINE, lambda x, t: x[:, 0], dt=0.1)
    run = adp.simulate(guard, LINE, COST, tensor([[1.0, 0.0]] * 3), steps=1, compile=False)
    record = run.identifier.clone()
    record[:, -1, -2] = tensor([1e-6, 1.1e-6, 1.9e-6])
    assert guard.report(dataclasses.replace(run, identifier=record))["infeasible"] == [1, 2]


def test_the_last_state_counts_too() -> None:
    guard = adp.SafetyFilter(
        lambda x: 0 * x[..., :1], LINE, lambda x, t: 1 - x[:, 0] - t, dt=0.1, low=-1e-9, high=1e-9
    )
    run = adp.simulate(guard, LINE, COST, tensor([[0.85, 0.0]]), steps=2, compile=False)
    report = guard.report(run)
    assert report["minimum_margin"] == pytest.approx(-0.05)
    assert report["constraint_violations"] == 1


def test_what_stands_behind_it_has_its_own_columns_and_value() -> None:
    learner = adp.ActorCritic(adp.QuadraticBasis(2), LINE, COST, adp.RandomPoints(1, half_width=0.5))
    inner = adp.SafetyFilter(adp.LQR(LINE, COST), LINE, lambda x, t: x[:, 0] + 9.0, dt=0.05)
    outer = adp.SafetyFilter(inner, LINE, lambda x, t: x[:, 0] + 0.1, dt=0.05)
    x0 = tensor([[1.0, -1.0], [0.2, -0.5]])
    run = adp.simulate(outer, LINE, COST, x0, steps=3, compile=False)
    assert run.identifier.shape[-1] == 8
    alone = adp.SafetyFilter(adp.LQR(LINE, COST), LINE, lambda x, t: x[:, 0] + 0.1, dt=0.05)
    other = adp.simulate(alone, LINE, COST, x0, steps=3, compile=False)
    assert torch.equal(run.state, other.state)
    assert outer.report(run) == alone.report(other)
    assert run.identifier[:, -1, 0].tolist() == [3.0, 3.0]  # steps that the inner one counts
    guard = adp.SafetyFilter(learner, LINE, lambda x, t: x[:, 0] + 0.1, dt=0.05)
    assert guard.draws == learner.draws
    carried = guard.init(x0)
    assert carried.identifier[:, -4:].tolist() == [[0.0, math.inf, 0.0, 0.0]] * 2
    value = learner.value(x0, learner.init(x0))
    assert value is not None
    torch.testing.assert_close(guard.value(x0, carried), value)
    assert guard.label == f"filtered {learner.label}"
    assert guard.period == guard.hold == 0.05


def test_a_decay_of_one_over_the_hold_is_taken_and_more_where_the_degree_is_one() -> None:
    adp.SafetyFilter(lambda x: x[..., :1], LINE, lambda x, t: x[:, 0], dt=0.125, decay=8.0)
    adp.SafetyFilter(lambda x: x[..., :1], LINE, lambda x, t: x[:, 1], dt=0.125, decay=80.0)
    both = [lambda x, t: x[:, 0], lambda x, t: x[:, 1]]
    assert adp.SafetyFilter(lambda x: x[..., :1], LINE, both, dt=0.125, decay=[8.0, 80.0]).degree == (2, 1)
    with pytest.raises(ValueError, match="must be at most 1/dt = 8 where"):
        adp.SafetyFilter(lambda x: x[..., :1], LINE, both, dt=0.125, decay=[8.1, 1.0])


def test_degrees_may_be_stated_for_all_or_each() -> None:
    both = [lambda x, t: 1 - x[:, 0], lambda x, t: 1 - x[:, 1]]
    for degree, found in ((1, (1, 1)), ([2, 1], (2, 1)), ([1, 2], (1, 2)), ((2, 2), (2, 2))):
        assert adp.SafetyFilter(lambda x: x[..., :1], LINE, both, dt=0.1, degree=degree).degree == found
    for wrong in (0, 3, [1], [1, 2, 1], [1, 3], []):
        with pytest.raises(
            ValueError, match=r"`SafetyFilter\(degree=...\)` must be 1 or 2, one a constraint"
        ):
            adp.SafetyFilter(lambda x: x[..., :1], LINE, both, dt=0.1, degree=wrong)
    third = systems.Linear([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0] * 3], [[0.0], [0.0], [1.0]])
    with pytest.raises(ValueError, match="neither first nor second derivative of number 1, at 160 states"):
        adp.SafetyFilter(lambda x: x[..., :1], third, [lambda x, t: x[:, 2], lambda x, t: x[:, 0]], dt=0.1)


@pytest.mark.parametrize("begin", [0.05, 0.5, 5.0, 50.0])
def test_what_depends_on_the_time_is_found_whenever_it_begins_to(begin: float) -> None:
    guard = adp.SafetyFilter(
        lambda x: x[..., :1], LINE, lambda x, t: 1 - x[:, 1] + (t - begin).clamp(min=0), dt=0.1
    )
    assert guard.moving
    assert not adp.SafetyFilter(lambda x: x[..., :1], LINE, lambda x, t: 1 - x[:, 1] + 0 * t, dt=0.1).moving


def test_bounds_of_the_plant_and_own_ones_and_none() -> None:
    plant = systems.Linear([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])
    free = adp.SafetyFilter(lambda x: x[..., :1], plant, lambda x, t: x[:, 1], dt=0.1)
    assert free.bounds.low.tolist() == [-math.inf]
    plant.bounds = systems.Bounds(-2.0, 3.0, 1)
    assert adp.SafetyFilter(lambda x: x[..., :1], plant, lambda x, t: x[:, 1], dt=0.1).bounds is plant.bounds
    one = adp.SafetyFilter(lambda x: x[..., :1], plant, lambda x, t: x[:, 1], dt=0.1, low=-1.0)
    assert (one.bounds.low.tolist(), one.bounds.high.tolist()) == ([-1.0], [math.inf])

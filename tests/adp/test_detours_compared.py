"""Detours beside rollouts that are written out, and the starts and rounds of plans that improve them."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from helpers import tensor, uniform
from torch import Tensor

from staf_torch import adp, systems
from staf_torch.adp.detours import _changes

PLANE = systems.Linear(torch.eye(4).roll(2, dims=1).triu().tolist(), torch.eye(4)[:, 2:].tolist())
COST = adp.QuadraticCost(1.0, 0.5, dim=4, inputs=2, low=[-1.0, -0.8], high=[0.9, 1.0])
LQR = adp.LQR(PLANE, COST, period=0.1)
HOLD = 0.1


def crossing(x: Tensor, t: Tensor) -> Tensor:
    return (x[:, 0] - 1.0).square() + (x[:, 1] + 0.5 - 0.3 * t).square() - 0.16


def above(x: Tensor, t: Tensor) -> Tensor:
    return x[:, 1] + 0.6 - 0.1 * t


AXES = [[1.0, 0.0, 0.0, 0.0], [0.5, 2.0, 0.0, 0.0]]


def ways(kind: type[adp.DetourRollout] = adp.DetourRollout, **given: Any) -> adp.DetourRollout:
    usual = {"axes": AXES, "dt": HOLD, "steps": 8, "stride": 2, "terminal": LQR.value, "weight": 50.0}
    usual |= {"margin": [0.02, 0.3], "sizes": [0.4, 1.0], "lengths": [3, 6]}
    return kind(LQR, PLANE, COST, [crossing, above], **(usual | given))


def paid(x: Tensor, u: Tensor, time: float) -> tuple[Tensor, Tensor]:
    """The next state of a mass and what a control costs over so long, of one row."""
    rates, slopes, at = [], [], x
    for share in (0.0, 0.5, 0.5, 1.0):
        at = x + share * time * slopes[-1] if slopes else x
        slopes.append(torch.cat((at[2:], u)))
        rates.append(at @ at + 0.5 * u @ u)
    step, rate = (part[0] + 2 * part[1] + 2 * part[2] + part[3] for part in (slopes, rates))
    return x + time / 6 * step, time / 6 * rate


def total(x: Tensor, detour: Tensor, done: float, stride: int = 2, steps: int = 8) -> tuple[Tensor, Tensor]:
    """J of one row and one detour without what is missing, and that."""
    spent, missing = torch.zeros(()).double(), torch.zeros(()).double()
    s = detour[:2] @ tensor(AXES)
    for k in range(0, steps, stride):
        u = COST.bounds.clip(LQR((x - s if k < float(detour[2]) else x)[None]))[0]
        x, cost = paid(x, u, stride * HOLD)
        t = tensor((done + k + stride) * HOLD)
        short = [(margin - h(x[None], t)[0]).clamp(min=0) for h, margin in ((crossing, 0.02), (above, 0.3))]
        spent, missing = spent + cost, missing + stride * HOLD * sum(short)
    return spent + LQR.value(x), missing


STATES = tensor([[1.9, 0.0, 0.0, 0.0], [1.4, -0.5, -0.8, 0.2], [0.9, 0.6, 0.3, -1.2], [-1.0, 1.5, 0.1, 0.3]])
BEFORE = tensor([[0.3, -0.2, 2.0], [0.0, 0.5, 4.0], [0.0, 0.0, 0.0], [-0.4, 0.1, 5.0]])
DONE = tensor([[0.0], [3.0], [5.0], [11.0]])


@pytest.mark.parametrize("stride", [1, 2])
def test_what_a_detour_costs_and_misses_is_that_of_a_rollout_written_out(stride: int) -> None:
    ahead = ways(stride=stride)
    tried = torch.cat(
        (torch.zeros(4, 1, 3).double(), BEFORE.unsqueeze(1), ahead.fresh[:6].expand(4, -1, -1)), 1
    )
    spent, missing = ahead._paid(STATES.unsqueeze(1).expand(-1, 8, -1), tried, DONE)
    assert spent.shape == missing.shape == (4, 8)
    for row in range(4):
        for k in range(8):
            cost, short = total(STATES[row], tried[row, k], float(DONE[row]), stride)
            assert float(spent[row, k]) == pytest.approx(float(cost), rel=1e-9)
            assert float(missing[row, k]) == pytest.approx(float(short), rel=1e-9, abs=1e-12)
    assert 4 < int((missing > 0).sum()) < 32


def test_the_cheapest_of_all_candidates_is_taken() -> None:
    ahead = ways()
    found = ahead.cheapest(STATES, BEFORE, DONE)
    kinds = set()
    for row in range(4):
        tried = [torch.zeros(3).double(), *(BEFORE[row] + _changes(2)), *ahead.fresh]
        costs = [
            sum(c * w for c, w in zip(total(STATES[row], one, float(DONE[row])), (1, 50.0), strict=True))
            for one in tried
        ]
        best = min(range(len(tried)), key=lambda k: float(costs[k]))
        torch.testing.assert_close(found[row], tried[best])
        kinds.add((best > 0) + (best > 9))
    assert len(kinds) > 1


def test_changes_are_none_and_two_sizes_along_each_axis() -> None:
    for count in (1, 2, 3):
        found = _changes(count)
        assert found.dtype == torch.float64
        assert found.shape == (1 + 4 * count, count + 1)
        wanted = [[0.0] * (count + 1)]
        for size in (0.2, -0.2, 0.07, -0.07):
            wanted += [[size * (k == axis) for k in range(count)] + [0.0] for axis in range(count)]
        torch.testing.assert_close(found, tensor(wanted))


class Fixed(adp.DetourRollout):
    """Whose choice is that of the test."""

    chosen = tensor([[0.1, 0.1, 7.0], [0.3, -0.2, 2.0], [0.5, 0.1, 1.0], [0.1, 0.1, 7.0]])

    def cheapest(self, x: Tensor, before: Tensor, done: Tensor) -> Tensor:
        assert torch.equal(before, BEFORE)
        assert torch.equal(done, DONE)
        return self.chosen


def test_a_step_applies_the_choice_where_something_is_in_its_way_and_shortens_it() -> None:
    ahead = ways(Fixed)
    carried = ahead.init(STATES)
    assert carried.identifier.tolist() == [[0.0] * 4] * 4
    known = torch.cat((BEFORE, DONE), dim=-1)
    u, after = ahead.step(STATES, carried._replace(identifier=known), STATES, HOLD)
    _, missing = ahead._paid(STATES.unsqueeze(1), torch.zeros(4, 1, 3).double(), DONE)
    assert (missing[:, 0] > 0).tolist() == [False, True, True, False]
    wanted = COST.bounds.clip(LQR(STATES - Fixed.chosen[:, :2] @ tensor(AXES)))
    torch.testing.assert_close(u[1:3], wanted[1:3])
    assert torch.equal(u[[0, 3]], COST.bounds.clip(LQR(STATES))[[0, 3]])
    assert after.identifier[:, 2].tolist() == [0.0, 1.0, 0.0, 0.0]
    torch.testing.assert_close(after.identifier[1:3, :2], Fixed.chosen[1:3, :2])
    assert not bool(after.identifier[[0, 3], :2].any())
    torch.testing.assert_close(after.identifier[:, 3:], DONE + 1)
    deep = ahead._definition(torch.cat((STATES, known), dim=-1).unflatten(0, (2, 2)))
    torch.testing.assert_close(deep.flatten(0, 1)[:, :2], u)
    assert [part.shape for part in carried[:3]] == [(4, 0), (4, 0), (4, 0, 0)]


def test_along_a_detour_the_goal_is_elsewhere_until_its_length_is_over() -> None:
    ahead, tried = ways(), tensor([[0.3, -0.2, 2.0]]).repeat(4, 1)
    s = tensor([0.3, -0.2]) @ tensor(AXES)
    for k, moved in ((0.0, True), (1.0, True), (2.0, False), (3.0, False)):
        found = ahead.control_along(STATES, tried, torch.full((4,), k).double())
        torch.testing.assert_close(found, COST.bounds.clip(LQR(STATES - s if moved else STATES)))
    free = adp.DetourRollout(
        *(LQR, PLANE, adp.QuadraticCost(1.0, 1.0, dim=4, inputs=2), crossing),
        **{"axes": AXES, "dt": HOLD, "steps": 2, "terminal": LQR.value},
    )
    found = free.control_along(9 * STATES, 0 * tried, torch.zeros(4).double())
    assert torch.equal(found, LQR(9 * STATES))


def test_of_costs_that_are_no_numbers_none_is_the_least() -> None:
    start, none = tensor([[1.9, -0.1, 0.0, 0.0]]), torch.zeros(1, 1, 3).double()
    ends: list[Tensor] = []

    def ended(x: Tensor) -> Tensor:
        ends.append(x)
        return LQR.value(x)

    ways(terminal=ended)._paid(start.unsqueeze(1), none, none[:, 0, :1])
    least = float(ends[0][0, 0, 0]) + 1e-3  # the policy comes a little nearer

    def far(x: Tensor) -> Tensor:
        return torch.where(x[..., 0] < least, torch.nan, LQR.value(x))

    ahead = ways(terminal=far)
    found = ahead.cheapest(start, none[:, 0], none[:, 0, :1])
    cost, _ = ahead._paid(start.unsqueeze(1), found.unsqueeze(1), none[:, 0, :1])
    assert bool(torch.isfinite(cost).all())
    assert bool(found.any())
    none = ways(terminal=lambda x: torch.nan * x[..., 0]).cheapest(STATES, BEFORE, DONE)
    assert not bool(none.any())  # the policy itself


def test_four_axes_and_a_horizon_of_one_period_are_enough() -> None:
    ahead = ways(axes=torch.eye(4).tolist(), steps=1, stride=1, lengths=[1])
    assert ahead.fresh.shape == (2 * 80, 5)
    assert ahead.axes.dtype == torch.float64
    assert (ahead.hold, ahead.period, ahead.steps, ahead.stride) == (HOLD, HOLD, 1, 1)
    for wrong in (
        {"axes": [1.0] * 4},
        {"axes": [[1.0] * 3]},
        {"axes": []},
        {"axes": [[1.0, 0.0, 0.0, torch.inf]]},
    ):
        with pytest.raises(ValueError, match=r"`DetourRollout\(axes=...\)` must be 1 to 4 rows of 4 finite"):
            ways(**wrong)
    for wrong in ({"constraints": [crossing, 1.0]}, {"plant": LQR}):
        given: dict[str, Any] = {"policy": LQR, "plant": PLANE, "cost": COST, "constraints": crossing} | wrong
        with pytest.raises(ValueError, match=rf"`DetourRollout\({next(iter(wrong))}=...\)` must be"):
            adp.DetourRollout(**given, axes=AXES, dt=HOLD, steps=2, terminal=LQR.value)


def plans(**given: Any) -> adp.DetourPlans:
    return adp.DetourPlans(ways(steps=4, stride=1, lengths=[2]), **given)


def test_first_plans_are_those_of_every_detour_and_of_shares_of_the_bounds_held() -> None:
    made = plans()
    starts = made._starts(STATES)
    fresh = len(made.detours.fresh)
    assert starts.shape == (1 + fresh + 3 * 2 * 9, 4, 4, 2)
    for number, detour in (
        (0, torch.zeros(3).double()),
        (1, made.detours.fresh[0]),
        (fresh, made.detours.fresh[-1]),
    ):
        for row in range(4):
            x = STATES[row]
            for k in range(4):
                u = made.detours.control_along(x[None], detour[None], tensor([float(k)]))[0]
                torch.testing.assert_close(starts[number, row, k], u)
                x = made._problem._advance(x[None], u[None])[0]
    held = starts[1 + fresh :]
    kinds = set()
    for one in held:
        assert bool((one == one[:1, :1]).all())  # of 4 periods all are held: five at least
        kinds.add(tuple(round(each, 9) for each in one[0, 0].tolist()))
    sides = [(0.0, -1.0, 0.9), (0.0, -0.8, 1.0)]
    assert kinds == {
        (round(share * a, 9), round(share * b, 9)) for share in (0.3, 1.0) for a in sides[0] for b in sides[1]
    }
    longer = adp.DetourPlans(ways(steps=20, stride=1, lengths=[2]))._starts(STATES[:1])[1 + fresh :, 0]
    policy = adp.DetourPlans(ways(steps=20, stride=1, lengths=[2]))._starts(STATES[:1])[0, 0]
    for number, length in ((0, 5), (17, 5), (18, 15), (35, 15), (36, 20)):
        assert bool((longer[number, :length] == longer[number, :1]).all())
        assert torch.equal(longer[number, length:], policy[length:])


def test_a_loop_begins_with_the_cheapest_of_the_plans_after_so_many_rounds() -> None:
    made, calls = plans(first=3), []
    starts = made._starts(STATES)
    count = len(starts)
    cost = uniform(count, 4, seed=1)
    cost[5, 0], cost[7, 1], cost[9, 2], cost[11, 3] = torch.nan, torch.inf, -7.0, -8.0

    def begun(z: Tensor) -> Tensor:
        calls.append(z)
        return torch.cat((cost.reshape(-1, 1), z[:, 4:] + 1), dim=-1)

    made._begun = begun  # type: ignore[assignment]
    known = made.init(STATES).identifier
    assert len(calls) == 3
    assert torch.equal(calls[0][:, :4], STATES.repeat(count, 1))
    assert torch.equal(calls[0][:, 4:], starts.flatten(0, 1).flatten(1))
    torch.testing.assert_close(calls[2][:, 4:], calls[0][:, 4:] + 2)
    best = torch.where(cost.isfinite(), cost, torch.inf).argmin(0)
    assert best[2:].tolist() == [9, 11]
    for row in range(4):
        torch.testing.assert_close(known[row, :8], starts[best[row], row].flatten() + 3)
    assert known[:, 8:].tolist() == [[torch.inf, 0.0]] * 4


@pytest.mark.parametrize(("share", "rounds"), [(1.03, 1), (1 / 1.018, 1), (1 / 1.022, 3)])
def test_a_way_is_left_where_it_costs_two_hundredths_more_than_expected(share: float, rounds: int) -> None:
    """Nothing is improved here: what is carried is the policy's own way, and no other one is looked for."""
    made, improved, looked = plans(iterations=2), [], []
    problem, x, done = made._problem, STATES[3:], torch.zeros(1, 1).double()
    control = made._starts(x)[0].flatten(1)
    way = control.unflatten(-1, (4, 2))
    cost = problem.follow(x, problem.others(x), done, way, lambda y, others, u, k: u).total

    def counted(now: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        improved.append(now)
        return now

    def asked(x: Tensor, before: Tensor, done: Tensor) -> Tensor:
        looked.append(before)
        return torch.zeros_like(before)

    problem.improve, made.detours.cheapest = counted, asked  # type: ignore[method-assign]
    others, plan = made._kept(x, control, share * cost, done)
    assert len(improved) == 2 * rounds
    assert [each.tolist() for each in looked] == [[[0.0] * 3]] * (rounds > 1)
    assert torch.equal(others, problem.others(x))
    assert torch.equal(plan.control, way)
    assert torch.equal(plan.total, cost)


def test_settings_of_plans_are_those_that_are_given() -> None:
    made = plans(moved=4, iterations=1, first=1, weight=3.0)
    assert (made.moved, made.iterations, made.first, made.weight) == (4, 1, 1, 3.0)
    assert (made.period, made.hold, made.steps) == (HOLD, HOLD, 4)
    assert plans().moved == 4
    state = made.init(STATES)
    assert [part.shape for part in state[:3]] == [(4, 0), (4, 0), (4, 0, 0)]
    four = systems.Linear((-torch.eye(4)).tolist(), torch.eye(4).tolist())
    wide = adp.QuadraticCost(1.0, 1.0, dim=4, inputs=4)
    policy = adp.LQR(four, wide)
    given: dict[str, Any] = {"axes": AXES, "dt": HOLD, "steps": 2, "terminal": policy.value}
    assert adp.DetourPlans(adp.DetourRollout(policy, four, wide, crossing, **given)).plant.inputs == 4
    five = systems.Linear((-torch.eye(4)).tolist(), torch.eye(4, 5).tolist())
    wider = adp.QuadraticCost(1.0, 1.0, dim=4, inputs=5)
    policy = adp.LQR(five, wider)
    with pytest.raises(ValueError, match="must have a QuadraticCost without discount and 4 inputs at most"):
        adp.DetourPlans(adp.DetourRollout(policy, five, wider, crossing, **given))

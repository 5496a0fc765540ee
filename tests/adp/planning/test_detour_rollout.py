"""Detours around what moves: the policy where nothing is in its way, else the cheapest way that is found."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from helpers import tensor
from torch import Tensor

from staf_torch import adp, systems
from staf_torch.adp.planning.obstacles import Detour

PLANE = systems.Linear(torch.eye(4).roll(2, dims=1).triu().tolist(), torch.eye(4)[:, 2:].tolist())
COST = adp.QuadraticCost(1.0, 1.0, dim=4, inputs=2, low=-1.0, high=1.0)
LQR = adp.LQR(PLANE, COST, period=0.1)
BESIDE = torch.tensor([[2.0, 0.0, 0.0, 0.0]], dtype=torch.float64)


def crossing(x: Tensor, t: Tensor) -> Tensor:
    """A disc that comes from below and goes the way on which the LQR would give way."""
    return (x[:, 0] - 1.0).square() + (x[:, 1] + 0.5 - 0.3 * t).square() - 0.16


def usual(**given: object) -> adp.DetourRollout:
    settings = {"axes": torch.eye(2, 4), "dt": 0.1, "steps": 20, "stride": 2, "terminal": LQR.value}
    settings |= {"margin": 0.02, "sizes": [0.4, 1.0], "lengths": [4, 12]}
    return adp.DetourRollout(LQR, PLANE, COST, crossing, **{**settings, **given})  # type: ignore[arg-type]


def test_where_nothing_is_in_its_way_the_policy_is_applied_bit_for_bit() -> None:
    ahead, x = usual(), torch.tensor([[-2.0, 1.0, 0.3, 0.2], [-0.5, 2.0, 0.0, 0.1]], dtype=torch.float64)
    u, after = ahead.step(x, ahead.init(x), x, 0.1)
    assert torch.equal(u, LQR(x))
    assert (after.way.tolist(), after.done.tolist()) == ([[0.0] * 3] * 2, [[1.0]] * 2)


@pytest.mark.compiled
def test_a_detour_is_cheaper_than_giving_way_at_the_last_moment() -> None:
    bounds = {"dt": 0.1, "low": -1.0, "high": 1.0, "decay": 3.0}
    costs = []
    for policy in (LQR, usual(sizes=[1.0], lengths=[12])):
        guard = adp.SafetyFilter(policy, PLANE, crossing, **bounds)  # type: ignore[arg-type]
        run = adp.simulate(guard, PLANE, COST, BESIDE, steps=30, compile=True)
        assert guard.report(run)["constraint_violations"] == 0
        if policy is not LQR:
            defined = adp.simulate(guard, PLANE, COST, BESIDE, steps=2, compile=False)
            torch.testing.assert_close(run.state[:, :3], defined.state, rtol=1e-9, atol=1e-9)
        costs.append(float(run.cost + LQR.value(run.state[:, -1])))
    assert costs[1] < 0.99 * costs[0]


@pytest.mark.parametrize(
    ("given", "rule"),
    [
        ({"axes": torch.eye(5, 4)}, r"`DetourRollout\(axes=...\)` must be 1 to 4 rows of 4 finite numbers"),
        ({"steps": 3}, r"`DetourRollout\(steps=...\)` must be a multiple of stride=2"),
        ({"margin": [0.1, 0.2]}, r"`DetourRollout\(margin=...\)` must be one number or a list of 1"),
    ],
)
def test_arguments_that_break_their_rule_are_named(given: dict[str, object], rule: str) -> None:
    with pytest.raises(ValueError, match=rule):
        usual(**given)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_detours_lead_to_all_sides_and_are_varied_along_each_axis(count: int) -> None:
    ahead = usual(axes=torch.eye(count, 4), sizes=[0.5, 2.0], lengths=[3, 8])
    found = ahead.fresh
    assert len(found) == 4 * (3**count - 1)
    assert sorted(found[:, -1].unique().tolist()) == [3, 8]
    assert sorted({round(size, 9) for size in found[:, :-1].norm(dim=-1).tolist()}) == [0.5, 2.0]
    ways = {tuple(row) for row in found.mul(1e6).round().tolist()}
    assert len(ways) == len(found)  # none twice
    assert {(*(-x for x in way[:-1]), way[-1]) for way in ways} == ways  # each with its opposite
    changes = {tuple(row) for row in ahead.changes.mul(1e6).round().tolist()}
    assert len(changes) == len(ahead.changes) == 1 + 4 * count
    assert {tuple(-x for x in way) for way in changes} == changes
    assert not bool(ahead.changes[:, -1].any())  # a length stays


# Beside rollouts that are written out ---------------------------------------------------------------------


CHEAP = adp.QuadraticCost(1.0, 0.5, dim=4, inputs=2, low=[-1.0, -0.8], high=[0.9, 1.0])


def above(x: Tensor, t: Tensor) -> Tensor:
    return x[:, 1] + 0.6 - 0.1 * t


AXES = [[1.0, 0.0, 0.0, 0.0], [0.5, 2.0, 0.0, 0.0]]


def ways(**given: Any) -> adp.DetourRollout:
    usual = {"axes": AXES, "dt": 0.1, "steps": 8, "stride": 2, "terminal": LQR.value, "weight": 50.0}
    usual |= {"margin": [0.02, 0.3], "sizes": [0.4, 1.0], "lengths": [3, 6]}
    return adp.DetourRollout(LQR, PLANE, CHEAP, [crossing, above], **(usual | given))


def paid(x: Tensor, u: Tensor, time: float) -> tuple[Tensor, Tensor]:
    """The next state of a mass and what a control costs over so long, of one row."""
    rates, slopes, at = [], [], x
    for share in (0.0, 0.5, 0.5, 1.0):
        at = x + share * time * slopes[-1] if slopes else x
        slopes.append(torch.cat((at[2:], u)))
        rates.append(at @ at + 0.5 * u @ u)
    step, rate = (part[0] + 2 * part[1] + 2 * part[2] + part[3] for part in (slopes, rates))
    return x + time / 6 * step, time / 6 * rate


def total(x: Tensor, detour: Tensor, done: float) -> tuple[Tensor, Tensor]:
    """J of one row and one detour without what is missing, and that."""
    spent, missing = torch.zeros(()).double(), torch.zeros(()).double()
    s = detour[:2] @ tensor(AXES)
    for k in range(0, 8, 2):
        u = CHEAP.bounds.clip(LQR((x - s if k < float(detour[2]) else x)[None]))[0]
        x, cost = paid(x, u, 0.2)
        t = tensor((done + k + 2) * 0.1)
        short = [(margin - h(x[None], t)[0]).clamp(min=0) for h, margin in ((crossing, 0.02), (above, 0.3))]
        spent, missing = spent + cost, missing + 0.2 * sum(short)
    return spent + LQR.value(x), missing


STATES = tensor([[1.9, 0.0, 0.0, 0.0], [1.4, -0.5, -0.8, 0.2], [0.9, 0.6, 0.3, -1.2], [-1.0, 1.5, 0.1, 0.3]])
BEFORE = tensor([[0.3, -0.2, 2.0], [0.0, 0.5, 4.0], [0.0, 0.0, 0.0], [-0.4, 0.1, 5.0]])
DONE = tensor([[0.0], [3.0], [5.0], [11.0]])


def test_the_cheapest_of_all_candidates_is_taken_and_followed_a_period() -> None:
    ahead, kinds = ways(), set()
    found = ahead.cheapest(STATES, BEFORE, DONE)
    u, after = ahead.step(STATES, Detour(BEFORE, DONE), STATES, 0.1)
    for row in range(4):
        tried = torch.cat((torch.zeros(1, 3).double(), BEFORE[row] + ahead.changes, ahead.fresh))
        parts = [total(STATES[row], one, float(DONE[row])) for one in tried]
        best = min(range(len(tried)), key=lambda k, parts=parts: float(parts[k][0] + 50 * parts[k][1]))
        torch.testing.assert_close(found[row], tried[best])
        kinds.add((best > 0) + (best > 9))
        chosen = tried[best] if float(parts[0][1]) > 0 else tried[0]  # the policy where it misses nothing
        s = chosen[:2] @ tensor(AXES) if float(chosen[2]) > 0 else torch.zeros(4).double()
        torch.testing.assert_close(u[row], CHEAP.bounds.clip(LQR(STATES[row] - s)))
        left = max(float(chosen[2]) - 1, 0.0)
        wanted = torch.cat((chosen[:2], tensor([left, float(DONE[row]) + 1])))
        torch.testing.assert_close(torch.cat(after, dim=-1)[row], wanted)
    assert len(kinds) >= 2
    alone = torch.cat(
        [ahead.cheapest(*(part[k : k + 1] for part in (STATES, BEFORE, DONE))) for k in range(4)]
    )
    assert torch.equal(found, alone)


def test_of_costs_that_are_no_numbers_none_is_the_least() -> None:
    none = ways(terminal=lambda x: torch.nan * x[..., 0]).cheapest(STATES, BEFORE, DONE)
    assert not bool(none.any())  # the policy itself
    some = ways(terminal=lambda x: torch.where(x[..., 1] > 0.3, torch.nan, LQR.value(x)))
    assert bool(some.cheapest(STATES, BEFORE, DONE).isfinite().all())

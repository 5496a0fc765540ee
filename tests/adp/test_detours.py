"""Detours around what moves: the policy where nothing is in its way, else the cheapest way that is found."""

from __future__ import annotations

import pickle

import pytest
import torch
from torch import Tensor

from staf_torch import adp, systems
from staf_torch.adp.detours import _detours

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
    assert torch.equal(after.identifier, torch.tensor([[0.0, 0.0, 0.0, 1.0]] * 2).double())


@pytest.mark.compiled
def test_a_detour_is_cheaper_than_giving_way_at_the_last_moment() -> None:
    bounds = {"dt": 0.1, "low": -1.0, "high": 1.0, "decay": 3.0}
    costs = []
    for policy in (LQR, usual(sizes=[1.0], lengths=[12])):
        guard = adp.SafetyFilter(policy, PLANE, crossing, **bounds)  # type: ignore[arg-type]
        run = adp.simulate(guard, PLANE, COST, BESIDE, steps=30, compile=policy is not LQR)
        assert guard.report(run)["constraint_violations"] == 0
        if policy is not LQR:
            defined = adp.simulate(guard, PLANE, COST, BESIDE, steps=2, compile=False)
            torch.testing.assert_close(run.state[:, :3], defined.state, rtol=1e-9, atol=1e-9)
        costs.append(float(run.cost + LQR.value(run.state[:, -1])))
    assert costs[1] < 0.99 * costs[0]


def test_a_detour_is_carried_on_and_becomes_shorter() -> None:
    ahead = usual(sizes=[0.5], lengths=[9])
    x, carried = torch.tensor([[1.6, -0.3, -0.8, 0.0]], dtype=torch.float64), ahead.init(BESIDE)
    u, carried = ahead.step(x, carried, x, 0.1)
    s, left = carried.identifier[:, :2], float(carried.identifier[0, 2])
    assert left == 8
    away = torch.cat((s, torch.zeros_like(s)), dim=-1)
    torch.testing.assert_close(u, LQR(x - away))


def test_rows_do_not_see_each_other() -> None:
    ahead, many = usual(steps=8), 2 * torch.randn(6, 4, dtype=torch.float64)
    carried = ahead.init(many)
    u, after = ahead.step(many, carried, many, 0.1)
    for k in range(len(many)):
        one, its = ahead.step(many[k : k + 1], ahead.init(many[k : k + 1]), many, 0.1)
        torch.testing.assert_close(one, u[k : k + 1], rtol=1e-12, atol=1e-12)
        torch.testing.assert_close(its.identifier, after.identifier[k : k + 1])


def test_it_can_be_pickled() -> None:
    ahead = adp.DetourRollout(
        LQR, PLANE, COST, adp_wall, axes=torch.eye(2, 4), dt=0.1, steps=4, terminal=LQR.value
    )
    again = pickle.loads(pickle.dumps(ahead))
    assert torch.equal(again.step(BESIDE, again.init(BESIDE), BESIDE, 0.1)[0], LQR(BESIDE))


def adp_wall(x: Tensor, t: Tensor) -> Tensor:
    return x[:, 0] + 9.0


@pytest.mark.parametrize(
    ("given", "rule"),
    [
        ({"axes": torch.eye(5, 4)}, r"`DetourRollout\(axes=...\)` must be 1 to 4 rows of 4 finite numbers"),
        ({"axes": [[torch.nan] * 4]}, r"`DetourRollout\(axes=...\)` must be 1 to 4 rows"),
        ({"steps": 3}, r"`DetourRollout\(steps=...\)` must be a multiple of stride=2"),
        ({"stride": 0}, r"`DetourRollout\(stride=...\)`"),
        ({"dt": 0.0}, r"`DetourRollout\(dt=...\)` must be positive"),
        ({"margin": [0.1, 0.2]}, r"`DetourRollout\(margin=...\)` must be one number or a list of 1"),
        ({"margin": -0.1}, r"`DetourRollout\(margin=...\)` must not be negative"),
        ({"weight": 0.0}, r"`DetourRollout\(weight=...\)` must be positive"),
        ({"sizes": [0.0]}, r"`DetourRollout\(sizes=...\)` must be positive"),
        ({"lengths": [0]}, r"`DetourRollout\(lengths=...\)`"),
    ],
)
def test_arguments_that_break_their_rule_are_named(given: dict[str, object], rule: str) -> None:
    with pytest.raises(ValueError, match=rule):
        usual(**given)


def test_constraints_plant_and_period_are_checked() -> None:
    more = {"axes": torch.eye(2, 4), "dt": 0.1, "steps": 4, "terminal": LQR.value}
    with pytest.raises(ValueError, match="constraints"):
        adp.DetourRollout(LQR, PLANE, COST, [], **more)  # type: ignore[arg-type]
    stepped = systems.StepPlant(
        lambda x, u: x + torch.cat((u, u), dim=-1), dim=4, inputs=2, dt=0.1, equilibrium=torch.zeros(4)
    )
    with pytest.raises(ValueError, match="plant"):
        adp.DetourRollout(LQR, stepped, COST, crossing, **more)  # type: ignore[arg-type]
    ahead = usual()
    with pytest.raises(ValueError, match=r"`DetourRollout\(dt=...\)` must be that of the loop"):
        ahead.step(BESIDE, ahead.init(BESIDE), BESIDE, 0.2)


def test_the_cheapest_detour_of_a_row_is_that_of_the_row_alone() -> None:
    ahead = usual(steps=8)
    x = BESIDE + torch.tensor([[-0.4, -0.3, -0.8, 0.0], [3.0, 2.0, 0.0, 0.0], [-0.2, 0.1, -0.9, 0.1]])
    before, done = torch.zeros(3, 3).double(), torch.zeros(3, 1).double()
    found = ahead.cheapest(x, before, done)
    alone = torch.cat([ahead.cheapest(x[k : k + 1], before[:1], done[:1]) for k in range(3)])
    assert torch.equal(found, alone)
    assert 0 < int((found[:, 2] > 0).sum()) < 3


@pytest.mark.parametrize("count", [1, 2, 3])
def test_detours_lead_to_all_sides(count: int) -> None:
    found = _detours(count, torch.tensor([0.5, 2.0]).double(), [3, 8])
    assert len(found) == 4 * (3**count - 1)
    assert sorted(found[:, -1].unique().tolist()) == [3, 8]
    assert sorted({round(size, 9) for size in found[:, :-1].norm(dim=-1).tolist()}) == [0.5, 2.0]
    ways = {tuple(row) for row in found.mul(1e6).round().tolist()}
    assert len(ways) == len(found)  # none twice
    assert {(*(-x for x in way[:-1]), way[-1]) for way in ways} == ways  # each with its opposite

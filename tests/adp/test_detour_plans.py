"""Plans around what moves: every control free, improved as the loop runs."""

from __future__ import annotations

import pickle
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from staf_torch import adp, systems

PLANE = systems.Linear(torch.eye(4).roll(2, dims=1).triu().tolist(), torch.eye(4)[:, 2:].tolist())
COST = adp.QuadraticCost(1.0, 1.0, dim=4, inputs=2, low=-1.0, high=1.0)
LQR = adp.LQR(PLANE, COST, period=0.2)
BESIDE = torch.tensor([[2.0, 0.1, 0.0, 0.0]], dtype=torch.float64)
AWAY = torch.tensor([[-1.0, 0.5, 0.2, 0.1], [0.6, -0.4, 0.0, 0.3]], dtype=torch.float64)


def disc(x: Tensor, t: Tensor) -> Tensor:
    """A disc on the way to the origin, that moves."""
    return (x[:, 0] - 1.0).square() + (x[:, 1] + 0.1 - 0.05 * t).square() - 0.16


class Wide(systems.ControlAffineSystem):
    """A mass in the plane, and a point that moves up at 5 cm/s and asks nobody."""

    dim, inputs = 6, 2

    def drift(self, x: Tensor) -> Tensor:
        still = torch.zeros_like(x[..., :2])
        return torch.cat((x[..., 2:4], still, still + 0.05 * x.new_tensor([0.0, 1.0]) * x[..., 4:5]), dim=-1)

    def effectiveness(self, x: Tensor) -> Tensor:
        return torch.eye(6, dtype=x.dtype)[:, 2:4].expand(*x.shape[:-1], 6, 2)


def detours(constraint: Callable[[Tensor, Tensor], Tensor] = disc, **given: object) -> adp.DetourRollout:
    settings = {"axes": torch.eye(2, 4), "dt": 0.2, "steps": 12, "terminal": LQR.value, "margin": 0.02}
    settings |= {"sizes": [0.6], "lengths": [5]}
    return adp.DetourRollout(LQR, PLANE, COST, constraint, **{**settings, **given})  # type: ignore[arg-type]


def test_where_nothing_is_in_its_way_and_no_bound_is_met_the_plan_is_the_lqr() -> None:
    plans, x = adp.DetourPlans(detours(steps=8), first=2), AWAY
    u, after = plans.step(x, plans.init(x), x, 0.2)
    # J counts a period by its beginning, the LQR of 0.2 s by the integral.
    torch.testing.assert_close(u, LQR(x), rtol=0.3, atol=0.05)
    ahead = after.identifier[:, :-2].unflatten(-1, (8, 2))
    torch.testing.assert_close(after.identifier[:, -1], torch.ones(2).double())
    moved = plans._problem._advance(x, u)
    torch.testing.assert_close(plans.step(moved, after, x, 0.2)[0], ahead[:, 0], rtol=0.02, atol=0.01)


def test_an_angle_counts_the_shorter_way_around() -> None:
    plant = systems.RatePlant(
        lambda x, u: torch.stack((x[..., 1], x[..., 0].sin() + u[..., 0]), -1),
        dim=2,
        inputs=1,
        periodic=[0],
    )
    cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1, low=-2.0, high=2.0)
    lqr = adp.LQR(plant, cost, period=0.1)
    ahead = adp.DetourRollout(
        *(lqr, plant, cost, lambda x, t: 9.0 + 0 * t + x[:, 1].square()),
        axes=[[0.0, 1.0]],
        dt=0.1,
        steps=6,
        terminal=lqr.value,
    )
    plans = adp.DetourPlans(ahead, first=3)
    x = torch.tensor([[0.4, 0.1], [-0.7, 0.3]], dtype=torch.float64)
    turned = x + 2 * torch.pi * torch.tensor([[1.0, 0.0], [-2.0, 0.0]], dtype=torch.float64)
    u, after = plans.step(x, plans.init(x), x, 0.1)
    other, same = plans.step(turned, plans.init(turned), x, 0.1)
    torch.testing.assert_close(other, u, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(same.identifier, after.identifier, rtol=1e-6, atol=1e-6)


def test_no_change_of_a_plan_lowers_what_it_costs() -> None:
    plans = adp.DetourPlans(detours(margin=0.0, steps=6), first=6)
    best = plans.init(BESIDE).identifier[:, :-2]
    found = plans._improved(BESIDE, best, torch.zeros(1, 1).double(), 1)[-1]
    others = best + 1e-3 * torch.randn(40, best.shape[1], generator=torch.Generator().manual_seed(1)).double()
    others = COST.bounds.clip(others.unflatten(-1, (6, 2))).flatten(1)
    x, still = BESIDE.expand(40, -1), torch.zeros(40, 1).double()
    tried = plans._problem.follow(
        x, plans._problem.others(x), still, others.unflatten(-1, (6, 2)), lambda y, o, u, k: u
    )
    assert bool((tried.total > found).all())


@pytest.mark.compiled
@pytest.mark.needs_compiler
def test_a_plan_leads_around_and_is_compiled_as_it_is_defined(caplog: pytest.LogCaptureFixture) -> None:
    # A point whose speed is the control: a program of half the size.
    point = systems.Linear(torch.zeros(2, 2).tolist(), torch.eye(2).tolist())
    cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=2, low=-1.0, high=1.0)
    lqr = adp.LQR(point, cost, period=0.2)
    given = {"axes": torch.eye(2), "steps": 4, "margin": 0.02, "sizes": [0.6], "lengths": [5]}
    ways = adp.DetourRollout(lqr, point, cost, disc, dt=0.2, terminal=lqr.value, **given)  # type: ignore[arg-type]
    plans, x0 = adp.DetourPlans(ways, first=1), BESIDE[:, :2]
    guard = adp.SafetyFilter(plans, point, disc, dt=0.2, low=-1.0, high=1.0, decay=3.0)
    defined = adp.simulate(guard, point, cost, x0, steps=2, compile=False)
    compiled = adp.simulate(guard, point, cost, x0, steps=24, compile=True)
    torch.testing.assert_close(compiled.state[:, :3], defined.state, rtol=1e-9, atol=1e-9)
    assert all("is compiled, once" in record.getMessage() for record in caplog.records)  # and not refused
    assert guard.report(compiled)["constraint_violations"] == 0
    assert float(compiled.state[0, -1].norm()) < 0.1


def test_states_that_no_input_moves_may_be_left_out_of_a_step() -> None:
    """A disc whose place is a state, not a function of time: the same plan, of four states or of six."""

    def near(x: Tensor, t: Tensor) -> Tensor:
        return (x[:, :2] - x[:, 4:]).square().sum(-1) - 0.16

    wide = Wide()
    cost = adp.QuadraticCost(1.0, 1.0, dim=6, inputs=2, low=-1.0, high=1.0, output=lambda x: x[..., :4])
    given = {"axes": torch.eye(2, 6), "dt": 0.2, "steps": 4, "sizes": [0.6], "lengths": [3]}
    ways = adp.DetourRollout(
        lambda x: LQR(x[..., :4]), wide, cost, near, terminal=lambda x: LQR.value(x[..., :4]), **given
    )
    x = torch.tensor([[1.7, 0.1, -0.5, 0.0, 1.0, -0.1]], dtype=torch.float64)
    one, other = adp.DetourPlans(ways, first=1), adp.DetourPlans(ways, first=1, moved=4)
    controls = [plans.step(x, plans.init(x), x, 0.2)[0] for plans in (one, other)]
    torch.testing.assert_close(*controls, rtol=1e-9, atol=1e-9)
    with pytest.raises(ValueError, match=r"`DetourPlans\(moved=...\)` must count every state"):
        adp.DetourPlans(ways, moved=3)


def test_rows_do_not_see_each_other_and_it_can_be_pickled() -> None:
    plans = pickle.loads(pickle.dumps(adp.DetourPlans(_picklable(), first=1)))
    u, after = plans.step(AWAY, plans.init(AWAY), AWAY, 0.2)
    for k in range(2):
        one, its = plans.step(AWAY[k : k + 1], plans.init(AWAY[k : k + 1]), AWAY, 0.2)
        torch.testing.assert_close(one, u[k : k + 1], rtol=1e-10, atol=1e-10)
        torch.testing.assert_close(its.identifier, after.identifier[k : k + 1], rtol=1e-10, atol=1e-10)


def _picklable() -> adp.DetourRollout:
    return detours(steps=3)


@pytest.mark.parametrize(
    ("given", "rule"),
    [
        ({"moved": 5}, r"`DetourPlans\(moved=...\)` must be at most the 4 states"),
        ({"moved": 0}, r"`DetourPlans\(moved=...\)`"),
        ({"iterations": 0}, r"`DetourPlans\(iterations=...\)`"),
        ({"first": 0}, r"`DetourPlans\(first=...\)`"),
        ({"weight": 0.0}, r"`DetourPlans\(weight=...\)` must be positive"),
    ],
)
def test_arguments_that_break_their_rule_are_named(given: dict[str, object], rule: str) -> None:
    with pytest.raises(ValueError, match=rule):
        adp.DetourPlans(detours(), **given)  # type: ignore[arg-type]


def test_the_cost_and_the_period_are_checked() -> None:
    fading = adp.QuadraticCost(1.0, 1.0, dim=4, inputs=2, discount=0.1)
    ways = adp.DetourRollout(
        LQR, PLANE, fading, disc, axes=torch.eye(2, 4), dt=0.2, steps=4, terminal=LQR.value
    )
    with pytest.raises(ValueError, match="must have a QuadraticCost without discount"):
        adp.DetourPlans(ways)
    plans = adp.DetourPlans(detours(steps=4), first=1)
    with pytest.raises(ValueError, match=r"`DetourPlans\(dt=...\)` must be that of the loop"):
        plans.step(BESIDE, plans.init(BESIDE), BESIDE, 0.1)


def test_a_plan_that_costs_more_than_expected_is_left_for_another_way() -> None:
    """A disc that was not there when the plan was made, and a carried plan that is worth nothing."""

    def appearing(x: Tensor, t: Tensor) -> Tensor:
        return torch.where(t < 0.1, 10.0, (x[:, 0] - 1.0).square() + (x[:, 1] + 0.1).square() - 0.16)

    plans = adp.DetourPlans(detours(appearing, steps=7, lengths=[3]), first=2)
    x = BESIDE
    carried = plans.init(x).identifier
    idle = torch.zeros(1, 14).double()
    done = torch.ones(1, 1).double()
    for control, expected, other in (
        (idle, 1.0, True),
        (idle, 1e9, False),
        (carried[:, :-2], torch.inf, False),
    ):
        level = torch.full((1,), expected, dtype=torch.float64)
        alone = plans._improved(x, control, done, plans.iterations)[-1]
        found = plans._kept(x, control, level, done)[1].total
        assert bool(found < alone) is other
        assert bool(found <= alone)
    # Where nothing is in its way a plan costs what was expected of it, so that no other is looked for.
    free = adp.DetourPlans(detours(steps=4), first=2)
    u, after = free.step(AWAY, free.init(AWAY), AWAY, 0.2)
    ahead, given = free._problem._advance(AWAY, u), after.identifier[:, :-2].unflatten(-1, (4, 2))
    others, later = free._problem.others(ahead), after.identifier[:, -1:]
    total = free._problem.follow(ahead, others, later, given, lambda y, others, u, k: u).total
    torch.testing.assert_close(total, after.identifier[:, -2], rtol=1e-9, atol=1e-12)


def test_a_plan_is_kept_where_no_other_way_is_cheaper_however_little_was_expected() -> None:
    """A plan that was improved twelve times, and a detour that is improved once."""
    plans = adp.DetourPlans(detours(steps=7), first=12, iterations=1)
    control, none = plans.init(BESIDE).identifier[:, :-2], torch.zeros(1, 1).double()
    alone = plans._improved(BESIDE, control, none, 1)[-1]
    found = plans._kept(BESIDE, control, torch.full((1,), 1e-9, dtype=torch.float64), none)[1].total
    torch.testing.assert_close(found, alone, rtol=1e-12, atol=0)


def test_what_a_period_cost_is_taken_off_at_the_time_of_that_period() -> None:
    """What is in the way from .3 to .5 s, everywhere, costs the third period, and none of those after it."""

    def passing(x: Tensor, t: Tensor) -> Tensor:
        return torch.where((t > 0.3) & (t < 0.5), -0.05, 10.0) + 0.0 * x[:, 0]

    plans = adp.DetourPlans(detours(passing, steps=4, lengths=[3], margin=0.0), first=1)
    problem, begun = plans._problem, plans.init(AWAY)
    known = torch.cat((begun.identifier[:, :-1], torch.full((2, 1), 2.0, dtype=torch.float64)), dim=-1)
    found = plans._definition(torch.cat((AWAY, known), dim=-1))
    u, given, expected, done = found.split((2, 8, 1, 1), dim=-1)
    assert problem.penalty(AWAY, torch.full((2,), 0.4, dtype=torch.float64)).min() > 1
    ahead = problem._advance(AWAY, u)
    plan = problem.follow(
        ahead, problem.others(ahead), done, given.unflatten(-1, (4, 2)), lambda y, others, u, k: u
    )
    torch.testing.assert_close(plan.total, expected[:, 0], rtol=1e-9, atol=1e-9)

"""Plans around what moves: every control free, improved as the loop runs."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from helpers import changed, tensor, uniform
from torch import Tensor

from staf_torch import adp, systems
from staf_torch.adp.planning.detour_ddp import CarriedPlan, PlanProblem

PLANE = systems.Linear(torch.eye(4).roll(2, dims=1).triu().tolist(), torch.eye(4)[:, 2:].tolist())
COST = adp.QuadraticCost(1.0, 1.0, dim=4, inputs=2, low=-1.0, high=1.0)
LQR = adp.LQR(PLANE, COST, period=0.2)
BESIDE = torch.tensor([[2.0, 0.1, 0.0, 0.0]], dtype=torch.float64)
AWAY = torch.tensor([[-1.0, 0.5, 0.2, 0.1], [0.6, -0.4, 0.0, 0.3]], dtype=torch.float64)


def disc(x: Tensor, t: Tensor) -> Tensor:
    """A disc on the way to the origin, that moves."""
    return (x[:, 0] - 1.0).square() + (x[:, 1] + 0.1 - 0.05 * t).square() - 0.16


def detours(constraint: Callable[[Tensor, Tensor], Tensor] = disc, **given: object) -> adp.DetourRollout:
    settings = {"axes": torch.eye(2, 4), "dt": 0.2, "steps": 12, "terminal": LQR.value, "margin": 0.02}
    settings |= {"sizes": [0.6], "lengths": [5]}
    return adp.DetourRollout(LQR, PLANE, COST, constraint, **{**settings, **given})  # type: ignore[arg-type]


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
    assert not caplog.records  # and not refused
    assert guard.report(compiled)["constraint_violations"] == 0
    assert float(compiled.state[0, -1].norm()) < 0.1


def test_rows_do_not_see_each_other() -> None:
    plans = adp.DetourPlans(detours(steps=3), first=1)
    u, after = plans.step(AWAY, plans.init(AWAY), AWAY, 0.2)
    for k in range(2):
        one, its = plans.step(AWAY[k : k + 1], plans.init(AWAY[k : k + 1]), AWAY, 0.2)
        torch.testing.assert_close(one, u[k : k + 1], rtol=1e-10, atol=1e-10)
        torch.testing.assert_close(
            its, CarriedPlan(*(part[k : k + 1] for part in after)), rtol=1e-10, atol=1e-10
        )


@pytest.mark.parametrize(
    ("given", "rule"),
    [
        ({"moved": 5}, r"`DetourPlans\(moved=...\)` must be at most the 4 states"),
        ({"moved": 2}, r"`DetourPlans\(moved=...\)` must count every state"),
        ({"iterations": 0}, r"`DetourPlans\(iterations=...\)`"),
        ({"first": 0}, r"`DetourPlans\(first=...\)`"),
        ({"weight": 0.0}, r"`DetourPlans\(weight=...\)` must be positive"),
    ],
)
def test_arguments_that_break_their_rule_are_named(given: dict[str, object], rule: str) -> None:
    with pytest.raises(ValueError, match=rule):
        adp.DetourPlans(detours(), **given)  # type: ignore[arg-type]


def test_a_discount_and_another_period_are_refused() -> None:
    fading = adp.QuadraticCost(1.0, 1.0, dim=4, inputs=2, discount=0.1)
    given = {"axes": torch.eye(2, 4), "dt": 0.2, "steps": 4, "terminal": LQR.value}
    ways = adp.DetourRollout(LQR, PLANE, fading, disc, **given)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="must have a QuadraticCost without discount"):
        adp.DetourPlans(ways)
    plans = adp.DetourPlans(detours(steps=4), first=1)
    for each in (plans, plans.detours):
        with pytest.raises(ValueError, match=r"\(dt=...\)` must be that of the loop"):
            each.step(BESIDE, each.init(BESIDE), BESIDE, 0.1)  # type: ignore[attr-defined]


def problem_of(plans: adp.DetourPlans) -> PlanProblem:
    return PlanProblem(plans.detours, plans.cost, plans.moved, plans.weight)


def total(plans: adp.DetourPlans, x: Tensor, control: Tensor, done: Tensor) -> Tensor:
    """J of controls (B, T, m) from x."""
    problem = problem_of(plans)
    given = x, problem.others(x), done, control, lambda y, others, u, k: u
    return problem.follow(*given).total


def planned(plans: adp.DetourPlans, x: Tensor, plan: Tensor, expected: float, done: float) -> Tensor:
    """J of the plan that a step makes of one that is carried, (B, T, m)."""
    none = torch.zeros(len(x), 1).double()
    u, after = plans.step(x, CarriedPlan(plan, none + expected, none + done), x, plans.hold)
    return total(plans, x, torch.cat((u.unsqueeze(1), after.control[:, :-1]), dim=1), none + done)


def test_a_first_plan_costs_less_than_every_detour_and_no_change_of_it_lowers_that() -> None:
    plans = adp.DetourPlans(detours(margin=0.0, steps=6), first=6)
    best = plans.init(BESIDE).control
    found, x, none = (
        total(plans, BESIDE, best, torch.zeros(1, 1).double()),
        BESIDE,
        torch.zeros(1, 1).double(),
    )
    problem, ways = problem_of(plans), plans.detours
    for detour in torch.cat((0 * ways.fresh[:1], ways.fresh)):
        control, y = [], BESIDE
        for k in range(6):
            control.append(ways.control_along(y, detour[None], none[0] + k))
            y = systems.runge_kutta_step(lambda at, u=control[-1]: PLANE.motion(at, u), y, 0.2)
        assert bool(total(plans, x, torch.stack(control, dim=1), none) > found)
    others = best + 1e-3 * uniform(40, 6, 2, seed=1)
    x, still = BESIDE.expand(40, -1), torch.zeros(40, 1).double()
    assert bool((total(plans, x, problem.cost.admissible(others), still) > found).all())


def test_a_plan_that_costs_more_than_expected_is_left_for_another_way() -> None:
    """A disc that was not there when the plan was made, and a carried plan that is worth nothing."""

    def appearing(x: Tensor, t: Tensor) -> Tensor:
        return torch.where(t < 0.1, 10.0, (x[:, 0] - 1.0).square() + (x[:, 1] + 0.1).square() - 0.16)

    plans = adp.DetourPlans(detours(appearing, steps=7, lengths=[3]), first=2)
    idle = torch.zeros(1, 7, 2).double()
    left, kept = (float(planned(plans, BESIDE, idle, expected, 1.0)) for expected in (1.0, 1e9))
    assert left < kept


def test_a_plan_is_kept_where_no_other_way_is_cheaper_however_little_was_expected() -> None:
    """A plan that was improved five times, and a detour that is improved once."""
    plans = adp.DetourPlans(detours(steps=4), first=5, iterations=1)
    control = plans.init(BESIDE).control
    little, enough = (planned(plans, BESIDE, control, expected, 0.0) for expected in (1e-9, torch.inf))
    torch.testing.assert_close(little, enough, rtol=1e-12, atol=0)


def test_what_a_period_cost_is_taken_off_at_the_time_of_that_period() -> None:
    """What is in the way from .3 to .5 s, everywhere, costs the third period, and none of those after it."""

    def passing(x: Tensor, t: Tensor) -> Tensor:
        return torch.where((t > 0.3) & (t < 0.5), -0.05, 10.0) + 0.0 * x[:, 0]

    plans = adp.DetourPlans(detours(passing, steps=4, lengths=[3], margin=0.0), first=1)
    begun = changed(plans.init(AWAY), done=torch.full((2, 1), 2.0, dtype=torch.float64))
    u, (given, expected, done) = plans.step(AWAY, begun, AWAY, 0.2)
    ahead = systems.runge_kutta_step(lambda y: PLANE.motion(y, u), AWAY, 0.2)
    later = total(plans, ahead, given, done)
    torch.testing.assert_close(later, expected[:, 0], rtol=1e-9, atol=1e-9)


# J beside a loop that is written out ----------------------------------------------------------------------

HOLD, STEPS, WEIGHT = 0.2, 4, 7.0
CURVED = tensor([[3.0, 0.5, 0.2], [0.5, 2.0, 0.1], [0.2, 0.1, 1.5]])
BEGUN = tensor([[0.0], [3.0]])
MARGIN = tensor([0.3, 0.1])


class Cart(systems.ControlAffineSystem):
    """A mass on a spring or below a hinge, two inputs, and a state that fades by itself and pulls."""

    dim, inputs = 3, 2

    def __init__(self, linear: bool = False, periodic: tuple[int, ...] = ()) -> None:
        super().__init__()
        self.linear, self.periodic = linear, periodic

    def drift(self, x: Tensor) -> Tensor:
        place = x[..., 0] if self.linear else x[..., 0].sin()
        return torch.stack((x[..., 1], 0.7 * place + 0.4 * x[..., 2], -0.5 * x[..., 2]), dim=-1)

    def effectiveness(self, x: Tensor) -> Tensor:
        return tensor([[0.0, 0.2], [1.0, 0.3], [0.0, 0.0]]).to(x).expand(*x.shape, 2)


def bowl(x: Tensor) -> Tensor:
    return ((x @ CURVED) * x).sum(-1)


def pressing(x: Tensor, t: Tensor) -> Tensor:
    """Far below its margin, and lower with the time."""
    return 0.5 * x[:, 0] - 0.2 * x[:, 1] - 4.0 - 0.3 * t


def curved(x: Tensor, t: Tensor) -> Tensor:
    return x[:, 0].square() + x[:, 1].sin() - 0.5 + 0.1 * t


def idle(x: Tensor, t: Tensor) -> Tensor:
    return 50.0 + x[:, 0] + 0 * t


def problem(
    plant: Any, cost: adp.QuadraticCost, moved: int, constraints: Any = (pressing, idle), steps: int = STEPS
) -> PlanProblem:
    given: dict[str, Any] = {"axes": torch.eye(1, 3), "dt": HOLD, "steps": steps, "terminal": bowl}
    policy = lambda x: 0 * x[..., :2]  # noqa: E731
    around = adp.DetourRollout(policy, plant, cost, list(constraints), margin=MARGIN.tolist(), **given)
    return PlanProblem(around, around.cost, moved, WEIGHT)


def stepped(plant: Any, x: Tensor, u: Tensor) -> Tensor:
    """The classical Runge-Kutta step by its table."""

    def f(x: Tensor) -> Tensor:
        return plant.drift(x) + (plant.effectiveness(x) @ u.unsqueeze(-1)).squeeze(-1)

    a = f(x)
    b = f(x + HOLD / 2 * a)
    c = f(x + HOLD / 2 * b)
    d = f(x + HOLD * c)
    return x + HOLD * (a / 6 + b / 3 + c / 3 + d / 6)


def missing(x: Tensor, t: Tensor, constraints: Any) -> Tensor:
    found = torch.zeros(len(x), dtype=torch.float64)
    for h, margin in zip(constraints, MARGIN, strict=True):
        level = torch.cat([h(x[b : b + 1], t[b]) for b in range(len(x))])
        found = found + (margin - level).clamp(min=0.0) ** 2
    return WEIGHT * found


def written_out(
    plant: Any, x: Tensor, u: Tensor, rate: Any, constraints: Any = (pressing, idle)
) -> tuple[Tensor, Tensor]:
    """States (B, T + 1, n) and J (B,) of controls (B, T, m)."""
    states, total = [x], torch.zeros(len(x), dtype=torch.float64)
    for k in range(u.shape[1]):
        t = HOLD * (BEGUN[: len(x), 0] + k)
        total = total + HOLD * (rate(x, u[:, k]) + missing(x, t, constraints))
        x = stepped(plant, x, u[:, k])
        states.append(x)
    last = HOLD * (BEGUN[: len(x), 0] + u.shape[1])
    return torch.stack(states, dim=1), total + HOLD * missing(x, last, constraints) + bowl(x)


TARGET, PUSH = tensor([0.0, 0.0, 0.0]), tensor([0.3, -0.2])
Q, R = tensor([[2.0, 0.3, 0.1], [0.3, 1.0, 0.0], [0.1, 0.0, 0.5]]), tensor([[0.6, 0.2], [0.2, 0.9]])


def turned(d: Tensor) -> Tensor:
    return torch.cat((torch.remainder(d[:, :1] + math.pi, 2 * math.pi) - math.pi, d[:, 1:]), dim=1)


def plain_rate(x: Tensor, u: Tensor) -> Tensor:
    e, v = turned(x), u
    return ((e @ Q) * e).sum(-1) + ((v @ R) * v).sum(-1)


def start(dim: int = 3, far: float = 0.0) -> Tensor:
    return uniform(2, dim, seed=3) + tensor([far, 0.0, 0.0])[:dim]


def given_control(y: Tensor, others: Tensor, u: Tensor, k: Tensor) -> Tensor:
    return u + 0.05 * k.unsqueeze(-1)


@pytest.mark.parametrize("constraints", [(pressing, idle), (curved, pressing)])
@pytest.mark.parametrize("moved", [2, 3])
def test_a_plan_costs_what_the_loop_over_its_periods_pays(moved: int, constraints: Any) -> None:
    plant = Cart(periodic=(0,))
    plan = problem(plant, adp.QuadraticCost(Q, R, 3, 2), moved, constraints)
    x, u = start(far=2 * math.pi), uniform(2, STEPS, 2, seed=4)
    others = plan.others(x)
    found = plan.follow(x[:, :moved], others, BEGUN, u, given_control)
    ahead = u + 0.05 * torch.arange(STEPS, dtype=torch.float64)[None, :, None]
    states, total = written_out(plant, x, ahead, plain_rate, constraints)
    torch.testing.assert_close(found.states, states[..., :moved])
    torch.testing.assert_close(found.control, ahead)
    torch.testing.assert_close(found.total, total)
    if moved == 3:
        assert torch.equal(others, torch.zeros(2, STEPS + 1, 1, dtype=torch.float64))
    else:
        torch.testing.assert_close(others, states[..., 2:])
    torch.testing.assert_close(
        plan.paid(x, ahead[:, 0], HOLD * BEGUN[:, 0]),
        HOLD * (plain_rate(x, ahead[:, 0]) + missing(x, HOLD * BEGUN[:, 0], constraints)),
    )


def steepness(plant: Any, x: Tensor, u: Tensor, rate: Any, constraints: Any = (pressing, idle)) -> Tensor:
    """dJ/du, (B, T, m): 0 where a quadratic J is least."""
    at = u.detach().requires_grad_()
    return torch.autograd.grad(written_out(plant, x, at, rate, constraints)[1].sum(), at)[0]


SEEN = tensor([[1.0, 0.5, 0.3], [0.0, 1.0, -0.4]])
THERE, HELD = tensor([0.4, 0.0, 0.0]), tensor([-0.28, 0.0])
PLACED: dict[str, Any] = {"target": THERE, "target_input": HELD}
COSTS = {
    "states": adp.QuadraticCost(Q, R, 3, 2),
    "a set-point that is pushed": adp.QuadraticCost(Q, R, 3, 2, **PLACED),
    "an output": adp.QuadraticCost(Q[:2, :2], R, 3, 2, **PLACED, output=lambda x: x @ SEEN.mT),
}


def rate_of(name: str, x: Tensor, u: Tensor) -> Tensor:
    e, v = (x, u) if name == "states" else (x - THERE, u - HELD)
    e, q = (e @ SEEN.mT, Q[:2, :2]) if name == "an output" else (e, Q)
    return ((e @ q) * e).sum(-1) + ((v @ R) * v).sum(-1)


@pytest.mark.parametrize(
    ("name", "moved"), [("states", 3), ("a set-point that is pushed", 2), ("an output", 2)]
)
def test_where_j_is_quadratic_one_step_is_its_minimum_from_here(name: str, moved: int) -> None:
    cost, rate = COSTS[name], functools.partial(rate_of, name)
    plant = Cart(linear=True)
    plan, x, u = problem(plant, cost, moved), start(), uniform(2, STEPS, 2, seed=4)
    others = plan.others(x)
    now = plan.follow(x[:, :moved], others, BEGUN, u, lambda y, o, u, k: u)
    steep = 1e-10 * float(steepness(plant, x, u, rate).abs().max())
    improved = plan.improve((others, BEGUN, *now))
    assert float(steepness(plant, x, improved[3], rate).abs().max()) < steep
    assert torch.equal(improved[0], others)
    assert torch.equal(improved[1], BEGUN)


def test_steps_within_bounds_end_where_no_admissible_change_lowers_j() -> None:
    plant = Cart()
    cost = adp.QuadraticCost(Q, R, 3, 2, low=[-0.6, -0.1], high=[0.5, 0.4])
    plan, x = problem(plant, cost, 2, (curved, idle), 3), start()
    others = plan.others(x)
    low, high = plan.bounds(x)
    assert (low.tolist(), high.tolist()) == ([-0.6, -0.1], [0.5, 0.4])
    assert plan.cost.admissible(tensor([9.0, -9.0])).tolist() == [0.5, -0.1]
    now: tuple[Tensor, ...] = (
        others,
        BEGUN,
        *plan.follow(x[:, :2], others, BEGUN, torch.zeros(2, 3, 2).double(), lambda y, o, u, k: u),
    )
    totals = [now[-1]]
    for _ in range(6):
        now = plan.improve(now)
        totals.append(now[-1])
    assert all(bool((after <= before).all()) for before, after in itertools.pairwise(totals))
    u = now[3]
    slope = steepness(plant, x, u, plain_rate, (curved, idle))
    inward = torch.where(((u <= low) & (slope > 0)) | ((u >= high) & (slope < 0)), 0.0, slope)
    assert float(inward.abs().max()) < 1e-4 * float(slope.abs().max())
    assert bool(((u == low) | (u == high)).any())

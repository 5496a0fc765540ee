"""J of a plan around what moves, beside a loop that is written out; its Newton step beside a dense one."""

from __future__ import annotations

import functools
import itertools
import math
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from helpers import tensor, uniform
from torch import Tensor

from staf_torch import adp, systems
from staf_torch.adp.plan_problem import Plan, PlanProblem
from staf_torch.numerics.forward_mode import use_forward_mode

use_forward_mode()

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
    around: Any = SimpleNamespace(
        plant=plant, hold=HOLD, steps=steps, constraints=constraints, margin=MARGIN, terminal=bowl
    )
    return PlanProblem(around, cost.around(plant), moved, WEIGHT)


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


def test_a_period_more_adds_its_cost_and_the_change_of_what_is_left() -> None:
    plant = Cart()
    plan = problem(plant, adp.QuadraticCost(Q, R, 3, 2), 3, (idle, idle))
    x, u = start(), uniform(2, STEPS, 2, seed=4)
    longer = problem(plant, adp.QuadraticCost(Q, R, 3, 2), 3, (idle, idle), STEPS + 1)
    last = uniform(2, 2, seed=6)
    short = plan.follow(x, plan.others(x), BEGUN, u, lambda y, o, u, k: u)
    whole = torch.cat((u, last.unsqueeze(1)), dim=1)
    long = longer.follow(x, longer.others(x), BEGUN, whole, lambda y, o, u, k: u)
    torch.testing.assert_close(plan.longer(short.states[:, -1], last), long.total - short.total)


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
def test_where_j_is_quadratic_one_step_is_its_minimum_from_here_and_from_aside(name: str, moved: int) -> None:
    cost, rate = COSTS[name], functools.partial(rate_of, name)
    plant = Cart(linear=True)
    plan, x, u = problem(plant, cost, moved), start(), uniform(2, STEPS, 2, seed=4)
    others = plan.others(x)
    now = plan.follow(x[:, :moved], others, BEGUN, u, lambda y, o, u, k: u)
    change, feedback = plan._newton(now, others, BEGUN)

    def wanted(y: Tensor, o: Tensor, given: Any, k: Tensor) -> Tensor:
        planned, u, change, feedback = given
        return u + change + (feedback @ (y - planned).unsqueeze(-1)).squeeze(-1)

    steep = 1e-10 * float(steepness(plant, x, u, rate).abs().max())
    aside, given = x + tensor([0.2, -0.3, 0.0]), (now.states[:, :-1], u, change, feedback)
    found = plan.follow(aside[:, :moved], others, BEGUN, given, wanted)
    assert float(steepness(plant, aside, found.control, rate).abs().max()) < steep
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
    assert plan.clipped(tensor([9.0, -9.0])).tolist() == [0.5, -0.1]
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
    _, feedback = plan._newton(Plan(*now[2:]), others, BEGUN)
    at_bound = ((u == low) & (slope > 1e-3)) | ((u == high) & (slope < -1e-3))
    assert bool((feedback[at_bound] == 0).all())
    assert bool((feedback[~at_bound] != 0).any(-1).all())


def test_without_bounds_every_control_is_admissible() -> None:
    plan = problem(Cart(), adp.QuadraticCost(Q, R, 3, 2), 3)
    low, high = plan.bounds(start())
    assert (low.tolist(), high.tolist()) == ([-math.inf] * 2, [math.inf] * 2)
    assert plan.clipped(tensor([9.0, -9.0])).tolist() == [9.0, -9.0]


@pytest.mark.parametrize(("reach", "tries"), [(2.0, 1), (0.5, 2), (0.05, 4), (0.003, 6), (0.001, 6)])
def test_six_lengths_are_tried_each_three_tenths_of_the_one_before(reach: float, tries: int) -> None:
    """J falls, from 1 to a half, where a step is shorter than `reach`, and stays the same where it is not."""
    lengths = []

    class Stubbed(PlanProblem):
        def _newton(self, plan: Plan, others: Tensor, done: Tensor) -> tuple[Tensor, Tensor]:
            return torch.ones_like(plan.control), torch.zeros(1, STEPS, 2, 3).double()

        def follow(self, y: Tensor, others: Tensor, done: Tensor, inputs: Any, chosen: Any) -> Plan:
            u = chosen(inputs[0][:, 0], others, tuple(part[:, 0] for part in inputs), torch.zeros(1))
            lengths.append(float(u[0, 0]))
            total = torch.where(u[:, 0] < reach, 0.5, 1.0)
            return Plan(inputs[0].new_full((1, STEPS + 1, 3), 5.0), u.unsqueeze(1).expand(1, STEPS, 2), total)

    plain = problem(Cart(), adp.QuadraticCost(Q, R, 3, 2), 3)
    plan = Stubbed(plain.detours, plain.cost, 3, WEIGHT)
    none = torch.zeros(1, STEPS + 1, 3).double(), torch.zeros(1, STEPS, 2).double(), torch.ones(1).double()
    found = plan.improve((torch.zeros(1, STEPS + 1, 1), torch.zeros(1, 1), *none))
    assert lengths == pytest.approx([0.3**k for k in range(tries)])
    lower = 0.3 ** (tries - 1) < reach
    assert float(found[4]) == (0.5 if lower else 1.0)
    assert float(found[3][0, 0, 0]) == pytest.approx(lengths[-1] if lower else 0.0)
    assert float(found[2][0, 0, 0]) == (5.0 if lower else 0.0)


def test_slopes_of_a_period_are_those_of_what_it_costs() -> None:
    """Gauss and Newton's curvature of outputs and constraints, the true one of what is paid at the end."""

    def seen(x: Tensor) -> Tensor:
        return torch.stack((x[..., 0].sin() + x[..., 1], x[..., 1] * x[..., 2]), dim=-1)

    cost = adp.QuadraticCost(Q[:2, :2], R, 3, 2, output=seen)
    plan = problem(Cart(), cost, 2, (curved, idle))
    plan.detours.terminal = lambda x: x[..., 0].cosh() * x[..., 1].exp() + x.square().sum(-1) * x[..., 2]
    x = 0.3 * start()
    y, others, t = x[:, :2], x[:, 2:], tensor([0.3, 0.5])
    slope, bend = plan._stage(y, others, t)
    end_slope, end_bend = plan._end(y, others, t)
    both = plan._slopes(y, others, PUSH.expand(2, -1))
    a, b = both[..., :2], both[..., 2:]
    for k in range(2):

        def whole(y: Tensor, k: int = k) -> Tensor:
            return torch.cat((y, others[k]))

        see: Any = torch.func.jacrev(lambda y, w=whole: seen(w(y)))(y[k])
        error = seen(whole(y[k]))
        level, rise = (
            curved(whole(y[k])[None], t[k]),
            torch.func.grad(lambda y: curved(y[None], 0.0)[0])(y[k]),
        )
        short = MARGIN[0] - level
        assert float(short) > 0
        pressed, stiff = -2 * WEIGHT * HOLD * short * rise, 2 * WEIGHT * HOLD * torch.outer(rise, rise)
        torch.testing.assert_close(slope[k], 2 * HOLD * see.mT @ Q[:2, :2] @ error + pressed)
        torch.testing.assert_close(bend[k], 2 * HOLD * see.mT @ Q[:2, :2] @ see + stiff)

        def left(y: Tensor, w: Any = whole) -> Tensor:
            return plan.detours.terminal(w(y))

        torch.testing.assert_close(end_slope[k], torch.func.grad(left)(y[k]) + pressed)
        torch.testing.assert_close(end_bend[k], torch.func.hessian(left)(y[k]) + stiff)  # type: ignore[operator]
        ahead: Any = torch.func.jacrev(
            lambda y, u, w=whole: stepped(Cart(), w(y)[None], u[None])[0, :2], argnums=(0, 1)
        )(y[k], PUSH)
        torch.testing.assert_close(a[k], ahead[0])
        torch.testing.assert_close(b[k], ahead[1])


def test_an_angle_presses_the_shorter_way_around() -> None:
    plan = problem(Cart(periodic=(0,)), adp.QuadraticCost(Q, R, 3, 2), 3, (idle, idle))
    x, t, turn = start(), torch.zeros(2).double(), tensor([2 * math.pi, 0.0, 0.0])
    slope, bend = plan._stage(x, x[:, :0], t)
    torch.testing.assert_close(slope, 2 * HOLD * x @ Q)
    torch.testing.assert_close(bend, (2 * HOLD * Q).expand(2, 3, 3))
    torch.testing.assert_close(plan._stage(x + turn, x[:, :0], t)[0], slope)


def test_a_margin_that_is_just_kept_neither_costs_nor_presses() -> None:
    plan = problem(Cart(), adp.QuadraticCost(Q, R, 3, 2), 3, (lambda x, t: x[:, 0] + 0 * t, idle))
    x, t = tensor([[0.3, 1.0, 0.0], [0.0, 1.0, 0.0]]), torch.zeros(2).double()
    assert plan.penalty(x, t).tolist() == pytest.approx([0.0, WEIGHT * 0.09])
    slope, bend = plan._pressure(x, x[:, :0], t)
    assert (slope[0].tolist(), bend[0].tolist()) == ([0.0] * 3, [[0.0] * 3] * 3)
    assert slope[1].tolist() == pytest.approx([-2 * WEIGHT * HOLD * 0.3, 0.0, 0.0])
    assert float(bend[1, 0, 0]) == pytest.approx(2 * WEIGHT * HOLD)

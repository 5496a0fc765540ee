"""Problems in steps and controls that are held, beside loops, exponentials and plain formulas."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from helpers import tensor, uniform
from torch import Tensor

from staf_torch import adp, lanes, systems
from staf_torch.adp.followed_simulation import followed
from staf_torch.adp.global_value import follow_plan
from staf_torch.adp.holding import Holding, fewest_and_most, runge_kutta_held
from staf_torch.adp.plans import LocalModel
from staf_torch.numerics.forward_mode import use_forward_mode

INF = math.inf
use_forward_mode()


def swung(x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    turned = x[..., 1] + 0.3 * x[..., 0].sin() + 0.2 * u[..., 0] * x[..., 2].cos()
    after = torch.stack((x[..., 0] + 0.1 * turned, turned, 0.9 * x[..., 2] + u[..., 1] * u[..., 0]), dim=-1)
    return after, x.square().sum(-1) + u.square().sum(-1) + (x[..., 0] * u[..., 1]).square() + x[
        ..., 2
    ] ** 3 * u[..., 0] ** 2


SWUNG = adp.SampledProblem(swung, dim=3, inputs=2, low=[-1.0, -INF], high=[INF, 2.0], periodic=[-3])


@pytest.mark.needs_compiler
def test_derivatives_in_a_program_are_those_of_plain_torch() -> None:
    """Forward along pairs of coordinates there, backwards here; beside a row that is no number, too."""
    x, u = uniform(4, 3, seed=3), uniform(4, 2, seed=4)
    x[2, 1] = torch.nan
    program = lanes.Program(lambda carry, now, row: (carry, tuple(SWUNG.derivatives(*row))))
    _, found = program((), (), (x, u), steps=1)
    for mine, wanted in zip(found, SWUNG.derivatives(x, u), strict=True):
        torch.testing.assert_close(mine[[0, 1, 3], 0], wanted[[0, 1, 3]])


def test_derivatives_of_a_step_are_those_of_its_row() -> None:
    x, u = uniform(3, 3, seed=1), uniform(3, 2, seed=2)
    found = SWUNG.derivatives(x, u)
    for row in range(3):
        z = torch.cat((x[row], u[row]))
        for part, first, second in ((0, found.first, found.second), (1, found.cost_first, found.cost_second)):
            function = lambda z, part=part: swung(z[None, :3], z[None, 3:])[part][0]  # noqa: E731
            torch.testing.assert_close(first[row], torch.func.jacrev(function)(z))
            torch.testing.assert_close(second[row], torch.func.jacrev(torch.func.jacrev(function))(z))
    assert [tuple(part.shape) for part in found] == [(3, 3, 5), (3, 3, 5, 5), (3, 5), (3, 5, 5)]


def test_levels_are_all_combinations_of_finite_bounds_and_rest() -> None:
    assert SWUNG.levels().tolist() == [[-1.0, 0.0], [-1.0, 2.0], [0.0, 0.0], [0.0, 2.0]]
    free = adp.SampledProblem(lambda x, u: (0.5 * x + u, x[..., 0] ** 2 + u[..., 0] ** 2), dim=1, inputs=1)
    assert free.levels().tolist() == [[0.0]]
    assert SWUNG.periodic == (0,)
    x, u = uniform(2, 4, 3, seed=1), uniform(2, 4, 2, seed=2)
    after, paid = SWUNG.advance(x, u)
    for mine, plain in zip((after, paid), swung(x, u), strict=True):
        torch.testing.assert_close(mine, plain)
    away = torch.cat((x[..., :1] + 4 * math.pi, x[..., 1:]), dim=-1)
    torch.testing.assert_close(SWUNG.away(away), x)
    torch.testing.assert_close(SWUNG.terminal(away), ((x @ SWUNG.p) * x).sum(-1))
    wanted = torch.minimum(torch.maximum(-x @ SWUNG.k.mT, SWUNG.bounds.low), SWUNG.bounds.high)
    torch.testing.assert_close(SWUNG.linear_feedback(away), wanted)
    more = torch.minimum(torch.maximum(wanted + u, SWUNG.bounds.low), SWUNG.bounds.high)
    torch.testing.assert_close(SWUNG.steered(away, u), more)
    goals = SWUNG.goals(away[0], 2)
    assert goals.shape == (4, 3, 3)
    torch.testing.assert_close(goals, tensor([4 * math.pi, 0.0, 0.0]).expand(4, 3, 3))
    assert torch.equal(SWUNG.end, SWUNG.p)


@pytest.mark.parametrize(
    ("drift", "due", "refused"),
    [
        (3.9e-6, 0.0, False), (-4.1e-6, 0.0, True), (0.0, 0.9e-6, False), (0.0, -1.1e-6, True),
    ],
)  # fmt: skip
def test_a_goal_may_move_by_a_millionth_of_its_size_and_cost_a_millionth(
    drift: float, due: float, refused: bool
) -> None:
    def step(x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        d = x[..., 0] - 3.0
        return x + u - 0.1 * d.unsqueeze(-1) + drift, d.square() + u[..., 0].square() + due

    def make() -> adp.SampledProblem:
        return adp.SampledProblem(step, dim=1, inputs=1, goal=tensor([3.0]))

    if refused:
        with pytest.raises(
            ValueError, match="must be a state of rest at no cost; within one step it moves by"
        ):
            make()
    else:
        assert make().goal.tolist() == [3.0]


@pytest.mark.parametrize("after", [lambda x: x, lambda x: x[:, :1]])
@pytest.mark.parametrize("paid", [lambda u: u[:, 0] ** 2, lambda u: u**2])
def test_a_step_of_either_wrong_shape_is_refused(after: Any, paid: Any) -> None:
    if after(torch.zeros(2, 2)).shape[1] == 2 and paid(torch.zeros(2, 1)).dim() == 1:
        return
    with pytest.raises(
        ValueError, match=r"must map x \(2, 2\) and u \(2, 1\) to x\+ \(2, 2\) and costs \(2,\)"
    ):
        adp.SampledProblem(lambda x, u: (after(x), paid(u)), dim=2, inputs=1)


def test_arguments_of_a_problem_break_their_rule_by_name() -> None:
    def step(x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        return 0.5 * x + u, x.square().sum(-1) + u.square().sum(-1)

    whole: dict[str, Any] = {"dim": 2, "inputs": 2}
    for given, message in (
        ({"periodic": [2]}, r"periodic=...\)` must be coordinates of 2; got \[2\]"),
        ({"periodic": [-3]}, r"periodic=...\)` must be coordinates of 2"),
        ({"rest": tensor([0.0, 1.0]), "high": 1.0}, r"rest=...\)` must lie between the bounds"),
        ({"rest": tensor([0.0, -1.0]), "low": -1.0}, r"rest=...\)` must lie between the bounds"),
        ({"goal": tensor([0.0])}, r"goal=...\)` must have 2 entries"),
        ({"dim": 0}, r"dim=...\)` must be at least 1"),
        ({"inputs": 0}, r"inputs=...\)` must be at least 1"),
    ):
        with pytest.raises(ValueError, match=message):
            adp.SampledProblem(step, **{**whole, **given})
    assert adp.SampledProblem(step, **whole, periodic=[1, -1, -2]).periodic == (0, 1)
    made = adp.SampledProblem(step, **whole, terminal=torch.eye(2))
    assert not made.endless
    assert made.end.dtype == made.goal.dtype == made.rest.dtype == torch.float64
    assert torch.equal(made.end, torch.eye(2).double())


class Leaning(systems.ControlAffineSystem):
    """A rod that is held aside of upright."""

    dim, inputs, periodic = 2, 1, (0,)

    def drift(self, x: Tensor) -> Tensor:
        return torch.stack((x[..., 1], 2.0 * x[..., 0].sin() - 0.3 * x[..., 1]), dim=-1)

    def effectiveness(self, x: Tensor) -> Tensor:
        return tensor([[0.0], [1.5]]).to(x).expand(*x.shape, 1)


def test_a_problem_of_a_plant_has_its_rest_its_bounds_and_its_runge_kutta_step() -> None:
    cost = adp.QuadraticCost([2.0, 0.5], 0.7, 2, 1, target=[0.4, 0.0], low=-5.0, high=4.0)
    problem = adp.SampledProblem.of(Leaning(), cost, dt=0.2)
    assert problem.goal.tolist() == [0.4, 0.0]
    assert problem.rest.tolist() == pytest.approx([-2.0 * math.sin(0.4) / 1.5])
    assert (problem.bounds.low.tolist(), problem.bounds.high.tolist()) == ([-5.0], [4.0])
    assert (problem.periodic, problem.path, problem.endless) == ((0,), None, True)
    x, u = uniform(3, 2, seed=1), uniform(3, 1, seed=2)

    def rates(x: Tensor) -> Tensor:
        d = x - tensor([0.4, 0.0])
        due = 2 * d[:, 0] ** 2 + 0.5 * d[:, 1] ** 2 + 0.7 * (u[:, 0] + 2.0 * math.sin(0.4) / 1.5) ** 2
        moved = torch.stack((x[:, 1], 2 * x[:, 0].sin() - 0.3 * x[:, 1] + 1.5 * u[:, 0]), dim=1)
        return torch.cat((moved, due[:, None]), dim=1)

    a = rates(x)
    b = rates(x + 0.1 * a[:, :2])
    c = rates(x + 0.1 * b[:, :2])
    d = rates(x + 0.2 * c[:, :2])
    mean = 0.2 * (a / 6 + b / 3 + c / 3 + d / 6)
    after, paid = problem.advance(x, u)
    torch.testing.assert_close(after, x + mean[:, :2])
    torch.testing.assert_close(paid, mean[:, 2])
    other = adp.SampledProblem.of(Leaning(), cost, dt=0.2, low=-3.0)
    assert (other.bounds.low.tolist(), other.bounds.high.tolist()) == ([-3.0], [INF])
    ended = adp.QuadraticCost(1.0, 1.0, 2, 1, terminal=2.0)
    assert torch.equal(adp.SampledProblem.of(Leaning(), ended, dt=0.2).end, 2 * torch.eye(2).double())
    with pytest.raises(ValueError, match=r"`SampledProblem.of\(cost=...\)` must have no discount; got 0.1"):
        adp.SampledProblem.of(Leaning(), adp.QuadraticCost(1.0, 1.0, 2, 1, discount=0.1), dt=0.2)
    plant = systems.StepPlant(lambda x, u: 0.9 * x + 0.1 * u, dim=1, inputs=1, dt=0.5)
    line = adp.QuadraticCost(1.0, 1.0, 1, 1)
    assert (
        float(adp.SampledProblem.of(plant, line, dt=0.5).advance(tensor([[2.0]]), tensor([[1.0]]))[1]) == 2.5
    )
    with pytest.raises(
        ValueError, match=r"`SampledProblem.of\(dt=...\)` must be the plant's period, 0.5 s; got 0.4"
    ):
        adp.SampledProblem.of(plant, line, dt=0.4)


def test_a_local_model_is_a_quadratic_function_the_shorter_way_around() -> None:
    model = LocalModel(
        uniform(2, 3, seed=1), uniform(2, seed=2), uniform(2, 3, seed=3), uniform(2, 3, 3, seed=4)
    )
    x = uniform(2, 5, 3, seed=5)
    d = x - model.state[:, None]
    bent = torch.einsum("bli,bij,blj->bl", d, model.curvature, d)
    wanted = model.value[:, None] + (d * model.gradient[:, None]).sum(-1) + 0.5 * bent
    turned = x + tensor([2 * math.pi, 0.0, 0.0])
    torch.testing.assert_close(model.at(SWUNG, turned), wanted)
    slope = model.gradient + (model.curvature @ d[:, 0].unsqueeze(-1)).squeeze(-1)
    torch.testing.assert_close(model.slope(SWUNG, turned[:, 0]), slope)


# --- a control that is held ---------------------------------------------------------------------------------


LIMITS = tensor([math.inf, 0.07, 0.21, 1e-3, 0.05])
X, U = uniform(5, 2, seed=1), uniform(5, 1, seed=2)


class Limited(systems.VanDerPol):
    """A plant whose rows have longest steps of their own, which grow with the distance from x_1 = 0."""

    limited = True

    def step_limit(self, x: Tensor, u: Tensor) -> Tensor | None:
        return LIMITS * (1 + x[..., 0].square()) if self.limited else None


class Unlimited(Limited):
    limited = False


def costs(discount: float) -> adp.QuadraticCost:
    return adp.QuadraticCost([2.0, 0.5], 0.7, dim=2, inputs=1, discount=discount)


def stepped(plant: Any, cost: adp.Cost, x: Tensor, u: Tensor, h: float) -> tuple[Tensor, float]:
    """One Runge-Kutta step of one row, and what it pays, discounted from its start."""
    k1 = plant.rate(x, u)
    second = x + 0.5 * h * k1
    k2 = plant.rate(second, u)
    third = x + 0.5 * h * k2
    k3 = plant.rate(third, u)
    last = x + h * k3
    k4 = plant.rate(last, u)
    half = math.exp(-0.5 * cost.discount * h)
    rates = [float(cost.rate(at, u)) for at in (x, second, third, last)]
    paid = h / 6 * (rates[0] + 2 * half * (rates[1] + rates[2]) + half**2 * rates[3])
    return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4), paid


def held(
    plant: Any, cost: adp.Cost, row: int, dt: float, least: int, most: int, policy: Any = None
) -> tuple[Tensor, float]:
    x, u, spent, left = X[row], U[row], 0.0, dt
    for count in range(most, 0, -1):
        if least != most and left <= 0:
            break
        if policy is not None and count < most:
            u = policy(x)
        length = left / count if least == most else min(left, dt / least)
        if plant.limited:
            length = min(length, float(LIMITS[row] * (1 + x[0] ** 2)))
        length = length if count > 1 else left
        after, paid = stepped(plant, cost, x, u, length)
        spent += math.exp(-cost.discount * (dt - left)) * paid
        x, left = after, left - length
    return x, spent


@pytest.mark.parametrize("discount", [0.0, 0.9])
@pytest.mark.parametrize("renewed", [False, True])
@pytest.mark.parametrize("kind", [Limited, Unlimited])
@pytest.mark.parametrize("substeps", [2, (2, 5)])
def test_substeps_are_as_long_as_a_row_allows_and_the_last_takes_the_rest(
    substeps: Any, kind: type[Limited], renewed: bool, discount: float
) -> None:
    plant, cost = kind(), costs(discount)

    def policy(x: Tensor) -> Tensor:
        return -1.5 * x[..., 1:]

    hold = Holding("Test", plant, cost, 0.4, substeps)
    least, most = (substeps, substeps) if isinstance(substeps, int) else substeps
    x, spent = hold(X, U, policy if renewed else None)
    own = renewed or plant.limited  # else all substeps are equal, as many as there may be
    for row in range(5):
        after, paid = held(plant, cost, row, 0.4, least if own else most, most, policy if renewed else None)
        torch.testing.assert_close(x[row], after, rtol=1e-10, atol=1e-12)
        assert float(spent[row]) == pytest.approx(paid, rel=1e-10)


@pytest.mark.parametrize("discount", [0.0, 0.9])
def test_a_step_is_as_long_as_it_is_told_for_all_rows_or_each(discount: float) -> None:
    plant, cost = Unlimited(), costs(discount)
    lengths = tensor([0.3, 0.0, 0.1, 0.25, 0.05])
    each, paid = runge_kutta_held(plant, cost, X, U, lengths)
    whole, spent = runge_kutta_held(plant, cost, X, U, 0.3)
    for row in range(5):
        for found, cost_of, h in ((each, paid, float(lengths[row])), (whole, spent, 0.3)):
            after, wanted = stepped(plant, cost, X[row], U[row], h)
            torch.testing.assert_close(found[row], after, rtol=1e-12, atol=1e-14)
            assert float(cost_of[row]) == pytest.approx(wanted, rel=1e-12)
    single, _ = runge_kutta_held(plant, cost, X.float(), U.float(), 0.3)
    assert single.dtype == torch.float32
    torch.testing.assert_close(single.double(), whole, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("substeps", [4, (2, 8)])
def test_one_state_that_decays_is_held_as_its_exponential(substeps: Any) -> None:
    decay, t = 0.5, 0.4
    plant, cost = systems.Linear([[-decay]], [[1.0]]), adp.QuadraticCost(1.0, 1.0, dim=1, inputs=1)
    start, u = tensor([[0.8], [-0.3], [0.05]]), tensor([[0.4], [0.0], [-1.0]])
    center, apart, left = u / decay, start - u / decay, math.exp(-decay * t)
    square = center**2 * t + 2 * center * apart * (1 - left) / decay + apart**2 * (1 - left**2) / (2 * decay)
    for renewed in (None, lambda x: u):  # asked again, the same control costs the same
        x, spent = Holding("Test", plant, cost, t, substeps)(start, u, renewed)
        torch.testing.assert_close(x, center + left * apart, rtol=1e-6, atol=1e-8)
        torch.testing.assert_close(spent, (square + u**2 * t).squeeze(-1), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("discount", [0.0, 0.9])
@pytest.mark.parametrize("clocked", [False, True])
def test_plants_in_steps_pay_at_the_start_of_each(discount: float, clocked: bool) -> None:
    inner = systems.StepPlant(lambda x, u: 0.9 * x.sin() + u, dim=2, inputs=1, dt=0.1)
    plant = systems.Clocked(inner) if clocked else inner
    cost = costs(discount)
    if clocked:
        cost = adp.QuadraticCost([2.0, 0.5, 0.0], 0.7, dim=3, inputs=1, discount=discount)  # type: ignore[assignment]
    x = torch.cat((X, 2 * torch.ones(5, 1).double()), -1) if clocked else X
    after, spent = Holding("Test", plant, cost, 0.3)(x, U)
    state, wanted = X, torch.zeros(5).double()
    for k in range(3):
        wanted = wanted + 0.1 * math.exp(-0.1 * discount * k) * costs(discount).rate(state, U)
        state = 0.9 * state.sin() + U
    torch.testing.assert_close(after[:, :2], state)
    torch.testing.assert_close(spent, wanted)
    if clocked:
        torch.testing.assert_close(after[:, 2], torch.full((5,), 2.3).double())
    with pytest.raises(ValueError, match="multiple of the plant's period"):
        Holding("Test", plant, cost, 0.25)


def test_numbers_of_substeps_are_one_or_a_range() -> None:
    assert fewest_and_most("Test", 3) == (3, 3)
    assert fewest_and_most("Test", (1, 1)) == (1, 1)
    assert fewest_and_most("Test", (2, 16)) == (2, 16)
    for wrong, least in ((0, 1), ((0, 2), 1), ((3, 2), 3)):
        with pytest.raises(ValueError, match=rf"`Test\(substeps=...\)` must be at least {least}"):
            fewest_and_most("Test", wrong)  # type: ignore[arg-type]


# --- a feedback through a simulator, and a plan -------------------------------------------------------------


def swing(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    if isinstance(x, Tensor):
        raise TypeError("NumPy alone")
    rate = x[:, 1] + 0.1 * (3.0 * np.sin(x[:, 0] - 0.2) + u[:, 0])
    return np.stack((x[:, 0] + 0.1 * rate, rate), axis=1)


def swinging(**given: Any) -> systems.StepPlant:
    return systems.StepPlant(swing, dim=2, inputs=1, dt=0.1, equilibrium=[0.2, 0.0], **given)


@pytest.mark.parametrize(
    ("periodic", "bounds", "target"), [((), (None, None), None), ((0,), (-0.7, 0.4), [0.6, 0.0])]
)
@pytest.mark.parametrize("base", ["lqr", "smooth", "function"])
def test_a_feedback_is_followed_as_it_is_asked(base: str, target: Any, bounds: Any, periodic: Any) -> None:
    plant = swinging(periodic=periodic)
    if base == "smooth":
        cost: adp.Cost = adp.BoundedInputCost(1.0, 1.0, 2, 1, bound=3.0, target=target)
    else:
        cost = adp.QuadraticCost(1.0, 1.0, 2, 1, target=target, low=bounds[0], high=bounds[1])
    lqr = adp.LQR(plant, cost)
    policy = (lambda x: lqr(x).sin()) if base == "function" else lqr
    limits = systems.Bounds(*bounds, 1)
    follow = followed(plant, policy, limits, 0.1)
    assert follow is not None
    x0 = tensor([[0.3, 0.1], [6.0, -0.5], [-3.5, 0.4]]).view(3, 1, 2)
    states, controls = follow(x0, 6)
    assert (states.shape, controls.shape) == ((3, 1, 7, 2), (3, 1, 6, 1))
    x = x0
    for k in range(6):
        torch.testing.assert_close(states[:, :, k], x, rtol=1e-11, atol=1e-12)
        u = limits.clip(policy(x))
        torch.testing.assert_close(controls[:, :, k], u, rtol=1e-11, atol=1e-12)
        x = plant.step(x, u)
    single, _ = follow(x0.float(), 2)
    assert single.dtype == torch.float32


def test_a_plan_costs_what_its_steps_pay_and_what_its_end_is_worth() -> None:
    n, m, steps = 2, 1, 4
    turn = 2 * math.pi

    def advance(x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        after = x + 0.1 * torch.stack((x[..., 1], u[..., 0] - x[..., 0]), -1)
        return after, 0.1 * (x.square().sum(-1) + u.square().sum(-1))

    def offset(x: Tensor, y: Tensor) -> Tensor:
        away = x - y
        return torch.stack((away[..., 0] - turn * (away[..., 0] / turn).round(), away[..., 1]), -1)

    problem = adp.SampledProblem(advance, dim=n, inputs=m, low=-0.5, high=0.5, periodic=[0])
    region, worst = tensor([2.0, 3.0]), 7.0
    state, control = uniform(5, steps, n, seed=1), uniform(5, steps, m, seed=2)
    feedback = uniform(5, steps, m * n, seed=3)
    end = torch.cat(
        (
            0.3 * uniform(5, n, seed=4),
            uniform(5, 1, seed=5),
            uniform(5, n, seed=6),
            uniform(5, n * n, seed=7),
        ),
        -1,
    )
    x = state[:, 0] + 0.2 * uniform(5, n, seed=8)
    x[1] += tensor([turn, 0.0])
    x[2] += tensor([0.0, 5.0])  # too far to arrive
    x[3] += torch.nan
    cost, first, covered = follow_plan(
        problem, region, worst, x, torch.cat((state, control, feedback), -1), end
    )
    for row in range(5):
        at, paid = state[row, 0] + offset(x[row], state[row, 0]), 0.0
        for k in range(steps):
            gain = feedback[row, k].view(m, n)
            u = (control[row, k] + gain @ (at - state[row, k])).clamp(-0.5, 0.5)
            if k == 0:
                torch.testing.assert_close(first[row], u, equal_nan=True)
            at, more = advance(at, u)
            paid += float(more)
        goal, value, slope, bend = end[row, :2], float(end[row, 2]), end[row, 3:5], end[row, 5:].view(2, 2)
        d = at - goal
        far = float((d / region).square().sum())
        if math.isnan(paid):
            assert float(cost[row]) == math.inf
            assert not bool(covered[row])
            continue
        assert bool(covered[row]) is (far < 0.3**2)
        rest = value + float(slope @ d + 0.5 * d @ bend @ d) if far < 0.3**2 else value + worst * (1 + far)
        assert float(cost[row]) == pytest.approx(paid + rest, rel=1e-10)
    assert covered.tolist()[2:4] == [False, False]
    assert bool(covered[1])

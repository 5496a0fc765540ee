"""Controls held in substeps, feedbacks and plans that are followed: beside loops and exponentials."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from helpers import tensor, uniform
from torch import Tensor

from staf_torch import adp, systems
from staf_torch.adp.followed_simulation import followed
from staf_torch.adp.global_value import follow_plan
from staf_torch.adp.holding import Holding, fewest_and_most, runge_kutta_held
from staf_torch.numerics.forward_mode import use_forward_mode

use_forward_mode()


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

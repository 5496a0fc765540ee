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
from staf_torch.adp.policies.sampled_rollout import followed
from staf_torch.adp.problem.held_plant import Holding, fewest_and_most
from staf_torch.numerics.derivatives import use_forward_mode

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


@pytest.mark.parametrize(
    ("substeps", "kind", "renewed", "discount"),
    [
        (4, Limited, False, 0.9),
        (4, Unlimited, True, 0.0),
        ((2, 5), Limited, True, 0.9),
        ((2, 5), Unlimited, False, 0.9),
    ],
)
def test_rows_with_lengths_of_their_own_go_where_fine_steps_lead_and_pay_that(
    substeps: Any, kind: type[Limited], renewed: bool, discount: float
) -> None:
    plant, cost = kind(), costs(discount)
    policy = (lambda x: U * 0 - 0.7) if renewed else None  # renewed and held: of a constant the same
    u = U * 0 - 0.7 if renewed else U
    x, spent = Holding("Test", plant, cost, 0.4, substeps)(X, u, policy)
    fine, paid = Holding("Test", Unlimited(), cost, 0.4, 80)(X, u)
    torch.testing.assert_close(x, fine, rtol=1e-3, atol=1e-3)  # the last substep takes what is left
    torch.testing.assert_close(spent, paid, rtol=1e-3, atol=1e-3)
    if kind is Limited:
        plain, _ = Holding("Test", Unlimited(), cost, 0.4, substeps)(X, u, policy)
        assert not torch.equal(x[1], plain[1])  # its own steps are shorter


@pytest.mark.parametrize(("clocked", "discount"), [(False, 0.0), (True, 0.9)])
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
    assert fewest_and_most("Test", (2, 16)) == (2, 16)
    with pytest.raises(ValueError, match=r"`Test\(substeps=...\)` must be at least 3"):
        fewest_and_most("Test", (3, 2))


# --- a feedback through a simulator, and a plan -------------------------------------------------------------


def swing(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    if isinstance(x, Tensor):
        raise TypeError("NumPy alone")
    rate = x[:, 1] + 0.1 * (3.0 * np.sin(x[:, 0] - 0.2) + u[:, 0])
    return np.stack((x[:, 0] + 0.1 * rate, rate), axis=1)


def swinging(**given: Any) -> systems.StepPlant:
    return systems.StepPlant(swing, dim=2, inputs=1, dt=0.1, equilibrium=[0.2, 0.0], **given)


@pytest.mark.parametrize(
    ("periodic", "bounds", "target"), [((), (None, None), None), ((0,), (-1.3, -0.2), [0.6, 0.0])]
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

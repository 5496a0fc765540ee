"""A simulator in NumPy that torch follows: the same numbers, with derivatives; else a black box."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers import uniform

from staf_torch import systems

Rows = np.ndarray


def stacked(x: Rows, u: Rows) -> Rows:
    rate = np.clip(x[:, 1] + 0.05 * (15.0 * np.sin(x[:, 0]) + 3.0 * u[:, 0]), -8.0, 8.0)
    return np.stack((x[:, 0] + 0.05 * rate, rate), axis=1)


def filled(x: Rows, u: Rows) -> Rows:
    angle, rate = x.T
    after = np.empty_like(x)
    drag = np.where(np.abs(rate) > 1, np.maximum(rate, 0.2) ** 2, -rate) + np.sum(x, axis=1)
    after[:, 0], after[:, 1] = angle + 0.1 * rate, rate + 0.1 * (u[:, 0] - drag)
    return after


def product(x: Rows, u: Rows) -> Rows:
    return x @ np.array([[1.0, 0.1], [0.0, 1.0]]).T + u * np.array([0.0, 0.1])


def turned(x: Rows, u: Rows) -> Rows:
    angle = (x[:, 0] + np.pi) % (2 * np.pi) - np.pi
    return np.column_stack((angle + 0.1 * x[:, 1].clip(-1, 1), np.hypot(x[:, 1], 0.1) + u.squeeze(-1) - 0.1))


def arrayed(x: Rows, u: Rows) -> Rows:
    return np.array([x[:, 0] + 0.1 * x[:, 1], x[:, 1] + u[:, 0]]).T


def branching(x: Rows, u: Rows) -> Rows:
    return x + (0.1 if np.abs(x).max() > 1 else 0.2) * u


def plant(step: object) -> systems.StepPlant:
    return systems.StepPlant(step, dim=2, inputs=1, dt=0.05)  # type: ignore[arg-type]


X, U = 3 * uniform(40, 2, seed=1), 2 * uniform(40, 1, seed=2)


@pytest.mark.parametrize("step", [stacked, filled, product, turned])
def test_what_torch_follows_has_the_numbers_of_numpy_and_derivatives(step: object) -> None:
    given = plant(step)
    assert not given.traceable
    found = given.in_torch(X, U)
    assert found is not None
    assert found.traceable
    torch.testing.assert_close(found.step(X, U), given.step(X, U), rtol=1e-12, atol=1e-12)
    assert found.in_torch(X, U) is found
    at, u = torch.tensor([0.3, -0.2]).double(), torch.tensor([0.1]).double()
    for one, other in zip(found.linearisation(at, u), given.linearisation(at, u), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("step", [arrayed, branching])
def test_what_torch_cannot_follow_stays_a_black_box(step: object) -> None:
    assert plant(step).in_torch(X, U) is None


def test_a_plant_that_is_more_than_its_function_is_not_followed() -> None:
    class Logged(systems.StepPlant):
        """A plant of a user."""

    assert Logged(stacked, dim=2, inputs=1, dt=0.05).in_torch(X, U) is None

"""The optimum beside a closed loop: by formula, by shooting, or not at all."""

from __future__ import annotations

import dataclasses
import logging
from typing import Any

import pytest
import torch
from helpers import uniform
from torch import Tensor

from staf_torch import adp, systems
from staf_torch.adp.loop.simulation import AdpProblem, OptimumSettings
from staf_torch.adp.planning.shooting.reference_optimum import compare, known_value, optima, optimal_cost

PLANT = systems.Linear([[0.0, 1.0], [2.0, -1.0]], [[0.0], [1.0]])
COST = adp.QuadraticCost(1.0, 0.5, dim=2, inputs=1)
LQR = adp.LQR(PLANT, COST)
BOUNDED = adp.QuadraticCost(1.0, 0.5, dim=2, inputs=1, low=-1.0)
X0 = uniform(3, 2, seed=1)


class Weak(adp.Feedback):
    """A half of the LQR, and its value of weights (0.5, 1, 0) in place of P's."""

    def __init__(self, values: bool = True) -> None:
        super().__init__(lambda x: 0.5 * LQR(x) - 2 * x[..., :1])
        self.values = values

    def value(self, x: Tensor, recorded: Any) -> Tensor | None:
        return x.square().sum(-1) if self.values else None


def problem(controller: Any = None, cost: adp.Cost = COST, **given: Any) -> AdpProblem:
    optimum = {"shooting": False, "states": 12, "horizon": 2.5, "intervals": 24} | given
    settings: dict[str, Any] = {"dt": 0.1, "steps": 10, "every": 2, "seed": 0, "integrator": "runge_kutta"}
    return AdpProblem(
        PLANT, cost, controller or Weak(), X0, compile=False, optimum=OptimumSettings(**optimum), **settings
    )


def result(controller: Any = None) -> adp.LoopResult:
    with torch.no_grad():
        return adp.simulate(controller or Weak(), PLANT, COST, X0, dt=0.1, steps=10, every=2, compile=False)


def test_a_formula_is_compared_with_at_every_recorded_time() -> None:
    loop, given = result(), problem()
    found = compare(given, loop)
    x = loop.state
    assert found.cost is not None
    assert found.control_error is not None
    assert found.value_error is not None
    torch.testing.assert_close(found.cost, LQR.value(X0))
    torch.testing.assert_close(found.control_error[:, :-1], (loop.control - LQR(x))[:, :-1, 0].abs())
    assert bool(found.control_error[:, -1].isnan().all())
    torch.testing.assert_close(found.value_error, (LQR.value(x) - x.square().sum(-1)).abs())
    torch.testing.assert_close(optimal_cost(given), LQR.value(X0))
    torch.testing.assert_close(known_value(given, x), LQR.value(x))


def test_a_controller_without_an_idea_of_the_value_has_no_error_of_it() -> None:
    found = compare(problem(Weak(values=False)), result())
    assert found.value_error is None
    assert found.control_error is not None


def test_the_value_of_a_learner_is_that_of_the_weights_of_its_time() -> None:
    points = adp.RandomPoints(1, 0.3)
    learner = adp.ActorCritic(adp.QuadraticBasis(2), PLANT, COST, points, critic=[1.0, 0.3, 1.0])
    with torch.no_grad():
        loop = adp.simulate(learner, PLANT, COST, X0, dt=0.1, steps=4, every=2, compile=False)
    error = compare(problem(learner), loop).value_error
    estimate = learner.basis.value(loop.critic_weights, loop.state)
    torch.testing.assert_close(error, (LQR.value(loop.state) - estimate).abs())


def test_where_no_formula_is_known_and_nothing_is_shot_nothing_is_said() -> None:
    for cost in (BOUNDED, adp.BoundedInputCost(1.0, 1.0, 2, 1, bound=2.0)):
        given = problem(cost=cost)
        assert known_value(given, X0) is None
        assert optima(given, X0) is None
        assert optimal_cost(given) is None
        assert compare(given, result()) == (None, None, None)


def test_some_recorded_states_are_shot_from_where_no_formula_is_known(
    caplog: pytest.LogCaptureFixture,
) -> None:
    loop, given = result(), problem(cost=BOUNDED, shooting=True, states=9)
    with caplog.at_level(logging.INFO):
        found = compare(given, loop)
    assert found.cost is not None
    assert found.control_error is not None
    assert found.value_error is not None
    at = [0, 1, 3]  # of six times the last, where no control is, is left out
    assert found.control_error.isnan().all(0).tolist() == [False, False, True, False, True, True]
    search = adp.DirectShooting(PLANT, BOUNDED, horizon=2.5, intervals=24)
    x = loop.state[:, at]
    best = search.solve(x.flatten(0, 1))
    assert bool(best.converged.all())
    value, control = best.value.view(3, 3), best.control.view(3, 3, 1)
    torch.testing.assert_close(found.cost, value[:, 0], rtol=1e-9, atol=0)
    off = (loop.control[:, at] - control).norm(dim=-1)
    torch.testing.assert_close(found.control_error[:, at], off, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(found.value_error[:, at], (value - x.square().sum(-1)).abs())
    assert "9 states, 24 intervals over 2.5 s" in caplog.text


def test_one_state_a_row_gives_the_cost_alone() -> None:
    found = compare(problem(cost=BOUNDED, shooting=True, states=3), result())
    assert found.cost is not None
    assert (found.control_error, found.value_error) == (None, None)


def test_what_shooting_does_not_find_is_told(caplog: pytest.LogCaptureFixture) -> None:
    """On four intervals no control is stationary; a plant without an LQR has no optimum at all."""
    found = optima(problem(cost=BOUNDED, shooting=True, intervals=4, horizon=9.0), X0)
    assert found is not None
    lost = int(found.value.isnan().sum())
    assert lost > 0
    assert f"direct shooting found no optimum from {lost} of 3 states" in caplog.text
    caplog.clear()
    stuck = systems.Linear([[1.5, 0.0], [0.0, -1.0]], [[0.0], [1.0]])
    given = dataclasses.replace(problem(cost=BOUNDED, shooting=True), system=stuck)
    assert optima(given, X0) is None
    assert compare(given, result()) == (None, None, None)
    assert "the optimum is not known: " in caplog.text

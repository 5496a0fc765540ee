"""The optimum beside a closed loop: by formula, by shooting, or not at all."""

from __future__ import annotations

import logging
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from helpers import uniform
from torch import Tensor

from staf_torch import adp, systems
from staf_torch.adp import reference_optimum
from staf_torch.adp.problem import AdpProblem, OptimumSettings
from staf_torch.adp.reference_optimum import _chosen, compare, known_value, optima, optimal_cost

PLANT = systems.Linear([[0.0, 1.0], [2.0, -1.0]], [[0.0], [1.0]])
COST = adp.QuadraticCost(1.0, 0.5, dim=2, inputs=1)
LQR = adp.LQR(PLANT, COST)
BOUNDED = adp.QuadraticCost(1.0, 0.5, dim=2, inputs=1, low=-1.0)
X0 = uniform(3, 2, seed=1)


class Weak(adp.Feedback):
    """A half of the LQR, and its value of weights (0.5, 1, 0) in place of P's."""

    def __init__(self, values: bool = True) -> None:
        super().__init__(lambda x: 0.5 * LQR(x) - 2 * x[..., :1])
        self.values, self.asked = values, []  # type: ignore[var-annotated]

    def value(self, x: Tensor, carried: adp.ControllerState) -> Tensor | None:
        self.asked.append((len(x), tuple(carried.critic.shape), tuple(carried.actor.shape)))
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


def test_values_are_asked_for_in_blocks_with_the_weights_of_their_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    whole = compare(problem(), result()).value_error
    monkeypatch.setattr(reference_optimum, "_AT_ONCE", 7)
    controller = Weak()
    found = compare(problem(controller), result()).value_error
    torch.testing.assert_close(found, whole)
    assert [rows for rows, *_ in controller.asked] == [7, 7, 4]
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


class Shot:
    """In place of `DirectShooting`: keeps how it was made, and answers by the LQR."""

    made: list[dict[str, Any]]
    lost = False

    def __init__(self, system: Any, cost: Any, **given: Any) -> None:
        Shot.made.append({"system": system, "cost": cost, **given})
        self.intervals, self.horizon = 24, 2.5

    def solve(self, x: Tensor) -> Any:
        Shot.made[-1]["x"] = x
        if Shot.lost is None:
            raise ValueError("no LQR\nat all")
        value, converged = LQR.value(x).clone(), torch.ones(len(x)).bool()
        error = torch.full((len(x),), 1e-3).double()
        if Shot.lost:
            value[1], converged[2], error[1] = torch.nan, False, torch.nan
        return SimpleNamespace(
            value=value, control=LQR(x), converged=converged, mesh_error=error, horizon_error=2 * error
        )


@pytest.fixture
def _shot(monkeypatch: pytest.MonkeyPatch) -> None:
    Shot.made, Shot.lost = [], False
    monkeypatch.setattr(reference_optimum, "DirectShooting", Shot)


@pytest.mark.usefixtures("_shot")
def test_some_recorded_states_are_shot_from(caplog: pytest.LogCaptureFixture) -> None:
    loop = result()
    given = problem(cost=BOUNDED, shooting=True, states=9)
    with caplog.at_level(logging.INFO):
        found = compare(given, loop)
    (made,) = Shot.made
    assert (made["horizon"], made["intervals"]) == (2.5, 24)
    assert made["cost"] is not given.cost
    assert made["system"] is not PLANT
    at = [0, 1, 3]  # of six times the last, where no control is, is left out
    torch.testing.assert_close(made["x"], loop.state[:, at].flatten(0, 1))
    assert found.cost is not None
    assert found.control_error is not None
    assert found.value_error is not None
    torch.testing.assert_close(found.cost, LQR.value(X0))
    assert found.control_error.shape == found.value_error.shape == (3, 6)
    assert found.control_error.isnan().all(0).tolist() == [False, False, True, False, True, True]
    x = loop.state[:, at]
    torch.testing.assert_close(found.control_error[:, at], (loop.control[:, at] - LQR(x)).norm(dim=-1))
    torch.testing.assert_close(found.value_error[:, at], (LQR.value(x) - x.square().sum(-1)).abs())
    said = "V* by direct shooting from 9 states, 24 intervals over 2.5 s: "
    assert [record.message for record in caplog.records] == [
        said + "mesh error <= 1.0e-03, horizon <= 2.0e-03"
    ]


@pytest.mark.usefixtures("_shot")
def test_one_state_a_row_gives_the_cost_alone_and_float_stays_float() -> None:
    for states in (3, 0):
        found = compare(problem(cost=BOUNDED, shooting=True, states=states), result())
        assert found.cost is not None
        assert (found.control_error, found.value_error) == (None, None)
    single = optima(problem(cost=BOUNDED, shooting=True), X0.float().view(3, 1, 2))
    assert single is not None
    assert Shot.made[-1]["x"].dtype == torch.float64
    assert (single.value.dtype, single.value.shape, single.control.shape) == (
        torch.float32,
        (3, 1),
        (3, 1, 1),
    )


@pytest.mark.usefixtures("_shot")
def test_what_shooting_does_not_find_is_told(caplog: pytest.LogCaptureFixture) -> None:
    given = problem(cost=BOUNDED, shooting=True)
    Shot.lost = True
    assert optima(given, X0) is not None
    assert [record.message for record in caplog.records] == [
        "direct shooting found no optimum from 1 of 3 states",
        "V* of 1 of 3 states may be a local minimum only",
    ]
    caplog.clear()
    Shot.lost = None  # type: ignore[assignment]
    assert optima(given, X0) is None
    assert compare(given, result()) == (None, None, None)
    assert {record.message for record in caplog.records} == {"the optimum is not known: no LQR"}


@pytest.mark.parametrize(
    ("times", "count", "chosen"),
    [
        (11, 5, [0, 2, 4, 6, 8]),
        (11, 10, list(range(10))),
        (11, 99, list(range(10))),
        (11, 0, [0]),
        (2, 4, [0]),
        (6, 2, [0, 2]),
    ],
)
def test_times_are_chosen_evenly_from_the_first(times: int, count: int, chosen: list[int]) -> None:
    assert _chosen(times, count).tolist() == chosen

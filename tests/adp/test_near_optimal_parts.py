"""Where a policy of one call plans, what its loops share and what its report asks, by stubs."""

from __future__ import annotations

import importlib
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from helpers import tensor
from torch import Tensor

from staf_torch import adp, systems
from staf_torch.adp.strained_plans import StrainedPlans

module: Any = importlib.import_module("staf_torch.adp.near_optimal")


def made(**given: Any) -> adp.NearOptimal:
    """Of a mode of 2 1/s, which the feedback hardly moves."""
    cost = adp.QuadraticCost(1e-9, 1.0, dim=1, inputs=1, **given)
    return adp.near_optimal(systems.Linear([[-2.0]], [[1.0]]), cost, dt=0.1)


class Made(SimpleNamespace):
    """A key of a dictionary, as what it stands for is."""

    __hash__ = object.__hash__


@pytest.fixture
def planners(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    found: list[Any] = []

    def plans(problem: Any, steps: int, policy: Any) -> Any:
        found.append(Made(problem=problem, steps=steps, policy=policy))
        return found[-1]

    def horizon(problem: Any, **given: Any) -> Any:
        return SimpleNamespace(problem=problem, given=given)

    stub = SimpleNamespace(of=lambda plant, cost, dt: (plant, cost, dt))
    for name, other in (("BoundedPlans", plans), ("RecedingHorizon", horizon), ("SampledProblem", stub)):
        monkeypatch.setattr(module, name, other)
    return found


def test_plans_are_made_where_there_are_bounds_and_once_for_all_loops(planners: list[Any]) -> None:
    assert made().plans() is None
    assert isinstance(made().controller(), adp.Feedback)
    assert made(low=-1.0, discount=0.1).plans() is None
    slower = made(low=-1.0)
    for dt, inside, planned in ((0.2, torch.sin, False), (0.1, np.sin, False), (0.1, torch.sin, True)):
        slower.plant = systems.StepPlant(
            lambda x, u, inside=inside: 0.8 * inside(x) + 0.1 * u, dim=1, inputs=1, dt=dt
        )
        assert (slower.plans() is not None) is planned
    assert len(planners) == 1
    policy = made(low=-1.0)
    first: Any = policy.plans()
    assert policy.plans() is first
    assert (first.steps, first.policy) == (policy.steps, policy) == (12, policy)
    assert first.problem == (policy.plant, policy.cost, 0.1)
    longer: Any = policy.plans(3.0)  # time constants of half a second
    assert longer.steps == 16
    assert policy.plans(0.1) is first  # no fewer than the policy looks ahead
    policy.cost = adp.QuadraticCost(1.0, 1.0, dim=1, inputs=1, low=-1.0)
    assert policy.plans() is not first
    loop: Any = made(low=-1.0).controller()
    assert isinstance(loop, StrainedPlans)
    assert loop._planner.steps == 16
    assert loop._begun.given == {"steps": 16, "held": True}
    planning: Any = made(low=-1.0)
    planning.planner = first
    carried: Any = planning.controller()
    assert carried.given == {"steps": 12, "held": True}
    assert carried.problem is first.problem
    assert planning.controller() is carried
    state = planning.__getstate__()
    assert (state["planner"], state["_planners"], state["_loops"]) == (True, {}, {})
    assert made().__getstate__()["planner"] is False


def test_a_policy_that_plans_does_so_in_the_rows_that_meet_a_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    policy, asked = made(low=-1.0), []

    class Planner:
        def strained(self, x: Tensor) -> Tensor:
            return x[:, 0] > 1

        def __call__(self, x: Tensor) -> Tensor:
            asked.append(x)
            return 100 + x

    monkeypatch.setattr(module.SampledRollout, "forward", lambda self, x: -x)
    x = tensor([[[2.0], [0.5], [3.0]], [[0.1], [4.0], [0.0]]])
    assert torch.equal(policy(x), -x)
    policy.planner = Planner()  # type: ignore[assignment]
    wanted = tensor([[[102.0], [-0.5], [103.0]], [[-0.1], [104.0], [-0.0]]])
    assert torch.equal(policy(x), wanted)
    assert asked[0].tolist() == [[2.0], [3.0], [4.0]]
    assert torch.equal(policy(0.1 * x), -0.1 * x)
    assert policy(tensor([7.0])).tolist() == [107.0]
    assert len(asked) == 2


def test_a_report_compares_what_both_loops_regulate(monkeypatch: pytest.MonkeyPatch) -> None:
    policy, asked = made(low=-1.0), []
    runs = {
        "ours": (tensor([1.0, 2.0, 3.0, 8.0]), torch.tensor([True, True, True, False])),
        "lqr": (tensor([2.0, 2.0, 1.0, 1.0]), torch.tensor([True, True, False, True])),
    }

    def run(controller: Any, x0: Tensor) -> Any:
        asked.append(("run", len(x0)))
        of_base = isinstance(controller, adp.Feedback)
        cost, fine = runs["lqr" if of_base else "ours"]
        more = torch.arange(len(x0) - 4)  # the states of the boxes, of which those of the third one are kept
        return torch.cat((cost, more.double())), torch.cat((fine, (more // 4 == 2) & (not of_base)))

    def over(x0: Tensor, cost: Tensor, fine: Tensor) -> Tensor:
        assert torch.equal(cost, runs["ours"][0])
        assert torch.equal(fine, runs["ours"][1])
        return tensor([1.5, 3.0, 2.0])

    def good(fine: Tensor, states: int, width: float, seed: int) -> float:
        asked.append((fine.all(dim=1).tolist(), states, width, seed))
        return 0.125

    planner = SimpleNamespace(strained=lambda x: torch.arange(len(x)) < 1)
    for name, stub in (
        ("_run", run),
        ("_over_optimum", over),
        ("_good", good),
        ("_microseconds", lambda x: float(len(x))),
        ("controller", lambda: None),
        ("plans", lambda: planner),
    ):
        monkeypatch.setattr(policy, name, stub)
    found = policy.report(states=4, spread=0.5, seed=7)
    assert found.pop("spectral_radius") == pytest.approx(0.8187, abs=1e-3)
    assert found.pop("largest_period") == torch.inf
    assert found == {
        "dt": 0.1, "base": "LQR", "centers": 3, "radius": 0.1, "horizon": pytest.approx(1.2), "substeps": 1,
        "spread": 0.5, "regulated": 0.75, "over_base_median": 0.5, "over_base_max": 1.0,
        "over_optimum_median": 2.0, "over_optimum_max": 3.0, "good_spread": 0.125, "microseconds": 1.0,
        "strained": 0.25,
    }  # fmt: skip
    assert asked == [("run", 24), ("run", 4), ([False, False, True, False, False], 4, 0.5, 8)]
    runs["lqr"] = (runs["lqr"][0], torch.zeros(4) > 0)
    monkeypatch.setattr(policy, "plans", lambda: None)
    none = policy.report(optimum=False)
    assert [none[name] for name in ("over_base_median", "over_base_max", "strained")] == [None] * 3
    assert [none[name] for name in ("over_optimum_median", "over_optimum_max")] == [None] * 2
    assert none["spread"] == policy.plant.spread
    assert asked[3:] == [("run", 120), ("run", 20), ([False] * 5, 20, policy.plant.spread, 1)]
    with pytest.raises(ValueError, match=r"`report\(spread=...\)` must be positive"):
        policy.report(spread=0.0)

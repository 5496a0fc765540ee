"""The penalty of an obstacle beside its Taylor series, and what plans around it are searched with."""

from __future__ import annotations

import copy
import types
from typing import Any, ClassVar

import pytest
import torch
from helpers import tensor, uniform
from torch import Tensor

from staf_torch import adp, systems
from staf_torch.adp import avoidance
from staf_torch.adp.plans import Trajectories

LINE = systems.Linear([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])


def slow(x: Tensor) -> Tensor:
    return x[..., 1] + 0.4


def cost_of(**given: Any) -> adp.AvoidanceCost:
    usual = {"obstacles": slow, "reach": 0.3, "low": -1.0, "high": 1.5}
    return adp.AvoidanceCost(1.0, 1.0, dim=2, inputs=1, **(usual | given))


FORMULAS = {"penalty": lambda q: (1 / q - 1) ** 2, "log": lambda q: q.log() ** 2}


@pytest.mark.parametrize("kind", FORMULAS)
@pytest.mark.parametrize("edge", [0.01, 0.2])
def test_below_the_edge_the_penalty_is_its_parabola_there(kind: str, edge: float) -> None:
    cost, formula = cost_of(kind=kind, reach=0.5), FORMULAS[kind]
    assert float(cost.edge) == 0.01
    cost.edge.fill_(edge)
    q = torch.linspace(edge, 1.0, 50, dtype=torch.float64)
    torch.testing.assert_close(cost.penalty(0.5 * q), formula(q))
    at = tensor(edge)
    slope, bend = torch.func.grad(formula)(at), torch.func.grad(torch.func.grad(formula))(at)
    below = torch.linspace(-2.0, edge * 0.999, 50, dtype=torch.float64)
    wanted = formula(at) + slope * (below - edge) + 0.5 * bend * (below - edge) ** 2
    torch.testing.assert_close(cost.penalty(0.5 * below), wanted)
    assert not bool(cost.penalty(0.5 * torch.linspace(1.0, 9.0, 20).double()).any())
    assert cost.penalty((0.5 * q).float()).dtype == torch.float32


def test_every_obstacle_counts_with_the_weight() -> None:
    x = uniform(4, 3, 2, seed=1)
    several = [slow, lambda x: x[..., 0] + 0.7, lambda x: 0.9 - x[..., 0]]
    for weight in (1.0, 3.0):
        cost = cost_of(obstacles=several, weight=weight)
        paid = x.square().sum(-1) + weight * sum(cost.penalty(h(x)) for h in several)
        torch.testing.assert_close(cost.state_rate(x), paid)
        torch.testing.assert_close(cost.outside(x), torch.stack([h(x) for h in several]).amin(0))
    assert cost.weight.dtype == cost.edge.dtype == torch.float64
    bare = adp.AvoidanceCost(1.0, 1.0, dim=2, inputs=1, obstacles=slow, reach=0.5)
    assert (float(bare.weight), bare.kind) == (1.0, "penalty")
    for wrong in ([slow, 1.0], [1.0]):
        with pytest.raises(ValueError, match=r"`AvoidanceCost\(obstacles=...\)` must be h\(x\) or a list"):
            cost_of(obstacles=wrong)


class Search:
    """In the place of a search: keeps what it was asked, and finds what the test says."""

    asked: ClassVar[list[dict[str, Any]]] = []
    speeds: ClassVar[list[list[float]]] = []
    costs: ClassVar[list[adp.AvoidanceCost]] = []

    def __init__(self, problem: adp.SampledProblem, **given: Any) -> None:
        self.problem, self.given = problem, given

    def solve(self, x0: Tensor, control: Tensor, reference: Any) -> Trajectories:
        cost, steps = self.costs[-1], self.given["steps"]
        weight, edge = float(cost.weight), float(cost.edge)
        self.asked.append(
            {**self.given, "x0": x0, "u": control, "around": reference, "weight": weight, "edge": edge}
        )
        rows = len(x0)
        state = torch.zeros(rows, steps + 1, 2, dtype=torch.float64)
        state[:, 1, 1] = tensor(self.speeds[len(self.asked) - 1])
        state[:, 0] = x0
        number = torch.arange(rows, dtype=torch.float64) + 100 * len(self.asked)
        control = control + number[:, None, None]
        whole = number[:, None].expand(rows, steps + 1)
        gains = number[:, None, None, None].expand(rows, steps, 1, 2)
        curvature = torch.zeros(rows, steps + 1, 2, 2).double()
        return Trajectories(state, control, gains, whole, 0 * state, curvature, number > 0)


def test_plans_are_searched_from_every_way_with_weights_that_shrink(monkeypatch: pytest.MonkeyPatch) -> None:
    def copied(cost: adp.AvoidanceCost) -> adp.AvoidanceCost:
        Search.costs.append(copy.deepcopy(cost))
        return Search.costs[-1]

    monkeypatch.setattr(avoidance, "BoxDDP", Search)
    monkeypatch.setattr(avoidance, "copy", types.SimpleNamespace(deepcopy=copied))
    Search.asked.clear()
    # A speed below -0.4 touches; a larger one costs more. Rows: three ways from each of two starts.
    Search.speeds[:] = [[0.3, -0.5, 0.2, -0.5, -0.5, -0.5], [0.1, -0.1, 0.5, -0.5, 0.7, -0.4]]
    cost, x0 = cost_of(weight=2.0), tensor([[1.0, 0.0], [2.0, 0.5]])
    given = {"dt": 0.3, "steps": 9, "shrink": (1.0, 0.25), "iterations": 7, "compile": False}
    found = avoidance.plan_around(LINE, cost, x0, **given)  # type: ignore[arg-type]
    first, second = Search.asked
    assert [(each["steps"], each["iterations"], each["compile"]) for each in Search.asked] == [
        (9, 7, False)
    ] * 2
    assert [each["weight"] for each in Search.asked] == [2.0, 0.5]
    assert [each["edge"] for each in Search.asked] == [0.01, 0.005]
    assert (float(cost.weight), float(cost.edge)) == (2.0, 0.01)
    assert first["x0"].tolist() == [[1.0, 0.0]] * 3 + [[2.0, 0.5]] * 3
    ways = torch.tensor([-1.0, 0.0, 1.5] * 2).double()
    assert torch.equal(first["u"][:, :2, 0], ways[:, None].expand(6, 2))  # for a quarter of the steps
    assert not bool(first["u"][:, 2:].any())
    free = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1, low=-1.0, high=1.5)
    problem = adp.SampledProblem.of(LINE, free, dt=0.3)
    torch.testing.assert_close(first["around"].feedback, (-problem.k).expand(6, 9, 1, 2))
    assert not bool(first["around"].state.any())
    # The second search begins where the first one ended.
    number = torch.arange(6, dtype=torch.float64) + 100
    assert torch.equal(second["u"], first["u"] + number[:, None, None])
    assert torch.equal(second["around"].feedback, number[:, None, None, None].expand(6, 9, 1, 2))
    assert second["around"].state.shape == (6, 9, 2)
    # What is paid is that of the bare cost, at the controls that were found.
    last = [{**each, "cost": paid_by(problem, k)} for k, each in enumerate(Search.asked)]
    total = torch.stack([each["cost"] for each in last])
    touched = torch.tensor(Search.speeds).double() < -0.4
    best = torch.where(touched, torch.inf, total)
    of_row = best.amin(0)
    chosen = [int(of_row[:3].argmin()), 3 + int(of_row[3:].argmin())]
    torch.testing.assert_close(found.cost, of_row[chosen])
    taken = best.argmin(0)[chosen]
    margin = torch.tensor(Search.speeds).double().clamp(max=0.0) + 0.4
    torch.testing.assert_close(found.margin, torch.stack([margin[taken[k], chosen[k]] for k in range(2)]))
    wanted = 100.0 * (taken + 1) + tensor([float(k) for k in chosen])
    assert torch.equal(found.trajectories.value[:, 0], wanted)


def paid_by(problem: adp.SampledProblem, k: int) -> Tensor:
    """What the states and controls cost that the test's search says it found at its k-th."""
    asked = Search.asked[k]
    rows = len(asked["x0"])
    state = torch.zeros(rows, 10, 2, dtype=torch.float64)
    state[:, 1, 1] = tensor(Search.speeds[k])
    state[:, 0] = asked["x0"]
    number = torch.arange(rows, dtype=torch.float64) + 100 * (k + 1)
    control = asked["u"] + number[:, None, None]
    paid = sum(problem.advance(state[:, j], control[:, j])[1] for j in range(9))
    return paid + problem.terminal(state[:, 9])


def test_a_plan_has_four_steps_at_least() -> None:
    found = adp.plan_around(
        LINE, cost_of(), tensor([[0.1, 0.0]]), dt=0.3, steps=4, shrink=[1.0], iterations=1, compile=False
    )
    assert found.trajectories.control.shape == (1, 4, 1)
    with pytest.raises(ValueError, match=r"`plan_around\(steps=...\)`"):
        adp.plan_around(LINE, cost_of(), tensor([[0.1, 0.0]]), dt=0.3, steps=4.5, compile=False)  # type: ignore[arg-type]

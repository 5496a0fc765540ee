"""Newton's iteration of direct shooting by its parts: models, steps, lengths of steps, where a row ends."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from helpers import tensor, uniform
from torch import Tensor

from staf_torch import adp, systems
from staf_torch.adp.shooting import newton
from staf_torch.adp.shooting.mesh import split
from staf_torch.adp.shooting.newton import Direction, Plan
from staf_torch.adp.shooting.stage import Expansion, Stage

LINE = systems.Linear([[0.0, 1.0], [2.0, -1.0]], [[0.0], [1.0]])
COST = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
INF = math.inf


def test_a_plan_on_half_the_intervals_is_the_same_control() -> None:
    cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=2)
    stage = Stage(systems.Linear([[0.0, 1.0], [2.0, -1.0]], [[1.0, 0.0], [0.0, 1.0]]), cost)
    lengths = tensor([0.2, 0.4, 0.6])
    plan = Plan(uniform(2, 4, 2, seed=1), uniform(2, 3, 4, seed=2), tensor([1.0, 2.0]))
    feedback = uniform(2, 3, 4, 2, seed=3)
    fine, around = split(stage, plan, feedback, lengths)
    assert torch.equal(fine.state[:, ::2], plan.state)
    assert torch.equal(around[:, ::2], feedback)
    assert torch.equal(around[:, 1::2], feedback)
    assert torch.equal(fine.cost, plan.cost)
    middle = 0.5 * (plan.control[..., :2] + plan.control[..., 2:])
    torch.testing.assert_close(fine.control[:, ::2], torch.cat((plan.control[..., :2], middle), -1))
    torch.testing.assert_close(fine.control[:, 1::2], torch.cat((middle, plan.control[..., 2:]), -1))
    for k in range(3):
        half, _ = stage.advance(plan.state[:, k], fine.control[:, 2 * k], 0.5 * lengths[k])
        torch.testing.assert_close(fine.state[:, 2 * k + 1], half)


def model_cost(expansion: Expansion, z: Tensor, v: Tensor, end: Tensor, bend: Tensor) -> Tensor:
    """The quadratic model of one row: d_0 (n,), (N, 2m) changes of the control."""
    total = torch.zeros((), dtype=torch.float64)
    d = z
    for k in range(len(v)):
        both = torch.cat((d, v[k]))
        total = total + expansion.gradient[0, k] @ both + 0.5 * both @ expansion.curvature[0, k] @ both
        d = expansion.slope[0, k] @ both
    return total + end[0] @ d + 0.5 * d @ bend[0] @ d


@pytest.mark.parametrize("roomy", [None, 1e3, 0.05])
def test_a_direction_is_the_minimum_of_the_model_and_promises_what_it_falls_by(roomy: float | None) -> None:
    n, m, steps = 2, 2, 3
    root = uniform(1, steps, n + m, n + m, seed=1)
    expansion = Expansion(
        uniform(1, steps, n, n + m, seed=2),
        uniform(1, steps, n + m, seed=3),
        root @ root.mT + 0.5 * torch.eye(n + m).double(),
    )
    end, bend = uniform(1, n, seed=4), torch.eye(n).double()[None] * 1.5
    wide = torch.full((1, steps, m), roomy or 0.0, dtype=torch.float64)
    room = None if roomy is None else (-wide, wide)
    found = newton.direction(expansion, end, bend, room)
    assert found.definite.tolist() == [True]

    def followed(d: Tensor) -> Tensor:
        controls = []
        for k in range(steps):
            controls.append(found.offset[0, k] + found.feedback[0, k] @ d)
            d = expansion.slope[0, k] @ torch.cat((d, controls[-1]))
        return torch.stack(controls)

    none = torch.zeros(n).double()
    value = lambda z: model_cost(expansion, z, followed(z), end, bend)  # noqa: E731
    torch.testing.assert_close(value(none), -found.decrement[0])
    torch.testing.assert_close(torch.func.jacrev(value)(none), found.gradient[0])
    torch.testing.assert_close(found.costates[0, 0], found.gradient[0])
    assert torch.equal(found.costates[:, -1], end)
    if roomy == 0.05:
        assert float(found.offset.abs().max()) == 0.05
        assert bool((found.feedback[found.offset.abs() == 0.05] == 0).all())
        return
    for z in (none, tensor([0.3, -0.2])):  # also from beside the plan
        slope = torch.func.jacrev(lambda v, z=z: model_cost(expansion, z, v, end, bend))(followed(z))
        assert float(slope.abs().max()) < 1e-9


def test_a_model_that_bends_down_has_no_minimum_until_it_is_made_convex() -> None:
    curvature = torch.diag_embed(tensor([[[1.0, -2.0, 3.0], [1.0, 2.0, 3.0], [4e3, 1e-5, 1.0]]]))
    curvature[0, 1, 0, 0] = math.nan
    expansion = Expansion(uniform(1, 3, 1, 3), uniform(1, 3, 3), curvature)
    found = newton.convexified(expansion)
    assert found.curvature[0, 0].tolist() == torch.diag(tensor([1.0, 2.0, 3.0])).tolist()
    torch.testing.assert_close(found.curvature[0, 1].diag(), tensor([3e-6, 2.0, 3.0]))
    torch.testing.assert_close(found.curvature[0, 2].diag(), tensor([4e3, 4e-3, 1.0]))
    assert found.slope is expansion.slope
    none = torch.zeros(2, 1, 2).double()
    flat = Expansion(none.unsqueeze(2), none, torch.zeros(2, 1, 2, 2).double())
    flat.curvature[0, 0, 1, 1], flat.curvature[1, 0, 1, 1] = -1.0, 1.0
    step = newton.direction(flat, torch.zeros(2, 1).double(), torch.zeros(2, 1, 1).double())
    assert step.definite.tolist() == [False, True]


def test_the_longest_share_that_pays_is_taken_row_by_row(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a share costs is a table; the shares are told from the offset."""
    costs = {
        1.0: [0.5, 2.0, 2.0, 1.0],
        0.5: [0.1, 0.9, 2.0, 1.0],
        0.25: [0.1, 0.3, 1.0, 1.0],
        0.1: [0.1, 0.4, 1.0, 1.0],
        0.03: [0.1, 0.4, 0.9, 1.0],
        0.01: [0.1, 0.4, 0.95, 1.0],
    }

    def replay(*given: Any) -> Plan:
        offset = given[-1]
        shares = offset[..., 0, 0, 0].reshape(-1).tolist() if offset.dim() == 4 else [1.0]
        asked.append([round(share, 9) for share in shares])
        cost = tensor([costs[round(share, 9)] for share in shares])
        marks = cost[..., None, None]
        return Plan(*((marks, marks, cost) if offset.dim() == 4 else (marks[0], marks[0], cost[0])))

    asked: list[list[float]] = []
    monkeypatch.setattr(newton, "replay", replay)
    one = torch.ones(4, 1, 1).double()
    plan = Plan(one, one, torch.ones(4).double())
    none: Any = None
    step = Direction(one, none, none, none, none, none)
    best, lower = newton.improved(none, plan, none, none, step)
    assert best.cost.tolist() == [0.5, 0.3, 0.9, 1.0]
    assert best.state[:, 0, 0].tolist() == [0.5, 0.3, 0.9, 1.0]
    assert lower.tolist() == [True, True, True, False]
    assert asked == [[1.0], [0.5, 0.25, 0.1, 0.03, 0.01]]


def test_a_row_of_the_iteration_ends_where_nothing_is_promised_or_nothing_pays(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tolerance, rounding = 1e-12, 1e-9
    # A row: the promises of its models, whether each has a minimum, and whether its steps pay.
    table: list[tuple[list[float], list[bool], list[bool]]] = [
        ([tolerance], [True], []),  # 0: nothing is promised
        ([math.nan], [True], []),  # 1: costs inf
        ([tolerance, tolerance], [False, True], [True]),  # 2: no minimum at first
        ([rounding], [True], [False]),  # 3: what is promised, rounding hides
        ([1.0, 1.0, 1.0], [True, True, True], [False, False]),  # 4: nor does the convex model pay
        ([1.0, 1.0, 0.0], [True, True, True], [False, True]),  # 5: the convex model pays
        ([0.5] * 9, [True] * 9, [True] * 9),  # 6: never ends
        ([2 * rounding, 1.0, 1.0], [True] * 3, [False, False]),  # 7: more than rounding hides
    ]
    rows = len(table)
    calls = {"step": 0, "improved": 0}
    asked_rough: list[list[bool]] = []

    def at(lists: list[list[Any]], k: int) -> list[Any]:
        return [one[min(k, len(one) - 1)] if one else True for one in lists]

    def step(problem: Any, plan: Plan, lengths: Any, rough: Tensor) -> tuple[Direction, Tensor]:
        k = calls["step"]
        calls["step"] += 1
        asked_rough.append(rough.tolist())
        promise = tensor(at([list(one[0]) for one in table], k))
        definite = torch.tensor(at([list(one[1]) for one in table], k))
        mark = torch.full((rows, 1, 1), float(k)).double()
        return Direction(mark, mark, mark[:, 0], promise * plan.cost, definite, mark), rough

    def improved(stage: Any, plan: Plan, lengths: Any, terminal: Any, kept: Any) -> tuple[Plan, Tensor]:
        lower = torch.tensor(at([list(one[2]) for one in table], calls["improved"]))
        calls["improved"] += 1
        return Plan(plan.state + 1, plan.control, plan.cost), lower

    monkeypatch.setattr(newton, "_step", step)
    monkeypatch.setattr(newton, "improved", improved)
    none = torch.zeros(rows, 1, 1).double()
    cost = torch.ones(rows).double()
    cost[1] = INF
    given = {"tolerance": tolerance, "iterations": 5, "stage": None, "terminal": None}
    problem: Any = type("Problem", (), given)
    found = newton.minimise(problem, Plan(none, none, cost), torch.ones(1))
    assert found.converged.tolist() == [True, False, True, True, False, True, False, False]
    assert found.iterations.tolist() == [0, 0, 1, 1, 2, 2, 5, 2]
    assert found.plan.state[:, 0, 0].tolist() == [0.0, 0.0, 1.0, 0.0, 0.0, 1.0, 5.0, 0.0]
    assert found.feedback[:, 0, 0].tolist() == [0.0, 0.0, 1.0, 0.0, 1.0, 2.0, 5.0, 1.0]
    assert [k for k, rough in enumerate(asked_rough[1]) if rough] == [3, 4, 5, 7]
    assert calls["improved"] == 5
    assert found.promise[6] == 0.5


def test_the_end_of_a_plan_has_the_derivatives_of_what_is_paid_there() -> None:
    def value(x: Tensor) -> Tensor:
        return x[..., 0].exp() * x[..., 1].square() + x[..., 0] * x[..., 1]

    x = uniform(3, 2, seed=1)
    slope, bend = newton._derivatives(value, x)
    for k in range(3):
        torch.testing.assert_close(slope[k], torch.func.jacrev(value)(x[k]))
        torch.testing.assert_close(bend[k], torch.func.jacrev(torch.func.jacrev(value))(x[k]))
    _, flat = newton._derivatives(lambda x: x.sum(-1) * 2 + 0 * x[..., 0].square(), x)
    assert not bool(flat.any())


def test_hard_bounds_are_of_both_halves_of_a_control_and_smooth_ones_of_none() -> None:
    hard = Stage(LINE, adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1, low=-0.5, high=2.0))
    v = tensor([[-1.0, 3.0], [0.25, 1.0]])
    assert hard.admitted(v).tolist() == [[-0.5, 2.0], [0.25, 1.0]]
    room = hard.room(v)
    assert room is not None
    assert [part.tolist() for part in room] == [[[0.5, -3.5], [-0.75, -1.5]], [[3.0, -1.0], [1.75, 1.0]]]
    assert hard.input(v) is v
    smooth = Stage(LINE, adp.BoundedInputCost(1.0, 1.0, dim=2, inputs=1, low=-0.5, high=2.0))
    free = Stage(LINE, COST)
    for stage in (smooth, free):
        assert stage.room(v) is None
        assert stage.admitted(v) is v
    torch.testing.assert_close(smooth.input(v[:, :1])[0, 0], -0.5 * tensor(2.0).tanh())
    assert free.input(v) is v

"""What plans begin from and how they are carried, by stubs of what is slow."""

from __future__ import annotations

import importlib
import math
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from helpers import tensor, uniform
from helpers_plans import BOX, pushed, trajectories
from torch import Tensor

from staf_torch import adp
from staf_torch.adp import bounded_plans
from staf_torch.adp.controllers import carrying
from staf_torch.adp.plans import LocalModel, Reference, Trajectories
from staf_torch.adp.strained_plans import StrainedPlans

receding: Any = importlib.import_module("staf_torch.adp.receding_horizon")


def test_corners_of_the_bounds_are_held_before_the_feedback() -> None:
    control, feedback = bounded_plans._guesses(BOX, 8)
    corners = [[-1.0, -2.0], [0.5, -2.0]]  # the second input has no upper bound
    held = [(length, u) for length in (2, 4, 7) for u in corners]
    assert control.shape == (7, 8, 2)
    assert not bool(control[0].any())
    torch.testing.assert_close(feedback[0], (-BOX.k).expand(8, 2, 2))
    for k, (length, u) in enumerate(held, 1):
        assert control[k, :length].tolist() == [u] * length
        assert not bool(control[k, length:].any())
        assert not bool(feedback[k, :length].any())
        torch.testing.assert_close(feedback[k, length:], (-BOX.k).expand(8 - length, 2, 2))
    assert len(bounded_plans._guesses(BOX, 31)[0]) == 13
    assert len(bounded_plans._guesses(BOX, 30)[0]) == 11
    assert len(bounded_plans._guesses(BOX, 2)[0]) == 1


def test_the_cheapest_of_the_held_plans_is_taken_row_by_row() -> None:
    asked: list[Any] = []

    def solve(x: Tensor, control: Tensor, reference: Reference) -> Trajectories:
        asked.append((x, control, reference))
        return trajectories(5.0, 1.0, math.nan, 3.0, 4.0, 2.0)

    x = tensor([[0.3, 0.1], [-0.2, 0.4]])
    search: Any = SimpleNamespace(problem=BOX, steps=3, solve=solve)
    found = bounded_plans.best_held(search, x)
    assert found.cost.tolist() == [4.0, 1.0]  # of rows 0, 2, 4 and of 1, 3, 5
    start, control, reference = asked[0]
    assert torch.equal(start, x.repeat(3, 1))
    assert control[:, 0].tolist() == [[0.0, 0.0]] * 2 + [[-1.0, -2.0]] * 2 + [[0.5, -2.0]] * 2
    torch.testing.assert_close(reference.state, torch.zeros(6, 3, 2).double())
    assert [bool(part.any()) for part in reference.feedback[:, 0]] == [True, True, False, False, False, False]


def test_a_plan_of_bounds_is_searched_for_in_fifteen_rounds(monkeypatch: pytest.MonkeyPatch) -> None:
    policy: Any = SimpleNamespace(meets_bound=lambda x: x[..., :1])
    made = bounded_plans.BoundedPlans.__new__(bounded_plans.BoundedPlans)
    monkeypatch.setattr(bounded_plans, "RowFunction", lambda function, owner, name: function)
    made.__init__(BOX, 7, policy)  # type: ignore[misc]
    assert (made.steps, made._search.steps, made._search.iterations) == (7, 7, 15)
    assert made._search.problem is BOX
    assert made.strained(tensor([[1.0, 0.0], [0.0, 1.0]])).tolist() == [True, False]
    monkeypatch.setattr(bounded_plans, "best_held", lambda search, x: trajectories(1.0, 2.0))
    assert made(tensor([[1.0, 0.0], [0.0, 1.0]])).tolist() == [[0.0, 0.0], [1.0, 1.0]]


# A loop that plans where a bound would be met ------------------------------------------------------------


class Begun:
    """Carries the first state of a plan and how often it was improved."""

    width = 2

    def __init__(self) -> None:
        self.hastened, self.steps, self.inits = 0, 0, 0

    def hasten(self) -> None:
        self.hastened += 1

    def idle(self, x: Tensor) -> Any:
        return carrying(torch.cat((torch.zeros(len(x), 1), 0 * x[:, :1], 100 + x[:, :1]), dim=1))

    def init(self, x: Tensor) -> Any:
        self.inits += 1
        return carrying(torch.cat((torch.zeros(len(x), 1), 0 * x[:, :1], 200 + x[:, :1]), dim=1))

    def step(self, x: Tensor, carried: Any, uniform: Tensor, dt: float) -> tuple[Tensor, Any]:
        self.steps += 1
        assert len(uniform) == len(x)
        plan = carried.identifier
        after = torch.cat((plan[:, :1], plan[:, 1:2] + 1, plan[:, 2:]), dim=1)
        return plan[:, 2:] + plan[:, 1:2] + dt, carried._replace(identifier=after)


def strained(compiled: bool = False) -> StrainedPlans:
    class Policy(torch.nn.Module):
        period, cost = 0.25, SimpleNamespace(inputs=1)

        def forward(self, x: Tensor) -> Tensor:
            return -x[:, :1]

    policy: Any = Policy()
    policy.compiled = compiled
    planner: Any = SimpleNamespace(strained=lambda x: ~(x[:, 0] < 1), hasten=lambda: hastened.append(1))
    hastened: list[int] = []
    loop = StrainedPlans(policy, planner, Begun())  # type: ignore[arg-type]
    loop.hastened = hastened  # type: ignore[assignment]
    return loop


def test_a_loop_plans_in_the_rows_that_need_it_and_carries_on_in_those_that_still_do() -> None:
    loop = strained()
    begun: Any = loop._begun
    assert (loop.label, loop.period) == ("Policy", 0.25)
    x = tensor([[2.0, 0.0], [0.5, 0.0], [3.0, 0.0], [math.nan, 0.0]])
    first = loop.init(x)
    assert first.identifier.tolist() == [[0.0, 0.0, 202.0], [-1.0] * 3, [0.0, 0.0, 203.0], [-1.0] * 3]
    assert (begun.hastened, begun.steps, begun.inits, loop.hastened) == (0, 0, 1, [])
    none = torch.zeros(4, 0)
    before = first.identifier.clone()
    ahead = tensor([[2.5, 0.0], [1.5, 0.0], [0.5, 0.0], [0.7, 0.0]])
    for step in (loop.step, loop._traced):
        u, after = step(ahead, first, none, 0.25)
        torch.testing.assert_close(u, tensor([[202.25], [101.75], [-0.5], [-0.7]]))
        wanted = [[0.0, 1.0, 202.0], [0.0, 1.0, 101.5], [-1.0] * 3, [-1.0] * 3]
        torch.testing.assert_close(after.identifier, tensor(wanted))
        assert torch.equal(first.identifier, before)
    far = ahead.abs() + 2
    u, more = loop.step(far, after, none, 0.25)  # all rows plan
    torch.testing.assert_close(u, tensor([[203.25], [102.75], [102.75], [102.95]]))
    near = 0.1 * ahead
    u, ended = loop.step(near, more, none, 0.25)
    assert torch.equal(u, -near[:, :1])
    assert torch.equal(ended.identifier, torch.full((4, 3), -1.0).double())
    assert loop.step(near, ended, none, 0.25)[1] is ended
    one = ended._replace(
        identifier=more.identifier * tensor([[1.0], [0.0], [0.0], [0.0]]) - tensor([[0.0], [1], [1], [1]])
    )
    assert torch.equal(loop.step(near, one, none, 0.25)[1].identifier, ended.identifier)


def test_a_loop_of_a_compiled_policy_makes_its_programs_before_it_begins() -> None:
    loop = strained(compiled=True)
    begun: Any = loop._begun
    assert loop.init(tensor([[0.5, 0.0]])).identifier.tolist() == [[-1.0] * 3]
    assert (begun.hastened, begun.steps, begun.inits, loop.hastened) == (1, 1, 0, [1])


# A plan that recedes -------------------------------------------------------------------------------------


def test_a_carried_plan_is_laid_out_as_it_is_read() -> None:
    mpc = adp.RecedingHorizon(BOX, steps=3, iterations=2, compile=False)
    assert (mpc.width, mpc.steps, mpc.iterations, mpc.costly) == (3 * 8, 3, 2, True)
    assert mpc._search is not None
    assert (mpc._search.steps, mpc._search.iterations, mpc._first.steps, mpc._first.iterations) == (
        3,
        2,
        3,
        60,
    )
    programs = [mpc._whole, mpc._first._back, mpc._search._back]
    assert [program.compile for program in programs] == [False] * 3
    x = uniform(2, 2, seed=1)
    idle = mpc.idle(x).identifier
    assert idle.shape == (2, 1 + mpc.width)
    control, reference = mpc._begun(x, idle)
    torch.testing.assert_close(control, torch.zeros(2, 3, 2).double())
    torch.testing.assert_close(reference.state, torch.zeros(2, 3, 2).double())
    torch.testing.assert_close(reference.feedback, (-BOX.k).expand(2, 3, 2, 2))
    state, u, feedback = uniform(2, 3, 2, seed=2), uniform(2, 3, 2, seed=3), uniform(2, 3, 2, 2, seed=4)
    rows = torch.cat((state, u, feedback.flatten(2)), dim=-1)
    control, reference = mpc._begun(x, receding._carrying(rows).identifier)
    assert torch.equal(control, u)
    assert torch.equal(reference.state, state)
    assert torch.equal(reference.feedback, feedback)
    ahead = mpc._ahead(rows, x).identifier
    control, reference = mpc._begun(x, ahead)
    assert torch.equal(control[:, :2], u[:, 1:])
    assert torch.equal(reference.feedback[:, :2], feedback[:, 1:])
    assert not bool(control[:, 2].any())
    assert not bool(reference.state[:, 2].any())
    torch.testing.assert_close(reference.feedback[:, 2], (-BOX.k).expand(2, 2, 2))
    assert ahead[:, 0].tolist() == [0.0, 0.0]
    with pytest.raises(ValueError, match=r"`RecedingHorizon\(iterations=...\)` must be at least 0"):
        adp.RecedingHorizon(BOX, steps=3, iterations=-1)


def test_plans_within_bounds_hasten_what_tells_whether_a_bound_is_met() -> None:
    asked: list[str] = []
    plans = bounded_plans.BoundedPlans.__new__(bounded_plans.BoundedPlans)
    plans._strained = SimpleNamespace(hasten=lambda: asked.append("strained"))  # type: ignore[assignment]
    plans.hasten()
    assert asked == ["strained"]


def test_the_first_control_of_the_best_plan_is_applied(monkeypatch: pytest.MonkeyPatch) -> None:
    plans = bounded_plans.BoundedPlans.__new__(bounded_plans.BoundedPlans)
    plans._search = object()  # type: ignore[assignment]
    control, x = uniform(4, 7, 2), uniform(4, 3)

    def best(search: object, at: Tensor) -> SimpleNamespace:
        assert search is plans._search
        assert at is x
        return SimpleNamespace(control=control)

    monkeypatch.setattr(bounded_plans, "best_held", best)
    assert torch.equal(plans(x), control[:, 0])


def test_a_plan_that_is_followed_answers_with_its_feedback_and_ends_in_that_of_the_goal(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    mpc = adp.RecedingHorizon(BOX, steps=3, iterations=0, compile=False)
    assert not mpc.costly
    mpc.hasten()
    assert not mpc._hastened
    state, u, feedback = uniform(2, 3, 2, seed=2), 0.1 * uniform(2, 3, 2, seed=3), uniform(2, 3, 2, 2, seed=4)
    rows = torch.cat((state, u, feedback.flatten(2)), dim=-1)
    carried, x = receding._carrying(rows), 0.3 * uniform(2, 2, seed=5)
    for k in range(5):
        answered = (
            u[:, k] + (feedback[:, k] @ (x - state[:, k]).unsqueeze(-1)).squeeze(-1)
            if k < 3
            else -x @ BOX.k.mT
        )
        wanted = torch.minimum(torch.maximum(answered, BOX.bounds.low), BOX.bounds.high)
        with monkeypatch.context() as inside:
            inside.setattr(receding, "tracing_now", lambda: True)
            torch.testing.assert_close(mpc.step(x, carried, x, 0.1)[0], wanted)
        found, carried = mpc.step(x, carried, x, 0.1)
        torch.testing.assert_close(found, wanted)
        assert carried.identifier[:, 0].tolist() == [k + 1.0] * 2
        assert torch.equal(carried.identifier[:, 1:], rows.flatten(1))


def test_the_first_plan_is_the_memorys_the_best_held_or_that_of_the_feedback(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    x, ends = uniform(2, 2, seed=1), LocalModel(*[torch.zeros(2)] * 4)
    control, reference = (
        0.1 * uniform(2, 3, 2, seed=2),
        Reference(uniform(2, 3, 2, seed=3), uniform(2, 3, 2, 2, seed=4)),
    )
    asked: list[Any] = []

    class Memory(torch.nn.Module):
        problem = BOX

        def choose(self, x: Tensor) -> Any:
            return SimpleNamespace(entry=torch.tensor([4, 7]))

        def replay(self, x: Tensor, entries: Tensor, steps: int) -> Any:
            assert (entries.tolist(), steps) == ([4, 7], 3)
            return control, reference

        def model(self, x: Tensor) -> LocalModel:
            asked.append(x)
            return ends

    def solve(self: Any, *given: Any) -> Trajectories:
        asked.append(given)
        return trajectories(1.0, 2.0)

    memory: Any = Memory()
    monkeypatch.setattr(adp.BoxDDP, "solve", solve)
    monkeypatch.setattr(receding, "best_from", lambda memory, search, x: trajectories(1.0, 2.0, mark=5.0))
    monkeypatch.setattr(receding, "best_held", lambda search, x: trajectories(1.0, 2.0, mark=9.0))

    def first(**given: Any) -> float:
        asked.clear()
        return float(adp.RecedingHorizon(BOX, steps=3, compile=False, **given).init(x).identifier[0, 1])

    assert first(memory=memory, iterations=0) == 5.0
    assert first(held=True) == first(held=True, iterations=0) == 9.0
    for given in ({}, {"iterations": 0}):
        assert first(**given) == 0.0
        assert [None if part is x else part for part in asked[0]] == [None] * 4
    assert first(memory=memory) == 0.0
    at = x
    for k in range(3):
        u = control[:, k] + (reference.feedback[:, k] @ (at - reference.state[:, k]).unsqueeze(-1)).squeeze(
            -1
        )
        at, _ = pushed(at, torch.minimum(torch.maximum(u, BOX.bounds.low), BOX.bounds.high))
    torch.testing.assert_close(asked[0], at)
    assert asked[1] == (x, control, reference, ends)
    mpc = adp.RecedingHorizon(BOX, steps=3, memory=memory, compile=False)
    mpc.hasten()
    assert not mpc._hastened
    asked.clear()
    u, after = mpc.step(x, mpc.init(x), x, 0.1)
    assert asked[-1] == (x, control, reference, ends)
    assert u.tolist() == [[0.0, 0.0], [1.0, 1.0]]
    assert after.identifier[1, 1:3].tolist() == [1.0, 1.0]
    plain = adp.RecedingHorizon(BOX, steps=3, compile=False)
    plain.hasten()
    assert plain._hastened

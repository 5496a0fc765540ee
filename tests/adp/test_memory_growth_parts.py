"""How a memory grows, by stubs of what is slow: what is swept, kept, guessed and said."""

from __future__ import annotations

import logging
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from helpers import tensor, uniform
from helpers_plans import BOX, pushed, trajectories
from torch import Tensor

from staf_torch import adp
from staf_torch.adp import memory_growth
from staf_torch.adp.plans import Reference, Trajectories


def test_a_memory_grows_by_what_it_did_not_know_to_a_hundredth(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    searches, memories, drawn, swept = [], [], [], []

    class Memory:
        def __init__(self, problem: Any, library: Any, width: Tensor, **given: int) -> None:
            assert problem is BOX
            assert width.dtype == torch.float64
            memories.append((len(library.cost), width.tolist(), given))
            self.library = library

        def choose(self, x: Tensor) -> Any:
            return SimpleNamespace(value=tensor([100.0, 101.0, 101.1, 99.0, 150.0]))

    def search(problem: Any, **given: Any) -> str:
        searches.append(given)
        return "search"

    def first(search: Any, x: Tensor, generator: Any) -> Trajectories:
        drawn.append(x)
        return trajectories(*[1.0] * len(x))

    def best(known: Any, search: Any, x: Tensor) -> Trajectories:
        drawn.append(x)
        return trajectories(*[100.0] * 5, mark=10.0)

    def sweep(memory: Any, search: Any) -> Trajectories:
        swept.append(len(memory.library.cost))
        return memory.library  # type: ignore[no-any-return]

    for name, stub in (
        ("GlobalValue", Memory),
        ("BoxDDP", search),
        ("_first", first),
        ("best_from", best),
        ("swept", sweep),
    ):
        monkeypatch.setattr(memory_growth, name, stub)
    with caplog.at_level(logging.INFO):
        grown: Any = adp.learn_global_value(
            BOX, [2.0, 0.5], steps=9, trajectories=500, rounds=2, states=5, seed=3, candidates=7, lookahead=8
        )
    assert searches == [{"steps": 9, "iterations": 40, "tolerance": 1e-5}]
    given = {"candidates": 7, "lookahead": 8}
    assert memories == [(size, [2.0, 0.5], given) for size in (500, 500, 502, 502, 504, 504)]
    assert swept == [500, 502, 504]
    assert grown.library.state[-2:, 0, 0].tolist() == [12.0, 14.0]
    assert [len(x) for x in drawn] == [500, 5, 5]
    assert float(drawn[0][:, 0].abs().max()) == pytest.approx(2.0, rel=0.02)
    assert float(drawn[0][:, 1].abs().max()) == pytest.approx(0.5, rel=0.02)
    assert abs(float(drawn[0].mean())) < 0.1
    assert not torch.equal(drawn[1], drawn[2])
    assert [record.getMessage() for record in caplog.records] == [
        f"round {k}: 60.0 % of 5 fresh states known to 1 %" for k in (1, 2)
    ]
    again: Any = adp.learn_global_value(BOX, [2.0, 0.5], steps=9, trajectories=4, rounds=0, seed=3)
    assert len(again.library.cost) == 4
    assert torch.equal(drawn[3][0, :1], drawn[0][0, :1])  # of the seed
    assert memories[-1][2] == {"candidates": 48, "lookahead": 60}


def test_a_sweep_keeps_what_is_cheaper_and_no_trajectory_helps_itself(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    library = trajectories(1.0, 2.0, 3.0)
    asked: list[Any] = []

    def best(memory: Any, search: Any, x: Tensor, own: Tensor) -> Trajectories:
        asked.append((x, own))
        return trajectories(1.0, 1.5, 4.0, mark=10.0)

    monkeypatch.setattr(memory_growth, "best_from", best)
    memory: Any = SimpleNamespace(library=library)
    found = memory_growth.swept(memory, None)  # type: ignore[arg-type]
    assert found.cost.tolist() == [1.0, 1.5, 3.0]
    assert found.state[:, 0, 0].tolist() == found.curvature[:, 0, 0, 0].tolist() == [0.0, 11.0, 2.0]
    assert asked[0][0].tolist() == library.state[:, 0].tolist()
    assert asked[0][1].tolist() == [0, 1, 2]


def test_of_the_plans_of_a_state_the_cheapest_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    owner, x = torch.tensor([0, 1, 0, 1, 0]), tensor([[0.1, 0.2], [0.3, 0.4]])
    seen = {}

    def guesses(memory: Any, steps: int, x: Tensor, own: Any) -> Any:
        seen["steps"], seen["own"] = steps, own
        return memory_growth.Guesses(owner, torch.zeros(5, 3, 2), Reference(x, x))

    def solve(x0: Tensor, control: Tensor, reference: Reference) -> Trajectories:
        seen["x0"] = x0
        return trajectories(3.0, 2.0, 1.0, 5.0, 4.0)

    monkeypatch.setattr(memory_growth, "_guesses", guesses)
    search: Any = SimpleNamespace(steps=3, solve=solve)
    found = memory_growth.best_from(None, search, x)  # type: ignore[arg-type]
    assert found.cost.tolist() == [1.0, 2.0]
    assert (seen["steps"], seen["own"]) == (3, None)
    assert torch.equal(seen["x0"], x[owner])


def test_the_first_trajectories_begin_at_rest_and_from_two_that_jump() -> None:
    asked: list[Any] = []

    def solve(x0: Tensor, control: Tensor) -> Trajectories:
        asked.append((x0, control))
        costs = torch.full((3, 40), 2.0).double()
        costs[0, 0] = costs[1, 1] = costs[2, 2] = 1.0
        return trajectories(*costs.flatten().tolist())

    x = uniform(40, 2, seed=1)
    search: Any = SimpleNamespace(problem=BOX, steps=23, solve=solve)
    found = memory_growth._first(search, x, torch.Generator().manual_seed(0))
    assert found.state[:4, 0, 0].tolist() == [0.0, 41.0, 82.0, 3.0]
    start, control = asked[0]
    assert torch.equal(start, x.repeat(3, 1))
    assert control.shape == (120, 23, 2)
    assert not bool(control[:40].any())
    jumps = (control[40:, 1:] != control[40:, :-1]).any(-1).any(0).nonzero().flatten().tolist()
    assert jumps == [9, 19]
    levels = {tuple(level) for level in BOX.levels().tolist()}
    assert {tuple(u) for u in control[40:].flatten(0, 1).tolist()} == levels


def test_the_plans_of_a_memory_are_the_three_cheapest_also_after_a_hold() -> None:
    """A memory whose entries cost by a table; after a hold what is left is 5 |x|^2."""
    x, own, steps = tensor([[0.3, 0.1], [-2.0, 0.9]]), torch.tensor([5, 6]), 5
    table = tensor([[0.4, 9.0, 0.3, 8.0], [9.0, 8.5, 9.5, 7.9]])
    entries = torch.tensor([[11, 12, 13, 14], [21, 22, 23, 24]])

    class Memory:
        problem = BOX

        def nearest(self, x: Tensor, given: Tensor) -> Tensor:
            assert given is own
            return entries

        def follow(self, x: Tensor, given: Tensor) -> tuple[Tensor, None, None]:
            assert given is entries
            return table, None, None

        def choose(self, x: Tensor, given: Tensor) -> Any:
            assert given is own
            return SimpleNamespace(value=5 * x.square().sum(-1), entry=(1000 * x[:, 0]).round().long())

        def replay(self, x: Tensor, entry: Tensor, steps: int) -> tuple[Tensor, Reference]:
            control = entry.double()[:, None, None].expand(-1, steps, 2)
            state = x.unsqueeze(1).expand(-1, steps, 2) + torch.arange(steps).double()[None, :, None]
            return control, Reference(state, 7 + torch.zeros(len(x), steps, 2, 2).double())

    made: Any = Memory()
    found = memory_growth._guesses(made, steps, x, own)
    assert sorted(found.owner.tolist()) == [0, 0, 0, 1, 1, 1]
    for row in range(2):
        plans: list[tuple[float, int, list[float], int, Tensor]] = [
            (float(cost), 0, [0.0, 0.0], int(entry), x[row])
            for cost, entry in sorted(
                zip(table[row], entries[row], strict=True), key=lambda pair: float(pair[0])
            )[:3]
        ]
        for length in (2, 4):
            for u in BOX.levels():
                at, paid = x[row], 0.0
                for _ in range(length):
                    at, now = pushed(at, u)
                    paid += float(now)
                cost = paid + 5 * float(at.square().sum())
                plans.append((cost, length, u.tolist(), round(1000 * float(at[0])), at))
        best = sorted(plans, key=lambda plan: plan[0])[:3]
        if row == 0:
            assert {plan[1] for plan in best} == {0, 2} or {plan[1] for plan in best} == {0, 2, 4}
        wanted = {(plan[1], *plan[2], plan[3]) for plan in best}
        mine = set()
        for k in (found.owner == row).nonzero().flatten().tolist():
            control, state, feedback = found.control[k], found.reference.state[k], found.reference.feedback[k]
            held = int((feedback == 0).all(-1).all(-1).sum())
            mine.add((held, *(control[0].tolist() if held else [0.0, 0.0]), round(float(control[-1, 0]))))
            assert control.shape == (steps, 2)
            assert bool((control[:held] == control[0]).all())
            assert bool((feedback[held:] == 7).all())
            torch.testing.assert_close(state[held:, 0] - state[held, 0], torch.arange(steps - held).double())
            assert bool((state[: held + 1] == state[held]).all())
        assert mine == wanted

"""What `rivals` makes of a method that steers: its episode, its times, the best that is known, its row."""

from __future__ import annotations

import dataclasses
import math
import sys
import types
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from composing import settings
from helpers import tensor, uniform
from torch import Tensor

from staf_torch.experiments import rivals
from staf_torch.experiments.rival_methods import Method, UnsuitableError
from staf_torch.experiments.rival_plants import CASES, Case
from staf_torch.results.progress import Progress


class Cart:
    """x+ = x + u, which costs |x| of its first coordinate; inputs in [-1, 3] and [-2, 2]."""

    bounds = SimpleNamespace(low=tensor([-1.0, -2.0]), high=tensor([3.0, 2.0]))

    def admissible(self, u: Tensor) -> Tensor:
        return u.maximum(self.bounds.low).minimum(self.bounds.high)

    def advance(self, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        return x + u, x[:, 0].abs() + 1

    def terminal(self, x: Tensor) -> Tensor:
        return x[:, 1].square()


CART: Any = Cart()


def test_an_episode_is_what_the_bounds_left_of_the_controls() -> None:
    wanted = iter(
        [
            tensor([[2.0, 0.0], [3.0 + 3e-6, 0.0]]),  # just beyond the upper bound, within what solvers round
            tensor([[0.0, 2.0 + 5e-6], [-1.0 - 5e-6, 0.0]]),  # both beyond it
            tensor([[-4.0, 5.0], [1.0, 1.0]]),  # the first
            tensor([[0.5, -0.5], [0.0, 0.0]]),
        ]
    )
    seen: list[Tensor] = []

    def begin(x0: Tensor) -> Callable[[Tensor], Tensor]:
        seen.append(x0)
        return lambda x: seen.append(x) or next(wanted)

    x0 = tensor([[1.0, 2.0], [-3.0, 0.5]])
    episode = rivals.play(CART, begin, x0, 4, offline=0.25)
    moves = tensor([[[2, 0], [0, 2], [-1, 2], [0.5, -0.5]], [[3, 0], [-1, 0], [1, 1], [0, 0]]])
    assert torch.equal(episode.control, moves)
    states = torch.cat((x0.unsqueeze(1), x0.unsqueeze(1) + moves.cumsum(1)), dim=1)
    torch.testing.assert_close(episode.state, states)
    left = states[:, -1, 1].square()
    torch.testing.assert_close(episode.left, left)
    torch.testing.assert_close(episode.cost, (states[:, :-1, 0].abs() + 1).sum(1) + left)
    assert episode.outside == pytest.approx((0 + 1 + 0.5 + 0) / 4)
    assert episode.offline == 0.25
    assert torch.equal(seen[0], x0)
    torch.testing.assert_close(torch.stack(seen[1:], 1), states[:, :-1])


def test_an_episode_that_loses_its_numbers_costs_infinitely_much() -> None:
    begin = lambda x0: lambda x: torch.zeros_like(x)  # noqa: E731
    episode = rivals.play(CART, begin, tensor([[1.0, math.inf], [1.0, 0.0], [math.nan, 0.0]]), 2)
    assert episode.cost.tolist() == [math.inf, 4.0, math.inf]
    assert (episode.outside, episode.offline) == (0.0, 0.0)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every reading is later than the last by twice, thrice, ... a second."""

    def readings() -> Iterator[float]:
        time, step = 5.0, 1.0
        while True:
            yield time
            time, step = time + step, step + 1

    ticks = readings()
    monkeypatch.setattr(rivals.time, "process_time", lambda: next(ticks))


@pytest.mark.usefixtures("clock")
def test_times_are_in_microseconds_without_the_first_tenth() -> None:
    seen: list[Tensor] = []

    def begin(x0: Tensor) -> Callable[[Tensor], Tensor]:
        return lambda x: seen.append(x) or torch.full_like(x, 9.0)

    found = rivals.timed(CART, begin, tensor([[0.0, 0.0]]), 20)
    # Readings 5, 6, 8, 11, 15, ...: a control takes 1, 3, 5, ... s; two of twenty are left out.
    assert found == [1e6 * (2 * k + 1) for k in range(2, 20)]
    assert torch.stack(seen)[:, 0].tolist() == [[3.0 * k, 2.0 * k] for k in range(20)]


def test_a_row_is_of_the_states_from_which_little_is_left() -> None:
    best = tensor([1.0, 2.0, 4.0, 1.0])
    episode = rivals.Episode(
        cost=tensor([1.5, 3.0, 4.0, 9.0]),
        control=torch.zeros(4, 1, 1),
        state=torch.zeros(4, 2, 1),
        left=tensor([0.25, 0.4, 1.0, 0.5]),  # of a share of a quarter: at the edge, below, at the edge, above
        outside=0.125,
        offline=3.0,
    )
    found = rivals._measured(episode, [1.0, 2.0, 6.0], best, 0.25)
    assert (found["ratio_median"], found["ratio_max"]) == (1.5, 1.5)  # 1.5, 1.5 and 1
    assert found["regulated"] == 0.75
    assert (found["violations"], found["offline"], found["us_median"]) == (0.125, 3.0, 2.0)
    assert found["us_p99"] == pytest.approx(2 + 0.98 * 4)
    none = rivals._measured(episode, [1.0], best, 0.0)
    assert (none["ratio_median"], none["ratio_max"], none["regulated"]) == (None, None, 0.0)


class Search:
    """Stands for box-DDP: from a guess it finds what it is told, row by row."""

    costs: ClassVar[dict[float, float]] = {}
    asked: ClassVar[list[Any]] = []

    def __init__(self, problem: object, steps: int, iterations: int) -> None:
        Search.asked = [(steps, iterations)]

    def solve(self, x0: Tensor, guess: Tensor | None = None) -> Any:
        Search.asked.append((x0.clone(), None if guess is None else guess.clone()))
        if guess is None:
            return SimpleNamespace(cost=tensor([4.0, 4.0, 4.0]), control=100 + x0, state=1000 + x0)
        found = tensor([self.costs[float(each)] for each in guess[:, 0]])
        return SimpleNamespace(cost=found, control=guess + 0.5, state=2000 + guess)


def ran(costs: list[float], marks: list[float]) -> rivals.Episode:
    """An episode whose controls are marked."""
    control = tensor(marks).unsqueeze(-1)
    return rivals.Episode(tensor(costs), control, control, tensor(costs), 0.0, 0.0)


def test_the_best_known_is_the_lowest_of_all_that_was_reached(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rivals, "BoxDDP", Search)
    monkeypatch.setattr(Method, "missing", property(lambda method: "it"))
    monkeypatch.setattr(Search, "costs", {1.0: 3.5, 3.0: 5.0, 4.0: 4.0, 6.0: 3.0})
    x0 = tensor([[0.0], [1.0], [2.0]])
    case: Any = dataclasses.replace(CASES["double_integrator"], steps=12)
    first = ran([3.9, math.inf, 4000.0 * 0.99], [1.0, 2.0, 3.0])
    few = ran([4e3, 3.8], [4.0, 6.0])  # from the first states; the first of them is as dear as a thousand
    lost = ran([math.nan, math.inf, 4e3], [7.0, 8.0, 9.0])
    best = rivals.best_known(case, CART, x0, [first, few, lost])
    assert Search.asked[0] == (12, 100)
    assert torch.equal(Search.asked[1][0], x0)
    (_, _, *refined) = Search.asked
    assert [(a.flatten().tolist(), b.flatten().tolist()) for a, b in refined] == [
        ([0.0, 2.0], [1.0, 3.0]),
        ([1.0], [6.0]),
    ]
    assert best.tolist() == [3.5, 3.0, 4.0]
    cheap = ran([2.0, 9.0, 3.9999], [1.0, 1.0, 3.0])  # what a method reached without being refined counts
    assert rivals.best_known(case, CART, x0, [cheap]).tolist() == [2.0, 3.5, 3.9999]


def test_ipopt_begins_from_the_best_of_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rivals, "BoxDDP", Search)
    monkeypatch.setattr(Method, "missing", property(lambda method: None if method.name == "IPOPT" else "it"))
    monkeypatch.setattr(Search, "costs", {1.0: 3.5, 2.0: 4.0, 3.0: 5.0})
    seen: list[Any] = []

    def by_ipopt(case: Case, problem: object, x0: Tensor, control: Tensor, state: Tensor) -> Tensor:
        seen.extend((control, state))
        return tensor([9.0, 1.0, math.inf])

    monkeypatch.setattr(rivals, "_by_ipopt", by_ipopt)
    x0 = tensor([[0.0], [1.0], [2.0]])
    case: Any = CASES["double_integrator"]
    best = rivals.best_known(case, CART, x0, [ran([5.0, 5.0, 5.0], [1.0, 2.0, 3.0])])
    assert best.tolist() == [3.5, 1.0, 4.0]
    control, state = (each.flatten().tolist() for each in seen)
    assert control == [1.5, 101.0, 102.0]  # the first is refined, of two that are as dear the first found
    assert state == [2001.0, 1001.0, 1002.0]


def test_a_whole_episode_is_given_to_ipopt_from_where_it_went(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "casadi", types.ModuleType("casadi"))
    asked: list[Any] = []

    def program(casadi: Any, case: Case, problem: Any, steps: int) -> Any:
        asked.append((case.name, problem, steps))

        def solve(x0: np.ndarray, p: np.ndarray) -> dict[str, Any]:
            asked.append((x0.tolist(), p.tolist()))
            return {"f": np.float64(7.0 + p[0]), "success": p[0] != 2.0}

        return solve

    monkeypatch.setattr(rivals, "ipopt_program", program)
    case = dataclasses.replace(CASES["double_integrator"], steps=2)
    x0 = tensor([[1.0, 5.0, 0.0], [2.0, 6.0, 0.0]])  # with the time, as where there is a path
    state, control = uniform(2, 3, 3, seed=1), uniform(2, 2, 1, seed=2)
    found = rivals._by_ipopt(case, CART, x0, control, state)
    assert found.tolist() == [8.0, math.inf]
    assert found.dtype == torch.float64
    assert asked[0] == ("double_integrator", CART, 2)
    for row in range(2):
        guess = [*state[row, :, :2].flatten().tolist(), *control[row].flatten().tolist()]
        assert asked[1 + row] == (guess, [*x0[row, :2].tolist(), 0.0])


@pytest.mark.usefixtures("clock")
def test_methods_are_begun_played_and_timed_and_the_slow_ones_from_fewer_states(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    told: list[Any] = []

    def prepared(case: Case) -> Callable[[Tensor], str]:
        return lambda x0: told.append(("begun", len(x0))) or "steer"

    def unsuited(case: Case) -> Any:
        raise UnsuitableError("is not made for it")

    def play(problem: object, begin: Any, x0: Tensor, steps: int, offline: float) -> rivals.Episode:
        told.append(("played", len(x0), steps, offline))
        rows = len(x0)
        return rivals.Episode(
            torch.full((rows,), 3.0), torch.zeros(1), torch.zeros(1), torch.zeros(rows), 0, offline
        )

    def timed(problem: object, begin: Any, x: Tensor, calls: int) -> list[float]:
        told.append(("timed", len(x), calls))
        return [1.0]

    monkeypatch.setattr(rivals, "play", play)
    monkeypatch.setattr(rivals, "timed", timed)
    monkeypatch.setattr(rivals, "best_known", lambda case, problem, x0, episodes: tensor([1.0, 2.0, 3.0]))
    methods = [Method("quick", prepared), Method("slow", prepared, slow=True), Method("unsuited", unsuited)]
    methods.append(Method("absent", prepared, ("no-such-package",)))
    case = dataclasses.replace(CASES["double_integrator"], steps=9)
    quick, slow, other, absent = rivals.compare(case, methods, case.states(3, 0), 11, slow=2)
    # A control is begun between two readings of the clock, 1 and 3 s apart.
    assert told == [
        *(("begun", 1), ("played", 3, 9, 1.0), ("timed", 1, 11)),
        *(("begun", 1), ("played", 2, 9, 3.0), ("timed", 1, 3)),
    ]
    assert (quick["note"], slow["note"]) == (None, "from 2 of the 3 states")
    assert (quick["ratio_max"], slow["ratio_max"]) == (3.0, 3.0)
    assert (quick["ratio_median"], slow["ratio_median"]) == (1.5, 1.5)  # torch's median is the lower one
    assert (other["note"], absent["note"]) == ("is not made for it", "no-such-package is not installed")
    assert (other["megabytes"], absent["megabytes"]) == (0, None)
    numbers = ("ratio_median", "ratio_max", "regulated", "violations", "us_median", "us_p99", "offline")
    for row in (other, absent):
        assert all(row[name] is None for name in numbers)
    assert [row["plant"] for row in (quick, absent)] == ["double_integrator"] * 2
    told.clear()
    rivals.compare(case, methods[1:2], case.states(3, 0), 11, slow=3)
    assert [each[1] for each in told] == [1, 3, 1]
    rivals.compare(case, methods[1:2], case.states(3, 0), 11)  # None: as many as the others
    assert [each[1] for each in told[3:]] == [1, 3, 1]


def test_a_run_has_a_row_a_plant_and_method_and_tells_how_far_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[Any] = []
    told: list[float] = []
    drawn: list[Any] = []

    def compare(case: Case, methods: list[Method], x0: Tensor, calls: int, slow: int) -> list[dict[str, Any]]:
        asked.append((case.name, [method.name for method in methods], len(x0), calls, slow))
        assert torch.equal(x0, case.states(len(x0), 3))
        some = {"ratio_median": 1.2345678, "ratio_max": math.inf, "regulated": 1.0, "violations": 0.0}
        return [{"plant": case.name, "method": method.name, "lines": 3} | some for method in methods]

    monkeypatch.setattr(rivals, "compare", compare)
    monkeypatch.setattr(rivals, "draw_rivals", lambda rows: drawn.append(list(rows)))
    monkeypatch.setattr(rivals, "images", lambda figure: {"txt": b"drawn"})
    given = ("rivals.plants=[pendulum,quadrotor]", "rivals.methods=[near_optimal planned,box-DDP]", "seed=3")
    cfg = settings("experiment=rivals", *given, "rivals.states=4", "rivals.slow=9", "rivals.calls=5")
    found = rivals.run(cfg, tmp_path, Progress(told.append))
    names = ["near_optimal planned", "box-DDP"]
    assert asked == [("pendulum", names, 4, 5, 4), ("quadrotor", names, 4, 5, 4)]
    keys = [
        f"{plant}_{name}"
        for plant in ("pendulum", "quadrotor")
        for name in ("near_optimal_planned", "box_ddp")
    ]
    some = {"ratio_median": 1.2345678, "ratio_max": None, "regulated": 1.0, "violations": 0.0}
    assert found == {f"{key}_{name}": number for key in keys for name, number in some.items()}
    assert len((tmp_path / "rivals.csv").read_text().splitlines()) == 5
    assert " 1.2346 |" in (tmp_path / "rivals.md").read_text()  # five digits
    assert len(drawn[0]) == 4
    assert (tmp_path / "figures" / "rivals.txt").exists()
    assert told[-1] == 1
    other = tmp_path / "other"
    other.mkdir()
    rivals.run(
        settings("experiment=rivals", *given, "rivals.slow=1", "rivals.states=2", "figures=false"), other
    )
    assert asked[-1][-1] == 1
    least = ("rivals.states=1", "rivals.slow=1", "rivals.calls=1", "figures=false")
    rivals.run(settings("experiment=rivals", *given, *least), other)
    assert asked[-1][2:] == (1, 1, 1)
    assert not (other / "figures").exists()
    assert rivals._key("box-DDP of mine") == "box_ddp_of_mine"

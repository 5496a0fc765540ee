"""What a gradient chase keeps, says and writes, and the blocks in which it runs."""

from __future__ import annotations

import dataclasses
import warnings
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from composing import settings
from helpers import tensor, uniform
from torch import Tensor

from staf_torch.experiments import chase_batch, gradient_chase
from staf_torch.experiments.chase_batch import HISTORY, Outcome
from staf_torch.experiments.gradient_chase import ChaseSolution, GradientChase, Title
from staf_torch.results.progress import Progress
from staf_torch.settings.chase import chase_problem

SHORT = ("dt=0.05", "duration=0.5", "settle_time=0.2")


def title(**changes: Any) -> Title:
    given = {"rows": 2, "times": 11, "dt": 0.5, "settle_time": 2.0, "method": "a method", "work": 3.0}
    return Title(**given | changes)


@pytest.mark.parametrize(
    ("words", "predictor"), [((), ""), (("predictor=tangent", "predictor.order=2"), ", tangent predictor")]
)
def test_a_title_says_what_is_run_and_how_much_work_a_second_takes(
    words: tuple[str, ...], predictor: str
) -> None:
    problem = chase_problem(settings(*SHORT, *words, "trajectories=3", "optimizer.inner_steps=4"))
    found = Title.of(problem)
    count = problem.basis.count
    assert (found.rows, found.times, found.dt, found.settle_time) == (3, 11, 0.05, 0.2)
    assert found.method == f"{count} centers, ExponentialKernel, SteepestDescent x 4{predictor}"
    work = problem.law.products(count, 4)
    work += problem.predictor.products(count) if problem.predictor is not None else 0
    assert found.work == pytest.approx(work / 0.05)
    assert (problem.predictor is not None) == bool(predictor)
    assert gradient_chase._times(found).tolist() == pytest.approx([0.05 * k for k in range(11)])


def test_what_is_solved_cannot_be_changed() -> None:
    outcome = Outcome({"a": 1.0}, {}, torch.zeros(1))
    solved = ChaseSolution(title(), outcome, np.zeros((1, 2)))
    assert (outcome.warnings, solved.warnings, solved.history) == ((), (), None)
    assert solved.metrics == {"a": 1.0, "products_per_second": 3.0}
    for each, name in ((outcome, "drawn"), (solved, "title"), (title(), "dt")):
        with pytest.raises(dataclasses.FrozenInstanceError):
            setattr(each, name, None)
    with pytest.raises(dataclasses.FrozenInstanceError):
        gradient_chase._Ready(None, True, None, []).figures = False  # type: ignore[misc, arg-type]


@pytest.mark.parametrize(
    ("given", "steps", "size"),
    [
        ({}, 10, 8 * 10 * (3 * (2 + 4 + 2 * 5) + (2 + 5 + 2 * 5))),
        ({"history": False}, 10, 8 * 10 * (3 + 17)),
        ({"initial_state": 1.0}, 10, 8 * 10 * (3 * (2 + 4 + 10) + 17)),
        ({"initial_state": [1, 2, 3, 4]}, 10, 8 * 10 * (3 * (4 + 4 + 10) + 19)),
        ({"centers.count": None}, 10, 8 * 10 * (3 * (2 + 4 + 24) + 31)),
        ({"trajectories": "many"}, 10, 0),
        ({"duration": 0.3}, 3, 8 * 3 * (3 * 16 + 17)),  # 2.9999999999999996 steps
        ({"dt": 0.3, "duration": 1}, 3, 8 * 3 * (3 * 16 + 17)),
        ({"dt": 0}, "none", 0),
        ({"dt": -0.1}, "none", 0),
        ({"dt": "no"}, "none", 0),
        ({"duration": None}, "none", 0),
        ({"duration": float("inf")}, "none", 0),
        ({"dt": 1}, 1, 8 * (3 * 16 + 17)),
        ({"dt": 0.5}, 2, 8 * 2 * (3 * 16 + 17)),
    ],
)
def test_the_shape_and_the_size_of_a_batch_follow_from_its_settings(
    given: dict[str, Any], steps: Any, size: int
) -> None:
    known: dict[str, Any] = {
        **{"dt": 0.1, "duration": 1.0, "trajectories": 3, "history": True, "centers.count": 5},
        **{"initial_state": [1.0, 0.0], "optimizer.inner_steps": 7},
    }
    chase = GradientChase()
    assert chase.shape(known | given) == [steps, 7]
    assert chase.size(known | given) == size
    assert chase.animates is True
    for name in ("seed", "dt", "centers.radius", "kernel.width", "optimizer.step"):
        assert chase.shared(name, 2.5) == "number"
    assert chase.shared("centers.count", 3) == 3


@pytest.mark.parametrize("count", [1, 20, 21, 23])
def test_the_diverged_are_named_up_to_twenty(count: int, caplog: pytest.LogCaptureFixture) -> None:
    at = torch.full((25,), -1)
    at[1 : 1 + count] = torch.arange(count)
    solved = ChaseSolution(title(), Outcome({}, {}, at), np.arange(50.0).reshape(25, 2))
    gradient_chase._name_the_diverged(solved)
    assert len(caplog.messages) == min(count, 20) + (count > 20)
    first = "trajectory 1 from [2.0, 3.0] diverged at t = 0 s; its weights are frozen from there on"
    assert caplog.messages[0] == first
    if count > 1:
        assert caplog.messages[1].startswith("trajectory 2 from [4.0, 5.0] diverged at t = 0.5 s")
    if count > 20:
        assert caplog.messages[-1] == f"and {count - 20} more trajectories diverged"


NAMES = (
    *("ultimate_error", "ultimate_error_before", "floor_error", "ultimate_excess", "ultimate_excess_before"),
    *("ball_error", "gradient_error", "condition_number", "settling_time", "contraction_violations"),
    "diverged_fraction",
)


def test_the_log_has_a_line_for_every_group_of_metrics(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    known: dict[str, float | None] = {name: 1.23456789 * (k + 1) for k, name in enumerate(NAMES)}
    gradient_chase._summarise(title(rows=1), known)
    head, table, error, excess, ball, rest = caplog.messages
    assert head == "Gradient chase: 1 trajectory, 11 times, dt = 0.5 s, a method"
    assert table.split() == ["worst,", "t", ">=", "2", "s", "corrected", "before", "ideal", "weights"]
    assert error.split()[-3:] == ["1.235", "2.469", "3.704"]
    assert excess.split()[-3:] == ["4.938", "6.173", "0"]
    assert ball == "  error on the ball 7.407, gradient error 8.642"
    assert rest.startswith("  condition number 9.877, settled after 11.11 s, contraction violations 12.35")
    caplog.clear()
    gradient_chase._summarise(title(), dict.fromkeys(NAMES))
    assert caplog.messages[0].startswith("Gradient chase: 2 trajectories, ")
    assert caplog.messages[1] == "nothing to report: no trajectory is finite at a time t >= settle_time = 2 s"
    assert caplog.messages[4].split()[-1] == "-"


@pytest.mark.parametrize(("times", "ends"), [(5, False), (4, True)])
def test_nothing_is_to_be_reported_of_a_run_that_ends_before_it_settles(times: int, ends: bool) -> None:
    found = gradient_chase._why_nothing(title(times=times))
    early = "the run ends at 1.5 s, and metrics begin at settle_time = 2 s"
    assert found == (early if ends else "no trajectory is finite at a time t >= settle_time = 2 s")


def test_a_history_in_memory_is_put_together_from_its_pieces() -> None:
    memory = gradient_chase._Memory(2, 5)
    state, weights = np.arange(20.0).reshape(2, 5, 2), np.arange(10).reshape(2, 5)
    for low, high in ((0, 2), (2, 3), (3, 5)):
        memory.add({"state": state[:, low:high], "weights": weights[:, low:high]})
    np.testing.assert_array_equal(memory.arrays["state"], state)
    np.testing.assert_array_equal(memory.arrays["weights"], weights)
    assert memory.arrays["weights"].dtype == weights.dtype


@pytest.mark.parametrize("figures", [True, False])
@pytest.mark.parametrize("animation", [True, False])
@pytest.mark.parametrize("history", [True, False])
def test_the_first_trajectory_is_kept_where_it_is_drawn_or_moves(
    figures: bool, animation: bool, history: bool
) -> None:
    cfg = settings(*SHORT, f"figures={figures}", f"animation={animation}", f"history={history}")
    assert gradient_chase._wanted(cfg, chase_problem(cfg)) == (figures or animation, history)


def test_alone_or_from_memory_a_run_leaves_the_same_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pictures: list[Any] = []
    monkeypatch.setattr(gradient_chase, "draw_chase", pictures.append)
    monkeypatch.setattr(gradient_chase, "images", lambda figure: {"txt": b"drawn"})
    monkeypatch.setattr(
        gradient_chase, "animate", lambda scene, kind: pictures.append(scene) or {kind: b"moved"}
    )
    cfg = settings(*SHORT, "figures=true", "history=true", "animation=gif", "trajectories=2")
    chase, told = GradientChase(), []
    folders = [tmp_path / name for name in ("alone", "solved")]
    for folder in folders:
        folder.mkdir()
    metrics = chase(cfg, folders[0], Progress(told.append))
    assert told[-1] == 1
    told.clear()
    (solved,) = chase.solve([cfg], Progress(told.append))
    assert told[-1] == 1
    assert isinstance(solved, ChaseSolution)
    assert chase.write(cfg, folders[1], solved) == metrics == solved.metrics
    with np.load(folders[0] / "history.npz") as first, np.load(folders[1] / "history.npz") as second:
        one, two = dict(first), dict(second)
    assert {*one} == {*two} >= {"time", *HISTORY}
    for name in one:
        np.testing.assert_array_equal(one[name], two[name])
    np.testing.assert_allclose(one["time"], 0.05 * np.arange(11))
    assert one["state"].shape == (2, 11, 2)
    for folder in folders:
        assert {path.name for path in (folder / "figures").iterdir()} == {"chase.gif", "gradient_chase.txt"}
    assert len(pictures) == 4
    np.testing.assert_array_equal(pictures[1].state, one["state"][0])
    bare = tmp_path / "bare"
    bare.mkdir()
    chase(settings(*SHORT, "figures=false", "history=false"), bare)
    assert [path.name for path in bare.iterdir()] == ["metrics.json"]
    (solved,) = chase.solve([settings(*SHORT, "figures=false", "history=false")], Progress(told.append))
    assert isinstance(solved, ChaseSolution)
    assert (solved.history, solved.outcome.drawn) == (None, {})
    (wrong, right) = chase.solve([settings("dt=-1"), cfg], Progress(told.append))
    assert isinstance(wrong, ValueError)
    assert isinstance(right, ChaseSolution)
    (alone,) = chase.solve([settings("dt=-1")], Progress(told.append))
    assert isinstance(alone, ValueError)


def test_what_a_problem_alone_is_warned_of_is_said_again_where_it_is_written(tmp_path: Path) -> None:
    cfg = settings(*SHORT, "figures=false", "history=false")
    (solved,) = GradientChase().solve([cfg], Progress([].append))
    assert isinstance(solved, ChaseSolution)
    with warnings.catch_warnings(record=True) as given:
        warnings.simplefilter("always")
        GradientChase().write(cfg, tmp_path, dataclasses.replace(solved, warnings=("first", "second")))
    assert [str(each.message) for each in given] == ["first", "second"]
    messages = ["before"]
    with gradient_chase._recorded(messages):
        for _ in range(2):  # also where the same was said before
            warnings.warn("heard", stacklevel=1)
    assert messages == ["before", "heard", "heard"]
    ready = gradient_chase._Ready(chase_problem(cfg), False, None, ["a", "b"])
    outcome = Outcome({}, {}, torch.zeros(1), ("c", "a"))
    assert ready.solved(outcome, ["b", "d"]).warnings == ("a", "b", "d", "c")


def piece(rows: int, times: int, start: int) -> Any:
    """A piece of a result whose entries are their times."""
    time = torch.arange(start, start + times).double().expand(rows, times)
    given: dict[str, Any] = {name: time + 100 * k for k, name in enumerate((*HISTORY, "ideal_estimate"))}
    given["state"] = time.unsqueeze(-1).expand(rows, times, 2) + torch.arange(rows)[:, None, None]
    given["diverged_at"] = torch.arange(rows) + start
    return SimpleNamespace(**given)


@pytest.mark.parametrize(("times", "most", "stride"), [(12, 4, 3), (13, 4, 4), (4, 4, 1), (5, 4, 2)])
def test_a_drawn_trajectory_is_thinned_as_if_it_came_in_one_piece(
    times: int, most: int, stride: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(chase_batch, "_DRAWN_TIMES", most)
    thinned = chase_batch._Thinned(times)
    assert thinned.stride == stride
    start = 0
    for length in (1, 2, 1, times - 4):
        thinned.add(piece(2, length, start), 1)
        start += length
    arrays = thinned.arrays()
    assert list(arrays) == [*HISTORY, "ideal_estimate"]
    np.testing.assert_array_equal(arrays["value"], 100 + np.arange(times)[::stride])
    np.testing.assert_array_equal(arrays["state"], (1 + np.arange(times)[::stride])[:, None] * [1, 1])


class Basis:
    """Says of every state that it is far; the farthest is remembered."""

    def __init__(self) -> None:
        self.said: list[Any] = []

    def check_reach(self, states: Tensor) -> None:
        if float(states.max()) > 1:
            warnings.warn(f"far: {float(states.max()):g}", stacklevel=1)

    def largest_reach(self, states: Tensor) -> float:
        return float(states.abs().max())

    def warn_reach(self, worst: float, stacklevel: int) -> None:
        self.said.append(worst)


def member(rows: int, sink: Any = None, drawn: bool = False, steps: int = 3) -> Any:
    problem: Any = SimpleNamespace(initial_states=torch.zeros(rows, 2), steps=steps, dt=0.5, basis=Basis())
    return chase_batch._Member(problem, sink, drawn)


def test_every_member_takes_its_own_rows_of_a_piece() -> None:
    taken: list[list[Any]] = [[], [], []]

    def noted(k: int) -> Any:
        def take(result: object, rows: slice, place: int, *, alone: bool) -> None:
            taken[k].append((rows.start, rows.stop, place, alone))

        return take

    members: list[Any] = [SimpleNamespace(rows=rows, take=noted(k)) for k, rows in enumerate((2, 3, 1))]
    for first, count in ((0, 3), (3, 2), (5, 1)):  # rows 0-1 | 2-4 | 5 in blocks 0-2, 3-4, 5
        chase_batch._distribute(piece(count, 2, 0), first, members, alone=False)
    assert taken == [[(0, 2, 0, False)], [(2, 3, 0, False), (0, 2, 1, False)], [(0, 1, 0, False)]]


def test_a_member_keeps_its_history_its_figure_its_warnings_and_where_it_diverged() -> None:
    kept: list[Any] = []
    one = member(3, kept.append, drawn=True)
    assert one.keeps
    one.take(piece(4, 2, 0), slice(1, 3), 0, alone=False)
    one.take(piece(2, 2, 7), slice(0, 1), 2, alone=False)
    assert list(kept[0]) == list(HISTORY)
    assert kept[0]["value"].shape == (2, 2)
    assert kept[1]["state"][:, 0, 0].tolist() == [7.0]
    found = one.outcome({"a": None})
    assert found.diverged_at.tolist() == [1, 2, 7]
    assert found.diverged_at.dtype == torch.int64
    assert found.metrics == {"a": None}
    assert found.drawn["value"].tolist() == [100.0, 101.0]  # of its first row alone
    assert found.drawn["state"][:, 0].tolist() == [1.0, 2.0]
    assert found.drawn["time"].tolist() == [0.0, 0.5, 1.0, 1.5]
    assert found.warnings == ("far: 3",)  # the first time it is told
    bare = member(2)
    assert not bare.keeps
    bare.take(piece(2, 2, 5), slice(0, 2), 0, alone=True)
    found = bare.outcome({})
    assert (found.drawn, found.warnings) == ({}, ())
    assert member(2).outcome({}).diverged_at.tolist() == [-1, -1]


def test_the_farthest_reach_of_all_blocks_is_said_once() -> None:
    basis: Any = Basis()
    reach = chase_batch._Reach(basis)
    for states in (uniform(3, 2), tensor([[0.0, -7.5]]), uniform(3, 2)):
        reach.see(states)
    reach.warn()
    assert basis.said == [7.5]
    still: Any = Basis()
    chase_batch._Reach(still).warn()
    assert still.said == [0.0]


@pytest.mark.parametrize("rows", [2, 5, 6])
def test_rows_in_blocks_have_the_numbers_of_all_rows_at_once(
    rows: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = (*SHORT, "trajectories=5", "spread=0.4", "certificate=true")
    problem = chase_problem(settings(*words))
    (whole,) = chase_batch.simulate([problem], [None], [True])
    told: list[int] = []
    monkeypatch.setattr(chase_batch, "_ROWS", rows)
    (found,) = chase_batch.simulate([problem], [None], [True], told.append)
    assert found.metrics.keys() == whole.metrics.keys()
    for name, number in whole.metrics.items():
        assert found.metrics[name] == pytest.approx(number, rel=1e-9, abs=1e-14), name
    assert torch.equal(found.diverged_at, whole.diverged_at)
    for name, array in whole.drawn.items():
        np.testing.assert_allclose(found.drawn[name], array, rtol=1e-7, atol=1e-9)
    assert sum(told) == 11
    kept: list[Any] = []
    chase_batch.simulate([problem], [kept.append], [False])  # a history has all rows of a time
    assert {each["state"].shape[0] for each in kept} == {5}
    assert sum(each["state"].shape[1] for each in kept) == 11


def test_problems_of_other_parts_are_batches_of_their_own_and_come_in_their_order(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ran: list[Any] = []

    def run(members: Any, advance: Any, errors: Any, *, alone: bool) -> list[Any]:
        ran.append(([each.problem.name for each in members], advance, errors, alone))
        return [each.problem.name for each in members]

    monkeypatch.setattr(chase_batch, "_run", run)
    parts = [object() for _ in range(4)]

    def problem(name: str, dt: float = 0.5, **changes: Any) -> Any:
        given = {"basis": parts[0], "target": parts[1], "law": parts[2], "metrics": (parts[3],)}
        about = {"name": name, "dt": dt, "initial_states": torch.zeros(2, 2), "steps": 3}
        return SimpleNamespace(**about | given | changes)

    other = object()
    problems = [
        problem("a"),
        problem("b", 0.25),
        problem("c"),
        problem("d", law=other),
        problem("e", metrics=()),
    ]
    found = chase_batch.simulate(problems, [None] * 5, [False] * 5, "advance", "errors")  # type: ignore[arg-type]
    assert found == ["a", "b", "c", "d", "e"]
    assert [each[0] for each in ran] == [["a", "c"], ["b"], ["d"], ["e"]]
    assert ran[0][1:] == ("advance", "errors", False)
    ran.clear()
    chase_batch.simulate(problems[:1], [None], [False])
    assert ran == [(["a"], None, None, True)]

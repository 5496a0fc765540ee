"""The pieces of time and the blocks of rows of a gradient chase, and what is said of states that are far."""

from __future__ import annotations

import dataclasses
import warnings
from typing import Any

import pytest
from composing import settings
from torch import Tensor

from staf_torch.experiments import chase_batch
from staf_torch.settings.chase import ChaseProblem, chase_problem

SHORT = ("dt=0.05", "duration=0.5", "settle_time=0.2")


class StoppedError(Exception):
    """Raised where a chase would begin."""


@pytest.mark.parametrize(
    ("times", "most", "chunk"),
    [
        (2001, 10**9, 101),  # a twentieth of a long run, rounded up
        (2000, 10**9, 100),
        (100, 10**9, 64),
        (1281, 10**9, 65),
        (100, 30, 30),
        (100, 1, 1),
        (100, 0, 1),
    ],
)
@pytest.mark.parametrize("kept", [True, False])
def test_a_run_comes_in_twenty_pieces_of_time_or_more(
    times: int, most: int, chunk: int, kept: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[Any] = []

    def trajectory(system: object, block: Tensor, *, dt: float, steps: int, chunk: int) -> None:
        seen.append((len(block), dt, steps, chunk))
        raise StoppedError

    def chunk_length(rows: int, basis: object, size: int) -> int:
        seen.append((rows, size))
        return most

    monkeypatch.setattr(chase_batch, "_ROWS", 2)
    monkeypatch.setattr(chase_batch, "chunk_length", chunk_length)
    monkeypatch.setattr(chase_batch, "trajectory", trajectory)
    problem = dataclasses.replace(chase_problem(settings(*SHORT, "trajectories=5")), steps=times - 1)
    sink: Any = (lambda pieces: None) if kept else None
    with pytest.raises(StoppedError):
        chase_batch.simulate([problem], [sink], [False])
    rows = 5 if kept else 2  # a history holds all rows of a time
    assert seen == [(rows, 8), (rows, 0.05, times - 1, chunk)]


def far(start: str) -> ChaseProblem:
    return chase_problem(settings(*SHORT, "centers.radius=0.1", f"initial_state={start}", "trajectories=3"))


def said(*problems: ChaseProblem) -> tuple[list[str], list[chase_batch.Outcome]]:
    none = [None] * len(problems)
    with warnings.catch_warnings(record=True) as given:
        warnings.simplefilter("always")
        found = chase_batch.simulate(problems, none, [False] * len(problems))
    return [str(each.message) for each in given], found


@pytest.mark.parametrize("rows", [2, 5, 100])
def test_a_problem_alone_is_warned_of_its_farthest_state_once(
    rows: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(chase_batch, "_ROWS", rows)
    messages, (outcome,) = said(far("[12.0,0.0]"))
    assert len(messages) == 1
    assert messages[0].startswith("|x| r = 1.2")
    assert outcome.warnings == ()  # it has been said
    assert said(far("[2.0,0.0]"))[0] == []


@pytest.mark.parametrize("rows", [2, 100])
def test_of_several_problems_each_keeps_its_own_warning(rows: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(chase_batch, "_ROWS", rows)
    near, away = far("[2.0,0.0]"), far("[12.0,0.0]")
    shared = dataclasses.replace(away, basis=near.basis, target=near.target, law=near.law)
    for second in (away, shared):  # in a batch of its own, and in one with the other
        messages, (one, two) = said(near, second)
        assert messages == []
        assert one.warnings == ()
        assert len(two.warnings) == 1
        assert two.warnings[0].startswith("|x| r = 1.2")


def test_another_warning_is_heard_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(chase_batch, "_ROWS", 2)
    problem = far("[12.0,0.0]")
    target = problem.target

    def grumbling(x: Tensor) -> Tensor:
        warnings.warn("of the target itself", stacklevel=1)
        return target(x)

    messages, _ = said(dataclasses.replace(problem, target=grumbling))
    assert "of the target itself" in messages
    assert sum(message.startswith("|x| r") for message in messages) == 1


def test_a_chase_has_the_iterations_the_predictor_and_the_certificate_of_its_problem(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    words = ("optimizer.inner_steps=3", "predictor=tangent", "certificate=true")
    problem = chase_problem(settings(*SHORT, *words))
    asked: list[Any] = []

    def noted(name: str) -> Any:
        real = getattr(chase_batch, name)

        def call(*given: Any, **more: Any) -> Any:
            asked.append((name, more))
            return real(*given, **more)

        return call

    for name in ("chase_pieces", "ChaseMetrics"):
        monkeypatch.setattr(chase_batch, name, noted(name))
    (found,) = chase_batch.simulate([problem], [None], [False])
    ((_, metrics), (_, chase)) = asked
    assert chase == {"inner_steps": 3, "predictor": problem.predictor, "certificate": problem.certificate}
    assert problem.predictor is not None
    assert problem.certificate
    assert (metrics["inner_steps"], metrics["own"]) == (3, problem.metrics)
    assert metrics["members"] == [(1, 0.05, 0.2)]
    assert found.metrics["contraction_violations"] is not None

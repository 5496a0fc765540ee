"""Executors without a library or a process behind them: what is begun when, tried again, and told."""

from __future__ import annotations

import logging
import os
from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf

from staf_torch.results.progress import SHOWN, Progress
from staf_torch.settings.plain import ManySettings, PlainSettings
from staf_torch.sweeps.batching import Batch, Done, Failed, Written
from staf_torch.sweeps.executors import Executor, base, executor, planning
from staf_torch.sweeps.executors.base import GivenUpError
from staf_torch.sweeps.executors.local import Inline, Process
from staf_torch.sweeps.workers import LostError


def batch(*names: str) -> Batch:
    return Batch([OmegaConf.create({"name": name}) for name in names], list(names))


class Plan(Executor):
    """Ends the batches in the order in which they began; notes what goes on, and loses some."""

    def __init__(self, workers: int | None, lost: dict[str, list[Exception]] | None = None) -> None:
        super().__init__(workers)
        self.notes: list[str] = []
        self.lost = lost or {}
        self.closed: list[bool] = []

    def close(self, *, failed: bool) -> None:
        self.closed.append(failed)

    def submit(self, batch: Batch, progress: Progress) -> str:
        self.notes.append(f"+{batch.directories[0]}")
        if batch.directories[0] == "refused":
            raise OSError("no\n room")
        return batch.directories[0]

    def wait(self, handles: dict[int, Any]) -> list[int]:
        assert handles
        return [next(iter(handles))]

    def result(self, handle: str) -> Done:
        self.notes.append(f"-{handle}")
        if self.lost.get(handle):
            raise self.lost[handle].pop()
        return Done([Written({}, [(0, handle)])], 1.0)


def said(done: Done) -> list[str]:
    words = []
    for one in done.outcomes:
        assert isinstance(one, Failed)
        assert isinstance(one.error, LostError)
        words.append(str(one.error))
    return words


def test_batches_begin_in_order_and_as_many_at_once_as_there_are_workers() -> None:
    for workers, notes in ((1, "+a -a +b -b +c -c"), (2, "+a +b -a +c -b -c"), (7, "+a +b +c -a -b -c")):
        plan = Plan(workers)
        found = list(plan.map([batch("a"), batch("b"), batch("c")], SHOWN))
        assert " ".join(plan.notes) == notes
        assert [(number, done.outcomes[0].log[0][1]) for number, done in found] == [  # type: ignore[union-attr]
            (0, "a"),
            (1, "b"),
            (2, "c"),
        ]
    assert list(Plan(1).map([], SHOWN)) == []


def test_a_batch_that_no_worker_can_begin_fails_alone() -> None:
    found = dict(Plan(2).map([batch("refused", "two"), batch("a")], SHOWN))
    assert said(found[0]) == ["no worker could begin (OSError: no room)"] * 2
    assert found[0].seconds == 0
    assert found[1].outcomes == [Written({}, [(0, "a")])]
    assert said(next(Plan(1).map([batch("refused")], SHOWN))[1]) == [
        "no worker could begin (OSError: no room)"
    ]


def test_a_batch_whose_worker_is_lost_is_tried_once_more(caplog: pytest.LogCaptureFixture) -> None:
    lost: dict[str, list[Exception]] = {
        "once": [LostError("gone")],
        "twice": [ValueError("worse"), LostError("gone")],
        "given up": [GivenUpError("cancelled")],
        "then given up": [GivenUpError("cancelled"), OSError("gone")],
    }
    plan = Plan(1, lost)
    found = dict(plan.map([batch(name) for name in lost], SHOWN))
    assert plan.notes == [
        *("+once", "-once") * 2,
        *("+twice", "-twice") * 2,
        *("+given up", "-given up"),
        *("+then given up", "-then given up") * 2,
    ]
    assert found[0].outcomes == [Written({}, [(0, "once")])]
    assert said(found[1]) == ["the worker was lost twice (ValueError: worse)"]
    assert said(found[2]) == ["the worker was lost (cancelled)"]
    assert said(found[3]) == ["the worker was lost twice (cancelled)"]
    words = "a worker was lost: {}; its batch is tried once more"
    assert caplog.messages == [words.format(why) for why in ("gone", "gone", "OSError: gone")]


@pytest.mark.parametrize("length", [3, 299, 300, 301, 500])
def test_what_is_said_of_a_lost_worker_is_a_line_of_bounded_length(length: int) -> None:
    found = base._words(LostError("x" * length))
    assert found == ("x" * length if length <= 300 else "x" * 297 + "...")
    assert base._words(GivenUpError("a\n b")) == "a b"
    assert base._words(KeyError("a")) == "KeyError: 'a'"


def test_an_executor_is_closed_and_told_whether_the_sweep_failed() -> None:
    plan = Plan(None)
    with plan as entered:
        assert entered is plan
    with pytest.raises(RuntimeError), plan:
        raise RuntimeError
    assert plan.closed == [False, True]


def test_workers_are_those_that_were_asked_for_or_one_a_core(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: 5)
    assert (Plan(None).workers, Plan(3).workers, Plan(1).pieces, Plan(None).pieces) == (5, 3, 1, 5)
    assert (Inline(4).workers, Inline(4).pieces) == (1, 1)
    monkeypatch.setattr(os, "cpu_count", lambda: None)
    assert Plan(None).workers == 1
    for workers in (0, -1, 1.5):
        with pytest.raises(ValueError, match=r"`hydra.launcher\(workers=...\)` must be"):
            Plan(workers)  # type: ignore[arg-type]


def test_an_executor_is_made_by_its_name(tmp_path: Path) -> None:
    assert type(executor("inline", 3, {}, tmp_path)) is Inline
    assert type(executor("process", 3, {}, tmp_path)) is Process
    assert executor("process", 3, {}, tmp_path).workers == 3


# Jobs as batches


class Listener(Plan):
    """Tells of its progress as it computes."""

    @property
    def pieces(self) -> int:
        return 2

    def submit(self, batch: Batch, progress: Progress) -> Any:
        with progress.over(4, "steps") as advance:
            for _ in range(4):
                advance(1)
        self.notes.append(" ".join(batch.directories))
        self.batches = [*getattr(self, "batches", []), batch]
        return batch

    def result(self, handle: Any) -> Done:
        return Done([Written({}, [(0, name)]) for name in handle.directories], 6.0)


PLACES = [Path("/") / str(n) for n in range(6)]
FLAT: list[dict[str, object]] = [
    {"task": "gradient_chase", "dt": 0.1, "duration": 1.0, "seed": n} for n in range(6)
]


def test_every_job_has_its_outcome_and_its_share_of_the_time() -> None:
    settings, told, workers = [OmegaConf.create(each) for each in FLAT], [], Listener(1)
    found = list(planning.compute(settings, PLACES, workers, tell=told.append))
    assert workers.notes == ["/0 /1 /2", "/3 /4 /5"]
    assert [(index, outcome.log[0][1], seconds) for index, outcome, seconds in found] == [  # type: ignore[union-attr]
        (n, f"/{n}", 2.0) for n in range(6)
    ]
    assert told == [0.75, 1.5, 2.25, 3.0, 3, 3.75, 4.5, 5.25, 6.0, 6]
    assert workers.batches[0].settings == settings[:3]
    assert workers.batches[0].whole == ()


def test_a_batch_of_finished_jobs_is_left_out_and_one_of_some_is_computed_as_a_whole(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO)
    settings, told, workers = [OmegaConf.create(each) for each in FLAT], [], Listener(1)
    whole: Any = [f"whole {n}" for n in range(6)]
    given = {"finished": {0, 1, 3}, "most": 2, "flat": FLAT, "whole": whole, "tell": told.append}
    found = list(planning.compute(settings, PLACES, workers, **given))
    assert workers.notes == ["/2 /3", "/4 /5"]
    assert [index for index, *_ in found] == [2, 4, 5]
    assert told == [0.25, 0.5, 0.75, 1.0, 1, 1.5, 2.0, 2.5, 3.0, 3]
    assert [each.whole for each in workers.batches] == [["whole 2", "whole 3"], ["whole 4", "whole 5"]]
    assert "6 jobs in 2 tensor batches" in caplog.messages
    assert list(planning.compute(settings, PLACES, workers, finished=range(6), tell=told.append)) == []


def test_settings_of_many_members_stay_together() -> None:
    flat = [{"task": "gradient_chase", "seed": n} for n in range(6)]
    many = ManySettings([PlainSettings(each) for each in flat], flat, lambda n: OmegaConf.create(flat[n]))
    listed = planning._Batches([[0, 2], [1]], many, PLACES, ())
    assert len(listed) == 2
    assert isinstance(listed[0].settings, ManySettings)
    assert listed[0].settings.flat == [flat[0], flat[2]]
    assert [each.directories for each in listed[0:2]] == [["/0", "/2"], ["/1"]]
    assert [each.directories for each in listed[::-1]] == [["/1"], ["/0", "/2"]]

"""The parts of the batched launcher: its line of progress, and jobs that are made when they are asked for."""

from __future__ import annotations

import contextlib
import gc
import io
import re
import sys
from types import SimpleNamespace

import pytest
from omegaconf import OmegaConf

from staf_torch.sweeps import launcher
from staf_torch.sweeps.launcher import SweepProgress, _Each, _Jobs, _seldom_collecting

# Progress


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    now = [0.0]
    monkeypatch.setattr(launcher, "time", SimpleNamespace(monotonic=lambda: now[0]))
    return now


def test_a_line_says_what_is_done_and_failed_and_the_time_that_is_left(
    clock: list[float], capsys: pytest.CaptureFixture[str]
) -> None:
    progress = SweepProgress(10, 2)
    assert progress.line == "2 of 10 jobs done"
    clock[0] = 10.0
    progress.running(0.8)  # a tenth of the eight that are left, in 10 s
    assert progress.line == "2 of 10 jobs done, 90 s left"
    progress.ended("job 2", None)  # one job of eight
    assert progress.line == "3 of 10 jobs done, 70 s left"
    progress.ended("job 3 (seed=1)", "it diverged")
    progress.ended("job 4 (seed=2)", "why")
    assert progress.line == "5 of 10 jobs done, 2 failed, 17 s left"
    progress.computed(4.0)
    assert progress.line == "5 of 10 jobs done, 2 failed, 10 s left"
    progress.running(0.2)  # three jobs and a bit are less than the four that are computed
    assert progress.line == "5 of 10 jobs done, 2 failed, 10 s left"
    progress.computed(8.0)
    assert progress.line == "5 of 10 jobs done, 2 failed"
    progress.close()
    said = capsys.readouterr()
    assert "job 3 (seed=1) failed: it diverged\njob 4 (seed=2) failed: why\n" in said.err
    assert said.out == ""


def test_time_is_counted_from_the_beginning(clock: list[float]) -> None:
    clock[0] = 50.0
    progress = SweepProgress(3, 2)
    clock[0] = 60.0
    progress.running(0.5)
    assert progress.line == "2 of 3 jobs done, 10 s left"
    assert SweepProgress(2).line == "0 of 2 jobs done"
    assert SweepProgress(2, 2).line == "2 of 2 jobs done"


class Terminal(io.StringIO):
    """Where bars are shown."""

    def isatty(self) -> bool:
        return True


def test_a_terminal_has_a_bar_every_fifth_of_a_second(
    clock: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    shown = Terminal()
    monkeypatch.setattr(sys, "stderr", shown)
    progress = SweepProgress(4)

    def said_at(seconds: float, jobs: float) -> str:
        before, clock[0] = len(shown.getvalue()), seconds
        progress.computed(jobs)
        return shown.getvalue()[before:]

    assert said_at(0.125, 1.0) == ""
    assert re.fullmatch(r" 25%\|.{30}\| 0 of 4 jobs done, 1 s left", said_at(0.2, 1.0).strip("\r"))
    assert said_at(0.3125, 2.0) == ""
    assert "100%|" in said_at(1.0, 9.0)  # no more than there are
    assert "it failed" not in shown.getvalue()
    before = len(shown.getvalue())
    progress.close()
    wiped = shown.getvalue()[before:]
    assert wiped
    assert not wiped.strip("\r \x1b[A")


def test_a_log_has_a_line_after_ten_seconds_exactly(
    clock: list[float], capsys: pytest.CaptureFixture[str]
) -> None:
    progress = SweepProgress(4)
    said = []
    for clock[0] in (9.5, 10.0, 19.5, 20.0, 20.5):
        progress.ended("one", None)
        said.append(capsys.readouterr().err)
    assert [bool(line) for line in said] == [False, True, False, True, False]
    assert said[1] == "2 of 4 jobs done, 10 s left\n"
    clock[0] = 30.0
    progress.running(0.5)
    assert capsys.readouterr().err == "5 of 4 jobs done\n"


def test_a_line_of_a_log_can_be_read_at_once(clock: list[float], monkeypatch: pytest.MonkeyPatch) -> None:
    progress, said = SweepProgress(4), io.StringIO()
    seen: list[str] = []
    monkeypatch.setattr(said, "flush", lambda: seen.append(said.getvalue()), raising=False)
    monkeypatch.setattr(sys, "stderr", said)
    clock[0] = 10.0
    progress.computed(1.0)
    assert seen == ["0 of 4 jobs done, 30 s left\n"]


# Jobs, each when it is asked for


def test_jobs_are_composed_once_while_they_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[int] = []

    def make(num: int, overrides: list[str]) -> launcher.Job:
        made.append(num)
        return launcher.Job(num, overrides, OmegaConf.create({"seed": num}))

    jobs = _Jobs({num: [f"seed={num}"] for num in (7, 8, 9, 10)}, make)
    monkeypatch.setattr(launcher, "_KEPT_JOBS", 3)
    assert len(jobs) == 4
    assert jobs.numbers == [7, 8, 9, 10]
    assert jobs.overrides(1) == ["seed=8"]
    assert made == []
    assert [jobs[i].num for i in (0, 1, 2, 0, 1, 2)] == [7, 8, 9] * 2
    assert made == [7, 8, 9]
    assert jobs[-1].settings.seed == 10
    assert [job.num for job in jobs[1:3]] == [8, 9]
    assert made == [7, 8, 9, 10]
    assert jobs[0].num == 7  # it had to go
    assert made == [7, 8, 9, 10, 7]
    jobs.forget(jobs[2])
    jobs.forget(jobs[2])
    assert made == [7, 8, 9, 10, 7, 9]
    assert jobs[3].name == "job 10 (seed=10)"
    assert launcher.job_name(3, ["seed=1", "hydra.x=1", "sweep.objective=a"]) == "job 3 (seed=1)"


def test_a_function_of_every_index_is_a_sequence() -> None:
    squares = _Each(5, lambda index: index**2)
    assert len(squares) == 5
    assert list(squares) == [0, 1, 4, 9, 16]
    assert squares[-1] == 16
    assert squares[1:4:2] == [1, 9]
    with pytest.raises(IndexError):
        squares[5]


@pytest.mark.parametrize("frozen", [False, True])
def test_garbage_is_looked_for_seldom_and_then_as_before(frozen: bool) -> None:
    before, was = gc.get_threshold(), gc.get_freeze_count() > 0
    (gc.freeze if frozen else gc.unfreeze)()
    try:
        with contextlib.suppress(RuntimeError), _seldom_collecting():
            assert gc.get_freeze_count() > 0
            assert gc.get_threshold()[:2] == (20_000, 5)
            raise RuntimeError
        assert gc.get_threshold() == before
        assert (gc.get_freeze_count() > 0) == frozen
    finally:
        (gc.freeze if was else gc.unfreeze)()

"""SLURM's controller without SLURM: what is asked of it how often, and what is told of its silence."""

from __future__ import annotations

import concurrent.futures
import subprocess
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from staf_torch.sweeps.executors import controller
from staf_torch.sweeps.executors.controller import Controller


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The time."""
    now = [1000.0]
    monkeypatch.setattr(controller, "time", SimpleNamespace(monotonic=lambda: now[0]))
    return now


# The controller


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch, clock: list[float]) -> list[dict[str, Any]]:
    """The commands that were run, of which each takes a second and says what its name says."""
    lines: list[dict[str, Any]] = []

    def run(line: list[str], **options: Any) -> SimpleNamespace:
        lines.append({"line": line, "at": clock[0], **options})
        clock[0] += 1
        return SimpleNamespace(stdout="7 RUNNING\nodd\n8 PENDING more\n9 DONE\n", stderr="")

    monkeypatch.setattr(controller.subprocess, "run", run)
    return lines


def test_slurm_is_asked_every_ten_seconds_and_has_twenty_to_answer(
    asked: list[dict[str, Any]], clock: list[float]
) -> None:
    clock[0] = 0.0  # a machine that has only just begun
    about = Controller()
    assert about.states() == {"7": "RUNNING", "9": "DONE"}
    clock[0] = 10.5
    assert about.states() is None
    clock[0] = 11.0
    assert about.states() is not None
    assert [each["at"] for each in asked] == [0.0, 11.0]
    assert asked[0]["timeout"] == 20.0
    assert asked[0]["line"][0] == "squeue"
    assert asked[0]["check"]
    assert asked[0]["text"]
    assert asked[0]["capture_output"]


def test_jobs_are_cancelled_a_thousand_at_a_time_in_four_seconds(asked: list[dict[str, Any]]) -> None:
    names = [str(n) for n in range(6001)]
    Controller().cancel(names)
    assert [each["line"][:2] for each in asked] == [["scancel", "--quiet"]] * 7
    assert [name for each in asked for name in each["line"][2:]] == names
    assert [len(each["line"]) - 2 for each in asked] == [1000] * 6 + [1]
    assert [each["timeout"] for each in asked] == [4.0, 3.0, 2.0, 1.0, 0.0, 0.0, 0.0]
    assert all(each["text"] and each["capture_output"] for each in asked)  # what it says is no noise here
    assert not any(each["check"] for each in asked)  # what could not be cancelled keeps no other job running
    asked.clear()
    Controller().cancel([])
    assert asked == []


def silence(about: Controller, clock: list[float], seconds: float, why: str = "no answer") -> None:
    clock[0] = 1000 + seconds
    about._silence(why, 1000.0)


def test_a_silence_is_told_at_a_minute_and_again_at_every_fifth(
    clock: list[float], capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    about = Controller()
    about._answer()
    said = []
    for seconds in (59.5, 60.0, 359.5, 360.0, 659.5, 660.0):
        silence(about, clock, seconds)
        said.append(capsys.readouterr())
    assert [bool(each.err) for each in said] == [False, True, False, True, False, True]
    assert [each.out for each in said] == [""] * 6
    assert "SLURM has not answered for 60 s (no answer). The sweep waits" in said[1].err
    assert "for 6 minutes" in said[3].err
    assert len(caplog.messages) == 3
    clock[0] = 1000 + 119.75
    about._answer()
    assert capsys.readouterr().err == "staf: SLURM answers again, after 120 s.\n"
    about._answer()
    assert capsys.readouterr().err == ""
    silence(about, clock, 30.0)
    about._answer()
    assert capsys.readouterr().err == ""  # nobody was told of the silence


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(0.4, "0 s"), (119.0, "119 s"), (120.0, "2 minutes"), (120.5, "2 minutes"), (151.0, "3 minutes")],
)
def test_a_time_is_told_in_seconds_or_minutes(seconds: float, words: str) -> None:
    assert controller._minutes(seconds) == words


def test_the_reason_is_the_last_line_of_what_a_command_said() -> None:
    assert controller._short("first\nsecond\n\n") == "second"
    assert controller._short(" \n") == "no reason"
    assert controller._short("x" * 300) == "x" * 200
    called = subprocess.CalledProcessError(1, ["squeue"], stderr=" it failed\n")
    assert controller._words(called) == " it failed\n"
    silent = subprocess.CalledProcessError(1, ["squeue"], stderr=" ")
    assert controller._words(silent) == str(silent)
    assert controller._words(subprocess.TimeoutExpired(["squeue", "a"], 1.0)) == "squeue did not end in time"
    assert controller._words(OSError("no such command")) == "no such command"


class Threads:
    """Stands for `threading`: a thread runs when it is started, or not at all."""

    def __init__(self, runs: bool) -> None:
        self.runs, self.native_id, self.made = runs, 7, []

    def Thread(self, *, target: Callable[[], None], daemon: bool = False) -> Any:  # noqa: N802
        assert daemon  # it must not keep a command that was ended
        self.target = target
        return self

    def start(self) -> None:
        if self.runs:
            self.target()


@pytest.fixture
def waits(monkeypatch: pytest.MonkeyPatch, clock: list[float]) -> list[float]:
    """How long a submission was waited for, each time."""
    asked: list[float] = []

    def wait(futures: list[concurrent.futures.Future[None]], seconds: float) -> SimpleNamespace:
        asked.append(seconds)
        if not futures[0].done():
            clock[0] += 20
            if len(asked) == 7:
                raise KeyboardInterrupt
        return SimpleNamespace(done=futures[0].done())

    monkeypatch.setattr(concurrent.futures, "wait", wait)
    return asked


def test_a_submission_is_waited_for_and_what_it_raises_comes_back(
    waits: list[float], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(controller, "threading", Threads(True))
    about, begun = Controller(), []
    about._since, about._told = 900.0, 950.0
    about.submit(lambda: begun.append(1))
    assert begun == [1]
    assert waits == [0.5]
    assert "SLURM answers again, after 100 s" in capsys.readouterr().err

    def refused() -> None:
        raise OSError("invalid partition")

    with pytest.raises(OSError, match="invalid partition"):
        about.submit(refused)


def test_a_submission_that_hangs_is_told_and_a_signal_ends_it(
    waits: list[float], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    ended: list[object] = []
    monkeypatch.setattr(controller, "threading", Threads(False))
    monkeypatch.setattr(controller, "_end_children", ended.append)
    with pytest.raises(KeyboardInterrupt):
        Controller().submit(lambda: None)
    assert waits == [0.5] * 7 + [4.0, 0.5]
    assert len(ended) == 1
    said = capsys.readouterr().err
    assert said.count("has not answered") == 1
    assert "for 60 s (sbatch has not ended)" in said

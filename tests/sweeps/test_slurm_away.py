"""SLURM's controller that is away: its commands hang or fail; whoever waits is told, and can end it."""

from __future__ import annotations

import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

from staf_torch.sweeps import signals
from staf_torch.sweeps.executors import controller
from staf_torch.sweeps.executors.controller import Controller

AWAY = "slurm_load_jobs error: Unable to contact slurm controller (connect failure)"
HANGS = "exec sleep 30"


@pytest.fixture
def commands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of commands that hide those of this machine."""
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    return tmp_path


def make(commands: Path, name: str, script: str) -> None:
    (commands / name).write_text(f"#!/bin/sh\n{script}\n")
    (commands / name).chmod(0o755)


def test_a_controller_without_an_answer_is_told_after_a_minute_and_every_few(
    commands: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    make(commands, "squeue", f'cat "{commands}/answer" || {{ echo "{AWAY}" >&2; exit 1; }}')
    clock = [1000.0]
    monkeypatch.setattr(controller, "time", SimpleNamespace(monotonic=lambda: clock[0]))
    asked = Controller()

    def said_at(seconds: float) -> str:
        clock[0] = 1000 + seconds
        assert asked.states() is None
        return capsys.readouterr().err

    assert [said_at(seconds) for seconds in (0, 20, 59)] == [""] * 3
    told = said_at(70)
    assert f"SLURM has not answered for 70 s ({AWAY})" in told
    assert "Ctrl-C" in told
    assert "hydra.launcher.executor=process" in told
    assert [said_at(seconds) for seconds in (90, 369)] == [""] * 2
    assert "for 6 minutes" in said_at(380)
    (commands / "answer").write_text("7 RUNNING\n8 PENDING\n\n")
    clock[0] += 9
    assert asked.states() is None  # asked a moment ago
    clock[0] += 1
    assert asked.states() == {"7": "RUNNING", "8": "PENDING"}
    assert "SLURM answers again, after 6 minutes" in capsys.readouterr().err
    (commands / "answer").unlink()
    assert [said_at(seconds) for seconds in (1000, 1059)] == [""] * 2  # a silence of its own


def test_a_question_that_hangs_is_given_up(
    commands: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    make(commands, "squeue", HANGS)
    monkeypatch.setattr(controller, "_ANSWER", 0.05)
    monkeypatch.setattr(controller, "_SILENT", 0.0)
    assert Controller().states() is None
    assert "(squeue did not end in time)" in capsys.readouterr().err


def test_a_lost_signal_ends_the_wait_for_slurm(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(signals, "_arrived", [signal.SIGTERM])  # what it raised was lost in a finaliser
    with pytest.raises(signals.Stopped):
        Controller().states()


@pytest.mark.parametrize(
    ("script", "said"),
    [
        ('echo "$*" >> "$0.log"', ""),
        (HANGS, "cancels 3 jobs (scancel did not end in time)"),
        (f'echo "{AWAY}" >&2; exit 1', f"cancels 3 jobs ({AWAY})"),
    ],
    ids=["answers", "hangs", "fails"],
)
def test_jobs_are_cancelled_in_bounded_time(
    script: str,
    said: str,
    commands: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    make(commands, "scancel", script)
    monkeypatch.setattr(controller, "_MANY", 2)
    monkeypatch.setattr(controller, "_END", 5.0 if not said else 0.3)
    Controller().cancel(["4", "5", "6"])
    told = capsys.readouterr().err
    if said:
        assert said in told
        assert "scancel 4 5 ..." not in told
        assert told.endswith("scancel 4 5 6\n")
    else:
        assert not told
        assert (commands / "scancel.log").read_text() == "--quiet 4 5\n--quiet 6\n"


def stopped_while_submitting(begin: Callable[[], None], end: Callable[[], None]) -> None:
    """Submit, and let another thread end this process meanwhile."""
    before = signal.signal(signal.SIGTERM, signal.SIG_DFL)
    thread = threading.Thread(target=end)
    try:
        with signals.stopped_by_signals():
            thread.start()
            with pytest.raises(signals.Stopped):
                Controller().submit(begin)
    finally:
        thread.join()
        signal.signal(signal.SIGTERM, before)


def test_a_signal_does_not_wait_for_a_submission_that_hangs(
    commands: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make(commands, "sbatch", f'echo $$ > "{commands}/made"; mv "{commands}/made" "{commands}/pid"; {HANGS}')
    monkeypatch.setattr(controller, "_END", 0.1)
    codes = []

    def begin() -> None:  # as submitit does it
        with subprocess.Popen(["sbatch"]) as run:
            codes.append(run.wait())

    def end() -> None:
        late = time.monotonic() + 60
        while not (commands / "pid").exists() and time.monotonic() < late:
            time.sleep(0.01)
        os.kill(os.getpid(), signal.SIGTERM)

    stopped_while_submitting(begin, end)
    assert codes == [-signal.SIGKILL]


def test_a_submission_that_a_signal_meets_may_come_through() -> None:
    begun, kept = threading.Event(), []

    def begin() -> None:
        begun.set()
        time.sleep(0.1)
        kept.append("7")

    def end() -> None:
        begun.wait()
        os.kill(os.getpid(), signal.SIGTERM)

    stopped_while_submitting(begin, end)
    assert kept == ["7"]


def test_what_a_submission_raises_comes_back() -> None:
    def begin() -> None:
        raise OSError("sbatch: error: invalid partition")

    with pytest.raises(OSError, match="invalid partition"):
        Controller().submit(begin)


@pytest.mark.parametrize("count", [19, 20, 21, 45])
def test_a_message_shows_twenty_jobs_and_says_that_there_are_more(
    count: int, commands: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make(commands, "scancel", "echo no >&2; exit 1")
    Controller().cancel([str(job) for job in range(count)])
    line = capsys.readouterr().err.rpartition("scancel ")[2].split()
    assert line == [str(job) for job in range(min(count, 20))] + ["..."] * (count > 20)

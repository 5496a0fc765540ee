"""Processes that compute: what is lost is told, and nothing stays when the parent has gone."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import worker_tasks
from command_line import environment
from harms import ended_with_us, working_in

from staf_torch.sweeps.workers import LostError, Worker, beginning, end_with, ready

LOST = {
    "die": "it was ended by SIGKILL",
    "exit": "it ended with exit code 3",
    "raise": "OSError: no more memory",
}


def test_a_worker_computes_one_thing_after_the_other(tmp_path: Path) -> None:
    worker = Worker(worker_tasks.work)
    for what in ("one", "two"):
        worker.begin(what, str(tmp_path / "note"))
        assert ready({7: worker}) == [7]
        assert worker.result() == what.encode()
    pid = int((tmp_path / "note").read_text())
    worker.end()
    assert not lives(pid)


@pytest.mark.parametrize("what", LOST)
def test_a_lost_worker_says_how_it_ended(what: str, tmp_path: Path) -> None:
    worker = Worker(worker_tasks.work)
    worker.begin(what, str(tmp_path / "note"))
    assert ready({0: worker}) == [0]
    with pytest.raises(LostError, match=LOST[what]):
        worker.result()
    assert worker.alive() == (what == "raise")
    worker.end()


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGHUP])
def test_workers_end_with_their_parent_however_it_ends(number: signal.Signals, tmp_path: Path) -> None:
    line = [sys.executable, worker_tasks.__file__, str(tmp_path / "note")]
    with subprocess.Popen(line, env=environment(), stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        assert parent.stdout.readline() == "at work\n"
        workers = [int((tmp_path / f"note{n}").read_text()) for n in range(2)]
        assert all(map(lives, workers))
        parent.send_signal(number)
    assert gone(workers)


def test_a_process_ends_with_another_that_is_no_direct_parent() -> None:
    program = "import sys, time; from staf_torch.sweeps.workers import end_with; end_with(int(sys.argv[1]));"
    program += "print('watching', flush=True); time.sleep(600)"
    with subprocess.Popen(["sleep", "600"]) as watched:
        line = [sys.executable, "-c", program, str(watched.pid)]
        with subprocess.Popen(line, env=environment(), stdout=subprocess.PIPE, text=True) as other:
            assert other.stdout is not None
            assert other.stdout.readline() == "watching\n"
            assert other.poll() is None
            watched.kill()
            watched.wait()
            assert other.wait(60) == 1


def test_a_number_that_is_used_again_is_no_parent(monkeypatch: pytest.MonkeyPatch) -> None:
    ended: list[int] = []
    monkeypatch.setattr(os, "_exit", ended.append)
    monkeypatch.setattr("staf_torch.sweeps.workers.threading.Thread.start", lambda thread: thread.run())
    end_with(os.getpid(), "another time")
    assert ended == [1]
    assert beginning(os.getpid()) != ""


def lives(pid: int) -> bool:
    """Whether a process goes on; one that has ended and nobody waited for does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False


def gone(pids: list[int]) -> bool:
    """Wait until all processes have ended, for a minute at most."""
    for _ in range(600):
        if not any(map(lives, pids)):
            return True
        time.sleep(0.1)
    return False


def test_kills_that_are_broken_off_leave_no_process(tmp_path: Path) -> None:
    """One that begins another and ends by SIGTERM, and one that does not care for it."""
    deaf = "trap '' TERM; : > deaf; while :; do sleep 0.05; done"
    script = f'(sleep 60 & : > begun; wait) & sh -c "{deaf}" & wait'
    with subprocess.Popen(["sh", "-c", script], cwd=tmp_path) as run:
        while not all((tmp_path / name).exists() for name in ("begun", "deaf")):
            time.sleep(0.01)
        assert len(working_in(tmp_path)) >= 4
        with pytest.raises(SystemExit), ended_with_us(tmp_path, 0.2):
            raise SystemExit
        assert not working_in(tmp_path)
        assert run.wait() != 0

"""Processes that compute: what is lost is told, and nothing stays when the parent has gone."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import worker_tasks
from command_line import environment

from staf_torch.sweeps.job import LostError
from staf_torch.sweeps.workers import Worker, ready

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


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGHUP])
def test_workers_end_with_their_parent_however_it_ends(number: signal.Signals, tmp_path: Path) -> None:
    line = [sys.executable, worker_tasks.__file__, str(tmp_path / "note")]
    with subprocess.Popen(line, env=environment(), stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        assert parent.stdout.readline() == "at work\n"
        workers = [int((tmp_path / f"note{n}").read_text()) for n in range(2)]
        assert all(map(lives, workers))
        parent.send_signal(number)
    assert gone(workers)


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

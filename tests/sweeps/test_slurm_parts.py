"""Jobs of SLURM without SLURM: how they are submitted, and when they have ended."""

from __future__ import annotations

import os
import pickle
import signal
import socket
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from omegaconf import OmegaConf

from staf_torch.results.progress import SHOWN
from staf_torch.sweeps.batching import DEFERRED, Batch, Done
from staf_torch.sweeps.executors import slurm
from staf_torch.sweeps.executors.base import GivenUpError
from staf_torch.sweeps.executors.slurm import Submitit, Task, _ended_by_signals
from staf_torch.sweeps.workers import LostError, beginning


class Job:
    """A job of submitit's that is as a test says."""

    def __init__(self, number: int, folder: Path, given: tuple[Any, ...]) -> None:
        self.job_id, self.given, self.cancelled, self.over = str(number), given, [], False
        self.paths = SimpleNamespace(result_pickle=folder / f"{number}.pkl", stderr=f"{number}.err")

    def done(self) -> bool:
        return self.over

    def cancel(self, check: bool = True) -> None:
        self.cancelled.append(check)

    def result(self) -> bytes:
        return self.paths.result_pickle.read_bytes()


class Auto:
    """submitit's executor, which notes what it is told."""

    detected = "slurm"

    def __init__(self, folder: Path, cluster: str | None = None, **more: Any) -> None:
        self.folder, self.cluster, self.more = folder, cluster or Auto.detected, more
        self.jobs: list[Job] = []

    def update_parameters(self, **parameters: Any) -> None:
        self.parameters = parameters

    def submit(self, *given: Any) -> Job:
        self.jobs.append(Job(len(self.jobs) + 1, self.folder, given))
        return self.jobs[-1]


@pytest.fixture(autouse=True)
def _library(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "submitit", SimpleNamespace(AutoExecutor=Auto))
    monkeypatch.setattr(os, "cpu_count", lambda: 5)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The time; to sleep is to let it pass."""
    now = [1000.0]

    def sleep(seconds: float) -> None:
        now[0] += seconds

    fake = SimpleNamespace(monotonic=lambda: now[0], sleep=sleep)
    monkeypatch.setattr(slurm, "time", fake)
    return now


BATCH = Batch([OmegaConf.create({"seed": 1})], ["here"])


def test_what_a_user_gives_goes_to_submitit_and_the_rest_is_ours(tmp_path: Path) -> None:
    sweep = tmp_path / "new" / "sweep"
    made = Submitit(None, sweep, {})
    auto = made._executor
    assert auto.folder.parent == sweep / ".submitit"
    assert auto.folder.is_dir()
    assert (auto.cluster, auto.more) == ("slurm", {})
    assert auto.parameters == {"name": "staf", "timeout_min": 1440}
    other = Submitit(None, sweep, {})._executor.folder
    assert other.parent == auto.folder.parent
    assert other != auto.folder
    given = {"cluster": "local", "folder": str(tmp_path / "a" / "b%j" / "c"), "name": "own", "mem_gb": 3}
    auto = Submitit(2, sweep, {**given, "slurm_max_num_timeout": 7})._executor
    assert auto.folder.parent == tmp_path / "a" / "b"
    assert (auto.cluster, auto.more) == ("local", {"slurm_max_num_timeout": 7})
    assert auto.parameters == {"name": "own", "timeout_min": 1440, "mem_gb": 3}


@pytest.mark.parametrize(
    ("cluster", "asked", "workers", "pieces"),
    [("slurm", None, 10**6, 1), ("slurm", 3, 3, 3), ("local", None, 5, 5), ("debug", 2, 2, 2)],
)
def test_a_cluster_takes_any_number_of_jobs_where_nobody_says_otherwise(
    cluster: str, asked: int | None, workers: int, pieces: int, tmp_path: Path
) -> None:
    made = Submitit(asked, tmp_path, {"cluster": cluster})
    assert (made.workers, made.pieces) == (workers, pieces)


@pytest.mark.parametrize("locked", [False, True])
@pytest.mark.parametrize("cluster", ["slurm", "local"])
def test_a_job_ends_with_the_command_on_its_machine_or_with_its_lock(
    cluster: str, locked: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("sweep").mkdir()
    if locked:
        Path("sweep/.lock").write_text("")
    task = Submitit(None, Path("sweep"), {"cluster": cluster})._task
    us = socket.gethostname(), os.getpid(), beginning(os.getpid())
    assert task._parent == (us if cluster == "local" else None)
    assert task._lock == (tmp_path / "sweep" / ".lock" if locked and cluster == "slurm" else None)


@pytest.mark.parametrize(
    ("parent", "lock", "watched"),
    [
        (("here", 7, "then"), None, [("process", 7, "then")]),
        (("here", 7, "then"), "there/.lock", [("process", 7, "then")]),
        (("elsewhere", 7, "then"), "there/.lock", ["file"]),
        (("elsewhere", 7, "then"), None, []),
        (None, "there/.lock", ["file"]),
        (None, "nowhere/.lock", []),
        (None, None, []),
    ],
)
def test_what_a_job_watches(
    parent: tuple[str, int, str] | None,
    lock: str | None,
    watched: list[Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (tmp_path / "there").mkdir()
    seen: list[Any] = []
    monkeypatch.setattr(socket, "gethostname", lambda: "here")
    monkeypatch.setattr(slurm, "end_with", lambda *given: seen.append(("process", *given)))
    monkeypatch.setattr(slurm, "end_with_file", lambda path: seen.append("file"))
    monkeypatch.setattr(slurm, "solve_elsewhere", lambda *given: pickle.dumps(given))
    task = pickle.loads(pickle.dumps(Task(parent, None if lock is None else tmp_path / lock)))
    assert pickle.loads(task(b"packed", ["path"], ["package"])) == (b"packed", ["path"], ["package"])
    assert seen == watched


def test_a_job_that_begins_anew_is_the_same_task(monkeypatch: pytest.MonkeyPatch) -> None:
    helpers = SimpleNamespace(DelayedSubmission=lambda *given: given)
    monkeypatch.setitem(sys.modules, "submitit.helpers", helpers)
    task = Task(None, None)
    assert task.checkpoint(b"packed", ["path"]) == (task, b"packed", ["path"])


@pytest.mark.parametrize("cluster", ["slurm", "local"])
def test_what_still_runs_is_cancelled_in_the_end(
    cluster: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = Submitit(None, tmp_path, {"cluster": cluster})
    cancelled: list[list[str]] = []
    monkeypatch.setattr(made._controller, "cancel", cancelled.append)
    submitted = []
    monkeypatch.setattr(made._controller, "submit", lambda begin: submitted.append(begin()))
    jobs = [made.submit(BATCH, SHOWN) for _ in range(3)]
    assert jobs == made._executor.jobs
    assert jobs[0].given[0] is made._task
    assert pickle.loads(jobs[0].given[1]).directories == ["here"]
    jobs[1].paths.result_pickle.write_bytes(pickle.dumps(Done([DEFERRED], 4.0)))
    assert made.result(jobs[1]) == Done([DEFERRED], 4.0)
    made.close(failed=True)
    made.close(failed=True)
    local = cluster == "local"
    assert cancelled == ([] if local else [["1", "3"], []])
    assert [job.cancelled for job in jobs] == ([[False], [], [False]] if local else [[], [], []])
    assert len(submitted) == (0 if local else 3)


def test_a_local_job_has_ended_where_it_says_so_or_left_a_result(tmp_path: Path, clock: list[float]) -> None:
    made = Submitit(None, tmp_path, {"cluster": "local"})
    one, two = made.submit(BATCH, SHOWN), made.submit(BATCH, SHOWN)
    assert not made._has_ended(one)
    two.paths.result_pickle.write_bytes(b"")
    assert made.wait({4: one, 6: two}) == [6]
    one.over = True
    assert made.wait({4: one, 6: two}) == [4, 6]
    with pytest.raises(LostError, match=r"^the process 1 ended without a result \(gone\); its log: 1.err$"):
        made.result(one)


def test_a_job_of_slurm_has_ended_some_seconds_behind_its_last_state(
    tmp_path: Path, clock: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    made = Submitit(None, tmp_path, {})
    monkeypatch.setattr(made._controller, "submit", lambda begin: begin())
    one, two, three = (made.submit(BATCH, SHOWN) for _ in range(3))
    answers: list[dict[str, str] | None] = [None]
    monkeypatch.setattr(made._controller, "states", lambda: answers[0])

    def ended_at(seconds: float, answer: dict[str, str] | None) -> list[bool]:
        clock[0], answers[0] = 1000 + seconds, answer
        return [made._has_ended(job) for job in (one, two, three)]

    assert ended_at(0, None) == [False] * 3  # nobody knows: they wait
    assert ended_at(1, {"1": "RUNNING", "2": "FAILED", "3": "PENDING"}) == [False] * 3
    assert ended_at(21, {"1": "RUNNING", "2": "FAILED", "3": "RUNNING"}) == [False] * 3
    assert ended_at(21.5, {"1": "RUNNING", "3": "RUNNING"}) == [False, True, False]  # it has been forgotten
    assert ended_at(22, {"1": "RUNNING", "2": "REQUEUED"}) == [False, False, False]  # and is there again
    assert ended_at(30, {"1": "RUNNING", "2": "TIMEOUT"}) == [False, False, False]
    assert made._states == {"1": "RUNNING", "2": "TIMEOUT", "3": "gone"}
    assert ended_at(42.5, None) == [False, False, True]
    one.paths.result_pickle.write_bytes(b"")
    assert made.wait({7: one, 8: two}) == [7]
    assert ended_at(50.5, None) == [True, True, True]


def test_results_are_looked_for_twice_a_second(
    tmp_path: Path, clock: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    made = Submitit(None, tmp_path, {})
    looks: list[float] = []
    monkeypatch.setattr(made, "_has_ended", lambda job: looks.append(clock[0]) or len(looks) == 4)
    assert made.wait({3: None}) == [3]
    assert looks == [1000.0, 1000.5, 1001.0, 1001.5]


@pytest.mark.parametrize(
    ("state", "error", "words"),
    [
        ("CANCELLED", GivenUpError, "SLURM job 1 was cancelled; its log: 1.err"),
        ("TIMEOUT", GivenUpError, "SLURM job 1 ran into its time limit: give it more by .*timeout_min; its"),
        ("DEADLINE", GivenUpError, "did not end before its deadline"),
        ("OUT_OF_MEMORY", GivenUpError, "too little memory: give it more by hydra.launcher.submitit.mem_gb"),
        ("FAILED", LostError, r"SLURM job 1 ended without a result \(FAILED\); its log: 1.err"),
        (None, LostError, r"SLURM job 1 ended without a result \(gone\); its log: 1.err"),
    ],
)
def test_a_job_without_a_result_says_why(
    state: str | None, error: type[Exception], words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = Submitit(None, tmp_path, {})
    monkeypatch.setattr(made._controller, "submit", lambda begin: begin())
    job = made.submit(BATCH, SHOWN)
    made._states = {} if state is None else {"1": state}
    with pytest.raises(error, match=words):
        made.result(job)
    assert made._running == {}


def test_the_last_line_of_a_trace_is_its_reason() -> None:
    framed = "Job failed\n-----\n Traceback\n ValueError: why \n\n-----\nYou can check full logs with x\n y"
    assert slurm._last_of_trace(framed) == "ValueError: why"
    assert slurm._last_of_trace("You can check full logs: 1") == "ended without a word"
    assert slurm._last_of_trace("- -\n") == "ended without a word"


# Signals of SLURM


@pytest.mark.parametrize(
    ("raised", "calls", "error"),
    [
        ([], 1, None),
        ([ValueError("no")], 1, ValueError),
        ([subprocess.CalledProcessError(1, "scontrol")] * 2, 3, None),
        ([subprocess.TimeoutExpired("scontrol", 1.0)], 2, None),
        ([subprocess.CalledProcessError(1, "scontrol")] * 9, 3, subprocess.CalledProcessError),
    ],
)
def test_a_command_that_slurm_itself_ends_is_started_anew_twice(
    raised: list[Exception], calls: int, error: type[Exception] | None
) -> None:
    left, called = list(raised), []

    def theirs(number: int, frame: object) -> None:
        called.append(number)
        if left:
            raise left.pop()

    def work() -> None:
        with _ended_by_signals():
            try:
                signal.raise_signal(signal.SIGUSR2)
            except Exception:  # as a batch does: it is no error of its own
                raise AssertionError from None

    before = [signal.signal(signal.SIGUSR1, signal.SIG_IGN), signal.signal(signal.SIGUSR2, theirs)]
    try:
        if error is None:
            work()
        else:
            with pytest.raises(error) as told:
                work()
            assert told.value.__suppress_context__
        assert signal.getsignal(signal.SIGUSR1) == signal.SIG_IGN
        assert signal.getsignal(signal.SIGUSR2) is theirs
    finally:
        signal.signal(signal.SIGUSR1, before[0])
        signal.signal(signal.SIGUSR2, before[1])
    assert called == [signal.SIGUSR2] * calls

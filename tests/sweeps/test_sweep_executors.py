"""Executors: what goes to a worker and comes back, and a worker that is lost."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from composing import compose
from omegaconf import DictConfig

from staf_torch.results.progress import SHOWN, Progress
from staf_torch.sweeps import executors, workers
from staf_torch.sweeps.batching import Batch, Done, Failed, Outcome, Written, completion, solve
from staf_torch.sweeps.executors import EXECUTORS, Executor, executor, planning
from staf_torch.sweeps.executors.base import GivenUpError
from staf_torch.sweeps.executors.ray_tasks import Ray
from staf_torch.sweeps.executors.slurm import Submitit, Task
from staf_torch.sweeps.hydra_compat import find_launcher
from staf_torch.sweeps.launcher import SweepProgress
from staf_torch.sweeps.workers import LostError

SHORT = ["duration=0.05", "settle_time=0", "figures=false", "history=false"]


@pytest.fixture(scope="module")
def settings() -> list[DictConfig]:
    find_launcher()
    return compose(SHORT, [["seed=0"], ["seed=1", "trajectories=2"], ["centers.count=4"]])


def batch(settings: list[DictConfig], place: Path) -> Batch:
    return Batch(settings, [str(place / str(num)) for num in range(len(settings))])


def test_a_batch_is_the_same_elsewhere(settings: list[DictConfig], tmp_path: Path) -> None:
    here = solve(settings[:2], SHOWN)
    there = executors.unpack(executors.solve_elsewhere(*executors.pack(batch(settings[:2], tmp_path))))
    for num, (one, other) in enumerate(zip(here, there.outcomes, strict=True)):
        written = [tmp_path / f"{side}{num}" for side in ("here", "there")]
        for place in written:
            place.mkdir()
        found = [
            completion(settings[num], outcome)(settings[num], place)
            for place, outcome in zip(written, (one, other), strict=True)
        ]
        assert found[0] == found[1]


def test_a_failure_comes_back_with_its_words(settings: list[DictConfig], tmp_path: Path) -> None:
    done = executors.unpack(executors.solve_elsewhere(*executors.pack(batch(settings[2:], tmp_path))))
    (failed,) = done.outcomes
    assert isinstance(failed, Failed)
    assert isinstance(failed.error, ValueError)
    assert "must be one of 3, 6, 10, 15, 21, 28; got 4." in str(failed.error)


def test_an_experiment_without_batches_runs_whole_in_the_worker(tmp_path: Path) -> None:
    find_launcher()
    lines = ["experiment=feasibility", "figures=false", "feasibility.states=2", "feasibility.epsilons=[0.1]"]
    (cfg,) = compose(lines, [["feasibility.radii=[0.1]"]])
    done = executors.unpack(executors.solve_elsewhere(*executors.pack(batch([cfg], tmp_path))))
    (written,) = done.outcomes
    assert isinstance(written, Written), written
    assert (tmp_path / "0" / "metrics.json").exists()
    assert written.metrics
    assert written.log


def words(outcome: Outcome) -> str:
    assert isinstance(outcome, Failed)
    return str(outcome.error)


class Lossy(Executor):
    """Two at once, the last one first; every second worker is lost."""

    def __init__(self) -> None:
        super().__init__(2)
        self.most = 0

    def close(self, *, failed: bool) -> None:
        return None

    def submit(self, batch: Batch, progress: Progress) -> Batch:
        return batch

    def wait(self, handles: dict[int, Any]) -> list[int]:
        self.most = max(self.most, len(handles))
        return [max(handles)]

    def result(self, handle: Batch) -> Done:
        if int(handle.directories[0]) % 2:
            raise OSError("no more memory")
        return Done([Written({}, [(0, name)]) for name in handle.directories], 1.0)


def test_a_lost_worker_fails_its_batch_alone() -> None:
    names = [["0"], ["1", "1"], ["2"], ["3"]]
    workers = Lossy()
    found = dict(workers.map([Batch([DictConfig({})] * len(n), n) for n in names], SHOWN))
    assert workers.most == 2
    assert set(found) == {0, 1, 2, 3}
    assert found[0].outcomes == [Written({}, [(0, "0")])]
    assert found[2].outcomes == [Written({}, [(0, "2")])]
    assert [words(outcome) for outcome in found[1].outcomes] == [
        "the worker was lost twice (OSError: no more memory)"
    ] * 2


def test_an_executor_that_is_none_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"executor=\.\.\.\)` must be one of 'inline', 'process'"):
        executor("thread", None, {}, tmp_path)
    with pytest.raises(ValueError, match=r"workers=\.\.\.\)` must be at least 1; got 0"):
        executor("process", 0, {}, tmp_path)


@pytest.mark.parametrize("name", [name for name in EXECUTORS if name not in ("inline", "process")])
def test_a_library_that_is_not_installed_is_named_with_its_extra(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ValueError, match=rf"executor={name}` needs the extra: pip install 'staf_torch\["):
        executor(name, None, {"submitit": {}, "ray": {}}, tmp_path)


def test_progress_is_one_line_with_what_failed_and_the_time_left(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = iter([0.0] + [10.0 * k for k in range(1, 100)])
    monkeypatch.setattr("staf_torch.sweeps.launcher.time.monotonic", lambda: next(clock))
    progress = SweepProgress(total=10, done=2)
    progress.computed(2.0)  # of eight that are left, after 20 s
    assert capsys.readouterr().err == "2 of 10 jobs done, 60 s left\n"
    progress.computed(4.0)
    progress.ended("job 2", None)
    progress.ended("job 3 (seed=1)", "it diverged")
    lines = capsys.readouterr().err.splitlines()
    assert lines[-2] == "job 3 (seed=1) failed: it diverged"
    assert lines[-1].startswith("4 of 10 jobs done, 1 failed, ")


@pytest.mark.parametrize(
    ("last", "error", "said"),
    [
        (
            "UncompletedJobError: Job not requeued because: timed-out too many times.",
            GivenUpError,
            "time limit",
        ),
        ("MemoryError: no more memory", LostError, "SLURM job 8 MemoryError: no more memory; its log: 8.err"),
    ],
)
def test_the_last_line_of_a_trace_says_why_a_job_of_slurm_has_no_result(
    last: str, error: type[Exception], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class AutoExecutor(SimpleNamespace):
        cluster = "slurm"

        def update_parameters(self, **parameters: Any) -> None:
            return None

    def result() -> None:  # as submitit says it
        frame = "-" * 22
        trace = f"Traceback (most recent call last):\n  File\n{last}\n"
        where = "You can check full logs with 'job.stderr(0)' or at paths:\n  - 8.err\n  - 8.out"
        raise RuntimeError(f"Job (task=0) failed with trace:\n{frame}\n{trace}\n{frame}\n{where}")

    monkeypatch.setitem(sys.modules, "submitit", SimpleNamespace(AutoExecutor=AutoExecutor))
    paths = SimpleNamespace(stderr="8.err", result_pickle=tmp_path)
    with pytest.raises(error, match=said):
        Submitit(None, tmp_path, {}).result(SimpleNamespace(job_id="8", paths=paths, result=result))


@pytest.mark.parametrize("lost", [0, 2, 9])
def test_a_signal_of_slurm_ends_the_job_and_is_no_error_of_its_batch(
    lost: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = []

    def requeued(
        number: int, frame: object
    ) -> None:  # as submitit's handler: by a command that may be killed
        calls.append(number)
        if len(calls) <= lost:
            raise subprocess.CalledProcessError(-15, "scontrol")
        raise SystemExit(-1)

    text = (
        "import os, signal\ndef task(cfg, directory, progress=None): os.kill(os.getpid(), signal.SIGUSR2)\n"
    )
    (tmp_path / "out_of_time.py").write_text(text)
    (cfg,) = compose(SHORT, [["task=out_of_time.task"]])
    monkeypatch.syspath_prepend(tmp_path)
    before = signal.signal(signal.SIGUSR2, requeued)
    try:
        with pytest.raises(subprocess.CalledProcessError if lost == 9 else SystemExit):
            Task(None, None)(*executors.pack(batch([cfg], tmp_path)))
        assert signal.getsignal(signal.SIGUSR2) is requeued
    finally:
        signal.signal(signal.SIGUSR2, before)
    assert len(calls) == min(lost, 2) + 1


def test_a_log_gets_a_line_of_progress_no_more_often_than_every_ten_seconds(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = [100.0]
    monkeypatch.setattr("staf_torch.sweeps.launcher.time.monotonic", lambda: clock[0])
    progress, lines = SweepProgress(total=100), []
    for second in range(1, 36):
        clock[0] = 100.0 + second
        progress.computed(second)
        lines += [second] * len(capsys.readouterr().err.splitlines())
    assert lines == [10, 20, 30]


class Direct(Lossy):
    """One after the other, none of which is lost."""

    def result(self, handle: Batch) -> Done:
        return Done([Written({}, []) for _ in handle.directories], 1.0)


def test_jobs_are_told_as_computed_when_their_batch_has_ended(settings: list[DictConfig]) -> None:
    told: list[float] = []
    places = [Path(str(2 * num)) for num in range(3)]
    found = list(planning.compute(settings, places, Direct(), finished=[], tell=told.append))
    assert sorted(index for index, *_ in found) == [0, 1, 2]
    assert told == sorted(told)
    assert told[-1] == 3


def test_a_ray_that_cannot_begin_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    def init(**given: object) -> None:
        raise RuntimeError("no\n  port is free")

    ray = SimpleNamespace(is_initialized=lambda: False, init=init, remote=lambda **_: lambda f: f)
    monkeypatch.setitem(sys.modules, "ray", ray)
    with pytest.raises(LostError, match=r"Ray could not begin \(RuntimeError: no port is free\)"):
        Ray(None, {})


def test_how_a_worker_ended_is_told_by_its_code() -> None:
    for code, said in (
        (0, "it ended with exit code 0"),
        (1, "it ended with exit code 1"),
        (None, "it ended with exit code None"),
        (-15, "it was ended by SIGTERM"),
        (-9, "it was ended by SIGKILL, as the kernel does where memory runs out"),
    ):
        assert workers._end_of(code) == said

"""Executors: what goes to a worker and comes back, and a worker that is lost."""

from __future__ import annotations

import signal
import subprocess
from pathlib import Path
from typing import Any

import pytest
from composing import compose
from omegaconf import DictConfig

from staf_torch.results.progress import SHOWN, Progress
from staf_torch.sweeps import executors
from staf_torch.sweeps.batching import Batch, Done, Failed, Outcome, Written, completion, solve
from staf_torch.sweeps.executors import EXECUTORS, Executor, executor
from staf_torch.sweeps.executors.slurm import Task
from staf_torch.sweeps.hydra_compat import find_launcher
from staf_torch.sweeps.launcher import SweepProgress

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
    import sys

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

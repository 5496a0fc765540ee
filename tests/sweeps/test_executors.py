"""Where tensor batches are computed: what is begun when, what goes to a worker, and what a lost one costs."""

from __future__ import annotations

import logging
import os
import pickle
import signal
import sys
import types
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from composing import compose
from omegaconf import DictConfig, OmegaConf

import staf_torch
from staf_torch.experiments.registry import Metrics
from staf_torch.results.files import write_metrics
from staf_torch.settings.plain import ManySettings
from staf_torch.signs import SHOWN, Progress
from staf_torch.sweeps.executors import Elsewhere, GivenUpError, Task, compute, executor
from staf_torch.sweeps.job import Batch, Done, Failed, LostError, Outcome, Written, completion, solve
from staf_torch.sweeps.workers import pack, solve_elsewhere, unpack

SHORT = ["duration=0.05", "settle_time=0", "figures=false", "history=false"]
MANY = {"inline": (1, 1), "process": (3, 3)}


def words(outcome: Outcome) -> str:
    assert isinstance(outcome, Failed), outcome
    return str(outcome.error)


# Any executor


class Plan(Elsewhere):
    """Ends the batches in the order in which they began; notes what goes on, and loses some."""

    def __init__(self, workers: int | None, lost: dict[str, list[Exception]] | None = None) -> None:
        super().__init__(workers)
        self.notes: list[str] = []
        self.lost = lost or {}

    def close(self) -> None:
        self.notes.append("closed")

    def submit(self, batch: Batch) -> Batch:
        self.notes.append(f"+{batch.directories[0]}")
        if batch.directories[0] == "refused":
            raise OSError("no\n room")
        return batch

    def wait(self, handles: dict[int, Any]) -> list[int]:
        return [next(iter(handles))]

    def result(self, handle: Batch) -> Done:
        name = handle.directories[0]
        self.notes.append(f"-{name}")
        if self.lost.get(name):
            raise self.lost[name].pop()
        return Done([Written({}, [(0, each)]) for each in handle.directories], 6.0)


def batch(*names: str) -> Batch:
    return Batch([OmegaConf.create({"name": name}) for name in names], list(names))


def mapped(plan: Plan, *batches: Batch) -> dict[int, Done]:
    with plan:
        return dict(plan.map(batches, SHOWN))


@pytest.mark.parametrize(("workers", "notes"), [(1, "+a -a +b -b +c -c"), (2, "+a +b -a +c -b -c")])
def test_batches_begin_in_order_and_as_many_at_once_as_there_are_workers(workers: int, notes: str) -> None:
    plan = Plan(workers)
    found = mapped(plan, batch("a"), batch("b"), batch("c"))
    assert " ".join(plan.notes) == f"{notes} closed"
    assert sorted(found) == [0, 1, 2]


def test_a_batch_whose_worker_is_lost_is_tried_once_more_and_then_fails_alone(
    caplog: pytest.LogCaptureFixture,
) -> None:
    lost: dict[str, list[Exception]] = {
        "once": [LostError("gone")],
        "twice": [ValueError("worse " * 100), LostError("gone")],
        "given up": [GivenUpError("cancelled")],
    }
    plan = Plan(1, lost)
    found = mapped(plan, *(batch(name) for name in lost), batch("refused", "two"), batch("kept"))
    assert plan.notes[:-4] == ["+once", "-once"] * 2 + ["+twice", "-twice"] * 2 + ["+given up", "-given up"]
    assert found[0].outcomes == [Written({}, [(0, "once")])]
    assert words(found[1].outcomes[0]).startswith("the worker was lost twice (ValueError: worse worse")
    assert len(words(found[1].outcomes[0])) < 400
    assert words(found[2].outcomes[0]) == "the worker was lost (cancelled)"
    assert [words(one) for one in found[3].outcomes] == [
        "no worker process could be started (OSError: no room)"
    ] * 2
    assert found[4].outcomes == [Written({}, [(0, "kept")])]
    assert [line.endswith("its batch is tried once more") for line in caplog.messages] == [True] * 2


def test_jobs_have_their_outcome_and_share_of_the_time_and_a_batch_of_some_finished_is_computed_whole() -> (
    None
):
    flat = [{"task": "gradient_chase", "dt": 0.1, "duration": 1.0, "seed": n} for n in range(6)]
    settings = ManySettings([OmegaConf.create(each) for each in flat])
    told: list[float] = []
    plan = Plan(1)
    given = settings, flat, lambda index: Path("/", str(index)), plan
    found = list(compute(*given, finished={0, 1, 3}, most=2, tell=told.append))
    assert plan.notes == ["+/2", "-/2", "+/4", "-/4"]  # nothing is left to do of 0 and 1
    assert [(index, outcome.log[0][1], seconds) for index, outcome, seconds in found] == [  # type: ignore[union-attr]
        (2, "/2", 3.0),
        (4, "/4", 3.0),
        (5, "/5", 3.0),
    ]
    assert told == sorted(told)
    assert told[-1] == 3
    assert list(compute(*given, finished=range(6), tell=told.append)) == []


def test_an_executor_is_made_by_its_name_or_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, sizes in MANY.items():
        made = executor(name, 3, {}, tmp_path)
        assert (made.workers, made.pieces) == sizes
    with pytest.raises(ValueError, match=r"executor=\.\.\.\)` must be one of 'inline', 'process'"):
        executor("thread", None, {}, tmp_path)
    with pytest.raises(ValueError, match=r"`hydra.launcher\(workers=\.\.\.\)` must be"):
        executor("process", 0, {}, tmp_path)
    for name in ("submitit", "ray"):
        monkeypatch.setitem(sys.modules, name, None)
        with pytest.raises(ValueError, match=rf"executor={name}` needs the extra: pip install 'staf_torch\["):
            executor(name, None, {"submitit": {}, "ray": {}}, tmp_path)


# What a worker does


def touchy(cfg: DictConfig, directory: Path, progress: Progress = SHOWN) -> Metrics:
    """An experiment without batches that says something in every way, and fails with an odd seed."""
    if cfg.seed % 2:
        raise NotPicklableError(directory, "in our words")
    logging.getLogger("own").info("told %d", 1)
    warnings.warn("take care", stacklevel=1)
    write_metrics(directory / "metrics.json", {"seed": float(cfg.seed)})
    return {"seed": float(cfg.seed)}


class NotPicklableError(Exception):
    """An error that cannot be made again of what pickle keeps."""

    def __init__(self, place: Path, why: str) -> None:
        super().__init__(why)


@pytest.fixture
def _as_before(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Give back the path of imports and the level of the log, which a worker changes."""
    root, level, path = logging.getLogger(), logging.getLogger().level, sys.path[:]
    yield
    root.setLevel(level)
    sys.path[:] = path


def elsewhere(cfgs: list[DictConfig], place: Path) -> list[Outcome]:
    packed = pack(Batch(cfgs, [str(place / str(n)) for n in range(len(cfgs))]))
    return unpack(solve_elsewhere(*packed)).outcomes


@pytest.mark.usefixtures("_as_before")
def test_a_batch_is_the_same_elsewhere_and_a_failure_keeps_its_words(tmp_path: Path) -> None:
    cfgs = compose(SHORT, [["seed=0"], ["seed=1", "trajectories=2"], ["centers.count=4"]])
    for cfg, one, other in zip(cfgs[:2], solve(cfgs[:2], SHOWN), elsewhere(cfgs[:2], tmp_path), strict=True):
        assert completion(cfg, one)(cfg, tmp_path) == completion(cfg, other)(cfg, tmp_path)
    (failed,) = elsewhere(cfgs[2:], tmp_path)
    assert isinstance(failed, Failed)
    assert isinstance(failed.error, ValueError)
    assert "must be one of 3, 6, 10, 15, 21, 28; got 4." in words(failed)


@pytest.mark.usefixtures("_as_before")
def test_an_experiment_without_batches_runs_whole_in_the_worker_and_its_log_comes_back(
    tmp_path: Path,
) -> None:
    before = logging.getLogger().handlers[:]
    cfgs = [OmegaConf.create({"task": f"{__name__}.touchy", "seed": seed}) for seed in (0, 1)]
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        written, failed = elsewhere(cfgs, tmp_path)
    assert written == Written({"seed": 0.0}, [(logging.INFO, "told 1"), (logging.WARNING, "take care")])
    assert words(failed) == "NotPicklableError: in our words"
    assert (tmp_path / "0" / "metrics.json").exists()
    assert logging.getLogger().handlers == before
    sys.path[:] = ["/both", *(path := sys.path[:])]
    solve_elsewhere(pickle.dumps(Batch([OmegaConf.create({})], ["here"])), ["/theirs", "/both"])
    assert sys.path == ["/theirs", "/both", *path]  # as the command imports


# submitit, by a small fake: what SLURM reports; tests/cluster has it and Ray themselves


class Clusters:
    """What the fakes are told and note: begun batches, states of jobs that are lost, jobs taken back."""

    def __init__(self) -> None:
        self.begun: list[str] = []
        self.states: list[str] = []  # of the next jobs, which leave no result
        self.trace = ""  # of jobs that leave it as their result
        self.cancelled: list[str] = []
        self.meanwhile: Callable[[], object] = lambda: None  # while somebody waits for a job


class Job:
    """A job of submitit's, which has run when it is asked for."""

    def __init__(self, notes: Clusters, folder: Path, task: Any, arguments: Any) -> None:
        self.notes, self.work, self.job_id = notes, lambda: task(*arguments), str(len(notes.begun))
        self.state = notes.states.pop(0) if notes.states else "COMPLETED"
        self.paths = types.ModuleType("paths")
        self.paths.stderr, self.paths.result_pickle = f"{self.job_id}.err", folder / self.job_id
        if self.state in ("COMPLETED", "FAILED"):
            self.paths.result_pickle.write_bytes(b"")

    def done(self) -> bool:
        self.notes.meanwhile()
        return self.state != "RUNNING"

    def cancel(self, check: bool = True) -> None:
        self.notes.cancelled.append(self.job_id)

    def result(self) -> bytes:
        if self.state == "COMPLETED":
            found: bytes = self.work()
            return found
        raise RuntimeError(
            f"failed with trace:\n----\n{self.notes.trace}\n\n----\nYou can check full logs with x"
        )


@pytest.fixture
def clusters(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Clusters:
    notes = Clusters()

    class AutoExecutor:
        def __init__(self, folder: Path, cluster: str | None) -> None:
            self.folder, self.cluster = folder, cluster or "slurm"

        def update_parameters(self, **given: Any) -> None:
            assert given == {"name": "staf", "timeout_min": 1440}

        def submit(self, task: Any, *arguments: Any) -> Job:
            notes.begun.append("job")
            return Job(notes, self.folder, task, arguments)

    submitit = types.ModuleType("submitit")
    submitit.AutoExecutor = AutoExecutor  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "submitit", submitit)
    monkeypatch.chdir(tmp_path)
    return notes


def swept(name: str, *more: str) -> staf_torch.sweeps.python_api.Runs:
    return staf_torch.sweep(*SHORT, f"hydra.launcher.executor={name}", *more, directory=name)


@pytest.mark.parametrize(
    ("state", "trace", "tries", "said"),
    [
        ("CANCELLED by 0", "", 1, "the worker was lost (SLURM job 1 was cancelled; its log: 1.err)"),
        ("NODE_FAIL", "", 2, "lost twice (SLURM job 2 ended without a result (NODE_FAIL); its log: 2.err)"),
        ("OUT_OF_MEMORY", "", 1, "too little memory: give it more by hydra.launcher.submitit.mem_gb"),
        ("FAILED", "Traceback\nMemoryError: no more", 2, "SLURM job 2 MemoryError: no more; its log: 2.err"),
        ("FAILED", "UncompletedJobError: timed-out and not checkpointable", 1, "ran into its time limit"),
    ],
)
@pytest.mark.usefixtures("_as_before")
def test_what_slurm_reports_of_a_job_is_the_reason_of_its_runs(
    state: str, trace: str, tries: int, said: str, clusters: Clusters
) -> None:
    clusters.states, clusters.trace = [state] * tries, trace
    lost, kept = swept("submitit", "kernel=gaussian,matern", "hydra.launcher.workers=1")
    assert said in str(lost.reason)
    assert (lost.status, kept.status) == ("failed", "completed")
    assert len(clusters.begun) == tries + 1
    assert clusters.cancelled == []


def test_ctrl_c_takes_the_jobs_of_a_cluster_back(clusters: Clusters) -> None:
    clusters.states = ["RUNNING"] * 2
    clusters.meanwhile = lambda: signal.raise_signal(signal.SIGINT)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            swept("submitit", "kernel=gaussian,matern")
    finally:
        signal.signal(signal.SIGINT, before)
    assert clusters.cancelled == ["1", "2"]


def task_out_of_time(cfg: DictConfig, directory: Path, progress: Progress = SHOWN) -> Metrics:
    """An experiment in the middle of which SLURM says that its time is over."""
    os.kill(os.getpid(), signal.SIGUSR2)
    return {}


@pytest.mark.usefixtures("_as_before")
def test_a_time_limit_ends_the_job_and_is_no_error_of_its_batch(tmp_path: Path) -> None:
    def theirs(number: int, frame: object) -> None:
        raise ValueError("timed-out and not checkpointable")  # as submitit's handler

    before = signal.signal(signal.SIGUSR2, theirs)
    cfg = OmegaConf.create({"task": f"{__name__}.task_out_of_time"})
    try:
        with pytest.raises(ValueError, match="timed-out"):
            Task(None)(*pack(Batch([cfg], [str(tmp_path)])))
        assert signal.getsignal(signal.SIGUSR2) is theirs
    finally:
        signal.signal(signal.SIGUSR2, before)

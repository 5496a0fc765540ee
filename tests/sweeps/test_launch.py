"""One call of Hydra's: which jobs run, in what order, and what is said of them."""

from __future__ import annotations

import contextlib
import gc
import json
import logging
import weakref
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hydra.core.utils import JobReturn, JobStatus
from omegaconf import DictConfig, OmegaConf

from staf_torch.results.progress import SHOWN
from staf_torch.sweeps import launcher, lock, signals
from staf_torch.sweeps.batching import DEFERRED, Failed
from staf_torch.sweeps.job import PRINTS
from staf_torch.sweeps.launcher import Launch, SweepProgress

# One call of Hydra's


class Context:
    """What Hydra hands to a launcher, without Hydra."""

    own_callbacks, numbered = True, True

    def __init__(self, _: object, config: DictConfig) -> None:
        self.master, self.started, self.here = config, 0, Path()
        self.alive: list[Any] = []  # settings that were made, while somebody has them
        self.before = lambda: None  # called before a job runs

    def start(self) -> None:
        self.started += 1

    def settings(self, overrides: list[str], *, reuse: bool = False) -> DictConfig:
        own = [line for line in overrides if "hydra" not in line]
        made = OmegaConf.create({"task": "stub", "seed": 0, **OmegaConf.from_dotlist(own)})
        self.alive.append(weakref.ref(made))
        return made

    def job_config(self, num: int, overrides: list[str], *, reuse: bool = False) -> DictConfig:
        sweep = {"dir": self.master.hydra.sweep.dir, "subdir": f"job{num}"}
        node = {"sweep": sweep, "runtime": {"choices": {"kernel": "own"}}, "job": {"config_name": "config"}}
        lines = {"task": [line for line in overrides if "hydra" not in line], "hydra": []}
        return OmegaConf.create({"hydra": {**node, "overrides": lines}})

    def run_job(self, task: Any, config: DictConfig, settings: DictConfig, overrides: list[str]) -> JobReturn:
        self.here = launcher.directory_of(config)
        self.here.mkdir(parents=True, exist_ok=True)
        self.before()
        ended = JobReturn(overrides=overrides, cfg=settings, hydra_cfg=config)
        try:
            ended.return_value, ended.status = task(settings), JobStatus.COMPLETED
        except ValueError as error:
            ended.return_value, ended.status = error, JobStatus.FAILED
        return ended


class Bench:
    """A launcher, what it asked for, and what ran."""

    def __init__(self, place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.master = OmegaConf.create({"hydra": {"sweep": {"dir": str(place)}}, "sweep": {"resume": None}})
        self.about = SimpleNamespace(
            hydra_context=None, config=self.master, task_function=self.execute, batch=None, foreign="warn"
        )
        self.about.executor, self.about.workers, self.about.arguments = "inline", None, {}
        self.ran: list[tuple[int, object, float]] = []
        self.silenced: list[int] = []
        self.asked: dict[str, Any] = {}
        self.executors: list[tuple[Any, ...]] = []
        self.failing: set[int] = set()
        self.context: Any = None
        self.about.task_function = execute = self.execute
        monkeypatch.setattr(launcher, "execute", execute)
        monkeypatch.setattr(launcher, "SweepContext", Context)
        monkeypatch.setattr(launcher, "compute", self.compute)
        monkeypatch.setattr(launcher, "executor", self.executor)
        monkeypatch.setattr(launcher, "silence_terminal", lambda: self.silenced.append(1))

    def execute(self, cfg: DictConfig, outcome: Any, seconds: float, progress: object) -> float:
        """As `job.execute`: fills the directory."""
        self.ran.append((cfg.seed, outcome, seconds))
        if isinstance(outcome, Failed):
            raise outcome.error
        (self.context.here / "metrics.json").write_text("{}")
        return float(cfg.seed)

    def compute(self, settings: Any, directories: Any, workers: Any, **more: Any) -> Iterator[Any]:
        self.asked = {
            "places": [directories[i] for i in range(min(5, len(settings)))],
            "workers": workers,
            **more,
        }
        for index in range(len(settings)):
            if index not in more["finished"]:
                bad = settings[index].seed in self.failing
                yield index, Failed(ValueError("odd")) if bad else DEFERRED, 0.5

    @contextlib.contextmanager
    def executor(self, *given: Any) -> Iterator[str]:
        self.executors.append(given)
        yield "workers"

    def launch(self) -> Launch:
        made = Launch(self.about)
        self.context = made._context
        return made

    def run(self, *jobs: list[str], first: int = 0) -> list[JobReturn]:
        return self.launch().run(jobs, first)


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> Bench:
    caplog.set_level(logging.INFO)
    return Bench(tmp_path / "new" / "sweep", monkeypatch)


def test_every_job_runs_once_and_a_failure_is_said(
    bench: Bench, tmp_path: Path, caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    bench.failing = {4}
    ended = bench.run(["seed=3"], ["seed=4"], ["seed=5"], first=6)
    assert [one.overrides for one in ended] == [["seed=3"], ["seed=4"], ["seed=5"]]
    assert [one.status.name for one in ended] == ["COMPLETED", "FAILED", "COMPLETED"]
    assert [one.return_value for one in ended[::2]] == [3.0, 5.0]
    assert all(one.cfg is one.hydra_cfg is None for one in ended)
    assert [(seed, seconds) for seed, _, seconds in bench.ran] == [(3, 0.5), (4, 0.5), (5, 0.5)]
    assert capsys.readouterr().err == "job 7 (seed=4) failed: odd\n"
    assert caplog.messages[-1] == "2 of 3 jobs completed, 1 failed"
    assert (bench.context.started, len(bench.silenced)) == (1, 3)
    sweep = tmp_path / "new" / "sweep"
    assert json.loads((sweep / "sweep.json").read_text())["jobs"] == [
        {"num": num, "overrides": [f"seed={num - 3}"]} for num in (6, 7, 8)
    ]
    assert bench.executors == [("inline", None, {}, sweep)]
    assert bench.asked["workers"] == "workers"
    assert bench.asked["places"] == [sweep / "6", sweep / "7", sweep / "8"]
    assert [dict(each) for each in bench.asked["flat"]] == [{"task": "stub", "seed": n} for n in (3, 4, 5)]
    assert (bench.asked["most"], bench.asked["whole"], bench.asked["finished"]) == (None, (), set())
    assert len(bench.run(["seed=3"], first=9)) == 1  # in the same directory


def test_a_job_with_lines_about_hydra_has_the_directory_that_they_say(bench: Bench, tmp_path: Path) -> None:
    lines = [["seed=0"], ["hydra.job.name=a"], ["+hydra.x=1"], ["~hydra.y"], ["seed=1", "hydra/x=y"]]
    bench.run(*lines)
    assert [path.name for path in bench.asked["places"]] == ["0", "job1", "job2", "job3", "job4"]
    Context.numbered = False
    try:
        bench.run(["seed=0"])
    finally:
        Context.numbered = True
    assert [path.name for path in bench.asked["places"]] == ["job0"]


def test_workers_run_jobs_of_many_members_whole(bench: Bench) -> None:
    bench.about.executor, bench.about.batch, bench.about.workers = "process", 7, 2
    bench.about.arguments = {"ray": {}}
    bench.run(["seed=0"], ["seed=1", "members=[x]"])
    none, whole = bench.asked["whole"]
    assert none is None
    assert whole.origin.overrides == ["seed=1", "members=[x]"]
    assert whole.origin.choices == {"kernel": "own"}
    assert whole.paths == launcher.search_paths()
    assert bench.asked["most"] == 7
    assert bench.executors[0][:3] == ("process", 2, {"ray": {}})


@pytest.mark.parametrize("prints", [True, False])
def test_python_sees_no_log_on_its_terminal(prints: bool, bench: Bench) -> None:
    token = PRINTS.set(prints)
    try:
        bench.run(["seed=0"])
    finally:
        PRINTS.reset(token)
    assert len(bench.silenced) == 1 + (not prints)


def finished(monkeypatch: pytest.MonkeyPatch, numbers: set[str]) -> list[tuple[str, bool]]:
    """Let the jobs of these directories be complete; what is asked about each."""
    asked = []

    class Record:
        def __init__(self, cfg: DictConfig, choices: Any, overrides: list[str], compiler: str) -> None:
            assert dict(choices) == {"kernel": "own"}
            assert overrides == [f"seed={cfg.seed}"]

        def finished(self, directory: Path, *, anyway: bool = False) -> dict[str, float] | None:
            asked.append((directory.name, anyway))
            return {"ball": 9.0, "other": 1.0} if directory.name in numbers else None

    monkeypatch.setattr(launcher.records, "RunRecord", Record)
    return asked


@pytest.mark.parametrize("anyway", [False, True])
def test_what_an_earlier_start_completed_is_not_run_again(
    anyway: bool, bench: Bench, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    asked = finished(monkeypatch, {"job0", "job2"})
    bench.run(["seed=0"], ["seed=1"])
    assert asked == []  # it is no sweep that was begun before
    bench.master.sweep = {"resume": "here", "resume_anyway": anyway, "objective": "ball"}
    bench.ran.clear()
    ended = bench.run(["seed=0"], ["seed=1"], ["seed=2"])
    assert asked == [("job0", anyway), ("job1", anyway), ("job2", anyway)]
    assert [seed for seed, *_ in bench.ran] == [1]
    assert bench.asked["finished"] == {0, 2}
    assert [one.return_value for one in ended] == [9.0, 1.0, 9.0]
    assert [one.overrides for one in ended] == [["seed=0"], ["seed=1"], ["seed=2"]]
    assert [one.status for one in ended] == [JobStatus.COMPLETED] * 3
    assert caplog.messages[-1] == "3 of 3 jobs completed, 0 failed"
    count = len(bench.executors)
    bench.run(["seed=0"])
    assert len(bench.executors) == count  # nobody is asked to compute nothing


@pytest.mark.parametrize("foreign", ["warn", "run"])
def test_jobs_of_another_program_run_one_by_one(
    foreign: str, bench: Bench, caplog: pytest.LogCaptureFixture
) -> None:
    bench.about.task_function = lambda cfg: 10 * cfg.seed  # writes no file, which is its own affair
    bench.about.foreign = foreign
    ended = bench.run(["seed=1"], ["seed=2"])
    assert [(one.return_value, one.status) for one in ended] == [(n, JobStatus.COMPLETED) for n in (10, 20)]
    assert bench.executors == []
    assert bench.silenced == []
    assert ("the jobs of this program cannot share tensor batches" in caplog.text) == (foreign == "warn")


def test_what_the_launcher_is_told_is_checked_before_anything_runs(bench: Bench) -> None:
    own, bench.about.task_function = bench.about.task_function, lambda cfg: 0.0
    bench.about.foreign = "refuse"
    with pytest.raises(ValueError, match=r"^`hydra.launcher.foreign=refuse`: the jobs of this program"):
        bench.launch()
    bench.about.task_function = own
    bench.launch()  # the library's own
    for foreign in ("run", "warn"):
        bench.about.foreign, bench.about.task_function = foreign, lambda cfg: 0.0
        bench.launch()
    bench.about.foreign = "ask"
    with pytest.raises(ValueError, match=r"foreign=...\)` must be one of 'run', 'warn', 'refuse'; got 'ask'"):
        bench.launch()
    bench.about.foreign, bench.about.batch = "run", 1
    bench.launch()
    for batch in (0, 1.5):
        bench.about.batch = batch
        with pytest.raises(ValueError, match=r"`hydra.launcher\(batch=...\)` must be"):
            bench.launch()


@pytest.mark.parametrize("when", [0, 1, 2])
def test_a_directory_that_is_taken_away_stops_its_sweep(
    when: int, bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While the job of that number runs."""
    monkeypatch.setattr(lock, "held", lambda _: SimpleNamespace(lost=lambda: len(bench.ran) > when))
    with pytest.raises(ValueError, match=rf"stopped when {when + 1} of 3 jobs were done, and those are lost"):
        bench.run(["seed=0"], ["seed=1"], ["seed=2"])
    assert len(bench.ran) == when + 1
    monkeypatch.setattr(lock, "held", lambda _: SimpleNamespace(lost=lambda: False))
    assert len(bench.run(["seed=0"])) == 1


def test_a_job_whose_results_are_taken_away_has_failed(
    bench: Bench, tmp_path: Path, caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    launch = bench.launch()
    lost = tmp_path / "new" / "sweep" / "job0" / "metrics.json"
    bench.context.before = lambda: lost.unlink(missing_ok=True)
    bench.failing = {2}  # which never had any
    ended = launch.run([["seed=0"], ["seed=1"], ["seed=2"]], 0)
    assert [one.status.name for one in ended] == ["FAILED", "COMPLETED", "FAILED"]
    said = f"the results of job 0 (seed=0) are not in {lost.parent} any more"
    assert str(ended[0]._return_value) == said
    assert str(ended[2]._return_value) == "odd"
    assert capsys.readouterr().err == f"job 2 (seed=2) failed: odd\njob 0 (seed=0) failed: {said}\n"
    assert caplog.messages[-1] == "1 of 3 jobs completed, 2 failed"


def test_a_signal_that_was_lost_stops_a_sweep_before_its_next_job(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    launch = bench.launch()
    closed: list[int] = []
    monkeypatch.setattr(SweepProgress, "close", lambda self: closed.append(1))
    arrived: list[int] = []
    monkeypatch.setattr(signals, "_arrived", arrived)
    bench.context.before = lambda: arrived.append(15)
    with pytest.raises(signals.Stopped):
        launch.run([["seed=0"], ["seed=1"]], 0)
    assert len(bench.ran) == 1
    assert closed == [1]


def test_settings_of_jobs_that_ended_are_given_back(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    launch, collected = bench.launch(), []
    collect = gc.collect
    monkeypatch.setattr(gc, "collect", lambda: collected.append(len(bench.ran)) or collect())
    most = []

    def look() -> None:
        if len(bench.ran) in (64, 128):  # jobs that have ended
            most.append(sum(each() is not None for each in bench.context.alive))

    bench.context.before = look
    assert len(launch.run([[f"seed={n}"] for n in range(130)], 0)) == 130
    assert collected == [64, 128]
    assert max(most) <= 3


def test_the_task_of_a_job_keeps_the_name_of_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    assert launcher._off_the_terminal(DEFERRED, 0.0, SHOWN).__name__ == "execute"

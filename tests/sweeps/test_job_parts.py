"""One job without Hydra: what its directory holds however it ends, and what the sweeper is told."""

from __future__ import annotations

import json
import logging
import warnings
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from staf_torch.experiments.registry import Metrics
from staf_torch.metrics import Metric
from staf_torch.results.files import write_metrics
from staf_torch.results.progress import SHOWN, Progress
from staf_torch.sweeps import job, lock
from staf_torch.sweeps.batching import DEFERRED, Failed, Written
from staf_torch.sweeps.hydra_compat import search_paths
from staf_torch.sweeps.job import InWorker, Origin, Refused, execute, objective, run, silence_terminal


def own(cfg: DictConfig, directory: Path, progress: Progress = SHOWN) -> Metrics:
    """An experiment that does what its settings say."""
    assert json.loads((directory / "run.json").read_text())["status"] == "running"
    for said in cfg.get("warns", ()):
        warnings.warn(said, stacklevel=1)
    if cfg.get("fails") == "user":
        raise ValueError("not like that")
    if cfg.get("fails") == "defect":
        raise RuntimeError("a defect")
    if cfg.get("fails") == "stop":
        raise KeyboardInterrupt
    write_metrics(directory / "metrics.json", {"ball": 2.0, "none": None})
    return {"ball": 2.0, "none": None}


class Moving:
    """An experiment that can be shown in motion."""

    animates = True

    def __call__(self, cfg: DictConfig, directory: Path, progress: Progress = SHOWN) -> Metrics:
        return own(cfg, directory)


class Reached(Metric):
    """A metric of one's own."""

    name = "reached"

    def __call__(self, result: Any, problem: Any) -> torch.Tensor:
        return result.state


@pytest.fixture(autouse=True)
def _no_time_goes_by(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("staf_torch.results.run_record.time", SimpleNamespace(monotonic=lambda: 5.0))


ORIGIN = Origin(["seed=1", "sweep.resume=null"], {"kernel": "own"})


def settings(**more: Any) -> DictConfig:
    return OmegaConf.create({"task": f"{__name__}.own", "seed": 1} | more)


def record(place: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((place / "run.json").read_text())
    return found


def test_a_run_fills_its_directory_and_says_how_it_ended(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    cfg = settings(warns=["odd 100 %", "odder"])
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        assert run(cfg, tmp_path, ORIGIN) == {"ball": 2.0, "none": None}
    found = record(tmp_path)
    assert (found["status"], found["reason"], found["overrides"]) == ("completed", None, ["seed=1"])
    assert found["settings"]["kernel"] == "own"
    assert "metrics" not in found
    assert caplog.messages == ["odd 100 %", "odder"]  # of warnings
    assert found["seconds"] == 0
    run(settings(), tmp_path, ORIGIN, seconds=1000.0)
    assert record(tmp_path)["seconds"] == 1000


@pytest.mark.parametrize(
    ("fails", "error", "reason"),
    [
        ("user", ValueError, "not like that"),
        ("defect", RuntimeError, "RuntimeError: a defect"),
        ("stop", KeyboardInterrupt, "interrupted"),
    ],
)
def test_a_run_that_raises_says_why(
    fails: str, error: type[BaseException], reason: str, tmp_path: Path
) -> None:
    with pytest.raises(error):
        run(settings(fails=fails), tmp_path, ORIGIN)
    assert (record(tmp_path)["status"], record(tmp_path)["reason"]) == ("failed", reason)


def test_what_was_computed_before_is_not_computed_again(tmp_path: Path) -> None:
    assert run(settings(fails="user"), tmp_path, ORIGIN, Written({"there": 1.0}, [])) == {"there": 1.0}
    with pytest.raises(ValueError, match="odd"):
        run(settings(), tmp_path, ORIGIN, Failed(ValueError("odd")))
    assert record(tmp_path)["reason"] == "odd"


def test_what_a_run_cannot_do_is_refused_and_recorded(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="which has no animation"):
        run(settings(animation=True), tmp_path, ORIGIN)
    assert record(tmp_path)["status"] == "failed"
    run(settings(animation=True, task=f"{__name__}.Moving"), tmp_path, ORIGIN)
    assert record(tmp_path)["status"] == "completed"
    with pytest.raises(ValueError, match=r"must be a `staf_torch.metrics.Metric`"):
        run(settings(metric={"_target_": "staf_torch.systems.TwoState"}), tmp_path, ORIGIN)


def test_metrics_of_ones_own_are_described_in_the_record(tmp_path: Path) -> None:
    run(settings(metric={"_target_": f"{__name__}.Reached"}), tmp_path, ORIGIN)
    assert list(record(tmp_path)["metrics"]) == ["reached"]


def test_a_job_of_members_is_run_by_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[Any] = []

    def members(cfg: Any, directory: Path, base: Sequence[str], name: Any, start: Any, progress: Any) -> Any:
        told.append((list(base), name, directory, start.left.made, lock.held(directory) is not None))
        return {"members": 3}

    begun: list[bool] = []
    start_of = job.members.start_of

    def noted(*given: Any, again: bool = False) -> Any:
        begun.append(again)
        return start_of(*given, again=again)

    monkeypatch.setattr(job.members, "run", members)
    monkeypatch.setattr(job.members, "start_of", noted)
    cfg = settings(members=["seed=range(3)"])
    origin = ORIGIN._replace(search=("hydra.searchpath=[x]",), config_name="other")
    assert run(cfg, tmp_path, origin) == {"members": 3}
    assert run(cfg, tmp_path, origin, again=True) == {"members": 3}
    lines = ["hydra.searchpath=[x]", "seed=1", "sweep.resume=null"]
    assert told == [(lines, "other", tmp_path, [], True)] * 2
    assert begun == [False, True]
    assert lock.held(tmp_path) is None
    paths = search_paths()
    assert InWorker(origin, paths)(cfg, tmp_path) == {"members": 3}
    assert begun == [False, True, True]
    assert record(tmp_path)["seconds"] == 0
    assert run(cfg, tmp_path, origin, Written({"there": 1.0}, [])) == {"there": 1.0}
    assert run(settings(members=None), tmp_path, origin) == {"ball": 2.0, "none": None}
    assert len(told) == 3


def test_the_origin_of_a_job_is_what_was_typed() -> None:
    overrides = SimpleNamespace(
        task=["seed=1"], hydra=["hydra.searchpath=[a]", "hydra.verbose=true", "hydra.searchpath=[b]"]
    )
    choices = {"kernel": "own", "hydra/launcher": None}
    node = SimpleNamespace(
        overrides=overrides,
        runtime=SimpleNamespace(choices=choices),
        job=SimpleNamespace(config_name="mine"),
    )
    search = ("hydra.searchpath=[a]", "hydra.searchpath=[b]")
    assert Origin.of(node) == Origin(["seed=1"], choices, "mine", search)
    assert Origin([], {}) == ([], {}, "config", ())


# As Hydra calls it


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> Path:
    """The directory of a run that Hydra has prepared."""
    caplog.set_level(logging.INFO)
    monkeypatch.chdir(tmp_path)
    directory = tmp_path / "run"
    (directory / ".hydra").mkdir(parents=True)
    (directory / ".hydra" / "config.yaml").write_text("")
    (directory / "staf.log").write_text("")
    node = SimpleNamespace(
        runtime=SimpleNamespace(output_dir=str(directory), choices={}),
        overrides=SimpleNamespace(task=["seed=1"], hydra=[]),
        job=SimpleNamespace(config_name="config"),
        mode=RunMode.RUN,
    )
    monkeypatch.setattr(job, "HydraConfig", SimpleNamespace(get=lambda: node, node=node))
    return directory


def sweeps(mode: RunMode = RunMode.MULTIRUN) -> None:
    job.HydraConfig.node.mode = mode  # type: ignore[attr-defined]


def test_the_sweeper_is_told_what_it_asked_for(place: Path, caplog: pytest.LogCaptureFixture) -> None:
    assert execute(settings()) == {"ball": 2.0, "none": None}
    assert caplog.messages == ["  run directory: run"]
    assert record(place)["seconds"] == 0
    assert execute(settings(sweep={"objective": "ball"}), seconds=100.0) == 2.0
    assert record(place)["seconds"] == 100
    assert execute(settings(), Written({"there": 1.0}, [])) == {"there": 1.0}


def test_a_run_of_a_users_error_leaves_nothing(place: Path, caplog: pytest.LogCaptureFixture) -> None:
    with pytest.raises(Refused) as told:
        execute(settings(fails="user"))
    assert told.value.code == "staf: not like that"
    assert isinstance(told.value.__cause__, ValueError)
    assert not place.exists()
    assert caplog.messages == []


@pytest.mark.parametrize("fails", ["defect", "stop"])
def test_a_run_of_a_defect_keeps_all_that_there_is(fails: str, place: Path) -> None:
    with pytest.raises(RuntimeError if fails == "defect" else KeyboardInterrupt):
        execute(settings(fails=fails))
    assert {path.name for path in place.iterdir()} == {".hydra", "staf.log", "run.json"}


@pytest.mark.parametrize(
    ("fails", "error", "said", "trace"),
    [
        ("user", ValueError, "not like that", False),
        ("defect", RuntimeError, "RuntimeError: a defect", True),
    ],
)
def test_a_job_of_a_sweep_logs_its_error_and_keeps_its_directory(
    fails: str, error: type[Exception], said: str, trace: bool, place: Path, caplog: pytest.LogCaptureFixture
) -> None:
    sweeps()
    with pytest.raises(error):
        execute(settings(fails=fails))
    assert caplog.messages == [said]
    assert bool(caplog.records[0].exc_info) == trace
    assert {path.name for path in place.iterdir()} == {".hydra", "staf.log", "run.json"}


def test_a_job_that_is_complete_is_not_run_again(place: Path, caplog: pytest.LogCaptureFixture) -> None:
    sweeps()
    again = {"resume": "here", "resume_anyway": False, "objective": "ball"}
    assert execute(settings(sweep=again)) == 2.0
    written = (place / "run.json").stat().st_mtime_ns
    caplog.clear()
    assert execute(settings(sweep=again)) == 2.0
    assert caplog.messages == ["completed before: run"]
    with pytest.raises(ValueError, match="spread"):
        execute(settings(sweep=again, spread=3))
    assert execute(settings(sweep=again | {"resume_anyway": True}, spread=3)) == 2.0
    assert (place / "run.json").stat().st_mtime_ns == written
    execute(settings(sweep={"resume": None}))
    assert (place / "run.json").stat().st_mtime_ns > written


@pytest.mark.parametrize("name", ["metrics.json", ".members.json.partial", ".lock", "notes.txt"])
def test_nothing_but_what_a_run_wrote_is_taken_back(name: str, place: Path) -> None:
    (place / name).write_text("")
    (place / "run.json").write_text("")
    job._take_back(place)
    if name == "notes.txt":
        assert [path.name for path in place.iterdir()] == ["notes.txt"]
    else:
        assert {path.name for path in place.iterdir()} == {name, "run.json", "staf.log", ".hydra"}


def test_a_directory_with_nothing_in_it_is_taken_back_too(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    job._take_back(tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_the_terminal_is_silent_and_files_are_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kinds = logging.StreamHandler(), logging.FileHandler(tmp_path / "log"), logging.NullHandler()
    with monkeypatch.context() as patch:
        patch.setattr(logging.getLogger(), "handlers", list(kinds))
        silence_terminal()
    kinds[1].close()
    assert [kind.level > logging.CRITICAL for kind in kinds] == [True, False, False]
    assert [kind.level for kind in kinds[1:]] == [logging.NOTSET] * 2


def test_a_program_prints_unless_somebody_says_otherwise() -> None:
    assert job.PRINTS.get() is True
    assert DEFERRED == job.DEFERRED


def test_an_objective_is_a_number_or_some_or_all() -> None:
    metrics: Metrics = {"ball": 2, "none": None}
    cases: dict[Any, Any] = {"ball": 2.0, "none": float("inf"), ("none", "ball"): (float("inf"), 2.0), (): ()}
    for named, expected in cases.items():
        wanted = list(named) if isinstance(named, tuple) else named
        found = objective(OmegaConf.create({"sweep": {"objective": wanted}}), metrics)
        assert found == expected
        assert type(found) is type(expected)
    assert objective(OmegaConf.create({}), metrics) is metrics
    with pytest.raises(ValueError, match=r"`staf sweep.objective=...` must be one of 'ball', 'none'"):
        objective(OmegaConf.create({"sweep": {"objective": ["ball", "speed"]}}), metrics)

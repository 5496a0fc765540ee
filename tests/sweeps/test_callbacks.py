"""What Hydra calls when a sweep begins and ends: its directory, its report and its trackers."""

from __future__ import annotations

import importlib.util
import json
import logging
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from command_line import one
from hydra.core.utils import JobReturn
from omegaconf import DictConfig, OmegaConf
from sweep_runs import write_run, write_sweep

from staf_torch.sweeps.callbacks import (
    SweepDirectory,
    SweepReport,
    TensorBoardTracker,
    Tracker,
    TrackRuns,
    claim,
    tracker,
)
from staf_torch.sweeps.lock import TakenError, give_back, held
from staf_torch.tables import RecordedRun, collect


def settings(place: Path, *typed: str, **more: Any) -> DictConfig:
    """Settings of a sweep into a directory; what was typed about Hydra."""
    overrides = {"hydra": list(typed), "task": ["seed=0,1"]}
    node = {"sweep": {"dir": str(place)}, "run": {"dir": str(place)}, "overrides": overrides}
    return OmegaConf.create({"sweep": {"resume": None}, "hydra": node, **more})


@pytest.fixture(autouse=True)
def _nothing_stays_locked(tmp_path: Path) -> Iterator[None]:
    yield
    for path in (tmp_path, *tmp_path.rglob("*")):
        give_back(path)


# The directory


def test_sweeps_of_the_same_moment_have_directories_of_their_own_and_note_what_was_typed(
    tmp_path: Path,
) -> None:
    place = tmp_path / "new" / "sweep"

    def begin(_: int) -> str:
        config = settings(place, "hydra.verbose=true")
        SweepDirectory().on_multirun_start(config)
        taken = Path(config.hydra.sweep.dir)
        more = [f"hydra.sweep.dir={taken}"] if taken != place else []  # also for its jobs
        assert list(config.hydra.overrides.hydra) == ["hydra.verbose=true", *more]
        assert held(taken) is not None
        record = json.loads((taken / "sweep.json").read_text())
        assert (record["overrides"], record["hydra"]) == (["seed=0,1"], ["hydra.verbose=true", *more])
        return taken.name

    with ThreadPoolExecutor(4) as pool:
        taken = set(pool.map(begin, range(4)))
    assert taken == {"sweep", "sweep-2", "sweep-3", "sweep-4"}


def test_a_directory_that_was_asked_for_is_taken_or_refused(tmp_path: Path) -> None:
    place = tmp_path / "sweep"
    place.mkdir()
    (place / "notes.txt").write_text("")
    asked = settings(place, f"hydra.sweep.dir={place}")
    claim(asked)  # where something else is
    with pytest.raises(TakenError):
        claim(asked)
    give_back(place)
    (place / "sweep.json").write_text("{}")
    with pytest.raises(ValueError, match=rf"{place} holds a sweep already.*sweep.resume={place}`"):
        claim(asked)


def test_a_file_in_the_way_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    config = settings(tmp_path / "file" / "a" / "b")
    for begin in (SweepDirectory().on_run_start, SweepDirectory().on_multirun_start):
        with pytest.raises(SystemExit, match=rf"^staf: cannot write {tmp_path}/file.*: Not a directory$"):
            begin(config)
    SweepDirectory().on_run_start(settings(tmp_path / "not" / "there"))
    (tmp_path / "link").symlink_to("file")
    with pytest.raises(SystemExit, match=r"staf: .*link is a link"):
        SweepDirectory().on_run_start(settings(tmp_path))


def test_a_sweep_that_breaks_before_its_first_job_leaves_no_trace(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "notes.txt").write_text("")
    for name in ("old", "new"):
        line = ["-m", "seed=0,1", "hydra.launcher.executor=thread", f"hydra.sweep.dir={name}"]
        code, _, err = one(str(tmp_path), line)
        assert code == 1
        assert "executor=...)` must be one of 'inline'" in err
        assert "report" not in err
    assert [str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*")] == ["old", "old/notes.txt"]


# The report


@pytest.mark.parametrize(
    ("own", "of_runs", "drawn"),
    [(None, False, False), (True, False, True), (False, True, False)],
)
def test_figures_of_a_report_are_drawn_as_it_or_the_runs_say(
    own: bool | None, of_runs: bool, drawn: bool, tmp_path: Path
) -> None:
    place = write_sweep(tmp_path / "sweep", ["gaussian"], counts=(3,), seeds=(0,))
    SweepReport(own).on_multirun_end(settings(place, figures=of_runs))
    assert (place / "figures").exists() == drawn


class Gone:
    """A terminal that has gone."""

    def write(self, _: str) -> None:
        raise BrokenPipeError


@pytest.mark.parametrize("kind", ["empty", "full", "no terminal"])
def test_a_report_that_cannot_be_written_or_read_is_no_sweep_gone_wrong(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    place = tmp_path / "sweep"
    if kind in ("full", "no terminal"):
        write_sweep(place, ["gaussian"], seeds=(0,))
    if kind == "empty":
        place.mkdir()
    if kind == "full":
        (place / "table.md").mkdir()
        with pytest.raises(SystemExit, match=r"^staf: no report of the sweep: cannot write .*table.md"):
            SweepReport(False).on_multirun_end(settings(place))
        return
    monkeypatch.setattr(sys, "stdout", Gone())
    SweepReport(False).on_multirun_end(settings(place))
    assert (place / "report.html").exists() == (kind == "no terminal")
    assert [line.startswith("no report of the sweep: ") for line in caplog.messages] == [True] * (
        kind == "empty"
    )


# Trackers

recorded: list[RecordedRun] = []


class Kept(Tracker):
    """Keeps what it is given, and refuses what it is told to."""

    def __init__(self, given: Any = None) -> None:
        if given == "refused":
            raise ValueError("in our own words")
        assert given is None or type(given) is dict  # plain values

    def record(self, run: RecordedRun) -> None:
        if run.metrics["ball_error"] == 9.0:
            raise RuntimeError("no connection")
        recorded.append(run)


def tracked(target: str | None, place: Path | None = None, **more: Any) -> DictConfig:
    node = {"runtime": {"output_dir": str(place)}}
    return OmegaConf.create({"tracker": {"_target_": target, **more}, "hydra": node})


KEPT = f"{__name__}.Kept"


def test_a_tracker_is_made_before_the_runs_and_refuses_in_its_own_words() -> None:
    for none in ({}, {"tracker": None}, {"tracker": {"_target_": None}}):
        assert tracker(OmegaConf.create(none)) is None
    assert isinstance(tracker(tracked(KEPT, given={"a": [1]})), Kept)
    for begin in (TrackRuns().on_run_start, TrackRuns().on_multirun_start):
        with pytest.raises(SystemExit, match=r"^staf: in our own words"):
            begin(tracked(KEPT, given="refused"))
        with pytest.raises(SystemExit, match=r"must be a staf_torch.sweeps.callbacks.Tracker|whitelist"):
            begin(tracked("builtins.dict"))
        begin(tracked(KEPT))


def test_every_run_that_is_complete_is_recorded_once_and_an_error_is_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.WARNING)
    recorded.clear()
    for name, status in (("a", "completed"), ("b", "failed"), ("c", "running"), ("d", "completed")):
        write_run(tmp_path / "runs" / name, {"kernel": "own"}, {"ball_error": 1.0}, status=status)
    TrackRuns().on_job_end(tracked(KEPT, tmp_path / "runs"), JobReturn())
    assert [run.directory.name for run in recorded] == ["a", "d"]
    assert recorded[0].settings["kernel"] == "own"
    TrackRuns().on_job_end(OmegaConf.create({"tracker": None}), JobReturn())  # asks for nothing else
    assert caplog.messages == []
    write_run(tmp_path / "broken", {}, {"ball_error": 9.0})
    TrackRuns().on_job_end(tracked(KEPT, tmp_path / "broken"), JobReturn())
    assert caplog.messages == ["not tracked: RuntimeError: no connection"]


def test_tensorboard_without_its_extra_names_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(SystemExit, match=r"pip install 'staf_torch\[tensorboard\]'"):
        TrackRuns().on_multirun_start(tracked("staf_torch.sweeps.callbacks.TensorBoardTracker"))


def test_tensorboard_reads_back_the_metrics(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard", reason="needs the extra `tensorboard`")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    write_run(tmp_path / "run", {"kernel": "gaussian"}, {"ball_error": 0.25, "settling_time": None})
    TensorBoardTracker().record(collect(tmp_path / "run").rows[0])
    events = EventAccumulator(str(tmp_path / "run" / "tensorboard")).Reload()
    assert [event.value for event in events.Scalars("ball_error")] == [0.25]
    assert "settling_time" not in events.Tags()["scalars"]
    assert "_hparams_/session_start_info" in events.summary_metadata

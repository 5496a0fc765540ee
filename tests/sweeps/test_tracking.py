"""Trackers: none, TensorBoard, a user's own."""

from __future__ import annotations

import importlib.util
import logging
from pathlib import Path

import pytest
from hydra.core.utils import JobReturn
from omegaconf import DictConfig, OmegaConf
from sweep_runs import write_run

from staf_torch.sweeps.callbacks import TensorBoardTracker, Tracker, TrackRuns, tracker
from staf_torch.tables import Run, collect

recorded: list[Run] = []


class Kept(Tracker):
    """Keeps what it is given."""

    def record(self, run: Run) -> None:
        recorded.append(run)


class Broken(Tracker):
    """Fails at every run."""

    def record(self, run: Run) -> None:
        raise RuntimeError("no connection")


def settings(target: str | None, directory: Path | None = None) -> DictConfig:
    return OmegaConf.create(
        {"tracker": {"_target_": target}, "hydra": {"runtime": {"output_dir": str(directory)}}}
    )


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return write_run(tmp_path / "run", {"kernel": "gaussian"}, {"ball_error": 0.25, "settling_time": None})


def test_no_tracker_is_none(run: Path) -> None:
    assert tracker(settings(None)) is None
    TrackRuns().on_job_end(settings(None, run), JobReturn())


def test_a_users_tracker_is_given_each_completed_run_once(run: Path) -> None:
    recorded.clear()
    cfg = settings(f"{__name__}.Kept", run)
    TrackRuns().on_run_start(cfg)
    TrackRuns().on_job_end(cfg, JobReturn())
    (one,) = recorded
    assert one.metrics["ball_error"] == 0.25
    assert one.settings["kernel"] == "gaussian"


def test_a_run_that_failed_is_not_tracked(tmp_path: Path) -> None:
    recorded.clear()
    write_run(tmp_path / "run", {}, None, status="failed", reason="why")
    TrackRuns().on_job_end(settings(f"{__name__}.Kept", tmp_path / "run"), JobReturn())
    assert recorded == []


def test_an_error_of_a_tracker_is_a_warning(run: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING)
    TrackRuns().on_job_end(settings(f"{__name__}.Broken", run), JobReturn())
    assert caplog.messages == ["not tracked: RuntimeError: no connection"]


def test_something_that_is_no_tracker_ends_the_program_before_the_run() -> None:
    with pytest.raises(
        SystemExit, match=r"must be a staf_torch.sweeps.callbacks.Tracker|execution whitelist"
    ):
        TrackRuns().on_run_start(settings("builtins.dict"))


def test_tensorboard_without_its_extra_names_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(SystemExit, match=r"pip install 'staf_torch\[tensorboard\]'"):
        TrackRuns().on_multirun_start(settings("staf_torch.sweeps.callbacks.TensorBoardTracker"))


def test_tensorboard_reads_back_the_metrics(run: Path) -> None:
    pytest.importorskip("tensorboard", reason="needs the extra `tensorboard`")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    TensorBoardTracker().record(collect(run).rows[0])
    events = EventAccumulator(str(run / "tensorboard")).Reload()
    assert [event.value for event in events.Scalars("ball_error")] == [0.25]
    assert "settling_time" not in events.Tags()["scalars"]
    assert "_hparams_/session_start_info" in events.summary_metadata

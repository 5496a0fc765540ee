"""Trackers: what they are made of, and what they are told."""

from __future__ import annotations

import importlib.util
import logging
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hydra.core.utils import JobReturn
from omegaconf import DictConfig, OmegaConf
from sweep_runs import write_run

from staf_torch.sweeps import callbacks
from staf_torch.sweeps.callbacks import (
    Tracker,
    TrackRuns,
)
from staf_torch.tables import Run, collect

# The tracker

recorded: list[Run] = []


class Arguments(Tracker):
    """Keeps what it is made with."""

    made: tuple[Any, ...] = ()

    def __init__(self, given: Any = None) -> None:
        if given == "refused":
            raise ValueError("in our own words")
        if given == "defect":
            raise RuntimeError("a defect")
        Arguments.made = (given,)

    def record(self, run: Run) -> None:
        recorded.append(run)


class NoTracker:
    """Something else."""


def tracked(name: str, place: Path | None = None, **more: Any) -> DictConfig:
    node = {"runtime": {"output_dir": str(place)}}
    return OmegaConf.create({"tracker": {"_target_": f"{__name__}.{name}", **more}, "hydra": node})


def test_a_tracker_is_made_of_plain_values_and_refuses_in_its_own_words() -> None:
    assert callbacks.tracker(OmegaConf.create({})) is None
    assert callbacks.tracker(OmegaConf.create({"tracker": None})) is None
    assert callbacks.tracker(OmegaConf.create({"tracker": {"_target_": None}})) is None
    assert isinstance(callbacks.tracker(tracked("Arguments", given={"a": [1]})), Arguments)
    assert type(Arguments.made[0]) is dict
    assert type(Arguments.made[0]["a"]) is list
    with pytest.raises(ValueError, match=r"^in our own words(\nfull_key: tracker)?$"):  # Hydra 1.4
        callbacks.tracker(tracked("Arguments", given="refused"))
    with pytest.raises(Exception, match="a defect") as defect:
        callbacks.tracker(tracked("Arguments", given="defect"))
    assert not isinstance(defect.value, ValueError)
    with pytest.raises(ValueError, match=r"`staf tracker=...` must be a staf_torch.sweeps.callbacks.Tracker"):
        callbacks.tracker(tracked("NoTracker"))
    for begin in (TrackRuns().on_run_start, TrackRuns().on_multirun_start):
        with pytest.raises(SystemExit, match=r"^staf: in our own words$"):
            begin(tracked("Arguments", given="refused"))
        begin(tracked("Arguments"))


def test_every_member_that_is_complete_is_recorded_and_no_other_run(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.WARNING)
    recorded.clear()
    for name, status in (("a", "completed"), ("b", "failed"), ("c", "running"), ("d", "completed")):
        write_run(tmp_path / "runs" / name, {}, {"ball_error": 1.0}, status=status)
    TrackRuns().on_job_end(tracked("Arguments", tmp_path / "runs"), JobReturn())
    assert [run.directory.name for run in recorded] == ["a", "d"]
    TrackRuns().on_job_end(OmegaConf.create({"tracker": None}), JobReturn())  # asks for nothing else
    assert caplog.messages == []


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("member", [None, 3])
def test_tensorboard_is_told_numbers_and_settings(
    known: bool, member: int | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[Any] = []

    class Writer:
        def __init__(self, folder: str) -> None:
            told.append(folder)

        def __enter__(self) -> Writer:
            return self

        def __exit__(self, *_: object) -> None:
            told.append("closed")

        def _get_file_writer(self) -> SimpleNamespace:
            return SimpleNamespace(add_summary=told.append)

        def add_scalar(self, name: str, number: float) -> None:
            told.append((name, number))

    def hparams(settings: object, numbers: object) -> tuple[object, ...]:
        return settings, numbers

    board = SimpleNamespace(SummaryWriter=Writer)
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", board)
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard.summary", SimpleNamespace(hparams=hparams))
    typed = {"kernel": "own", "count": 3, "dt": 0.5, "figures": True, "start": [1, 2], "none": None}
    run: Any = SimpleNamespace(
        directory=tmp_path,
        member=member,
        metrics={"ball": 1, "lost": None},
        settings=typed if known else {},
        overrides={"kernel": "typed"},
    )
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: name)
    callbacks.TensorBoardTracker().record(run)
    folder = tmp_path / "tensorboard"
    told_of = {**typed, "start": "[1, 2]"} if known else {"kernel": "typed"}
    told_of.pop("none", None)
    assert told == [
        str(folder if member is None else folder / "3"),
        told_of,
        {"ball": 1.0},
        ("ball", 1.0),
        "closed",
    ]
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match="`tracker=tensorboard` needs TensorBoard"):
        callbacks.TensorBoardTracker()


def test_what_is_collected_of_a_directory_is_what_is_recorded(tmp_path: Path) -> None:
    recorded.clear()
    write_run(tmp_path / "one", {"kernel": "gaussian"}, {"ball_error": 0.25})
    TrackRuns().on_job_end(tracked("Arguments", tmp_path / "one"), JobReturn())
    assert recorded == list(collect(tmp_path / "one").rows)

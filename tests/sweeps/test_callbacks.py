"""What Hydra calls when a sweep begins and ends: its directory and its report."""

from __future__ import annotations

import contextlib
import json
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from omegaconf import DictConfig, OmegaConf

from staf_torch.sweeps import callbacks, lock
from staf_torch.sweeps.callbacks import (
    SweepDirectory,
    SweepReport,
    claim,
    close,
    farewell,
)
from staf_torch.sweeps.hydra_compat import BrokenSweep
from staf_torch.sweeps.job import PRINTS


def settings(place: Path, *typed: str, **more: Any) -> DictConfig:
    """Settings of a sweep into a directory; what was typed about Hydra."""
    overrides = {"hydra": list(typed), "task": ["seed=0,1"]}
    node = {"sweep": {"dir": str(place)}, "run": {"dir": str(place)}, "overrides": overrides}
    return OmegaConf.create({"sweep": {"resume": None}, "hydra": node, **more})


def asked(place: Path) -> DictConfig:
    return settings(place, f"hydra.sweep.dir={place}")


def resumed(place: Path) -> DictConfig:
    return settings(place, sweep={"resume": str(place)})


@pytest.fixture(autouse=True)
def _nothing_stays_locked() -> Iterator[None]:
    before = dict(lock._held)
    yield
    for key in set(lock._held) - set(before):
        lock.give_back(Path(key))


def held(place: Path) -> bool:
    return lock.held(place) is not None


@pytest.fixture
def breaking(monkeypatch: pytest.MonkeyPatch) -> list[bool]:
    """Whether an exception ends the sweep that calls back."""
    now = [False]
    monkeypatch.setattr(callbacks, "breaking_off", lambda: now[0])
    return now


# The directory


def test_a_sweep_that_begins_has_a_directory_of_its_own_and_notes_what_was_typed(tmp_path: Path) -> None:
    place = tmp_path / "new" / "sweep"
    for number, name in enumerate(("sweep", "sweep-2", "sweep-3")):
        config = settings(place, "hydra.verbose=true")
        SweepDirectory().on_multirun_start(config)
        taken = tmp_path / "new" / name
        assert config.hydra.sweep.dir == str(taken)
        more = [f"hydra.sweep.dir={taken}"] if number else []
        assert list(config.hydra.overrides.hydra) == ["hydra.verbose=true", *more]
        assert held(taken)
        record = json.loads((taken / "sweep.json").read_text())
        assert (record["overrides"], record["hydra"]) == (["seed=0,1"], ["hydra.verbose=true", *more])


def test_a_directory_that_was_asked_for_is_taken_or_refused(tmp_path: Path) -> None:
    place = tmp_path / "new" / "sweep"
    config = asked(place)
    claim(config)
    assert held(place)
    assert config.hydra.sweep.dir == str(place)
    assert list(config.hydra.overrides.hydra) == [f"hydra.sweep.dir={place}"]
    with pytest.raises(lock.TakenError):
        claim(asked(place))
    lock.give_back(place)
    (place / "notes.txt").write_text("")
    claim(asked(place))  # where something else is
    lock.give_back(place)
    (place / "0").mkdir()
    claim(asked(place))
    lock.give_back(place)
    for left in ("sweep.json", "0/run.json"):
        (place / left).write_text("{}")
        with pytest.raises(ValueError, match=rf"{place} holds a sweep already.*sweep.resume={place}`"):
            claim(asked(place))
        lock.give_back(place)
        (place / left).unlink()


def refused(config: DictConfig) -> str:
    with pytest.raises(SystemExit) as told:
        SweepDirectory().on_multirun_start(config)
    assert not held(Path(str(config.hydra.sweep.dir)))
    return str(told.value)


@pytest.mark.parametrize("kind", [asked, resumed])
def test_nothing_is_written_through_what_leads_elsewhere(
    kind: Callable[[Path], DictConfig], tmp_path: Path
) -> None:
    place = tmp_path / "sweep"
    (place / ".submitit").mkdir(parents=True)
    (place / ".submitit" / "job").symlink_to(tmp_path)  # submitit's own
    SweepDirectory().on_multirun_start(kind(place))
    assert held(place)
    lock.give_back(place)
    (place / "sweep.json").unlink(missing_ok=True)
    for count, more in enumerate(("", " and 1 more", " and 2 more")):
        (place / f"link{count}").symlink_to(tmp_path)
        assert refused(kind(place)).startswith(f"staf: {place}/link0{more} is a link")


def test_a_sweep_that_is_resumed_keeps_what_was_noted(tmp_path: Path) -> None:
    (tmp_path / "sweep.json").write_text("kept")
    SweepDirectory().on_multirun_start(resumed(tmp_path))
    assert held(tmp_path)
    assert (tmp_path / "sweep.json").read_text() == "kept"


def test_a_file_in_the_way_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    config = settings(tmp_path / "file" / "a" / "b")
    for begin in (SweepDirectory().on_run_start, SweepDirectory().on_multirun_start):
        with pytest.raises(SystemExit) as told:
            begin(config)
        assert str(told.value).startswith(f"staf: cannot write {tmp_path / 'file'}")
        assert str(told.value).endswith(": Not a directory")
    SweepDirectory().on_run_start(settings(tmp_path / "not" / "there"))
    SweepDirectory().on_run_start(settings(tmp_path))
    (tmp_path / "link").symlink_to("file")
    with pytest.raises(SystemExit, match=r"staf: .*link is a link"):
        SweepDirectory().on_run_start(settings(tmp_path))


@pytest.mark.parametrize(
    ("ours", "broken", "begun", "again", "stays"),
    [
        (True, True, False, False, False),
        (True, False, False, False, True),
        (True, True, True, False, True),
        (True, True, False, True, True),
        (False, True, False, False, True),
    ],
)
def test_a_sweep_that_ends_gives_its_directory_back_and_takes_it_away_where_nothing_ran(
    ours: bool, broken: bool, begun: bool, again: bool, stays: bool, tmp_path: Path, breaking: list[bool]
) -> None:
    place = tmp_path / "sweep"
    config = settings(place)
    claim(config)
    (place / "multirun.yaml").write_text("")
    (place / "sweep.json").write_text("")
    (place / ".submitit" / "1").mkdir(parents=True)
    if begun:
        (place / "a" / "b").mkdir(parents=True)
        (place / "a" / "b" / "run.json").write_text("{}")
    if not ours:
        lock.give_back(place)
    breaking[0] = broken
    SweepDirectory().on_multirun_end(resumed(place) if again else config)
    assert place.exists() == stays
    assert not held(place)
    assert not stays or {"multirun.yaml", "sweep.json", ".submitit"} <= {p.name for p in place.iterdir()}


def test_what_was_in_a_directory_before_stays_where_nothing_ran(tmp_path: Path, breaking: list[bool]) -> None:
    (tmp_path / "notes.txt").write_text("")
    claim(asked(tmp_path))
    breaking[0] = True
    SweepDirectory().on_multirun_end(asked(tmp_path))  # no multirun.yaml, no sweep.json, no .submitit
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


# The end of a broken sweep


class Told:
    """Callbacks of a sweep that note that it is over."""

    def __init__(self) -> None:
        self.count = 0

    def on_multirun_end(self, **_: Any) -> None:
        self.count += 1


@pytest.mark.parametrize("case", ["not ours", "lost", "begun", "in vain"])
def test_a_broken_sweep_ends_with_its_report_or_without_a_trace(
    case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place, told = tmp_path / "sweep", Told()
    monkeypatch.setattr(BrokenSweep, "end", lambda self: self.callbacks.on_multirun_end())
    config = settings(place)
    claim(config)
    (place / "sweep.json").write_text("")
    if case == "not ours":
        lock.give_back(place)
    if case == "begun":
        (place / "0").mkdir()
        (place / "0" / "run.json").write_text("{}")
    if case == "lost":
        os.rename(place, tmp_path / "moved")
        place.mkdir()
        (place / "sweep.json").write_text("")
    close(BrokenSweep(config, told))
    assert told.count == (case == "begun")
    assert (place / "sweep.json").exists() == (case != "in vain")
    assert place.exists() == (case != "in vain")
    assert held(place) == (case == "begun")  # the callbacks give it back


def test_a_farewell_says_what_is_complete_and_how_to_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    error = KeyboardInterrupt()
    assert farewell(None, error, "interrupted") == "staf: interrupted"
    for note in ("3 of 4", "resume"):
        error.add_note(note)
    assert farewell(None, error, "interrupted") == "staf: interrupted; 3 of 4; resume"
    sweep = BrokenSweep(settings(tmp_path / "runs" / "one"), None)
    assert farewell(sweep, error, "ended by SIGTERM") == "staf: ended by SIGTERM"
    for name, text in (("0", '{"status": "completed"}'), ("1", '{"status": "running"}'), ("2", "damaged")):
        (tmp_path / "runs" / "one" / name).mkdir(parents=True)
        (tmp_path / "runs" / "one" / name / "run.json").write_text(text)
    said = "staf: interrupted; 1 jobs are complete. Resume with:\n  staf -m sweep.resume=runs/one"
    assert farewell(sweep, error, "interrupted") == said


# The report


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[bool]:
    """Whether figures were asked for, a report each."""
    wanted: list[bool] = []

    def write(directory: Path, *, figures: bool = True) -> str:
        wanted.append(figures)
        return "the table"

    monkeypatch.setattr(callbacks, "write_report", write)
    return wanted


@pytest.mark.parametrize(
    ("own", "of_runs", "wanted"),
    [
        (None, True, True),
        (None, False, False),
        (None, None, True),
        (True, False, True),
        (False, True, False),
        (True, True, True),
        (False, False, False),
    ],
)
def test_figures_of_a_report_are_drawn_as_it_or_the_runs_say(
    own: bool | None, of_runs: bool | None, wanted: bool, tmp_path: Path, drawn: list[bool]
) -> None:
    SweepReport(own).on_multirun_end(settings(tmp_path, figures=of_runs))
    assert drawn == [wanted]


@pytest.mark.parametrize("prints", [True, False])
def test_a_report_is_printed_for_a_command_alone(
    prints: bool, tmp_path: Path, drawn: list[bool], capsys: pytest.CaptureFixture[str]
) -> None:
    token = PRINTS.set(prints)
    try:
        SweepReport().on_multirun_end(settings(tmp_path))
    finally:
        PRINTS.reset(token)
    assert capsys.readouterr().out == f"\nthe table\n  report: {tmp_path / 'report.html'}\n" * prints
    assert drawn == [True]


def test_a_terminal_that_has_gone_costs_nothing(
    tmp_path: Path, drawn: list[bool], monkeypatch: pytest.MonkeyPatch
) -> None:
    flushed: list[int] = []
    screen = SimpleNamespace(write=lambda text: None, flush=lambda: flushed.append(1))
    monkeypatch.setattr(sys, "stdout", screen)
    SweepReport().on_multirun_end(settings(tmp_path))
    assert flushed == [1]

    def gone(_: str) -> None:
        raise BrokenPipeError

    monkeypatch.setattr(screen, "write", gone)
    SweepReport().on_multirun_end(settings(tmp_path))
    assert flushed == [1]


def test_there_is_no_report_where_nothing_ran(
    tmp_path: Path, drawn: list[bool], breaking: list[bool]
) -> None:
    place = tmp_path / "sweep"
    SweepReport().on_multirun_end(settings(place))
    assert drawn == []
    claim(settings(place))
    breaking[0] = True
    SweepReport().on_multirun_end(settings(place))
    assert drawn == []
    breaking[0] = False
    SweepReport().on_multirun_end(settings(place))
    assert drawn == [True]


@pytest.mark.parametrize("error", [OSError(28, "No space left", "table.md"), RuntimeError("a defect")])
def test_a_report_that_cannot_be_written_is_no_sweep_gone_wrong(
    error: Exception,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def fails(directory: Path, **_: Any) -> str:
        raise error

    monkeypatch.setattr(callbacks, "write_report", fails)
    disk = isinstance(error, OSError)
    with pytest.raises(SystemExit) if disk else contextlib.nullcontext() as ended:
        SweepReport().on_multirun_end(settings(tmp_path))
    said = "staf: no report of the sweep: cannot write table.md: No space left"
    assert not disk or str(ended.value) == said  # type: ignore[union-attr]
    assert caplog.messages == ([] if disk else ["no report of the sweep: a defect"])
    assert capsys.readouterr().out == ""

"""The command line of what is resumed: taken over, changed, asked about or refused; nothing runs."""

from __future__ import annotations

import io
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from staf_torch import __version__
from staf_torch.sweeps.command import command_line, recorded


def sweep(place: Path, typed: Sequence[str] = ("seed=0,1",), hydra: Sequence[str] = (), **more: Any) -> Path:
    record = {"version": __version__, "overrides": typed, "hydra": hydra, **more}
    (place / "sweep.json").write_text(json.dumps(record))
    return place


def end(place: Path) -> list[str]:
    """The last two words of the new command line."""
    return [f"hydra.sweep.dir={place}", f"sweep.resume={place}"]


def lines(place: Path, *argv: str) -> list[str]:
    return command_line([*argv, f"sweep.resume={place}"])


def test_the_last_directory_that_is_named_is_resumed_and_else_a_line_stays_as_it_is(tmp_path: Path) -> None:
    for argv in ([], ["-m", "seed=1"], [f"sweep.resume={tmp_path}", "sweep.resume=null"]):
        assert command_line(argv) == argv
    (tmp_path / "one").mkdir()
    place = sweep(tmp_path / "one")
    for quote in "'\"":
        line = ["sweep.resume=nowhere", f"sweep.resume={quote}{place}/../one/{quote}"]
        assert command_line(line) == ["--multirun", "seed=0,1", *end(place)]
    assert lines(place, "-m", "--config-dir=conf") == ["-m", "--config-dir=conf", "seed=0,1", *end(place)]


def test_overrides_that_are_repeated_are_those_of_the_sweep_in_any_order(tmp_path: Path) -> None:
    place = sweep(tmp_path, ["seed=0,1", "kernel=gaussian"])
    whole = ["-m", "seed=0,1", "kernel=gaussian", *end(place)]
    assert lines(place, "-m", "kernel=gaussian", "seed=0,1") == whole
    start = rf"^`staf -m sweep.resume={place}` must have the overrides of that sweep, or none; got them "
    for given, words in (
        (
            ["seed=0,1"],
            "without 'kernel=gaussian'. Only .*figures.* The sweep is: staf -m seed=0,1 kernel=gaussian$",
        ),
        (["kernel=matern", "seed=0,1"], "without 'kernel=gaussian' and with 'kernel=matern'. Only"),
        (["seed=0,1", "kernel=gaussian", "seed=0,1"], "more than once. Only"),
    ):
        with pytest.raises(ValueError, match=start + words):
            lines(place, "-m", *given)


def test_lines_about_hydra_are_taken_over_but_those_that_change(tmp_path: Path) -> None:
    before = [
        "hydra.verbose=true",
        "hydra.mode=MULTIRUN",
        "hydra.sweep.dir=old",
        "+hydra.launcher.submitit.timeout_min=2",
        "hydra/launcher=batched",
        "sweep.objective=ball_error",
    ]
    place = sweep(tmp_path, hydra=before)
    kept = [
        "hydra.verbose=true",
        "+hydra.launcher.submitit.timeout_min=2",
        "hydra/launcher=batched",
        "sweep.objective=ball_error",
    ]
    assert lines(place, "-m") == ["-m", "seed=0,1", *kept, *end(place)]
    assert lines(place, "-m", "hydra.verbose=false", "hydra.mode=RUN", "sweep.objective=null") == [
        *("-m", "seed=0,1", "+hydra.launcher.submitit.timeout_min=2", "hydra/launcher=batched"),
        *("sweep.objective=null", "hydra.verbose=false", *end(place)),
    ]
    assert lines(place, "-m", "hydra/launcher=joblib", "hydra.launcher.n_jobs=3") == [
        *("-m", "seed=0,1", "hydra.verbose=true", "sweep.objective=ball_error"),
        *("hydra/launcher=joblib", "hydra.launcher.n_jobs=3", *end(place)),
    ]


def test_settings_that_change_no_number_may_be_others(tmp_path: Path) -> None:
    typed = ["seed=0,1", "figures.width=3.4", "animation=false"]
    place = sweep(tmp_path, typed)
    assert lines(place) == ["--multirun", *typed, *end(place)]
    for given, kept in (
        ("figures=false", typed[2:]),
        ("figures.draw=true", typed[1:]),
        ("tracker=none", typed[1:]),
    ):
        for whole in ([], ["seed=0,1"], [typed[0], given]):
            assert lines(place, *whole, given)[1:-2] == ["seed=0,1", *kept, given]
    with pytest.raises(ValueError, match="with 'figures=true,false'"):  # these are other jobs
        lines(place, "seed=0,1", "figures=true,false")


@pytest.mark.parametrize("record", [None, "[]", '{"overrides": []}', "damaged"])
def test_what_is_no_sweep_is_refused(record: str | None, tmp_path: Path) -> None:
    if record is not None:
        (tmp_path / "sweep.json").write_text(record)
    with pytest.raises(
        ValueError, match=rf"must be the directory of a sweep, with its sweep.json; got '{tmp_path}'"
    ):
        lines(tmp_path)
    for spoilt in ({"overrides": "seed=1"}, {"hydra": ["a", None]}):
        with pytest.raises(ValueError, match="must be the directory of a sweep"):
            recorded(sweep(tmp_path, **spoilt), anyway=True)  # type: ignore[arg-type]


def test_a_sweep_of_another_version_is_resumed_where_a_person_means_it(tmp_path: Path) -> None:
    place = sweep(tmp_path, version="0.0.1" + "x" * 100)
    with pytest.raises(
        ValueError, match=rf"of this version \({__version__}\).*was written by 0.0.1x{{75}}\."
    ):
        lines(place)
    anyway = "sweep.resume_anyway=true"
    assert lines(place, anyway) == ["--multirun", "seed=0,1", anyway, *end(place)]


# Code of somebody else


class Terminal(io.StringIO):
    """Where somebody sits, or not."""

    def __init__(self, text: str = "", here: bool = True) -> None:
        super().__init__(text)
        self.here, self.flushed = here, ""

    def isatty(self) -> bool:
        return self.here

    def flush(self) -> None:
        self.flushed = self.getvalue()


FOREIGN = ["kernel.path=evil.Kernel", "hydra.callbacks.a._target_=evil"]


@pytest.mark.parametrize("answer", [" YES \n", "\n", "yess\n"])
def test_somebody_at_a_terminal_is_asked_whether_lines_may_run(
    answer: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = sweep(tmp_path, [FOREIGN[0], "seed=1"], FOREIGN[1:])
    err = Terminal()
    monkeypatch.setattr(sys, "stdin", Terminal(answer))
    monkeypatch.setattr(sys, "stderr", err)
    shown = f"\n  {FOREIGN[0]}\n  {FOREIGN[1]}\n"
    if answer == " YES \n":
        assert lines(place) == ["--multirun", FOREIGN[0], "seed=1", FOREIGN[1], *end(place)]
    else:
        with pytest.raises(ValueError, match="may run code of whoever started it") as told:
            lines(place)
        assert shown in str(told.value)
        assert str(told.value).endswith("If you know them, repeat them, or add --trust.")
    question = f"staf: {place} was started with lines that may run code:{shown}Run them? [y/N] "
    assert err.getvalue() == err.flushed == question

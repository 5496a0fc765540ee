"""`staf doctor`, `staf --version`, and a table that is printed while a sweep goes on."""

from __future__ import annotations

import sys
import threading
import time
from pathlib import Path

import pytest
from sweep_runs import write_run, write_sweep

from staf_torch import __version__
from staf_torch.cli import doctor, table
from staf_torch.cli.staf import main
from staf_torch.results.build import source


def test_version_is_told_without_a_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["staf", "--version"])
    with pytest.raises(SystemExit) as ended:
        main()
    assert not ended.value.code
    assert capsys.readouterr().out == f"staf_torch {__version__} (source {source()})\n"
    assert not list(tmp_path.iterdir())


def test_the_doctor_finds_this_machine_sound(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["staf", "doctor"])
    with pytest.raises(SystemExit) as ended:
        main()
    said = capsys.readouterr().out
    assert ended.value.code == 0, said
    names = ("staf_torch", "python", "packages", "compiler", "threads", "gpu", "cache", "runs", "self-test")
    assert all(f"{name}:" in said for name in names)
    assert not list(tmp_path.iterdir())


def test_the_doctor_says_where_the_problem_is(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(doctor, "_EXPECTED", 1.0)
    assert doctor.main() == 1
    (line,) = [line for line in capsys.readouterr().out.splitlines() if "<- problem" in line]
    assert line.startswith("self-test:")


def test_a_watched_table_ends_with_the_sweep(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sweep = write_sweep(tmp_path / "sweep", counts=(3,), seeds=(0,))
    late = tmp_path / "sweep" / "99"
    write_run(late, {"kernel": "matern"}, None, status="running")

    def end() -> None:
        time.sleep(0.3)
        record = (late / "run.json").read_text().replace('"running"', '"completed"')
        (late / "metrics.json").write_text('{"ball_error": 0.5}')
        (late / "run.json").write_text(record)

    other = threading.Thread(target=end)
    other.start()
    assert table.main([str(sweep), "--watch", "0.1"]) == 0
    other.join()
    printed = capsys.readouterr().out.split("| kernel")
    assert len(printed) > 2
    assert "running" in printed[1]
    assert "running" not in printed[-1]
    assert "0.5" in printed[-1]

"""`staf-table`, `staf doctor`, `staf docs`, `staf --version`: what options do, with which code they end."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from command_line import ROOT, environment
from sweep_runs import write_run, write_sweep

from staf_torch import __version__
from staf_torch.cli import doctor, table
from staf_torch.cli.staf import main
from staf_torch.results.build import source


@pytest.fixture
def staf(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., tuple[object, str]]:
    """Runs `staf` in an empty folder, which no command that is no run may write to."""

    def run(*words: str) -> tuple[object, str]:
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", ["staf", *words])
        with pytest.raises(SystemExit) as ended:
            main()
        assert not list(tmp_path.iterdir())
        return ended.value.code, capsys.readouterr().out

    return run


def test_version_is_printed_with_a_hash_of_the_source(staf: Any) -> None:
    code, said = staf("--version")
    assert not code
    assert said == f"staf_torch {__version__} (source {source()})\n"


def test_a_reader_may_stop_early(tmp_path: Path) -> None:
    write_sweep(tmp_path, counts=(3,), seeds=(0,))
    tables = "import sys; from staf_torch.cli.table import main; sys.exit(main())"
    started = subprocess.Popen(
        [sys.executable, "-c", tables, str(tmp_path), "--format", "csv"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert started.stdout is not None
    started.stdout.close()
    assert "ipe" not in started.communicate()[1]
    assert started.returncode == 0


def test_the_doctor_finds_this_machine_sound(staf: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    code, said = staf("doctor")
    assert code == 0, said
    names = ("staf_torch", "python", "packages", "compiler", "threads", "gpu", "cache", "runs", "self-test")
    assert all(f"{name}:" in said for name in names)
    assert "OMP_NUM_THREADS 1" in said


def test_help_of_a_command_is_its_line(staf: Any) -> None:
    for command in ("doctor", "schema", "docs"):
        code, said = staf(command, "--help")
        assert (code or 0, said.count("\n")) == (0, 1)
        assert said.startswith(f"staf {command}")


def test_the_doctor_says_where_the_problem_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "runs").touch()
    monkeypatch.chdir(tmp_path)
    assert doctor.main() == 1
    (line,) = [line for line in capsys.readouterr().out.splitlines() if "<- problem" in line]
    assert line.startswith("runs:")
    assert "not a folder" in line


CODE = """import os, sys
sys.path.insert(0, 'staf_torch/plugins')
import staf_torch.cli, hydra_plugins.staf_batched
print(os.environ['OMP_WAIT_POLICY'], *{'torch', 'numpy', 'matplotlib'} & set(sys.modules))
"""


@pytest.mark.parametrize("stated", [None, "active"])
def test_a_command_and_the_plugin_begin_without_torch_and_threads_leave_the_processor_while_they_wait(
    stated: str | None,
) -> None:
    others = {key: value for key, value in environment().items() if key != "OMP_WAIT_POLICY"}
    given = (
        {} if stated is None else {"OMP_WAIT_POLICY": stated}
    )  # before torch is loaded, or it has no effect
    begun = subprocess.run(
        [sys.executable, "-c", CODE], cwd=ROOT, env=others | given, capture_output=True, text=True, check=True
    )
    assert begun.stdout.split() == [stated or "passive"]


# `staf-table`


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    for num, (kernel, error) in enumerate((("a", 0.123456), ("b", 2.5))):
        metrics = {"ball_error": error, "condition_number": 3.0}
        write_run(tmp_path / "runs" / str(num), {"kernel": kernel}, metrics)
    return tmp_path / "runs"


def test_a_table_is_what_its_options_say(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def said(*words: str, code: int = 0) -> str:
        assert table.main([str(runs), *words]) == code
        found = capsys.readouterr()
        return found.err if code else found.out

    assert "0.123 " in said()
    assert "condition_number" not in said()
    assert "**0.123**" in said("--best", "bold")
    assert "0.12346" in said("--digits", "5")
    assert "condition_number" in said("--metric", " condition_number ,")
    assert said("--sort", "ball_error:desc").index("2.5") < said("--sort", "ball_error:desc").index("0.123")
    assert said("--format", "csv").count("0.123456") == 1
    assert "\n\\begin{tabular}" in said("--format", "tex")
    assert len(json.loads(said("--format", "json"))) == 2
    assert said("--digits", "0", code=1) == "staf-table: `staf-table --digits` must be at least 1; got 0.\n"
    no_file = "staf-table: `staf-table --format parquet` needs --output FILE.\n"
    assert said("--format", "parquet", code=1) == no_file
    assert table.main([str(runs), "--output", str(runs / "out.md")]) == 0
    assert capsys.readouterr().out == ""
    assert (runs / "out.md").read_text() == said()
    assert said("--output", str(runs / "no" / "out.md"), code=1).startswith("staf-table: [Errno 2]")
    with pytest.raises(SystemExit) as ended:
        table.main(["--help"])
    assert ended.value.code == 0
    assert "examples:" in capsys.readouterr().out


def test_what_has_no_row_is_named_beside_the_table(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (runs / "9").mkdir()
    (runs / "9" / "run.json").write_text("damaged")
    write_run(runs / "8", {"kernel": "c"}, {"ball_error": 1.0}, version="0.0.1")
    assert table.main([str(runs)]) == 0
    said = capsys.readouterr().err.splitlines()
    assert said[0].startswith(f"skipped {runs / '9'}: ")
    assert said[1].startswith("note: 1 of 3 runs were written by staf_torch 0.0.1")
    assert table.main([str(runs / "nowhere")]) == 1
    assert capsys.readouterr().err.startswith("staf-table: `collect(path=...)` must be a directory")


def test_a_watched_table_is_printed_until_the_sweep_has_ended(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sweep = write_sweep(tmp_path / "sweep", counts=(3,), seeds=(0,))
    late = tmp_path / "sweep" / "99"
    write_run(late, {"kernel": "matern"}, None, status="running")
    jobs = {"jobs": [{"num": 99, "overrides": ["kernel=matern"]}, {"num": 100, "overrides": ["kernel=late"]}]}
    (sweep / "sweep.json").write_text(json.dumps(jobs))

    def end() -> None:
        time.sleep(0.2)
        record = (late / "run.json").read_text().replace('"running"', '"completed"')
        (late / "metrics.json").write_text('{"ball_error": 0.5}')
        (late / "run.json").write_text(record)
        time.sleep(0.2)
        write_run(sweep / "100", {"kernel": "late"}, {"ball_error": 0.25})

    other = threading.Thread(target=end)
    other.start()
    assert table.main([str(sweep), "--watch", "0.1"]) == 0
    other.join()
    printed = capsys.readouterr().out.split("| kernel")
    assert len(printed) > 2
    assert "running" in printed[1]
    assert "\x1b" not in printed[1]  # no terminal is cleared where there is none
    assert "running" not in printed[-1]
    assert "0.25" in printed[-1]

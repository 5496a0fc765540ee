"""`sweep.records=table`: a row a job in one file, killed and taken up again, here and in workers."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from command_line import one

import staf_torch
from staf_torch.results.files import write_metrics
from staf_torch.results.reader import collect

SHORT = ["dt=0.05", "duration=0.3", "settle_time=0.1", "figures=false"]
TABLE = "sweep.records=table"


def rows_of(place: str) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = json.loads(Path(place, "rows.json").read_text())["rows"]
    return found


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.chdir(tmp_path)
    yield
    sys.modules.pop("mine", None)


def test_rows_are_what_the_same_sweep_leaves_in_directories() -> None:
    lists = [*SHORT, "history=false", "kernel=gaussian,matern", "seed=0,1", "trajectories=2"]
    table = staf_torch.sweep(*lists, TABLE, directory="one")
    sweep = staf_torch.sweep(*lists, directory="many")
    rows = rows_of("one")
    assert rows[1]["overrides"] == ["kernel=gaussian", "seed=1"]  # what all jobs share is not repeated
    for number, (row, read, job) in enumerate(zip(rows, table, sweep, strict=True)):
        assert (row["num"], row["status"], row["reason"]) == (number, "completed", None)
        assert row["metrics"] == read.metrics == job.metrics
        assert [read.setting(key) for key in table.found.swept] == [
            job.setting(key) for key in table.found.swept
        ]
    assert table.found.swept == sweep.found.swept == ("kernel", "seed")
    names = {path.name for path in Path("one").iterdir()}
    report = {"table.md", "table.tex", "table.csv", "report.html"}
    assert names == report | {"sweep.json", "multirun.yaml", "run.json", "rows.json"}
    for change in (("many", TABLE), ("one", "sweep.records=directories")):
        with pytest.raises(ValueError, match="which a sweep keeps"):
            staf_torch.sweep(f"sweep.resume={change[0]}", change[1])


def test_failed_and_diverged_rows_are_named_and_the_others_go_on() -> None:
    lists = ["centers.radius=0.1,-1", "initial_state=[1.0,0.0],[90.0,90.0]"]
    lines = [*lists, "system=van_der_pol", "dt=0.2", "duration=8", "settle_time=0.5", "figures=false"]
    code, out, err = one(".", ["-m", TABLE, *lines, "hydra.sweep.dir=one"])
    rows = rows_of("one")
    assert [row["status"] for row in rows] == ["completed", "completed", "failed", "failed"]
    wrong = "`ConstantRadius(radius=...)` must be positive; got -1."
    assert (rows[2]["reason"], rows[2]["metrics"]) == (wrong, {})
    assert rows[1]["metrics"]["ultimate_error"] is None
    assert "2 of 4 jobs completed, 2 failed" in out
    assert "job 2 (centers.radius=-1 initial_state=[1.0,0.0]" in err
    assert (code, err.splitlines()[-1].endswith(wrong)) == (1, True)


def test_rows_keep_a_history_only_where_it_is_asked_for() -> None:
    staf_torch.sweep(*SHORT, "seed=1,2", "history=true", TABLE, directory="one")
    kept = sorted(str(path) for path in Path("one").rglob("history.npz"))
    assert kept == ["one/rows/0/history.npz", "one/rows/1/history.npz"]


def alone(cfg: Any, directory: Path, progress: object = None) -> dict[str, float]:
    """An experiment without batches."""
    write_metrics(directory / "metrics.json", {"radius": cfg.centers.radius})
    return {"radius": cfg.centers.radius}


def test_experiments_without_batches_run_one_by_one() -> None:
    lines = ["task=test_table.alone", "figures=false", TABLE]
    runs = staf_torch.sweep(*lines, "centers.radius=0.1,0.2", directory="one")
    assert [run.status for run in runs] == ["completed"] * 2
    assert [row["metrics"] for row in rows_of("one")] == [{"radius": 0.1}, {"radius": 0.2}]
    assert Path("one", "rows", "1", "metrics.json").is_file()


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("-m sweep.records=tables", "`staf sweep.records=...` must be one of 'directories', 'table'"),
        (f"-m {TABLE} hydra/launcher=basic", "needs a sweep (staf -m) whose launcher is"),
        (f"-m {TABLE} hydra.sweeper.max_batch_size=1", "needs all jobs at once"),
        (f"-m {TABLE} seed=range(1000001)", "a sweep of 2e+06 jobs, and 1000000 are the most"),
        (TABLE, "needs a sweep (staf -m)"),
    ],
)
def test_what_has_no_table_is_refused_in_a_sentence(line: str, words: str) -> None:
    swept = ["trajectories=1,2", "hydra.sweep.dir=one"] if line.startswith("-m") else []
    code, _, err = one(".", [*line.split(), *SHORT, *swept])
    assert code == 1
    assert words in err
    assert not Path("one", "rows.json").exists()


# Killed, and taken up again

MINE = '''
import dataclasses
from pathlib import Path
from staf_torch.experiments.registry import BatchedExperiment
from staf_torch.settings.plain import to_read
from staf_torch.sweeps.job import LostError

SCALE = 1.0

@dataclasses.dataclass
class Square:
    metrics: dict

class Squares(BatchedExperiment[Square]):
    """Squares of a number; notes what it computes, ends at the number in the file `stop`, loses others."""
    batchable = frozenset({"seed", "trajectories"})

    def solve(self, cfgs, progress):
        cfgs = to_read(cfgs)
        numbers = [40 * cfg.seed + cfg.trajectories for cfg in cfgs]
        if Path("stop").exists() and int(Path("stop").read_text()) in numbers:
            Path("stop").unlink()
            raise KeyboardInterrupt
        with open("computed", "a") as file:
            file.write("".join(f"{number}\\n" for number in numbers))
        scale, lost = SCALE * cfgs[0].kernel.width, Path("lose").exists()
        return [LostError("gone") if lost and n > 42 else Square({"square": scale * n**2}) for n in numbers]

    def __call__(self, cfg, directory, progress=None):
        return self.write(cfg, directory, self.solve([cfg], progress)[0])

    def write(self, cfg, directory, solution):
        if cfg.history:
            (directory / "history.npz").write_text(f"{solution.metrics['square']:.0f}"[:1])
        return solution.metrics
'''
PARTIAL, SUMS = ".rows.json.partial", ".rows.json.sums"
PIECE, BATCH, ALL = 1024, 128, 1040  # rows that are written together, that are computed together, and all
OWN = ["-m", TABLE, "task=mine.Squares", "kernel=choice(own)"]
GRID = [*OWN, "seed=range(26)", "trajectories=range(40)"]
FEW = [*OWN, "seed=range(2)", "trajectories=range(4)", "history=true", "hydra.sweep.dir=lost"]


def staf(*argv: str) -> tuple[int, str]:
    sys.modules.pop("mine", None)
    code, out, err = one(".", ["--config-dir", "conf", *argv])
    return code, out + err


def computed() -> list[int]:
    """The jobs that were computed since this was last asked, in order."""
    path = Path("computed")
    found = list(map(int, path.read_text().split())) if path.exists() else []
    path.unlink(missing_ok=True)
    return found


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a user's experiment and kernel, runs that are whole, killed and with a lost row."""
    place = tmp_path_factory.mktemp("rows")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(place)
        Path("conf", "kernel").mkdir(parents=True)
        Path("conf", "kernel", "own.yaml").write_text(
            "_target_: staf_torch.kernels.GaussianKernel\nwidth: 1.5\n"
        )
        Path("mine.py").write_text(MINE)
        code, said = staf(*GRID, "hydra.sweep.dir=whole")
        assert code == 0, said
        assert computed() == list(range(ALL))
        Path("stop").write_text(str(PIECE + 5))
        code, said = staf(*GRID, "hydra.sweep.dir=killed")
        assert code == 130
        Path("said").write_text(said)
        assert computed() == list(range(PIECE))
        Path("lose").touch()
        assert staf(*FEW)[0] == 1
        computed()
        Path("lose").unlink()
    return place


@pytest.fixture
def place(runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of it, which is the working directory."""
    copy = Path(shutil.copytree(runs, tmp_path / "copy", ignore=shutil.ignore_patterns("__pycache__")))
    monkeypatch.chdir(copy)
    return copy


def test_ctrl_c_says_how_many_rows_are_complete_and_how_to_resume(runs: Path) -> None:
    said = f"staf: interrupted; {PIECE} of {ALL} jobs have a row, {ALL - PIECE} are to do. Resume with:\n"
    assert (runs / "said").read_text().endswith(said + "  staf -m sweep.resume=killed\n")
    whole, left = collect(runs / "whole").rows, collect(runs / "killed").rows
    assert [run.metrics for run in left[:PIECE]] == [run.metrics for run in whole[:PIECE]]
    assert {run.status for run in left[PIECE:]} == {"failed"}


def test_many_rows_are_reported_as_the_spread_of_each_metric(runs: Path) -> None:
    text = (runs / "whole" / "table.md").read_text()
    assert f"{ALL} rows, {ALL} completed, 0 diverged" in text
    cells = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if "| " in line]
    assert ["metric", "least", "median", "most", "rows"] in cells
    (row,) = (row for row in cells if row[0] == "square")
    assert row[1:2] + row[4:] == ["0", str(ALL)]
    page = (runs / "whole" / "report.html").read_text()
    assert "median" in page
    assert "mine.Squares" in page  # the settings that all share
    assert "<dt>trajectories</dt>" not in page


def test_a_resumed_job_computes_what_is_missing_and_ends_with_the_same_bytes(place: Path) -> None:
    first, partial = 900, Path("killed", PARTIAL)  # the first row that is not whole: it has another digit
    lines = partial.read_bytes().splitlines(keepends=True)
    at = max(n for n, letter in enumerate(lines[first + 1]) if chr(letter).isdigit())
    lines[first + 1] = lines[first + 1][:at] + b"x" + lines[first + 1][at + 1 :]
    partial.write_bytes(b"".join(lines[:950]) + lines[950][:40])  # a row is cut, and what comes after is gone
    code, said = staf("-m", "sweep.resume=killed", "--trust")
    assert code == 0, said
    assert "and those after it run again" in said
    assert computed() == list(range(first - first % BATCH, ALL))  # a batch as a whole, as it was then
    for file in ("rows.json", "table.md"):
        assert Path("killed", file).read_bytes() == Path("whole", file).read_bytes()
    assert not list(Path("killed").glob(".rows*"))
    before = Path("killed/rows.json").stat().st_mtime_ns
    code, said = staf("-m", "sweep.resume=killed", "--trust")  # it is complete
    assert (code, computed()) == (0, []), said
    assert f"{ALL} of {ALL} jobs completed, 0 failed" in said
    assert Path("killed/rows.json").stat().st_mtime_ns == before


def test_a_history_belongs_to_its_row_and_one_that_is_damaged_is_made_again(place: Path) -> None:
    spoiled = Path("lost/rows/2/history.npz")
    assert spoiled.read_text() == "6"
    spoiled.write_text("8")  # of the same size
    code, said = staf("-m", "sweep.resume=lost", "--trust")
    assert code == 0, said
    assert "history.npz is damaged" in said
    assert spoiled.read_text() == "6"


def test_rows_that_lost_their_workers_are_computed_later_and_the_others_stay(place: Path) -> None:
    assert collect("lost").rows[-1].reason == "1 of 8 rows lost their workers; sweep.resume computes them"
    code, said = staf("-m", "sweep.resume=lost", "--trust")
    assert code == 0, said
    assert [row["metrics"]["square"] for row in rows_of("lost")][-2:] == [1.5 * 42**2, 1.5 * 43**2]


def test_rows_of_other_settings_or_modules_are_refused_and_stay(place: Path) -> None:
    rows = Path("lost", PARTIAL).read_bytes()
    for path, before, after, words in (
        (
            "conf/kernel/own.yaml",
            "1.5",
            "2.5",
            "job 0 (task=mine.Squares kernel=own seed=0 trajectories=0 history=True) would be made otherwise",
        ),
        ("mine.py", "SCALE = 1.0", "SCALE = 2.0", "rows that were made with other settings or source"),
    ):
        text = Path(path).read_text()
        Path(path).write_text(text.replace(before, after))
        code, said = staf("-m", "sweep.resume=lost", "--trust")
        assert code == 1
        assert words in said
        assert computed() == []
        assert Path("lost", PARTIAL).read_bytes() == rows
        if path != "mine.py":
            Path(path).write_text(text)
    code, said = staf("-m", "sweep.resume=lost", "sweep.resume_anyway=true", "--trust")
    assert code == 0, said
    assert rows_of("lost")[2]["metrics"]["square"] == 12.0  # the sweep begins anew where a person means it

"""The setting `members`: a sweep inside one job, killed and taken up again."""

from __future__ import annotations

import contextlib
import json
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from command_line import one
from composing import settings

import staf_torch
from staf_torch.results.reader import collect
from staf_torch.sweeps.batching import Batch, Failed, Outcome, Written
from staf_torch.sweeps.executors import pack, solve_elsewhere, unpack
from staf_torch.sweeps.hydra_compat import config_loader, search_paths
from staf_torch.sweeps.job import InWorker, Origin
from staf_torch.sweeps.member_rows import Left, left, writer
from staf_torch.sweeps.members import member_overrides

SHORT = ["dt=0.05", "duration=0.3", "settle_time=0.1", "figures=false"]


def members(place: Path) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = json.loads((place / "members.json").read_text())["members"]
    return found


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.chdir(tmp_path)
    yield
    sys.modules.pop("mine", None)


def test_members_are_the_rows_of_the_same_sweep() -> None:
    lists = ["kernel=gaussian,matern", "seed=0,1", "trajectories=2"]
    run = staf_torch.run(*SHORT, f"members={lists}", directory="one")
    assert run.metrics == {"members": 4, "failed": 0, "diverged": 0}
    rows = members(Path("one"))
    sweep = staf_torch.sweep(*SHORT, "history=false", *lists, directory="many")
    assert rows[1]["overrides"] == ["kernel=gaussian", "seed=1", "trajectories=2"]
    for number, (row, job) in enumerate(zip(rows, sweep, strict=True)):
        assert (row["num"], row["status"], row["reason"]) == (number, "completed", None)
        assert row["metrics"] == pytest.approx(job.metrics, rel=1e-9, abs=1e-12)
    alone = staf_torch.run(*SHORT, "history=false", *rows[3]["overrides"])
    assert rows[3]["metrics"] == pytest.approx(alone.metrics, rel=1e-9, abs=1e-12)
    names = {path.name for path in Path("one").iterdir()}
    assert names == {".hydra", "run.json", "staf.log", "members.json", "metrics.json"}


def test_failed_and_diverged_members_are_counted_and_named() -> None:
    lists = "members=['centers.radius=0.1,-1','initial_state=[1.0,0.0],[90.0,90.0]']"
    lines = [lists, "system=van_der_pol", "dt=0.2", "duration=20", "settle_time=0.5", "figures=false"]
    run = staf_torch.run(*lines, directory="one")
    assert run.metrics == {"members": 4, "failed": 2, "diverged": 1}
    rows = members(Path("one"))
    assert [row["status"] for row in rows] == ["completed", "completed", "failed", "failed"]
    assert rows[2]["reason"] == "`ConstantRadius(radius=...)` must be positive; got -1."
    assert rows[2]["metrics"] == {}
    assert rows[1]["metrics"]["ultimate_error"] is None
    log = Path("one", "staf.log").read_text()
    assert "member 2 (centers.radius=-1 initial_state=[1.0,0.0])" in log
    assert "| centers.radius=0.1 initial_state=[1.0,0.0]" in log  # few members are listed


def test_members_keep_a_history_only_where_it_is_asked_for() -> None:
    staf_torch.run(*SHORT, "members=['seed=1,2']", "history=true", directory="one")
    found = sorted(str(path) for path in Path("one").rglob("history.npz"))
    assert found == ["one/members/0/history.npz", "one/members/1/history.npz"]


def test_experiments_without_batches_run_one_by_one() -> None:
    lines = ["experiment=layouts", "layouts.radii=[0.1]", "layouts.states=2", "figures=false"]
    run = staf_torch.run(*lines, "members=['centers.radius=0.1,0.2']", directory="one")
    assert run.metrics["failed"] == 0
    assert all(row["metrics"] for row in members(Path("one")))
    assert Path("one", "members", "1", "metrics.json").is_file()


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ("[]", "`staf members=...` must be a list of overrides, like 'seed=range"),
        ("[1,2]", "`staf members=...` must be a list of overrides"),
        ("['hydra.job.name=a']", "must be about the experiment alone"),
        (r"['members=\'seed=1\'']", "must be about the experiment alone"),
        ("['centers.raduis=0.1,0.2']", "there is no setting `centers.raduis`"),
        ("['seed=range(1']", "must be overrides in Hydra's grammar"),
        ("['seed=interval(0,1)']", "does not support sweep type"),
        ("['seed=range(1000001)']", "must be 1000000 at most, in several jobs if need be"),
    ],
)
def test_what_cannot_be_swept_is_refused_in_a_sentence(lines: str, words: str) -> None:
    with pytest.raises(ValueError) as error:  # noqa: PT011  # the words are compared below
        staf_torch.run(
            *SHORT, f'members="{lines}"' if lines[0] != "[" else f"members={lines}", directory="one"
        )
    assert words in str(error.value)
    assert not Path("one").exists()


def test_a_million_members_are_not_written_out() -> None:
    assert len(member_overrides(["seed=range(1000)", "spread=range(1,1001)"], config_loader())) == 10**6


# Killed, and taken up again

MINE = '''
import dataclasses
from pathlib import Path
from staf_torch.experiments.registry import BatchedExperiment
from staf_torch.settings.plain import to_read

SCALE = 1.0

@dataclasses.dataclass
class Square:
    metrics: dict

class Squares(BatchedExperiment[Square]):
    """Squares of a number; notes what it computes, and is killed at the number that the file `stop` names."""
    batchable = frozenset({"seed", "trajectories"})

    def solve(self, cfgs, progress):
        cfgs = to_read(cfgs)
        numbers = [50 * cfg.seed + cfg.trajectories for cfg in cfgs]
        if Path("stop").exists() and int(Path("stop").read_text()) in numbers:
            Path("stop").unlink()
            raise KeyboardInterrupt
        with open("computed", "a") as file:
            file.write("".join(f"{number}\\n" for number in numbers))
        width = cfgs[0].kernel.width
        return [Square({"square": SCALE * width * number**2}) for number in numbers]

    def __call__(self, cfg, directory, progress=None):
        return self.write(cfg, directory, self.solve([cfg], progress)[0])

    def write(self, cfg, directory, solution):
        return solution.metrics
'''
PARTIAL, SUMS = ".members.json.partial", ".members.json.sums"
PIECE, BATCH, ALL = 1024, 128, 1100  # members that are written together, that are computed together, and all
GRID = [
    "task=mine.Squares",
    "members=['kernel=own','seed=range(22)','trajectories=range(50)']",
    "figures=false",
]


def staf(*argv: str) -> tuple[int, str]:
    sys.modules.pop("mine", None)
    code, out, err = one(".", ["--config-dir", "conf", *argv])
    return code, out + err


def computed() -> list[int]:
    """The members that were computed since this was last asked, in order."""
    path = Path("computed")
    found = list(map(int, path.read_text().split())) if path.exists() else []
    path.unlink(missing_ok=True)
    return found


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a user's experiment and kernel, a whole run, one killed in its second piece."""
    place = tmp_path_factory.mktemp("members")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(place)
        Path("conf", "kernel").mkdir(parents=True)
        Path("conf", "kernel", "own.yaml").write_text(
            "_target_: staf_torch.kernels.GaussianKernel\nwidth: 1.5\n"
        )
        Path("mine.py").write_text(MINE)
        code, said = staf(*GRID, "hydra.run.dir=whole")
        assert code == 0, said
        assert computed() == list(range(ALL))
        Path("stop").write_text(str(PIECE + 5))
        code, said = staf(*GRID, "hydra.run.dir=killed")
        assert code == 130
        Path("said").write_text(said)
        assert computed() == list(range(PIECE))
    return place


@pytest.fixture
def place(runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of it, which is the working directory."""
    copy = Path(shutil.copytree(runs, tmp_path / "copy", ignore=shutil.ignore_patterns("__pycache__")))
    monkeypatch.chdir(copy)
    return copy


def test_ctrl_c_says_how_many_members_are_complete_and_how_to_resume(runs: Path) -> None:
    said = f"staf: interrupted; {PIECE} of {ALL} members are complete. Resume with:\n"
    assert (runs / "said").read_text().endswith(said + "  staf sweep.resume=killed\n")
    whole, left = collect(runs / "whole").rows, collect(runs / "killed").rows
    assert [run.metrics for run in left[:PIECE]] == [run.metrics for run in whole[:PIECE]]
    assert {run.status for run in left[PIECE:]} == {"failed"}


def test_many_members_end_as_the_spread_of_each_metric(runs: Path) -> None:
    log = (runs / "whole" / "staf.log").read_text()
    cells = [[cell.strip() for cell in line.split("|")[1:-1]] for line in log.splitlines() if "| " in line]
    assert ["metric", "least", "median", "most", "members"] in cells
    (row,) = (row for row in cells if row[0] == "square")
    assert row[1:2] + row[4:] == ["0", str(ALL)]


def lines_of(name: str) -> list[bytes]:
    return Path("killed", name).read_bytes().splitlines(keepends=True)


def cut_in_a_row(number: int) -> None:
    """A row ends in its middle, and what comes after is gone."""
    lines = lines_of(PARTIAL)
    Path("killed", PARTIAL).write_bytes(b"".join(lines[: number + 1]) + lines[number + 1][:40])


def flip_a_digit(number: int) -> None:
    lines = lines_of(PARTIAL)
    at = max(n for n, letter in enumerate(lines[number + 1]) if chr(letter).isdigit())
    lines[number + 1] = lines[number + 1][:at] + b"x" + lines[number + 1][at + 1 :]
    Path("killed", PARTIAL).write_bytes(b"".join(lines))


def lose_a_checksum(number: int) -> None:
    """The row was on the disk, and its checksum was not yet."""
    lines = lines_of(SUMS)
    Path("killed", SUMS).write_bytes(b"".join(lines[: number + 1]) + lines[number + 1][:20])


def lose_everything(number: int) -> None:
    Path("killed", PARTIAL).unlink()


DAMAGE: dict[str, tuple[Any, int]] = {  # what is done, and the first row that is not whole then
    "none": (lambda number: None, PIECE),
    "a cut row": (cut_in_a_row, 900),
    "another digit": (flip_a_digit, 3),
    "a cut checksum": (lose_a_checksum, 896),
    "everything": (lose_everything, 0),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_a_resumed_job_computes_what_is_missing_and_ends_with_the_same_bytes(name: str, place: Path) -> None:
    spoil, first = DAMAGE[name]
    spoil(first)
    code, said = staf("sweep.resume=killed", "--trust")
    assert code == 0, said
    assert ("and those after it run again" in said) == (
        name in ("a cut row", "another digit", "a cut checksum")
    )
    batch = first - first % PIECE % BATCH  # which is computed as a whole, as it was then
    assert computed() == list(range(batch, ALL))
    for file in ("members.json", "metrics.json"):
        assert Path("killed", file).read_bytes() == Path("whole", file).read_bytes()
    assert not list(Path("killed").glob(".members*"))


def test_a_history_belongs_to_its_row(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    rows = [{"num": number, "metrics": {}} for number in range(3)]
    for number in range(2):
        (tmp_path / "members" / str(number)).mkdir(parents=True)
        (tmp_path / "members" / str(number) / "history.npz").write_text("kept")
    with contextlib.suppress(KeyboardInterrupt), writer(tmp_path, "run", 4, Left([])) as write:
        write(rows, ["made"] * 3)
        raise KeyboardInterrupt
    assert left(tmp_path, "another run") is None
    assert len(left(tmp_path, "run").made) == 3  # type: ignore[union-attr]
    (tmp_path / "members" / "1" / "history.npz").write_text("Kept")  # of the same size
    assert len(left(tmp_path, "run").made) == 1  # type: ignore[union-attr]
    assert "history.npz is damaged" in caplog.text


def test_rows_of_other_settings_or_modules_are_refused_and_stay(place: Path) -> None:
    rows = Path("killed", PARTIAL).read_bytes()
    for path, before, after, words in (
        (
            "conf/kernel/own.yaml",
            "1.5",
            "2.5",
            "member 0 (kernel=own seed=0 trajectories=0) was not made as it would be now",
        ),
        ("mine.py", "SCALE = 1.0", "SCALE = 2.0", "rows of members that were not mad"),
    ):
        text = Path(path).read_text()
        Path(path).write_text(text.replace(before, after))
        code, said = staf("sweep.resume=killed", "--trust")
        assert code == 1
        assert words in said
        assert computed() == []
        assert Path("killed", PARTIAL).read_bytes() == rows
        if path != "mine.py":
            Path(path).write_text(text)
    code, said = staf("sweep.resume=killed", "sweep.resume_anyway=true", "--trust")
    assert code == 0, said
    assert computed() == list(range(ALL))  # the job begins anew where a person means it
    assert members(Path("killed"))[2]["metrics"]["square"] == 12.0


def test_one_run_is_not_resumed_as_a_sweep(place: Path) -> None:
    code, said = staf("-m", "sweep.resume=killed", "--trust")
    assert code == 1
    assert "is one run, of many members: resume it without -m" in said


def test_a_sweep_of_such_jobs_goes_on_within_the_job(place: Path) -> None:
    lists = ["members=['trajectories=range(3)'],['seed=range(1,23)','trajectories=range(50)']"]
    lists += ["task=mine.Squares", "kernel=own", "figures=false"]
    Path("stop").write_text(str(50 + PIECE))
    code, said = staf("-m", *lists, "hydra.sweep.dir=two")
    assert code == 130, said
    computed()
    assert staf("-m", "sweep.resume=two", "--trust")[0] == 0
    assert computed() == list(range(50 + PIECE, 50 + ALL))  # the first piece of the second job stays
    assert (len(members(Path("two/0"))), len(members(Path("two/1")))) == (3, ALL)


def in_a_worker(place: Path) -> Outcome:
    """Run the killed job as a worker does, with the folder of settings that `--config-dir` named."""
    *usual, schema = search_paths()
    paths = (*usual, ("command-line", f"file://{Path('conf').absolute()}"), schema)
    whole = InWorker(Origin(GRID, {}), paths)
    (found,) = unpack(solve_elsewhere(*pack(Batch([settings(*GRID)], [str(place)], [whole])))).outcomes
    return found


def test_a_worker_goes_on_where_an_earlier_try_of_the_job_was_killed(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(place))
    Path("stop").write_text(str(PIECE + 5))
    with pytest.raises(KeyboardInterrupt):
        in_a_worker(place / "again")
    computed()
    found = in_a_worker(place / "again")
    assert isinstance(found, Written), found
    assert found.metrics == {"members": ALL, "failed": 0, "diverged": 0}
    assert computed() == list(range(PIECE, ALL))
    assert Path("again/members.json").read_bytes() == Path("whole/members.json").read_bytes()
    Path("conf/kernel/own.yaml").unlink()
    failed = in_a_worker(place / "third")
    assert isinstance(failed, Failed)
    assert "own" in str(failed.error)

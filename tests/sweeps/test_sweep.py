"""Sweeps by the batched launcher: what they leave, beside Hydra's own, and what can go wrong on the way."""

from __future__ import annotations

import json
import logging
import os
import re
import shutil
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from command_line import one
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from staf_torch.experiments.registry import Metrics
from staf_torch.results.files import write_metrics
from staf_torch.results.reader import collect
from staf_torch.signs import SHOWN, Progress
from staf_torch.sweeps.job import objective
from staf_torch.sweeps.launcher import SweepProgress

pytestmark = pytest.mark.filterwarnings("always:odd 100")
SHORT = ["duration=0.05", "settle_time=0", "figures=false", "history=false"]
GRID = ["centers.count=3,4,6", "centers.radius=0.1", "trajectories=2", "+note='ü: x'", *SHORT]
BAD = "`rings(count=...)` must be one of 3, 6, 10, 15, 21, 28; got 4."


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A working directory, and the logging of before afterwards."""
    root = logging.getLogger()
    kept, level, here = list(root.handlers), root.level, Path.cwd()
    yield tmp_path_factory.mktemp("sweeps")
    root.handlers[:], root.level = kept, level
    os.chdir(here)


def sweep(place: Path, name: str, *argv: str, code: int = 0) -> tuple[Path, str]:
    """A sweep into `runs/<name>`: its directory and what was said."""
    ended, out, err = one(str(place), ["-m", *argv, f"hydra.sweep.dir=runs/{name}"])
    assert ended == code, err
    return place / "runs" / name, out + err


def record(run: Path) -> dict[str, Any]:
    found = json.loads((run / "run.json").read_text(), parse_constant=pytest.fail)
    assert isinstance(found, dict)
    return found


def rows(directory: Path) -> dict[str, dict[str, float | None] | str]:
    """Overrides to metrics, or to the reason why there are none."""
    found = {}
    for run in directory.glob("*/run.json"):
        about = record(run.parent)
        metrics = run.with_name("metrics.json")
        key = " ".join(about["overrides"])
        found[key] = json.loads(metrics.read_text()) if metrics.exists() else about["reason"]
    return found


@pytest.fixture(scope="module")
def batched(place: Path) -> tuple[Path, str]:
    return sweep(place, "batched", *GRID, code=1)


@pytest.fixture(scope="module")
def basic(place: Path) -> tuple[Path, str]:
    return sweep(place, "basic", *GRID, "hydra/launcher=basic", code=1)


def test_a_batched_sweep_leaves_what_the_basic_launcher_leaves(
    batched: tuple[Path, str], basic: tuple[Path, str]
) -> None:
    ours, hydras = (
        {str(path.relative_to(found)) for path in found.rglob("*") if path.is_file()}
        for found in (batched[0], basic[0])
    )
    assert ours == hydras
    assert {"table.md", "report.html"} <= ours  # although jobs failed
    for num in range(3):
        run, other = batched[0] / str(num), basic[0] / str(num)
        assert hydra_of(run) == hydra_of(other)
        for name in ("config", "overrides"):
            path = f".hydra/{name}.yaml"
            assert (run / path).read_text() == (other / path).read_text()
        same = {"task", "overrides", "settings", "status", "reason", "version"}
        assert {key: record(run)[key] for key in same} == {key: record(other)[key] for key in same}
    expected = rows(basic[0])
    for key, found in rows(batched[0]).items():
        other_row = expected.pop(key)
        numbers = other_row if isinstance(other_row, str) else pytest.approx(other_row, rel=1e-9, abs=1e-12)
        assert found == numbers
    assert not expected


def hydra_of(run: Path) -> Any:
    """`.hydra/hydra.yaml` without the launcher and where it writes."""
    node = OmegaConf.to_container(OmegaConf.load(run / ".hydra/hydra.yaml"), resolve=False)["hydra"]
    del node["launcher"], node["sweep"]["dir"], node["overrides"]["hydra"]
    del node["runtime"]["output_dir"], node["runtime"]["choices"]["hydra/launcher"]
    return node


def test_a_job_that_fails_fails_alone_and_says_why(batched: tuple[Path, str]) -> None:
    directory, said = batched
    status = [record(directory / str(num))["status"] for num in range(3)]
    assert status == ["completed", "failed", "completed"]
    assert record(directory / "1")["reason"] == BAD
    assert "job 1 (centers.count=4 centers.radius=0.1" in said
    assert said.rstrip().endswith(f"staf: {BAD}")
    assert "2 of 3 jobs completed, 1 failed" in said
    assert "Traceback" not in said
    assert BAD in (directory / "1" / "staf.log").read_text()


def test_jobs_are_listed_with_the_sweep_and_have_settings_and_a_log_of_their_own(
    batched: tuple[Path, str],
) -> None:
    listed = json.loads((batched[0] / "sweep.json").read_text())["jobs"]
    assert [job["num"] for job in listed] == list(range(3))
    for job in listed:
        about = record(batched[0] / str(job["num"]))
        assert about["overrides"] == job["overrides"]
        assert about["settings"]["kernel"] == "exponential"
        assert f"centers.radius={about['settings']['centers.radius']}" in job["overrides"]
        assert not any(key.startswith(("hydra", "sweep")) for key in about["settings"])
    for num, count in ((0, 3), (2, 6)):  # each log has its own job alone
        log = (batched[0] / str(num) / "staf.log").read_text()
        (told,) = [line for line in log.splitlines() if "Gradient chase" in line]
        assert f"{count} centers" in told


@pytest.mark.parametrize("launcher", ["batched", "basic"])
def test_a_resumed_sweep_runs_what_is_missing_and_ends_with_the_same_bits(
    launcher: str, place: Path, request: pytest.FixtureRequest
) -> None:
    again = shutil.copytree(request.getfixturevalue(launcher)[0], place / "runs" / f"{launcher}_again")
    before = rows(again)
    first = (again / "0" / "run.json").stat().st_mtime_ns
    (again / "2" / "run.json").write_text(json.dumps(record(again / "2") | {"status": "running"}))
    (again / "1" / "run.json").unlink()
    free = "figures.draw=false"  # the sweep was typed with `figures=false`
    code, out, err = one(
        str(place), ["-m", f"sweep.resume=runs/{launcher}_again", f"hydra/launcher={launcher}", free]
    )
    assert not collect(again).skipped
    assert code == 1  # the failed one fails again
    told = (
        "2 of 3 jobs completed, 1 failed" if launcher == "batched" else "completed before: runs/basic_again/0"
    )
    assert told in out, err
    assert [*rows(again).values()] == [*before.values()]
    assert (again / "0" / "run.json").stat().st_mtime_ns == first


@pytest.mark.parametrize("line", ["batch=0", "workers=0", "foreign=ask"])
def test_what_the_launcher_is_told_is_checked_before_anything_runs(line: str, place: Path) -> None:
    directory, said = sweep(place, "refused", "seed=0,1", f"hydra.launcher.{line}", code=1)
    assert f"`hydra.launcher({line.partition('=')[0]}=...)` must be" in said
    assert not directory.exists()


# A user's experiment, and what befalls it


def own(cfg: DictConfig, directory: Path, progress: Progress = SHOWN) -> Metrics:
    """An experiment that notes where it runs and that something befalls, as its settings say."""
    warnings.warn("odd 100 %", stacklevel=1)
    harm = cfg.get("harm") if cfg.seed == 1 else None
    if harm == "user":
        raise ValueError("not like that")
    if harm == "defect":
        raise RuntimeError("the second seed is unlucky")
    if harm == "Ctrl-C" and not Path("go on").exists():
        raise KeyboardInterrupt
    if harm == "a job gone":
        shutil.rmtree(directory.parent / "0")
    node = HydraConfig.get()
    assert node.runtime.output_dir == str(directory.absolute())
    assert json.loads((directory / "run.json").read_text())["status"] == "running"
    found: Metrics = {"num": float(node.job.get("num", -1)), "set": float(os.environ.get("STAF_JOB", 0))}
    write_metrics(directory / "metrics.json", found)
    return found


OWN = ["task=test_sweep.own", "figures=false"]


def test_hydra_knows_of_a_job_while_it_runs_and_what_was_typed_is_kept_as_typed(place: Path) -> None:
    more = ["+hydra.job.env_set.STAF_JOB=7", "hydra.sweep.subdir=x${hydra.job.num}", "+at=${centers.radius}"]
    directory, _ = sweep(place, "own", *OWN, "seed=0,1", *more)
    runs = [directory / f"x{num}" for num in range(2)]
    assert [json.loads((run / "metrics.json").read_text()) for run in runs] == [
        {"num": num, "set": 7.0} for num in range(2)
    ]
    assert "STAF_JOB" not in os.environ
    assert json.loads((directory / "sweep.json").read_text())["overrides"][-1] == more[-1]  # as typed
    assert all("odd 100 %" in (run / "staf.log").read_text() for run in runs)  # a warning
    (runs[1] / "run.json").unlink()
    _, out, err = one(str(place), ["-m", "sweep.resume=runs/own", "--trust"])
    assert "2 of 2 jobs completed" in out, err


def test_equal_failures_are_told_once_and_end_a_sweep_where_nothing_swept_matters(place: Path) -> None:
    wrong = ["centers.count=4", "seed=range(5)", "kernel=exponential,gaussian", *SHORT]
    directory, said = sweep(place, "alike", *wrong, code=1)
    assert said.count(f"failed: {BAD}") == 2  # as it happened, and in the table's note
    assert "7 more failed like job 0 (" in said
    assert said.endswith(f"staf: 8 jobs failed with the same error, the other 2 were not run: {BAD}\n")
    assert len(list(directory.glob("*/run.json"))) == 8


def test_a_directory_is_one_jobs(place: Path) -> None:
    jobs = [*OWN, "hydra/launcher=batched", "seed=1,2", "centers.radius=0.1,0.2"]
    directory, said = sweep(place, "places", *jobs, "hydra.sweep.subdir=r_${centers.radius}", code=1)
    assert "gives two jobs one directory, runs/places/" in said
    assert not directory.exists()
    coupled = ["+pair={r:0.1,s:1},{r:0.2,s:2}", "centers.radius=${pair.r}", "seed=${pair.s}"]
    subdir = "hydra.sweep.subdir=r_${centers.radius}_${seed}"
    directory, _ = sweep(place, "apart", *jobs[:-2], *coupled, subdir)
    assert {path.name for path in directory.glob("r_*")} == {"r_0.1_1", "r_0.2_2"}
    assert {record(path)["settings"]["seed"] for path in directory.glob("r_*")} == {1, 2}


def test_a_defect_keeps_its_trace_and_spares_the_others(place: Path) -> None:
    directory, said = sweep(place, "defect", *OWN, "seed=range(3)", "+harm=defect", code=99)
    assert "RuntimeError: the second seed is unlucky" in said
    status = [record(directory / str(num))["status"] for num in range(3)]
    assert status == ["completed", "failed", "completed"]
    assert record(directory / "1")["reason"] == "RuntimeError: the second seed is unlucky"
    assert "Traceback" in (directory / "1" / "staf.log").read_text()


def test_an_interrupted_sweep_says_how_to_resume(place: Path) -> None:
    directory, said = sweep(place, "interrupted", *OWN, "seed=range(3)", "+harm=Ctrl-C", code=130)
    assert "1 of 3 jobs are complete, 0 failed, 2 are to do" in said
    (waiting,) = collect(directory).skipped
    assert "1 of 3 jobs have not started: 2; 1 completed; 1 failed. `staf -m sweep.resume=" in waiting.reason
    assert said.endswith("staf -m sweep.resume=runs/interrupted\n")
    assert record(directory / "1")["reason"] == "interrupted"
    (place / "go on").touch()
    code, out, err = one(str(place), ["-m", "sweep.resume=runs/interrupted", "--trust"])
    assert code == 0, err
    assert "3 of 3 jobs completed" in out
    assert len(rows(directory)) == 3


def test_results_that_are_taken_away_are_no_completed_jobs(place: Path) -> None:
    directory, said = sweep(place, "gone", *OWN, "seed=range(2)", "+harm=a job gone", code=1)
    assert "the results of job 0 (task=test_sweep.own" in said
    assert [run.parent.name for run in directory.glob("*/run.json")] == ["1"]


@pytest.mark.parametrize(
    ("harm", "code", "before"), [("user", 1, True), ("user", 1, False), ("defect", 99, True)]
)
def test_a_run_of_a_users_error_leaves_nothing_and_others_keep_all_that_there_is(
    harm: str, code: int, before: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    if before:
        (tmp_path / "run").mkdir()
        (tmp_path / "run" / "notes.txt").write_text("")
    ended, _, err = one(str(tmp_path), [*OWN, "seed=1", f"+harm={harm}", "hydra.run.dir=run"])
    assert ended == code
    left = {path.name for path in tmp_path.glob("run/*")}
    kept = {"notes.txt"} if before else set()
    assert left == (kept if harm == "user" else kept | {".hydra", "run.json", "staf.log"})
    assert (tmp_path / "run").exists() == (before or harm != "user")
    assert ("staf: not like that" in err) == (harm == "user")


def test_an_objective_is_what_the_sweeper_is_told() -> None:
    metrics: Metrics = {"ball_error": 0.5, "settling_time": None}
    none, one_, two, wrong = (
        OmegaConf.create({"sweep": {"objective": named}})
        for named in (None, "ball_error", ["settling_time", "ball_error"], "speed")
    )
    assert objective(none, metrics) is metrics
    assert objective(one_, metrics) == 0.5
    assert objective(two, metrics) == (float("inf"), 0.5)
    with pytest.raises(ValueError, match=r"sweep\.objective.*must be one of 'ball_error'"):
        objective(wrong, metrics)


# Progress


def test_a_line_says_what_is_done_and_failed_and_the_time_that_is_left(
    capsys: pytest.CaptureFixture[str],
) -> None:
    progress = SweepProgress(10, 2)
    assert progress.line == "2 of 10 jobs done"
    progress.running(0.8)  # a tenth of the eight that are left
    assert progress.line == "2 of 10 jobs done"  # what loads and compiles says nothing of the others
    progress.ended("job 2", None)
    progress.ended("job 3 (seed=1)", "it diverged")
    assert re.fullmatch(r"4 of 10 jobs done, 1 failed, \d+ s left", progress.line)
    progress.computed(8.0)
    assert progress.line == "4 of 10 jobs done, 1 failed"  # no time is left, but for the files
    progress.close()
    assert capsys.readouterr() == ("", "job 3 (seed=1) failed: it diverged\n")  # no line at once

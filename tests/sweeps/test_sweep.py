"""Sweeps by the batched launcher: what they leave, beside Hydra's own, and what can go wrong on the way."""

from __future__ import annotations

import json
import logging
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from command_line import environment, one
from omegaconf import OmegaConf

from staf_torch.cli.staf import command_line
from staf_torch.results import run_record as records
from staf_torch.sweeps import launcher as launch
from staf_torch.sweeps.callbacks import SweepReport, claim

SHORT = ["duration=0.05", "settle_time=0", "figures=false", "history=false"]
GRID = [
    "centers.count=3,4,6",
    "centers.radius=0.1,0.2",
    "trajectories=2",
    *SHORT,
]  # rings of 4: there are none


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
    assert "Traceback" not in out + err
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
    for num in range(6):
        one_, other = batched[0] / str(num), basic[0] / str(num)
        assert hydra_of(one_) == hydra_of(other)
        assert (one_ / ".hydra/config.yaml").read_text() == (other / ".hydra/config.yaml").read_text()
        assert (one_ / ".hydra/overrides.yaml").read_text() == (other / ".hydra/overrides.yaml").read_text()
        same = {"task", "overrides", "settings", "status", "reason", "version"}
        assert {key: record(one_)[key] for key in same} == {key: record(other)[key] for key in same}


def hydra_of(run: Path) -> Any:
    """`.hydra/hydra.yaml` without the launcher and where it writes."""
    node = OmegaConf.to_container(OmegaConf.load(run / ".hydra/hydra.yaml"), resolve=False)["hydra"]
    del node["launcher"], node["sweep"]["dir"], node["overrides"]["hydra"]
    del node["runtime"]["output_dir"], node["runtime"]["choices"]["hydra/launcher"]
    return node


def test_a_batched_sweep_finds_the_numbers_of_the_basic_launcher(
    batched: tuple[Path, str], basic: tuple[Path, str]
) -> None:
    ours, hydras = rows(batched[0]), rows(basic[0])
    assert ours.keys() == hydras.keys()
    for key, found in ours.items():
        expected = hydras[key]
        if isinstance(expected, str):
            assert found == expected
        else:
            assert found == pytest.approx(expected, rel=1e-9, abs=1e-12)


def test_a_count_that_the_layout_cannot_have_fails_alone_and_says_why(batched: tuple[Path, str]) -> None:
    directory, said = batched
    status = {num: record(directory / str(num))["status"] for num in range(6)}
    assert status == {
        0: "completed",
        1: "completed",
        2: "failed",
        3: "failed",
        4: "completed",
        5: "completed",
    }
    reason = "`rings(count=...)` must be one of 3, 6, 10, 15, 21, 28; got 4."
    assert record(directory / "2")["reason"] == reason
    assert "job 2 (centers.count=4 centers.radius=0.1" in said
    assert said.rstrip().endswith(f"staf: {reason}")
    assert reason in (directory / "2" / "staf.log").read_text()


def test_sweep_json_lists_the_jobs_and_run_json_their_settings(batched: tuple[Path, str]) -> None:
    listed = json.loads((batched[0] / "sweep.json").read_text())["jobs"]
    assert [job["num"] for job in listed] == list(range(6))
    for job in listed:
        about = record(batched[0] / str(job["num"]))
        assert about["overrides"] == job["overrides"]
        assert about["settings"]["kernel"] == "exponential"
        assert f"centers.radius={about['settings']['centers.radius']}" in job["overrides"]
        assert not any(key.startswith(("hydra", "sweep")) for key in about["settings"])


def test_each_log_has_its_own_job_alone(batched: tuple[Path, str]) -> None:
    for num, count in ((0, 3), (4, 6)):
        log = (batched[0] / str(num) / "staf.log").read_text()
        told = [line for line in log.splitlines() if "Gradient chase" in line]  # more where it was resumed
        assert told
        assert all(f"{count} centers" in line for line in told)


def test_a_resumed_sweep_runs_what_is_missing_and_ends_with_the_same_bits(
    place: Path, batched: tuple[Path, str]
) -> None:
    again = shutil.copytree(batched[0], place / "runs" / "again")  # other tests look at that one
    before = rows(again)
    first = (again / "0" / "run.json").stat().st_mtime_ns
    running = record(again / "5") | {"status": "running"}
    (again / "5" / "run.json").write_text(json.dumps(running))
    (again / "4" / "run.json").unlink()
    code, out, err = one(str(place), ["-m", "sweep.resume=runs/again"])
    assert code == 1  # the failed ones fail again
    assert "4 of 6 jobs completed, 2 failed" in out, err
    assert rows(again) == before
    assert (again / "0" / "run.json").stat().st_mtime_ns == first
    assert not list((again / "0").glob(".*partial"))


def test_other_launchers_resume_too(place: Path, basic: tuple[Path, str]) -> None:
    again = shutil.copytree(basic[0], place / "runs" / "basic_again")
    before = rows(again)
    first = (again / "0" / "run.json").stat().st_mtime_ns
    (again / "5" / "run.json").unlink()
    code, out, _ = one(str(place), ["-m", *GRID, "sweep.resume=runs/basic_again", "hydra/launcher=basic"])
    assert code == 1
    assert "completed before: runs/basic_again/0" in out
    assert rows(again) == before
    assert (again / "0" / "run.json").stat().st_mtime_ns == first


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (["seed=1"], "must have the overrides of that sweep, or none; got them without"),
        ([*GRID, "seed=1"], "with 'seed=1'"),
    ],
)
def test_a_resumed_sweep_of_other_overrides_is_refused(
    place: Path, batched: tuple[Path, str], change: list[str], words: str
) -> None:
    code, _, err = one(str(place), ["-m", *change, "sweep.resume=runs/batched"])
    assert code == 1
    assert words in err


def test_what_is_no_sweep_of_this_version_is_not_resumed(place: Path, tmp_path: Path) -> None:
    _, _, err = one(str(place), ["-m", f"sweep.resume={tmp_path}"])
    assert "must be the directory of a sweep" in err
    (tmp_path / "sweep.json").write_text('{"version": "0.0.1", "overrides": [], "hydra": [], "jobs": []}')
    _, _, err = one(str(place), ["-m", f"sweep.resume={tmp_path}"])
    assert "written by 0.0.1" in err


def test_a_resumed_sweep_keeps_hydras_settings_but_those_that_change(tmp_path: Path) -> None:
    hydra = ["hydra.mode=MULTIRUN", "hydra.launcher.batch=2", "hydra.verbose=true", "hydra.sweep.dir=old"]
    records.begin_sweep(tmp_path, ["seed=0,1", "sweep.objective=ball_error"], hydra)
    place = records.quoted(str(tmp_path))
    end = [f"hydra.sweep.dir={place}", f"sweep.resume={place}"]
    kept = ["--multirun", "seed=0,1", "hydra.launcher.batch=2", "hydra.verbose=true"]
    kept += ["sweep.objective=ball_error", *end]
    assert command_line([f"sweep.resume={tmp_path}"]) == kept
    other = ["-m", "seed=0,1", "hydra.verbose=true", "sweep.objective=null", "hydra/launcher=basic", *end]
    changed = ["sweep.objective=null", "hydra/launcher=basic"]
    assert command_line(["-m", f"sweep.resume={tmp_path}", *changed]) == other
    assert command_line(["-m", "sweep.resume=null", "seed=0"]) == ["-m", "sweep.resume=null", "seed=0"]


def test_a_directory_with_another_run_in_it_is_named(tmp_path: Path) -> None:
    about = {"version": records.__version__, "overrides": ["seed=1"], "status": "completed"}
    (tmp_path / "run.json").write_text(json.dumps(about))
    run = records.RunRecord(OmegaConf.create({"seed": 2}), {}, ["seed=2", "sweep.resume=here"])
    with pytest.raises(ValueError, match="holds the run 'seed=1', where this sweep has 'seed=2'"):
        run.finished(tmp_path)


def test_an_unknown_swept_key_starts_nothing(place: Path) -> None:
    (place / "runs").mkdir(exist_ok=True)
    before = set((place / "runs").iterdir())
    code, _, err = one(str(place), ["-m", "centers.raduis=0.1,0.2", *SHORT])
    assert code == 1
    assert err == "staf: there is no setting `centers.raduis`; `staf --help` lists them.\n"
    assert set((place / "runs").iterdir()) == before


def test_a_batch_that_raises_is_retried_to_find_the_culprit(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from staf_torch.experiments import gradient_chase

    solve = gradient_chase.GradientChase.solve

    def touchy(self: Any, cfgs: Any, progress: Any) -> Any:
        if any(cfg.seed == 1 for cfg in cfgs):
            raise RuntimeError("the second seed is unlucky")
        return solve(self, cfgs, progress)

    monkeypatch.setattr(gradient_chase.GradientChase, "solve", touchy)
    monkeypatch.setenv("HYDRA_FULL_ERROR", "0")
    with pytest.raises(RuntimeError, match="unlucky"):  # a defect keeps its trace
        run_main(place, ["-m", "seed=range(3)", *SHORT, "hydra.sweep.dir=runs/culprit"])
    status = [record(place / f"runs/culprit/{num}")["status"] for num in range(3)]
    assert status == ["completed", "failed", "completed"]
    assert record(place / "runs/culprit/1")["reason"] == "RuntimeError: the second seed is unlucky"
    assert "Traceback" in (place / "runs/culprit/1/staf.log").read_text()


def run_main(place: Path, argv: list[str]) -> None:
    """The command, with exceptions that are no user's error as they are."""
    from staf_torch.cli.staf import main

    os.chdir(place)
    before = sys.argv
    sys.argv = ["staf", *argv]
    try:
        main()
    finally:
        sys.argv = before


def test_an_interrupted_sweep_says_how_to_resume(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    replay = launch.Launch._replay

    def impatient(self: launch.Launch, job: launch.Job, *rest: Any) -> Any:
        if job.num == 1:
            raise KeyboardInterrupt
        return replay(self, job, *rest)

    monkeypatch.setattr(launch.Launch, "_replay", impatient)
    directory, said = sweep(place, "interrupted", "seed=range(3)", *SHORT, code=130)
    assert "1 jobs are complete" in said
    assert said.endswith("staf -m sweep.resume=runs/interrupted\n")
    monkeypatch.undo()
    code, out, _ = one(str(place), ["-m", "sweep.resume=runs/interrupted"])
    assert code == 0
    assert "3 of 3 jobs completed" in out
    assert len(rows(directory)) == 3


def test_sweeps_of_the_same_moment_have_directories_of_their_own(tmp_path: Path) -> None:
    def begin(_: int) -> str:
        sweep = {"dir": str(tmp_path / "runs" / "now_sweep")}
        cfg = OmegaConf.create({"hydra": {"sweep": sweep, "overrides": {"hydra": []}}})
        claim(cfg)
        moved = [line.partition("=")[2] for line in cfg.hydra.overrides.hydra]
        assert moved in ([], [cfg.hydra.sweep.dir])
        return str(cfg.hydra.sweep.dir)

    with ThreadPoolExecutor(8) as pool:
        taken = list(pool.map(begin, range(8)))
    assert len(set(taken)) == 8
    assert {path.name for path in (tmp_path / "runs").iterdir()} == {Path(name).name for name in taken}


def test_an_objective_is_what_the_sweeper_is_told(place: Path) -> None:
    from staf_torch.sweeps.job import objective

    metrics = {"ball_error": 0.5, "settling_time": None}
    none, one_, two, wrong = (
        OmegaConf.create({"sweep": {"objective": named}})
        for named in (None, "ball_error", ["settling_time", "ball_error"], "speed")
    )
    assert objective(none, metrics) is metrics
    assert objective(one_, metrics) == 0.5
    assert objective(two, metrics) == (float("inf"), 0.5)
    with pytest.raises(ValueError, match=r"sweep\.objective.*must be one of 'ball_error'"):
        objective(wrong, metrics)


def test_the_plugin_imports_no_torch() -> None:
    program = (
        "import sys; sys.path.insert(0, 'staf_torch/plugins'); import hydra_plugins.staf_batched;"
        "assert not {'torch', 'staf_torch', 'numpy', 'matplotlib'} & set(sys.modules)"
    )
    root = Path(__file__).resolve().parents[2]
    subprocess.run([sys.executable, "-c", program], cwd=root, env=environment(), check=True)


def test_a_sweep_with_a_failure_is_told_to_be_over(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Hydra forgets its callbacks then, and the table is made by one."""
    told = []

    def note(self: SweepReport, config: Any, **_: Any) -> None:
        told.append(str(config.hydra.sweep.dir))

    monkeypatch.setattr(SweepReport, "on_multirun_end", note)
    sweep(place, "told", "centers.count=4", *SHORT, code=1)
    assert told == ["runs/told"]

"""A sweep that is taken up again: nothing that its folder says runs unasked, and no two settings mix."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from command_line import one

from staf_torch.results import build
from staf_torch.results.reader import collect
from staf_torch.results.run_directory import History
from staf_torch.sweeps.command import command_line, may_run_code
from staf_torch.tables import Layout, tabulate

SHORT = ["duration=0.05", "settle_time=0", "figures=false", "trajectories=2"]
OWN = ["-m", "--config-dir", "conf", "experiment=mine", "target=custom", "target.path=bowls.bowl"]
BOWL = """
import importlib
from bowl_helper import SCALE

FURTHER = importlib.import_module("_".join(["bowl", "extra"])).SCALE

def bowl(x):
    return SCALE * FURTHER * x.square().sum(-1)
"""


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with settings and modules of one's own, and a sweep over them of three jobs."""
    place = tmp_path_factory.mktemp("own")
    (place / "conf" / "experiment").mkdir(parents=True)
    (place / "conf" / "experiment" / "mine.yaml").write_text(
        "# @package _global_\ntask: gradient_chase\nspread: 0.5\n"
    )
    (place / "bowls.py").write_text(BOWL)
    for name in ("bowl_helper", "bowl_extra"):
        (place / f"{name}.py").write_text("SCALE = 1.0\n")
    code, _, err = one(str(place), [*OWN, "seed=0,1,2", *SHORT, "hydra.sweep.dir=sweep"])
    assert code == 0, err
    return place


@pytest.fixture
def place(whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of it, in which the last job is missing."""
    copy = Path(shutil.copytree(whole, tmp_path / "own", ignore=shutil.ignore_patterns("__pycache__")))
    shutil.rmtree(copy / "sweep" / "2")
    monkeypatch.chdir(tmp_path)  # comes back here from wherever the command goes
    for name in ("bowls", "bowl_helper", "bowl_extra"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    return copy


def resume(place: Path, *more: str) -> tuple[int, str, str]:
    return one(str(place), ["-m", "--config-dir", "conf", "sweep.resume=sweep", "--trust", *more])


def edit(path: Path, before: str, after: str) -> None:
    text = path.read_text()
    assert before in text
    path.write_text(text.replace(before, after))


CHANGED = {
    "files": ["spread was 0.5 and is now 2.5", "module bowls has changed", "module bowl_helper has changed"],
    "build": ["the source of staf_torch was 0", "torch was 0"],
}


@pytest.mark.parametrize("what", CHANGED)
def test_what_changed_between_start_and_resume_is_told(what: str, place: Path) -> None:
    if what == "files":
        edit(place / "conf/experiment/mine.yaml", "0.5", "2.5")
        edit(place / "bowls.py", "SCALE *", "2 * SCALE *")
        edit(place / "bowl_helper.py", "1.0", "3.0")
    else:
        path = place / "sweep" / "1" / "run.json"
        about = json.loads(path.read_text())
        about["build"] |= {"source": "0", "torch": "0"}
        path.write_text(json.dumps(about | {"checksum": build.record_checksum(about)}))
    code, _, err = resume(place)
    assert code == 1
    for said in (*CHANGED[what], "sweep.resume_anyway=true"):
        assert said in err
    assert not (place / "sweep" / "2").exists()


def test_what_is_mixed_all_the_same_stands_apart(place: Path) -> None:
    edit(place / "conf/experiment/mine.yaml", "0.5", "2.5")
    code, _, err = resume(place, "sweep.resume_anyway=true")
    assert code == 0, err
    found = collect(place / "sweep")
    assert found.unswept == ("spread",)
    assert any("`spread` differs between runs although nobody swept it: 0.5 in 2" in r for r in found.remarks)
    table = tabulate(found, Layout(rows=("target.path",), aggregates=("mean",), metrics=("ball_error",)))
    assert [(row.cells["spread"], row.cells["ball_error.n"]) for row in table.rows] == [(0.5, 2), (2.5, 1)]


def flip(path: Path) -> None:
    """One digit of a number becomes another."""
    text = path.read_text()
    at = next(n for n in range(len(text) // 2, len(text)) if text[n].isdigit())
    path.write_text(text[:at] + str((int(text[at]) + 1) % 10) + text[at + 1 :])


def cut(path: Path) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])


@pytest.mark.parametrize(
    "spoilt", [{"0/metrics.json": flip, "1/history.npz": cut}, {"1/run.json": flip}], ids=["result", "record"]
)
def test_a_damaged_file_is_named_and_made_again(
    spoilt: dict[str, Callable[[Path], None]], place: Path, whole: Path
) -> None:
    for file, spoil in spoilt.items():
        spoil(place / "sweep" / file)
        job, _, name = file.partition("/")
        (bad,) = (run for run in collect(place / "sweep").rows if run.directory.name == job)
        assert bad.metrics == {}
        assert f"{name} is damaged" in str(bad.reason)
    code, out, err = resume(place)
    assert code == 0, err
    for job, _, name in (file.partition("/") for file in spoilt):
        assert f"{name} is damaged" in out + err
        again, before = (History(folder / "sweep" / job / "history.npz") for folder in (place, whole))
        for key in before:
            np.testing.assert_array_equal(again[key], before[key])
    found, wanted = (collect(folder / "sweep").rows for folder in (place, whole))
    assert [run.metrics for run in found] == [run.metrics for run in wanted]


FOREIGN = [
    "hydra.callbacks.mine._target_=evil.Callback",
    "+hydra.callbacks.x={_target_: os.system}",
    "hydra.launcher.submitit.slurm_setup=['touch owned']",
    "hydra.job.env_set.LD_PRELOAD=evil.so",
    "hydra.searchpath=[file:///tmp/evil]",
    "hydra/job_logging=../../evil",
    "hydra.launcher.ray.address=evil:1",
    "hydra.sweep.subdir=../../x",
    "hydra.launcher.executor=${oc.env:HOME}",
    "hydra/launcher=evil",
    "task=os.abort",
    "task=str(os.abort)",
    "kernel=custom kernel.path=evil.Kernel",
    "kernel={_target_: torch.load, f: evil.pt}",
    "+target.x=${oc.env:SECRET}",
    "kernel=../../../tmp/evil",
    "kernel=/tmp/evil",
    "tracker=custom",
    "target.path=evil.x,evil.y",
    "+kernel@hydra.callbacks.x=evil",
]
HARMLESS = """kernel=gaussian,matern centers.radius=0.1,0.2 adp/policy=lqr seed=range(5) +new=1
sweep.records=table initial_state=[1.0,0.0] hydra.launcher.executor=process hydra/sweeper=optuna
+hydra.launcher.submitit.timeout_min=10 centers.radius=interval(0.1,0.2)"""


@pytest.mark.parametrize("line", FOREIGN)
def test_a_line_of_somebody_else_is_shown_and_not_run(line: str, tmp_path: Path) -> None:
    jobs = [] if line.lstrip("+").startswith("hydra") else line.split(" ", line.count("custom "))
    hydra = [] if jobs else [line]
    record = {"version": build.__version__, "overrides": ["seed=0", *jobs], "hydra": hydra, "jobs": []}
    (tmp_path / "sweep.json").write_text(json.dumps(record))
    with pytest.raises(ValueError, match="may run code of whoever started it") as refused:
        command_line(["-m", f"sweep.resume={tmp_path}"])
    assert line.split()[-1] in str(refused.value)
    assert {*jobs, *hydra} <= set(command_line(["-m", f"sweep.resume={tmp_path}", "--trust"]))
    assert command_line(["-m", f"sweep.resume={tmp_path}", "seed=0", *jobs, *hydra])  # repeated: known


def test_a_plain_line_is_taken_over_without_a_question() -> None:
    assert [line for line in HARMLESS.split() if may_run_code(line)] == []


@pytest.mark.parametrize("name", ["1/staf.log", "2", ".lock", "table.md"])
def test_a_planted_link_is_not_written_through(name: str, place: Path, tmp_path: Path) -> None:
    victim = tmp_path / "victim"
    folder = name == "2"
    victim.mkdir() if folder else victim.write_text("mine")
    planted = place / "sweep" / name
    planted.unlink(missing_ok=True)
    planted.hardlink_to(victim) if name == "table.md" else planted.symlink_to(victim)
    code, _, err = resume(place)
    assert code == 1
    assert ("hard link" if name == "table.md" else "link") in err
    assert list(victim.iterdir()) == [] if folder else victim.read_text() == "mine"

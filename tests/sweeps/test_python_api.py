"""`staf_torch.run` and `staf_torch.sweep`: what the command does, in a process that goes on."""

from __future__ import annotations

import gc
import json
import logging
import operator
import os
import random
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import ROOT, Outcome, run_all
from composing import HYDRA
from hydra import compose, initialize_config_dir, version
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from matplotlib.figure import Figure

import staf_torch
from staf_torch import lanes
from staf_torch.results.files import write_metrics
from staf_torch.sweeps.hydra_compat.inside import HAS_WHITELIST
from staf_torch.sweeps.lock import DirectoryLock

SHORT = ("duration=0.1", "settle_time=0.05")
notebook = operator.methodcaller("_repr_html_")
BARE = (*SHORT, "figures=false", "history=false")
SWEPT = ("kernel=gaussian,matern", *BARE)


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def _untouched() -> Iterator[None]:
    """Compare all that a process shares before and after a test."""

    def state() -> list[object]:
        root = logging.getLogger()
        hydra = [GlobalHydra.instance(), HydraConfig.instance().cfg, version.getbase()]
        environment = {name: value for name, value in os.environ.items() if name != "PYTEST_CURRENT_TEST"}
        return [
            *(environment, sys.path[:], sys.argv[:], os.getcwd(), hydra, root.handlers[:], root.level),
            *(random.getstate(), torch.get_rng_state().tolist(), np.random.get_state()[1].tolist()),  # noqa: NPY002
            *(torch.get_num_threads(), torch.get_default_dtype(), gc.get_threshold()),
            *(sys.stdout, sys.stderr),
        ]

    if not HAS_WHITELIST:
        version.base_at_least("1.1")  # Hydra 1.3 notes one itself where nobody has named one
    before = state()
    yield
    assert state() == before


@pytest.fixture(scope="module")
def commands(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Outcome]:
    """The command itself, in a process of its own, which compiles as little as these tests."""
    jobs = {
        "run": [*SHORT, "centers.radius=0.2", "hydra.run.dir=two"],
        "sweep": ["-m", *SWEPT, "hydra.sweep.dir=two"],
    }
    with lanes.compiling("never"):
        return run_all(jobs, tmp_path_factory.mktemp("commands"))


@pytest.mark.usefixtures("_untouched")
def test_a_run_leaves_what_the_command_leaves(
    capsys: pytest.CaptureFixture[str], commands: dict[str, Outcome]
) -> None:
    found = staf_torch.run(*SHORT, "centers.radius=0.2", directory="one")
    assert capsys.readouterr().out == ""
    assert (commands["run"].code, commands["run"].err) == (0, "")
    two = commands["run"].folder / "two"
    for name in ("metrics.json", ".hydra/config.yaml", "figures/gradient_chase.png"):
        assert Path("one", name).read_bytes() == (two / name).read_bytes(), name
    assert {path.name for path in Path("one").iterdir()} == {path.name for path in two.iterdir()}
    assert "Gradient chase" in Path("one/staf.log").read_text()
    assert found.metrics == json.loads(Path("one/metrics.json").read_text())
    assert found.settings["centers.radius"] == 0.2
    assert found.history["state"].shape == (1, 11, 2)
    with np.load(two / "history.npz") as other:
        assert sorted(found.history) == sorted(other)
        assert all(np.array_equal(array, other[name]) for name, array in found.history.items())
    (figure,) = found.figures().values()
    assert isinstance(figure, Figure)
    assert len(repr(found)) < 120
    shown = notebook(found)
    assert "data:image/png;base64," in shown
    assert "<th>ball_error</th>" in shown


@pytest.mark.usefixtures("_untouched")
def test_a_sweep_is_that_of_the_command_and_shows_nothing(
    capsys: pytest.CaptureFixture[str], commands: dict[str, Outcome]
) -> None:
    found = staf_torch.sweep(*SWEPT, directory="one")
    assert capsys.readouterr().out == ""
    assert commands["sweep"].code == 0, commands["sweep"]
    two = commands["sweep"].folder / "two"
    assert Path("one/table.csv").read_bytes() == (two / "table.csv").read_bytes()
    assert {path.name for path in Path("one").iterdir()} == {path.name for path in two.iterdir()}
    assert repr(found) == "<Runs 2 completed, over kernel>"
    best = found.best("ball_error")
    assert best.metrics["ball_error"] == min(run.metrics["ball_error"] for run in found)
    assert len(staf_torch.read_runs(two)) == 2
    assert list(best.figures()) == ["gradient_chase"]  # the run drew none: drawn anew
    assert not (best.directory / "figures").exists()


@pytest.mark.usefixtures("_untouched")
@pytest.mark.parametrize(
    ("lines", "words"),
    [
        (["centers.radius=-1"], "must be positive; got -1"),
        (["kernel=gauss"], "there is no `kernel/gauss`; there are anchored"),
        (["centers.radius=0.1,0.2"], "a list is a sweep"),
        (["experiment=ablation"], "call `staf_torch.sweep`"),
    ],
)
def test_what_a_user_got_wrong_is_a_value_error(lines: list[str], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        staf_torch.run(*BARE, *lines)
    assert not list(Path("runs").glob("*"))


@pytest.mark.usefixtures("_untouched")
def test_a_failed_job_is_a_row_with_its_reason_and_resume_tries_it_again() -> None:
    found = staf_torch.sweep("centers.count=6,7", *BARE, directory="sweep")
    assert [run.status for run in found] == ["completed", "failed"]
    assert "must be one of 3, 6, 10" in found[1].reason
    assert repr(found) == "<Runs 1 completed, 1 failed, over centers.count>"
    again = staf_torch.sweep("sweep.resume=sweep")
    assert [run.metrics for run in again] == [run.metrics for run in found]
    with pytest.raises(ValueError, match="must have the overrides of that sweep"):
        staf_torch.sweep("sweep.resume=sweep", "seed=3")


def interrupted(cfg: object, directory: Path, progress: object = None) -> dict[str, float]:
    """An experiment during which somebody presses Ctrl-C at the second seed."""
    if cfg.seed == 1:
        raise KeyboardInterrupt
    write_metrics(directory / "metrics.json", {"answer": 42.0})
    return {"answer": 42.0}


@pytest.mark.usefixtures("_untouched")
def test_ctrl_c_leaves_a_sweep_that_can_be_resumed_and_a_process_as_it_was() -> None:
    with pytest.raises(KeyboardInterrupt, match=r"1 of \d+ jobs are complete.*\n.*sweep.resume=sweep"):
        staf_torch.sweep("task=test_python_api.interrupted", "seed=0,1,2", directory="sweep")
    assert [run.status for run in staf_torch.read_runs("sweep")] == ["completed", "failed"]
    with pytest.raises(KeyboardInterrupt):
        staf_torch.run("task=test_python_api.interrupted", "seed=1", directory="one")
    assert json.loads(Path("one/run.json").read_text())["reason"] == "interrupted"


@pytest.mark.usefixtures("_untouched")
def test_a_run_has_its_directory_to_itself_and_replaces_no_other_command() -> None:
    first = staf_torch.run(*BARE, "seed=1", directory="one").metrics
    assert staf_torch.run("seed=1", *BARE, directory="one").metrics == first  # a manual's line, typed again
    assert "replaces the run of the same command line in one" in Path("one/staf.log").read_text()
    before = {path: path.read_bytes() for path in Path("one").rglob("*") if path.is_file()}
    with pytest.raises(
        ValueError, match=r"one holds the run 'seed=1 .*', which this run would .*`hydra.run.dir`"
    ):
        staf_torch.run(*BARE, "seed=2", directory="one")
    other = DirectoryLock(Path("one"), "run")
    with pytest.raises(
        ValueError, match=rf"belongs to a run that goes on: process {os.getpid()} .*`hydra.run.dir`"
    ):
        staf_torch.run(*BARE, "seed=1", directory="one")
    other.release()
    assert {path: path.read_bytes() for path in Path("one").rglob("*") if path.is_file()} == before
    with pytest.raises(ValueError, match="tracker"):
        staf_torch.run(*BARE, "tracker=custom", "tracker.path=torch.nn.Linear", directory="three")
    assert not Path("three").exists()


def test_runs_inside_another_hydra_application_and_leaves_it_alone() -> None:
    with initialize_config_dir(str(ROOT / "conf"), **HYDRA):
        before = GlobalHydra.instance()
        found = staf_torch.run(*BARE)
        assert GlobalHydra.instance() is before
        assert compose("config").dt == 0.01
    assert found.status == "completed"


def test_log_handlers_of_the_process_go_on(tmp_path: Path) -> None:
    handler = logging.FileHandler(tmp_path / "mine.log", mode="w")
    logging.getLogger().addHandler(handler)
    try:
        logging.getLogger().error("before")
        staf_torch.run(*BARE)
        logging.getLogger().error("after")
    finally:
        logging.getLogger().removeHandler(handler)
        handler.close()
    assert (tmp_path / "mine.log").read_text() == "before\nafter\n"


def test_a_data_frame_over_kernel_radius_and_count_in_three_lines() -> None:
    pandas = pytest.importorskip("pandas")
    from staf_torch import sweep

    runs = sweep("kernel=gaussian,matern", "centers.count=3,7", *BARE)
    frame = runs.pivot("kernel", ["centers.count"], "ball_error")
    assert isinstance(frame, pandas.DataFrame)
    assert frame.loc["matern", 3] == runs[2].metrics["ball_error"]
    assert frame[7].isna().all().all()  # a layout that there is not
    with pytest.raises(ValueError, match=r"`Runs.best\(metric=...\)` must be one of ; got"):
        runs.filter("centers.count=7").best("ball_error")


def test_memory_is_flat_over_sweeps() -> None:
    counts = []
    for _ in range(3):
        staf_torch.sweep("seed=0,1", *BARE)
        gc.collect()
        counts.append(len(gc.get_objects()))
    assert counts[2] < 1.01 * counts[1] + 100  # Python 3.13 names its youngest objects alone

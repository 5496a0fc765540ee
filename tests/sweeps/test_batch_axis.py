"""The setting `members`: a sweep inside one job."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from composing import compose
from hydra.errors import HydraException

from staf_torch.experiments.registry import Metrics, experiment
from staf_torch.results.progress import Progress
from staf_torch.sweeps import members
from staf_torch.sweeps.batching import sentence
from staf_torch.sweeps.hydra_compat import Composer, config_loader
from staf_torch.sweeps.member_rows import Left

SHORT = ["dt=0.05", "duration=1.0", "settle_time=0.5", "figures=false"]


def run(
    directory: Path, lines: object, *base: str, progress: Progress | None = None
) -> tuple[Metrics, list[dict[str, Any]]]:
    (cfg,) = compose([*SHORT, *base], [[]])
    cfg.members = lines
    start = members.Start("", Left([]))
    metrics = members.run(cfg, directory, [*SHORT, *base], "config", start, progress or Progress())
    record = json.loads((directory / "members.json").read_text())
    assert json.loads((directory / "metrics.json").read_text()) == metrics
    return metrics, record["members"]


def test_members_are_the_rows_of_the_same_sweep(tmp_path: Path) -> None:
    lines = ["kernel=gaussian,matern", "centers.radius=0.1,0.2", "seed=range(2)", "trajectories=2"]
    told: list[float] = []
    metrics, rows = run(tmp_path, lines, "optimizer.inner_steps=2", "dt=0.1", progress=Progress(told.append))
    assert told == [0.0, *(each / 8 for each in range(1, 9))]
    assert metrics == {"members": 8, "failed": 0, "diverged": 0}
    assert rows[1]["overrides"] == ["kernel=gaussian", "centers.radius=0.1", "seed=1", "trajectories=2"]
    composer = Composer(config_loader(), hydra_node=False)
    for number, row in enumerate(rows):
        assert (row["num"], row["status"], row["reason"]) == (number, "completed", None)
        directory = tmp_path / f"alone{number}"
        directory.mkdir()
        cfg = composer([*SHORT, "optimizer.inner_steps=2", "dt=0.1", "history=false", *row["overrides"]])
        alone = experiment(cfg.task)(cfg, directory, Progress())
        assert row["metrics"] == pytest.approx(alone, rel=1e-9, abs=1e-12)
    assert {path.name for path in tmp_path.iterdir() if path.is_file()} == {"members.json", "metrics.json"}


def test_failed_and_diverged_members_are_counted_and_named(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    lines = ["centers.radius=0.1,-1", "initial_state=[1.0,0.0],[90.0,90.0]"]
    metrics, rows = run(tmp_path, lines, "system=van_der_pol", "dt=0.2", "duration=20")
    assert metrics == {"members": 4, "failed": 2, "diverged": 1}
    assert [row["status"] for row in rows] == ["completed", "completed", "failed", "failed"]
    assert rows[2]["reason"] == "`ConstantRadius(radius=...)` must be positive; got -1."
    assert rows[2]["metrics"] == {}
    assert rows[1]["metrics"]["ultimate_error"] is None
    assert "member 2 (centers.radius=-1 initial_state=[1.0,0.0])" in caplog.text
    assert "| centers.radius=0.1 initial_state=[1.0,0.0]" in caplog.text


def test_many_members_end_as_the_spread_of_each_metric(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    run(tmp_path, "seed=range(21)", "trajectories=2", "duration=0.6")
    assert "| metric " in caplog.text
    assert "| ball_error " in caplog.text


def test_members_keep_a_history_only_where_it_is_asked_for(tmp_path: Path) -> None:
    run(tmp_path, ["seed=1,2"], "history=true")
    assert sorted(str(p.relative_to(tmp_path)) for p in tmp_path.rglob("history.npz")) == [
        "members/0/history.npz",
        "members/1/history.npz",
    ]


def test_experiments_without_batches_run_one_by_one(tmp_path: Path) -> None:
    metrics, rows = run(
        tmp_path, ["centers.radius=0.1,0.2"], "experiment=layouts", "layouts.radii=[0.1]", "layouts.states=2"
    )
    assert metrics["failed"] == 0
    assert all(row["metrics"] for row in rows)
    assert (tmp_path / "members" / "1" / "metrics.json").is_file()


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ([], "`staf members=...` must be a list of overrides"),
        (3, "`staf members=...` must be a list of overrides"),
        ([1, 2], "`staf members=...` must be a list of overrides"),
        (["hydra.job.name=a"], "must be about the experiment alone"),
        (["members='seed=1'"], "must be about the experiment alone"),
        (["centers.raduis=0.1,0.2"], "there is no setting `centers.raduis`"),
        (["kernle=gaussian"], "there is no setting `kernle`"),
        (["seed=range(1"], "must be overrides in Hydra's grammar"),
        (["seed=interval(0,1)"], "does not support sweep type"),
    ],
)
def test_what_cannot_be_swept_is_refused_in_a_sentence(tmp_path: Path, lines: object, words: str) -> None:
    with pytest.raises((ValueError, HydraException)) as error:
        run(tmp_path, lines)
    assert words in sentence(error.value)
    assert list(tmp_path.iterdir()) == []

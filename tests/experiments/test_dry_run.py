"""`device=meta`: a dry run says what a run would keep, computes nothing, and refuses where numbers decide."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from composing import settings
from helpers_experiments import run, words

import staf_torch
from staf_torch.experiments.registry import experiment
from staf_torch.experiments.study import experiment_of


def dry(folder: Path, *overrides: str) -> dict[str, tuple[str, str]]:
    """The rows of a dry run's table, which is all that it writes beside their sum: shapes and kinds."""
    cfg = settings(*overrides, "device=meta")
    folder.mkdir(exist_ok=True)
    metrics = experiment_of(cfg)(cfg, folder)
    assert {path.name for path in folder.iterdir()} == {"metrics.json", "dry_run.md", "dry_run.csv"}
    assert json.loads((folder / "metrics.json").read_text()) == metrics
    with (folder / "dry_run.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert metrics == {"history_bytes": sum(float(row["bytes"]) for row in rows)}
    return {row["history"]: (row["shape"], row["dtype"]) for row in rows}


def form(x: Any) -> tuple[str, str]:
    return " x ".join(map(str, x.shape)), str(x.dtype).removeprefix("torch.")


@pytest.mark.parametrize("name", ["gradient_chase", "adp"])
def test_a_dry_run_has_the_shapes_of_the_history_that_a_run_writes(name: str, tmp_path: Path) -> None:
    line = (*words(name), "dtype=float32")
    rows = dry(tmp_path / "dry", *line)
    run(tmp_path, *line, "figures=false")
    with np.load(tmp_path / "history.npz") as written:
        assert rows == {key: form(array) for key, array in written.items() if key != "time"}


@pytest.mark.parametrize("name", ["icl", "laws"])
def test_a_dry_run_has_the_shapes_that_the_loops_of_a_study_have_on_the_cpu(
    name: str, tmp_path: Path
) -> None:
    cfg = settings(*words(name))
    study: Any = experiment(cfg.task)
    with torch.no_grad():
        assert dry(tmp_path, *words(name)) == {key: form(x) for key, x in study.held(cfg).items()}


@pytest.mark.parametrize("name", ["exponential_bound", "flat_limit", "rivals"])
def test_an_experiment_in_which_numbers_decide_refuses_before_it_writes(name: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=f"must not be meta for the task {name}, in which numbers decide"):
        staf_torch.run(f"experiment={name}", "device=meta", directory=tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_plant_that_looks_at_numbers_refuses_with_the_line_of_code(tmp_path: Path) -> None:
    cfg = settings("system=custom", f"system.path={__name__}.Branching", "device=meta")
    with pytest.raises(ValueError, match=r"numbers, which decide at .*: return x if x\.sum"):
        experiment_of(cfg)(cfg, tmp_path)
    assert not list(tmp_path.iterdir())


class Branching(staf_torch.systems.VanDerPol):
    def drift(self, x: torch.Tensor) -> torch.Tensor:
        return x if x.sum() > 9 else super().drift(x)


def test_a_million_rows_are_a_dry_run_of_a_second_and_a_sweep_counts_bytes(tmp_path: Path) -> None:
    done = staf_torch.run("device=meta", "trajectories=1000000", directory=tmp_path / "run")
    assert done.metrics == {"history_bytes": 8.0 * 10**6 * 1129 * 11}
    runs = staf_torch.sweep("device=meta", "trajectories=1,1000", directory=tmp_path / "sweep")
    assert [each.metrics["history_bytes"] for each in runs] == [8.0 * 1129 * 11, 8.0 * 1000 * 1129 * 11]
    assert dry(tmp_path / "none", "history=false", "trajectories=1000000") == {}

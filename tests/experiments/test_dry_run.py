"""`device=meta`: a dry run says what a run would keep, computes nothing, and refuses where numbers decide."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from composing import settings
from helpers_experiments import CASES, run, words

import staf_torch
from staf_torch.experiments.dry_run import experiment_of
from staf_torch.experiments.registry import experiment

SHAPES = ("gradient_chase", "adp", "laws", "memory")
"""Whose shapes are compared with those of a run."""

WITHOUT = ("exponential_bound", "feasibility", "flat_limit", "layouts", "learn_kernel", "rivals")
"""In which numbers decide all that happens."""
SAME = ("adp_comparison", "avoidance of a unicycle", "faults from the start")
"""Whose loops are made as another's."""
FASTER = {"safe_box": ["safe_box.filter=false"]}  # torch is slow to infer the shapes of its filters


def dry(folder: Path, *overrides: str) -> list[dict[str, str]]:
    """The rows of a dry run's table, which is all that it writes beside their sum."""
    cfg = settings(*overrides, "device=meta")
    metrics = experiment_of(cfg)(cfg, folder)
    assert {path.name for path in folder.iterdir()} == {"metrics.json", "dry_run.md", "dry_run.csv"}
    assert json.loads((folder / "metrics.json").read_text()) == metrics
    with (folder / "dry_run.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert metrics == {"history_bytes": sum(float(row["bytes"]) for row in rows)}
    return rows


def form(x: Any) -> tuple[str, str]:
    return " x ".join(map(str, x.shape)), str(x.dtype).removeprefix("torch.")


@pytest.mark.parametrize("name", [name for name in CASES if name not in (*WITHOUT, *SHAPES, *SAME)])
def test_every_experiment_says_what_a_run_would_keep(name: str, tmp_path: Path) -> None:
    rows = dry(tmp_path, *words(name), *FASTER.get(name, []), "dtype=float32")
    cfg = settings(*words(name))
    assert rows
    for row in rows:
        shape = [int(size) for size in row["shape"].split(" x ")]
        assert (row["dtype"], int(row["bytes"])) == ("float32", 4 * math.prod(shape))
        assert shape[0] >= cfg.trajectories
        assert shape[1] > 1


@pytest.mark.parametrize("name", SHAPES[:2])
def test_a_dry_run_has_the_shapes_of_the_history_that_a_run_writes(name: str, tmp_path: Path) -> None:
    (tmp_path / "dry").mkdir()
    rows = dry(tmp_path / "dry", *words(name))
    run(tmp_path, *words(name), "figures=false")
    with np.load(tmp_path / "history.npz") as written:
        wanted = {key: form(array) for key, array in written.items() if key != "time"}
    assert {row["history"]: (row["shape"], row["dtype"]) for row in rows} == wanted


@pytest.mark.parametrize("name", SHAPES[2:])
def test_a_dry_run_has_the_shapes_that_loops_have_on_the_cpu(name: str, tmp_path: Path) -> None:
    rows, cfg = dry(tmp_path, *words(name)), settings(*words(name))
    study: Any = experiment(cfg.task)
    with torch.no_grad():
        wanted = {key: form(x) for key, x in study.held(cfg).items()}
    assert {row["history"]: (row["shape"], row["dtype"]) for row in rows} == wanted


@pytest.mark.parametrize("name", WITHOUT)
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
    assert not (tmp_path / "run" / "history.npz").exists()
    runs = staf_torch.sweep("device=meta", "trajectories=1,1000", directory=tmp_path / "sweep")
    assert [each.metrics["history_bytes"] for each in runs] == [8.0 * 1129 * 11, 8.0 * 1000 * 1129 * 11]


def test_no_history_is_none_to_count(tmp_path: Path) -> None:
    assert dry(tmp_path, "history=false", "trajectories=1000000") == []

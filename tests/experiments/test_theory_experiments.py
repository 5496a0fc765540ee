"""The experiments on the theorems, run small through their own settings."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import composing
import pytest
import torch
from experiments.test_reference_metrics import CASES, RECORDED
from omegaconf import DictConfig

from staf_torch.experiments import exponential_bound, feasibility, layouts
from staf_torch.experiments.registry import EXPERIMENTS

MODULES = {"exponential_bound": exponential_bound, "feasibility": feasibility, "layouts": layouts}
SMALL = {
    "exponential_bound": ["exponential_bound.states=9", "exponential_bound.radii=[0.1]"],
    "feasibility": ["feasibility.states=16", "feasibility.radii=[0.1]", "feasibility.epsilons=[0.1,0.01]"],
    "layouts": ["layouts.states=4", "layouts.radii=[0.1,0.2]"],
}


def settings(name: str, *overrides: str) -> DictConfig:
    return composing.settings(f"experiment={name}", *SMALL[name], *overrides)


def run(name: str, directory: Path, *overrides: str) -> dict[str, float | None]:
    metrics: dict[str, float | None] = MODULES[name].run(settings(name, *overrides), directory)
    assert json.loads((directory / "metrics.json").read_text()) == metrics
    return metrics


def leaves_its_tables(name: str, directory: Path, *overrides: str) -> None:
    """Run without figures: those are looked at by `test_reference_metrics.py`."""
    assert name in EXPERIMENTS
    metrics = run(name, directory, "figures=false", *overrides)
    assert any(value is not None for value in metrics.values())
    rows = list(csv.DictReader((directory / f"{name}.csv").read_text().splitlines()))
    assert len((directory / f"{name}.md").read_text().splitlines()) >= 3
    assert len(rows) >= 2
    assert not (directory / "figures").exists()


def test_experiments_report_the_reference_numbers() -> None:
    """What `test_reference_metrics.py` finds again, of the same small settings."""
    for name, lines in SMALL.items():
        assert CASES[name].split() == [f"experiment={name}", *lines]
    recorded = json.loads(RECORDED.read_text())
    bound, counts, found = (recorded[name] for name in ("exponential_bound", "feasibility", "layouts"))
    names = ("N", "S", "count", "one_polynomial_count", "measured_count")
    assert [bound[f"r0.1.eps0.001.{name}"] for name in names] == [3, 2, 21, 10, 10]
    assert counts == {"r0.1.eps0.1.count": 3, "r0.1.eps0.01.count": 6}
    for count, order in ((3, 2), (6, 3), (10, 4)):
        assert found[f"rings{count}.slope"] == pytest.approx(order, abs=0.15)
    assert found["polygon15.slope"] == pytest.approx(2, abs=0.1)


def test_the_bound_leaves_its_tables(tmp_path: Path) -> None:
    lines = ("exponential_bound.epsilons=[0.1,0.2]", "exponential_bound.states=5")
    leaves_its_tables("exponential_bound", tmp_path, *lines)


PLANE = "kernel=gaussian dtype=float32 centers.radius=0.2"
SPACE = (
    "target=quadratic system=linear system.matrix=[[-1,0,0],[0,-1,0],[0,0,-2]] "
    "initial_state=[1,0.5,0.2] centers=ball"
)


@pytest.mark.parametrize("overrides", [PLANE.split(), SPACE.split()], ids=["plane", "space"])
@pytest.mark.parametrize("name", ["feasibility", "layouts"])
def test_common_settings_hold(name: str, overrides: list[str], tmp_path: Path) -> None:
    fewer = {"feasibility": "feasibility.states=9", "layouts": "layouts.states=2"}[name]
    leaves_its_tables(name, tmp_path, fewer, *overrides)


@pytest.mark.parametrize(
    ("name", "override", "message"),
    [
        ("exponential_bound", "kernel=gaussian", "must be exponential"),
        ("exponential_bound", "exponential_bound.radii=[]", "list of numbers"),
        ("exponential_bound", "exponential_bound.epsilons=[0]", "must be positive"),
        ("feasibility", "feasibility.states=0", r"feasibility\.states.*at least 1"),
        ("feasibility", "feasibility.radii=0.1", "list of numbers"),
        ("layouts", "layouts.radii=[a]", "must be a number"),
        ("layouts", "centers.shrink.offset=0.1", "constant radius"),
    ],
)
def test_bad_settings_are_named(name: str, override: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=message):
        run(name, tmp_path, override)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("count", [5, 9])
def test_the_bound_is_of_as_many_states_as_are_stated(count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []
    bound = exponential_bound.theory.layout_errors

    def layout_errors(target: object, kernel: object, domain: torch.Tensor, *rest: object) -> torch.Tensor:
        seen.append(len(domain))
        return bound(target, kernel, domain, *rest)

    monkeypatch.setattr(exponential_bound.theory, "layout_errors", layout_errors)
    lines = ("exponential_bound.epsilons=[0.1]", f"exponential_bound.states={count}")
    exponential_bound.solve(settings("exponential_bound", *lines))
    assert seen == [len(exponential_bound.theory.disc(1.0, count=count))]


def test_the_bound_holds_in_space_too() -> None:
    lines = ("exponential_bound.epsilons=[0.1]", "exponential_bound.states=5", "centers.radius=0.05")
    row, *_ = exponential_bound.solve(settings("exponential_bound", *lines, *SPACE.split())).values()
    assert row["measured_count"] <= row["one_polynomial_count"] <= row["count"]


def test_where_no_layout_is_good_enough_none_is_needed_by_name() -> None:
    good = torch.tensor([[False, True, True], [False, False, False], [True, False, True]])
    assert feasibility._first(good, torch.tensor([3, 6, 10])).tolist() == [6, 0, 3]


def test_a_bound_that_no_degree_reaches_has_a_row_without_numbers() -> None:
    cfg = settings("exponential_bound", "exponential_bound.epsilons=[1e-6]", "exponential_bound.max_degree=1")
    (row,) = exponential_bound.solve(cfg).values()
    assert list(row) == ["N", "S", "count", "m", "error", *list(row)[5:]]
    assert {"degree", "one_polynomial_count", "one_polynomial_m", "one_polynomial_error"} <= row.keys()
    assert row["N"] is row["degree"] is None

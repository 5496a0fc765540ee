"""`staf experiment=laws`, its table and the options of the laws on the command line."""

from __future__ import annotations

import csv
import io
import json
import os
from pathlib import Path

import pytest
import torch
from composing import settings
from hydra.errors import HydraException
from variants import LAWS

from staf_torch import optim, predictors
from staf_torch.cli.staf import config_directory
from staf_torch.experiments import chase_batch, gradient_chase, laws
from staf_torch.experiments.laws import cases
from staf_torch.experiments.registry import log_slope
from staf_torch.metrics.ball_error import StateErrorPass
from staf_torch.settings.chase import chase_problem


def options(group: str) -> list[str]:
    """The library's own; `custom` has its test in tests/cli."""
    found = (path.stem for path in Path(config_directory(), group).glob("*.yaml"))
    return sorted(name for name in found if name != "custom")


def test_the_comparison_fills_its_run_directory(tmp_path: Path) -> None:
    short = (
        "dt=0.1",
        "duration=1.0",
        "settle_time=0.5",
        "laws.steps=[0.1,0.05]",
        "laws.work=4",
        "figures=false",
    )
    metrics = laws.run(settings("experiment=laws", *short), tmp_path)
    found = {os.path.relpath(path, tmp_path) for path in tmp_path.rglob("*") if path.is_file()}
    assert found == {"laws.md", "laws.csv", "laws.json", "metrics.json"}
    rows = json.loads((tmp_path / "laws.json").read_text())
    assert len(rows) == len(cases(4, 3)) == len({row["key"] for row in rows})
    assert {row["predictor"] for row in rows} == {"none", "secant", "tangent order 1", "tangent order 2"}
    read = list(csv.DictReader(io.StringIO((tmp_path / "laws.csv").read_text())))
    assert [float(row["ultimate_excess"]) for row in read] == [row["ultimate_excess"] for row in rows]
    assert json.loads((tmp_path / "metrics.json").read_text()) == metrics
    assert metrics["exact_x1.slope"] == pytest.approx(2, abs=0.3)
    assert metrics["a_priori.paper_step"] is not None
    violated = [value for name, value in metrics.items() if name.endswith("certificate_violations")]
    assert set(violated) == {0.0}


def test_the_comparison_has_every_law() -> None:
    assert {type(law) for law in LAWS.values()} == {type(case.law) for case in cases(11, 3)}
    dear = [case.name for case in cases(11, 3) if case.products > 11]
    assert dear == ["recursive least squares"]
    assert len({case.key for case in cases(11, 2)}) == len(cases(11, 2))


def test_steps_longer_than_the_run_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"`staf laws.steps=..."):
        laws.run(settings("experiment=laws", "duration=1.0", "laws.steps=[2.0,1.0]"), tmp_path)


@pytest.mark.parametrize("name", options("optimizer"))
def test_every_law_is_an_option_with_its_iterations(name: str) -> None:
    problem = chase_problem(settings(f"optimizer={name}", "optimizer.inner_steps=3"))
    assert isinstance(problem.law, optim.UpdateLaw)
    assert problem.inner_steps == 3


def test_there_is_an_option_for_every_law() -> None:
    made = {type(chase_problem(settings(f"optimizer={name}")).law) for name in options("optimizer")}
    assert made == {type(law) for law in LAWS.values()}


def test_every_predictor_is_an_option() -> None:
    made = {name: chase_problem(settings(f"predictor={name}")).predictor for name in options("predictor")}
    assert made.pop("none") is None
    assert {name: type(value) for name, value in made.items()} == {
        "secant": predictors.Secant,
        "tangent": predictors.Tangent,
    }
    with pytest.raises(HydraException):
        settings("predictor=oracle")


def test_a_certified_chase_counts_its_violations() -> None:
    short = ("dt=0.05", "duration=2.0", "settle_time=1.0", "predictor=tangent", "optimizer.inner_steps=1")
    metrics = gradient_chase.solve(chase_problem(settings("certificate=true", *short))).metrics
    assert metrics["certificate_violations"] == 0
    assert "certificate_violations" not in gradient_chase.solve(chase_problem(settings(*short))).metrics


def test_single_precision_runs_every_law(tmp_path: Path) -> None:
    short = ("dtype=float32", "dt=0.1", "duration=1.0", "settle_time=0.5", "laws.work=2", "figures=false")
    metrics = laws.run(settings("experiment=laws", "laws.steps=[0.2,0.1]", *short), tmp_path)
    assert all(value == 0 for name, value in metrics.items() if name.endswith("diverged_fraction"))
    assert torch.get_default_dtype() == torch.float32


@pytest.mark.parametrize(("rows", "times", "problems"), [(4, 10, 2), (3, 7, 3), (1, 5, 1), (2, 100, 5)])
def test_progress_is_told_in_times_of_whole_problems_and_ends_with_all(
    rows: int, times: int, problems: int
) -> None:
    told: list[int] = []
    progress = chase_batch._Told(told.append, rows, times, problems)
    for done in range(1, rows * times + 1):
        progress.more(1)
        assert sum(told) == times * problems * done // (rows * times)
    assert min(told) > 0
    chase_batch._Told(None, rows, times, problems).more(1)


def test_errors_along_the_same_states_are_found_by_the_pass_that_is_given() -> None:
    problem = chase_problem(settings("dt=0.05", "duration=0.5", "settle_time=0.2"))
    asked = []

    class Heard(StateErrorPass):
        def __call__(self, *given):  # type: ignore[no-untyped-def]
            asked.append(given[0].shape)
            return super().__call__(*given)

    heard = Heard(problem.basis, problem.target)
    chase_batch.simulate([problem], [None], [False], errors=heard)
    assert asked


def test_a_slope_is_of_the_points_that_are_known_and_above_the_floor() -> None:
    x = [0.1, 0.2, 0.4, 0.8, 1.6]
    cubes: list[float | None] = [2 * step**3 for step in x]
    assert log_slope(x, cubes) == pytest.approx(3.0)
    assert log_slope(x, [None, *cubes[1:3], 0.0, None]) == pytest.approx(3.0)
    assert log_slope(x, [1.0, *cubes[1:]], above=1e9) is None
    assert log_slope(x, [1e-3, *cubes[1:]], above=2e-3) == pytest.approx(3.0)  # of what is above alone
    assert log_slope(x, [None, None, None, None, 1.0]) is None

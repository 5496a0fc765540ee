"""Gradient chases alone and in batches, their laws side by side, and the memory beyond the ball."""

from __future__ import annotations

import dataclasses
import json
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from composing import settings
from helpers_experiments import ran, run
from hydra.utils import instantiate
from omegaconf import OmegaConf
from variants import LAWS

from staf_torch import predictors
from staf_torch.experiments import chase_batch, laws
from staf_torch.experiments.gradient_chase import ChaseSolution, GradientChase
from staf_torch.settings import config_directory
from staf_torch.settings.chase import ChaseProblem, chase_problem
from staf_torch.signs import Progress
from staf_torch.systems import trajectory

SHORT = ("dt=0.05", "duration=0.5", "settle_time=0.2")


def test_every_law_is_compared_and_the_exact_one_has_the_order_of_its_predictor() -> None:
    result = ran("laws")
    rows = json.loads((result.directory / "laws.json").read_text())
    assert len(rows) == len(laws.cases(4, 3)) == len({row["key"] for row in rows})
    assert {row["predictor"] for row in rows} == {"none", "secant", "tangent order 1", "tangent order 2"}
    read = [float(row["ultimate_excess"]) for row in result.rows("laws")]
    assert read == [row["ultimate_excess"] for row in rows]
    found = result.metrics
    assert found["exact_x1.slope"] == pytest.approx(2, abs=0.3)
    assert found["exact_x1_tangent_order_1.slope"] == pytest.approx(4, abs=0.6)
    assert {value for name, value in found.items() if name.endswith("certificate_violations")} == {0.0}
    # More iterations of the paper's law are better, the exact law leaves nothing, a predictor helps.
    assert found["steepest_descent_x3.ultimate_excess"] < found["steepest_descent_x1.ultimate_excess"]
    assert found["exact_x1.ultimate_excess"] < 1e-6 * found["steepest_descent_x3.ultimate_excess"]
    before = [found[f"exact_x1{p}.ultimate_excess_before"] for p in ("_tangent_order_2", "_secant", "")]
    assert before == sorted(before)
    # What was promised before the run is kept by it.
    measured = found["steepest_descent_x3.ultimate_excess_before"]
    assert measured < found["a_priori.ultimate_excess_before"]
    assert found["a_priori.paper_step"] < found["a_priori.step"] < 0.1


def test_there_is_an_option_for_every_law_and_for_every_predictor() -> None:
    """But `custom`, which has its test in tests/cli."""
    paths = [path for path in Path(config_directory(), "optimizer").glob("*.yaml") if path.stem != "custom"]
    assert {type(instantiate(OmegaConf.load(path))) for path in paths} == {type(law) for law in LAWS.values()}
    kinds = {"none": type(None), "secant": predictors.Secant, "tangent": predictors.Tangent}
    for name, kind in kinds.items():
        assert type(chase_problem(settings(f"predictor={name}")).predictor) is kind
    assert chase_problem(settings("optimizer=nesterov", "optimizer.inner_steps=3")).inner_steps == 3


def test_a_memory_knows_the_region_that_passing_models_forget() -> None:
    found = ran("memory").metrics
    assert found["covered_fraction"] == 1
    assert found["memory_rms_error"] < 0.1 * found["last_rms_error"]
    assert found["memory_max_error"] < found["last_max_error"]
    excess = [found[f"revisit_excess_{name}"] for name in ("memory", "carried", "zero")]
    assert excess[0] < min(excess[1:])  # a start from the memory is the best at a revisit
    assert found["revisit_steps_memory"] <= found["revisit_steps_carried"]
    where, region, _ = ran("memory").figures[0].axes
    assert len(where.collections[0].get_offsets()) == found["models"]
    worst = max(float(np.max(line.get_ydata())) for line in region.get_lines())
    assert worst == pytest.approx(max(found[f"{k}_max_error"] for k in ("memory", "passing", "last")))


def test_the_comparison_has_every_law_at_the_same_work() -> None:
    assert {type(law) for law in LAWS.values()} == {type(case.law) for case in laws.cases(11, 3)}
    dear = [case.name for case in laws.cases(11, 3) if case.products > 11]
    assert dear == ["recursive least squares"]
    found = laws.cases(30, 12)
    for case in found:
        extra = 0 if case.predictor is None else case.predictor.products(12)
        assert case.products == case.law.products(12, case.iterations) + extra
    assert {case.key for case in laws.curves(30, 12)} <= {case.key for case in found}


def test_more_rows_than_go_through_time_together_change_nothing() -> None:
    """A run goes in blocks of 4096 rows; its history has the rows in their order."""
    few = ("dt=0.1", "duration=0.2", "settle_time=0.1", "trajectories=4100", "spread=0.4")
    problem = chase_problem(settings(*few))
    kept: dict[int, list[Any]] = {}
    sink = lambda pieces, row, time: kept.setdefault(row, []).append(pieces["state"])  # noqa: E731
    (blocks,) = chase_batch.simulate([problem], [sink], [True])
    assert [*kept] == [0, 4096]
    states = np.concatenate([np.concatenate(pieces, axis=1) for pieces in kept.values()])
    whole = trajectory(problem.system, problem.initial_states, dt=problem.dt, steps=2, chunk=3)
    np.testing.assert_array_equal(states, torch.cat([*whole], dim=1))
    alone = dataclasses.replace(problem, initial_states=problem.initial_states[:9])
    (few_rows,) = chase_batch.simulate([alone], [None], [True])
    for name, array in few_rows.drawn.items():
        np.testing.assert_allclose(blocks.drawn[name], array, rtol=1e-9, atol=1e-12)


def far(start: str) -> ChaseProblem:
    return chase_problem(settings(*SHORT, "centers.radius=0.1", f"initial_state={start}", "trajectories=3"))


def said(*problems: ChaseProblem) -> tuple[list[str], list[chase_batch.Outcome]]:
    with warnings.catch_warnings(record=True) as given:
        warnings.simplefilter("always")
        found = chase_batch.simulate(problems, [None] * len(problems), [False] * len(problems))
    return [str(each.message) for each in given], found


def test_a_problem_alone_is_warned_of_its_farthest_state_and_of_several_each_keeps_its_own(
    tmp_path: Path,
) -> None:
    near, away = far("[2.0,0.0]"), far("[12.0,0.0]")
    messages, (outcome,) = said(away)
    assert [message[:11] for message in messages] == ["|x| r = 1.2"]
    assert outcome.warnings == ()  # it has been said
    assert said(near)[0] == []
    shared = dataclasses.replace(away, basis=near.basis, target=near.target, law=near.law)
    for second in (away, shared):  # in a batch of its own, and in one with the other
        messages, (one, two) = said(near, second)
        assert messages == []
        assert one.warnings == ()
        assert [warning[:11] for warning in two.warnings] == ["|x| r = 1.2"]
    cfg = settings(*SHORT, "figures=false", "history=false")
    (solved,) = GradientChase().solve([cfg], Progress([].append))
    assert isinstance(solved, ChaseSolution)
    with pytest.warns(UserWarning, match="of the batch"):  # where a member is written
        GradientChase().write(cfg, tmp_path, dataclasses.replace(solved, warnings=("of the batch",)))


def test_a_trajectory_that_diverges_is_named_with_its_time(tmp_path: Path) -> None:
    exploding = ("system=linear", "system.matrix=[[2000,0],[0,2000]]", "kernel=gaussian")
    result = run(tmp_path, *SHORT, *exploding, "trajectories=25", "figures=false")
    assert result.metrics["diverged_fraction"] == 1
    assert "trajectory 0 from [" in result.log
    assert "its weights are frozen from there on" in result.log
    assert "and 5 more trajectories diverged" in result.log
    assert "nothing to report" in result.log

"""Metrics against loops over rows and times, of results with numbers that are made up."""

from __future__ import annotations

import dataclasses
import itertools
import math
from typing import Any

import numpy as np
import pytest
import torch
from helpers import basis_of
from torch import Tensor

from staf_torch import optim
from staf_torch.adp import LoopResult
from staf_torch.engine import Certificate, ChaseResult
from staf_torch.metrics import Metric
from staf_torch.metrics.chase import ChaseMetrics, Member, StateErrorPass
from staf_torch.metrics.closed_loop import adp_metrics, comparison_row, regulated, tracking_metrics
from staf_torch.targets import Paper

ROWS, TIMES = 6, 12
MEMBERS = [Member(2, 0.1, 0.3), Member(1, 0.25, 0.0), Member(3, 0.5, 4.9)]
FIRST = [3, 0, 10]  # of each member


def some(*shape: int, seed: int) -> Tensor:
    return torch.rand(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


BASIS = basis_of("gaussian", 3, 0.3)


def result(certified: bool, diverged: tuple[int, ...]) -> ChaseResult:
    names = ("value", "estimate", "estimate_before", "ideal_estimate", "excess", "excess_before")
    parts = {name: some(ROWS, TIMES, seed=at) for at, name in enumerate(names)}
    lost = torch.full((ROWS,), -1)
    lost[list(diverged)] = 5
    one = torch.ones(ROWS, TIMES).double()
    violated = some(ROWS, TIMES, seed=20) > 0.5
    return ChaseResult(
        **parts,
        state=some(ROWS, TIMES, 2, seed=7),
        weights=some(ROWS, TIMES, 3, seed=8),
        coefficients=some(ROWS, TIMES, 3, seed=8),
        ideal_weights=some(ROWS, TIMES, 3, seed=9),
        diverged_at=lost,
        certificate=Certificate(one, one, one, one, violated) if certified else None,
    )


def piece(whole: ChaseResult, rows: slice, times: slice) -> ChaseResult:
    cut = {k: v[rows, times] for k, v in vars(whole).items() if isinstance(v, Tensor) and v.dim() > 1}
    proof = whole.certificate
    cut["certificate"] = None if proof is None else Certificate(*(part[rows, times] for part in proof))
    return dataclasses.replace(whole, **cut, diverged_at=whole.diverged_at[rows])


class Law(optim.UpdateLaw):
    """Halves the excess of every iteration, or promises nothing."""

    def __init__(self, promises: bool = True) -> None:
        self.promises = promises

    def step(self, objective: Any, weights: Tensor, state: Any) -> Any:
        raise NotImplementedError

    def contraction(self, condition_number: Tensor) -> Tensor | None:
        return torch.sqrt(0.5 * condition_number / condition_number) if self.promises else None


def metrics_of(law: Law, inner_steps: int = 1, **given: Any) -> ChaseMetrics:
    return ChaseMetrics(BASIS, Paper(), law, inner_steps=inner_steps, **given)


class Steepness(Metric):
    """One that is better where it is larger."""

    name, larger_is_better = "steepness", True

    def __call__(self, result: Any, problem: Any) -> Tensor:
        assert problem.basis is BASIS
        found: Tensor = result.value - 0.5
        return found


def expected(whole: Any, member: int, promises: bool) -> dict[str, float | None]:
    start = sum(each.rows for each in MEMBERS[:member])
    rows = [r for r in range(start, start + MEMBERS[member].rows) if not whole.diverged[r]]
    window = list(itertools.product(rows, range(FIRST[member], TIMES)))
    found = StateErrorPass(BASIS, Paper())(whole.state, whole.coefficients, whole.ideal_weights)
    eps = float(np.finfo(np.float64).eps)
    quantities = {
        "ultimate_error": (whole.value - whole.estimate).abs(),
        "ultimate_error_before": (whole.value - whole.estimate_before).abs(),
        "floor_error": (whole.value - whole.ideal_estimate).abs(),
        "ultimate_excess": whole.excess,
        "ultimate_excess_before": whole.excess_before,
        "ball_error": found.ball_error,
        "ball_floor_error": found.ball_floor_error,
        "rounding_floor": eps * whole.value,
        "gradient_error": found.gradient_error,
        "condition_number": found.condition_number,
    }
    wanted: dict[str, float | None] = {
        name: max((float(values[r, t]) for r, t in window), default=None)
        for name, values in quantities.items()
    }
    wanted["steepness"] = min((float(whole.value[r, t]) - 0.5 for r, t in window), default=None)
    last = 0
    for r in rows:
        worst = max(float(whole.excess[r, t]) for t in range(FIRST[member], TIMES))
        last = max([last, *(t + 1 for t in range(FIRST[member]) if float(whole.excess[r, t]) > worst)])
    wanted["settling_time"] = last * MEMBERS[member].dt if rows else None
    allowed = 0.25 * whole.excess_before + 1e3 * eps * found.native_square.abs()
    broken = sum(bool(whole.excess[r, t] > allowed[r, t]) for r, t in window)
    wanted["contraction_violations"] = float(broken) if rows and promises else None
    if whole.certificate is not None and promises:
        proven = float(sum(bool(whole.certificate.violated[r, t]) for r, t in window))
        wanted["certificate_violations"] = proven if rows else None
    count = MEMBERS[member].rows
    wanted["diverged_fraction"] = (count - len(rows)) / count
    return wanted


def measured(
    whole: Any, promises: bool, length: int, blocks: tuple[int, ...]
) -> list[dict[str, float | None]]:
    metrics = metrics_of(Law(promises), 4, members=MEMBERS, own=(Steepness(),))
    start = 0
    for at, count in enumerate(blocks):
        if at:
            metrics.next_rows()
        for time in range(0, TIMES, length):
            metrics.add(piece(whole, slice(start, start + count), slice(time, time + length)))
        start += count
    return metrics.summaries()


@pytest.mark.parametrize(
    ("certified", "promises", "length", "blocks", "diverged"),
    [
        (True, True, 5, (6,), ()),
        (True, True, 5, (6,), (3, 4, 5)),
        (False, True, 12, (6,), (1, 3)),
        (True, False, 5, (6,), (2,)),
        (True, True, 1, (2, 1, 3), (3, 4, 5)),
        (True, True, 1, (2, 1, 3), (1, 3)),
    ],
)
def test_metrics_of_members_are_those_of_a_loop_over_rows_and_times(
    certified: bool, promises: bool, length: int, blocks: tuple[int, ...], diverged: tuple[int, ...]
) -> None:
    whole = result(certified, diverged)
    for member, found in enumerate(measured(whole, promises, length, blocks)):
        wanted = expected(whole, member, promises)
        assert set(found) == set(wanted)
        for name, number in wanted.items():
            assert found[name] == (None if number is None else pytest.approx(number, rel=1e-9)), name


@pytest.mark.parametrize(
    ("settle", "dt", "first"), [(0.0, 0.1, 0), (0.3, 0.1, 3), (0.31, 0.1, 4), (-1.0, 0.5, -2), (0.7, 0.1, 7)]
)
def test_a_window_begins_at_the_first_time_that_is_not_before_it(
    settle: float, dt: float, first: int
) -> None:
    assert Member(1, dt, settle).first == first


@pytest.mark.parametrize(("settle", "ends"), [(11.0, True), (12.0, False), (40.0, False)])
def test_of_a_window_after_the_end_there_is_nothing(settle: float, ends: bool) -> None:
    whole = result(True, ())
    metrics = metrics_of(Law(), members=[Member(len(whole.state), 1.0, settle)])
    metrics.add(whole)
    (found,) = metrics.summaries()
    assert ("certificate_violations" in found) is ends
    assert (found["ultimate_error"] is not None) is ends
    assert (found["settling_time"] is not None) is ends
    assert (found["contraction_violations"] is not None) is ends
    assert found["diverged_fraction"] == 0.0


# Closed loops


def loop(diverged: tuple[int, ...] = (), times: int = 21) -> LoopResult:
    state = some(4, times, 4, seed=30)
    state[0, -1], state[1, -1], state[2, -1] = 0.0, 0.0, 5e-4  # the norm of the third is 1e-3, not below
    frozen, paid = torch.full((4,), math.inf).double(), torch.zeros(4, times).double()
    frozen[list(diverged)], paid[:, -1] = 0.5, torch.tensor([3.0, 1.0, 2.0, 8.0]).double()
    time, u = torch.arange(times).double(), torch.zeros(4, times, 1).double()
    return LoopResult(time, state, u, paid, {}, frozen)


@pytest.mark.parametrize("diverged", [(), (1,), (0, 2, 3)])
def test_a_closed_loop_is_measured_over_the_rows_that_are_left(diverged: tuple[int, ...]) -> None:
    found, kept = loop(diverged), [r for r in range(4) if r not in diverged]
    optimal = torch.tensor([1.5, 0.0, math.nan, 2.0]).double()
    control, value = some(4, 21, seed=31), some(4, 21, seed=32)
    control[:, ::3], value[0, 10:] = math.nan, math.nan
    metrics = adp_metrics(found, optimal_cost=optimal, control_error=control, value_error=value)
    ratios = [float(found.cost[r] / optimal[r]) for r in kept if optimal[r] > 0]
    known = [float(optimal[r]) for r in kept if optimal[r] == optimal[r]]
    late = [(r, t) for r in kept for t in range(10, 20)]
    assert metrics == {
        "cost": float(np.median([float(found.cost[r]) for r in kept])),
        "optimal_cost": float(np.median(known)),
        "cost_ratio": float(np.median(ratios)) if ratios else None,
        "cost_ratio_mean": float(np.mean(ratios)) if ratios else None,
        "cost_ratio_max": max(ratios, default=None),
        "final_state_norm": pytest.approx(max(float(found.state[r, -1].norm()) for r in kept)),
        "control_error": max(float(control[r, t]) for r, t in late if t % 3),
        "value_error": max((float(value[r, t]) for r, t in late if r), default=None),
        "regulated_fraction": sum(r in kept for r in (0, 1)) / 4,
        "diverged_fraction": len(diverged) / 4,
    }
    moved = adp_metrics(
        found, optimal_cost=None, control_error=None, value_error=None, final=found.state[:, 0]
    )
    assert moved["final_state_norm"] == pytest.approx(max(float(found.state[r, 0].norm()) for r in kept))
    assert moved["regulated_fraction"] == 0.0
    assert [moved[name] for name in ("optimal_cost", "cost_ratio", "control_error", "value_error")] == [
        None
    ] * 4


def test_what_is_known_of_no_row_is_none() -> None:
    found = loop((0, 1, 2, 3))
    unknown = torch.full((4,), math.nan).double()
    metrics = adp_metrics(found, optimal_cost=unknown, control_error=None, value_error=some(4, 21, seed=1))
    assert {name for name, number in metrics.items() if number is not None} == {
        "regulated_fraction",
        "diverged_fraction",
    }
    found = loop()
    found.running_cost[0, -1] = math.inf
    metrics = adp_metrics(found, optimal_cost=torch.ones(4).double(), control_error=None, value_error=None)
    assert metrics["cost_ratio_max"] is metrics["cost_ratio_mean"] is None
    assert metrics["cost_ratio"] == 5.0


def test_a_method_is_compared_by_the_rows_that_it_regulated() -> None:
    found = loop((1,))
    found.state[3, -1] = 1e-4
    assert regulated(found).tolist() == [True, False, False, True]
    ratio = torch.tensor([1.25, 1.0, 7.0, 3.0]).double()
    final = found.state[:, -1].norm(dim=-1)
    assert comparison_row(found, ratio) == {
        "ratio_median": 2.125,
        "ratio_mean": 2.125,
        "ratio_max": 3.0,
        "regulated": 0.5,
        "diverged": 0.25,
        "final_state_norm": pytest.approx(float(np.median(final.numpy()))),
    }
    ratio[0] = math.nan
    assert comparison_row(found, ratio)["ratio_mean"] == 3.0
    none = comparison_row(found, torch.full((4,), math.nan).double())
    assert [none[f"ratio_{name}"] for name in ("median", "mean", "max")] == [None] * 3


@pytest.mark.parametrize("times", [21, 9, 40])
def test_tracking_is_measured_by_the_last_tenth_and_the_parameters_at_the_end(times: int) -> None:
    found = loop((2,), times)
    parameters, truth = some(4, times, 3, 2, seed=6), some(3, 2, seed=7)
    optimal = torch.tensor([1.0, math.nan, 1.0, 4.0]).double()
    metrics = tracking_metrics(found, parameters, truth, optimal)
    kept, tail = [0, 1, 3], {21: 2, 9: 1, 40: 4}[times]
    assert metrics == {
        "cost": 3.0,
        "cost_ratio": 2.5,
        "final_error": pytest.approx(float(found.state[kept, -tail:, :2].square().sum(-1).sqrt().max())),
        "parameter_error": pytest.approx(
            max(float((parameters[r, -1] - truth).square().sum().sqrt()) for r in kept)
        ),
        "diverged_fraction": 0.25,
    }
    metrics = tracking_metrics(found, None, truth, None)
    assert metrics["parameter_error"] is metrics["cost_ratio"] is None

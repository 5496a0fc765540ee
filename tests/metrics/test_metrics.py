"""From a chase to numbers."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable

import pytest
import torch
from helpers import basis_of, tensor, uniform
from variants import KERNELS, over

import staf_torch as st
from staf_torch import systems
from staf_torch.adp.simulation import LoopResult
from staf_torch.approximation.conditioning import sup_error
from staf_torch.engine import ChaseResult, chase_pieces
from staf_torch.metrics import Metric
from staf_torch.metrics import ball_error as ball_errors
from staf_torch.metrics.ball_error import StateErrorPass
from staf_torch.metrics.chase import ChaseMetrics, Member
from staf_torch.metrics.closed_loop import adp_metrics, tracking_metrics
from staf_torch.numerics.linalg import condition_number
from staf_torch.optim import SteepestDescent
from staf_torch.targets import Paper

KEYS = {
    "ultimate_error",
    "ultimate_error_before",
    "floor_error",
    "ultimate_excess",
    "ultimate_excess_before",
    "ball_error",
    "ball_floor_error",
    "rounding_floor",
    "gradient_error",
    "condition_number",
    "settling_time",
    "contraction_violations",
    "diverged_fraction",
}
MOVING = ("exponential", "matern52")  # a graded and a Newton space, at a moving radius
DT = 0.05
STARTS = tensor([[1.0, 0.0], [0.3, 0.9], [-1.2, 0.4]])


def states(steps: int = 100) -> torch.Tensor:
    return systems.simulate(systems.Oscillator(), STARTS, dt=DT, steps=steps)


def gather(
    at: torch.Tensor, settle_time: float = 2.0, piece: int | None = None, kernel: str = "exponential"
) -> tuple[dict[str, float | None], ChaseResult]:
    basis, law = basis_of(kernel, 3), SteepestDescent()
    metrics = ChaseMetrics(basis, Paper(), law, inner_steps=10, dt=DT, settle_time=settle_time)
    parts = at.split(at.shape[1] if piece is None else piece, dim=1)
    for result in chase_pieces(parts, basis, Paper(), law, inner_steps=10):
        metrics.add(result)
    return metrics.summary(), st.chase(at, basis, Paper(), law, inner_steps=10)


@over(KERNELS)
def test_metrics_are_the_worst_over_the_window(name: str) -> None:
    found, result = gather(states(), kernel=name)
    basis, window = basis_of(name, 3), slice(40, None)
    value = result.value[:, window]
    expected = {
        "ultimate_error": (value - result.estimate[:, window]).abs().max(),
        "ultimate_error_before": (value - result.estimate_before[:, window]).abs().max(),
        "floor_error": (value - result.ideal_estimate[:, window]).abs().max(),
        "ultimate_excess": result.excess[:, window].max(),
        "ultimate_excess_before": result.excess_before[:, window].max(),
        "condition_number": condition_number(basis.gram(result.state[:, window])).max(),
        "ball_floor_error": sup_error(basis, result.state[:, window], Paper(), 97).max(),
        "rounding_floor": torch.finfo(torch.float64).eps * value.abs().max(),
    }
    assert set(found) == KEYS
    for key, number in expected.items():
        assert found[key] == pytest.approx(float(number), rel=1e-6), key
    assert found["contraction_violations"] == 0
    assert found["diverged_fraction"] == 0


@pytest.mark.parametrize("piece", [1, 7, 40])
def test_pieces_of_time_do_not_change_the_metrics(piece: int) -> None:
    found, whole = gather(states(), piece=piece)[0], gather(states())[0]
    for key, number in whole.items():
        assert found[key] == pytest.approx(number, rel=1e-9), key


def test_settling_time_is_the_last_time_above_the_settled_excess() -> None:
    found, result = gather(states())
    above = result.excess[:, :40] > result.excess[:, 40:].amax(1, keepdim=True)
    last = max(int(row.nonzero().max()) for row in above if row.any())
    assert found["settling_time"] == pytest.approx((last + 1) * DT)
    assert gather(states(), settle_time=0.0)[0]["settling_time"] == 0.0


@pytest.mark.parametrize(("time", "counted"), [(39, False), (40, True)])
def test_the_window_begins_at_the_first_time_that_is_settled(time: int, counted: bool) -> None:
    basis, law = basis_of("exponential", 3), SteepestDescent()
    metrics = ChaseMetrics(basis, Paper(), law, inner_steps=10, dt=DT, settle_time=40 * DT)
    result = st.chase(states(), basis, Paper(), law, inner_steps=10)
    excess = result.excess.clone()
    excess[1, time] = 7.0
    metrics.add(dataclasses.replace(result, excess=excess))
    assert (metrics.summary()["ultimate_excess"] == 7.0) == counted


def test_a_window_after_the_end_has_nothing_to_report() -> None:
    found, _ = gather(states(), settle_time=1e3)
    assert found["diverged_fraction"] == 0.0
    assert {key for key, number in found.items() if number is None} == KEYS - {"diverged_fraction"}


def test_diverged_trajectories_are_counted_and_left_out() -> None:
    poisoned = states()
    poisoned[1, 60:] = torch.nan
    found = gather(poisoned)[0]
    basis, law = basis_of("exponential", 3), SteepestDescent()
    metrics = ChaseMetrics(basis, Paper(), law, inner_steps=10, dt=DT, settle_time=2.0)
    for result in chase_pieces([states()[[0, 2]]], basis, Paper(), law):
        metrics.add(result)
    others = metrics.summary()
    assert found["diverged_fraction"] == pytest.approx(1 / 3)
    for key in KEYS - {"diverged_fraction"}:
        assert found[key] == pytest.approx(others[key], rel=1e-9), key


def test_a_run_in_which_all_diverged_is_null_not_nan() -> None:
    found, _ = gather(torch.full_like(states(), torch.nan))
    assert found["diverged_fraction"] == 1.0
    assert all(number is None for key, number in found.items() if key != "diverged_fraction")
    json.dumps(found, allow_nan=False)


class _Lazy(SteepestDescent):
    """A law that promises the rate of the line search and walks a hundredth of its step."""

    def step(self, objective, weights, state):  # type: ignore[no-untyped-def]
        new, state = super().step(objective, weights, state)
        return weights + 0.01 * (new - weights), state


def test_a_law_that_breaks_its_promise_is_counted() -> None:
    basis, law = basis_of("exponential", 3), _Lazy()
    metrics = ChaseMetrics(basis, Paper(), law, inner_steps=10, dt=DT, settle_time=0.0)
    for result in chase_pieces([states()], basis, Paper(), law):
        metrics.add(result)
    rate = law.contraction(condition_number(basis.gram(states())))
    broken = int((result.excess > rate**10 * result.excess_before * (1 + 1e-9)).sum())
    assert broken > 100
    assert metrics.summary()["contraction_violations"] == broken


def in_kernels(basis: st.StaFBasis, x: torch.Tensor, target: Callable[..., torch.Tensor]) -> torch.Tensor:
    """b of the ideal weights in V^(x + z) = e^{s(z)} sum_i b_i k0(z, d_i)."""
    space = basis.local(x)
    scaled = space.scaled_weights(space.fit(basis.values(x, target)))
    s = basis.kernel.log_scale(x, space.offsets)
    return scaled if s is None else scaled * s.exp()


@pytest.mark.parametrize("radius", [0.4, st.StateRadius(0.5, 0.1)])
@pytest.mark.parametrize("dim", [1, 2, 3])
def test_ball_error_is_close_to_a_dense_supremum(radius: object, dim: int) -> None:
    basis = basis_of("gaussian", 3, radius, dim) if dim == 2 else basis_of("gaussian", 4, radius, dim)
    x = uniform(5, dim)

    def target(y: torch.Tensor) -> torch.Tensor:
        return (y.sum(-1) + 0.3).exp()

    coefficients = in_kernels(basis, x, target)
    found = StateErrorPass(basis, target)(x, coefficients, coefficients).ball_error
    inside = torch.randn(20_000, dim).double()
    inside /= inside.norm(dim=-1, keepdim=True).clamp(min=1.0)
    inside[::2] /= inside[::2].norm(dim=-1, keepdim=True)
    y = x.unsqueeze(-2) + basis.centers.radius(x)[..., None, None] * inside
    staf = st.StaF(basis, (5,)).fit_(x, target)
    dense = (target(y) - staf(y)).abs().amax(-1).detach()
    assert (found <= dense * 1.01).all()
    assert (found >= dense * 0.7).all()


COMPILED = [
    ("matern52", False),
    *((name, True) for name in ("anchored_gaussian", "polynomial", "user_defined")),
]


@pytest.mark.needs_compiler
@pytest.mark.parametrize(
    ("name", "radius"),
    [*((name, 0.2) for name in KERNELS), *((name, st.StateRadius(0.2, 0.1)) for name in MOVING)],
)
def test_errors_around_states_in_pieces_of_any_size_and_compiled(
    name: str, radius: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    basis, x = basis_of(name, 3, radius), uniform(4, 9, 2)
    coefficients = (1 + 0.1 * uniform(4, 9, 3)) * in_kernels(basis, x, Paper())
    ideal = basis.ideal_weights(x, Paper())
    found = StateErrorPass(basis, Paper(), compile=False)(x, coefficients, ideal)
    torch.testing.assert_close(
        found.ball_floor_error, sup_error(basis, x, Paper(), 97), rtol=1e-9, atol=1e-12
    )
    kappa = condition_number(basis.gram_structure(x).scaled()).expand(4, 9)
    torch.testing.assert_close(found.condition_number, kappa, rtol=0.0, atol=0.0)
    ways = []
    if (name, isinstance(radius, float)) in COMPILED:
        compiled = StateErrorPass(basis, Paper(), compile=True)
        ways.append(compiled(x, coefficients, ideal))
        assert compiled.compiled
    monkeypatch.setattr(ball_errors, "_BLOCK", 1)
    ways.append(StateErrorPass(basis, Paper(), compile=False)(x, coefficients, ideal))
    for errors in ways:
        for label, got, wanted in zip(found._fields, errors, found, strict=True):
            # Eigenvalues are exact to eps of the largest: the smallest to eps kappa of itself.
            bound = 1e-14 * float(kappa.max()) if label == "condition_number" else 1e-9
            torch.testing.assert_close(got, wanted, rtol=bound, atol=1e-11, msg=label)


@pytest.mark.needs_compiler
def test_a_state_that_is_not_finite_spoils_no_other_in_the_compiled_pass() -> None:
    basis, x = basis_of("exponential", 3), uniform(1, 20, 2)
    coefficients = in_kernels(basis, x, Paper())
    errors = StateErrorPass(basis, Paper(), compile=True)
    clean = errors(x, coefficients, coefficients)
    x[0, 3], coefficients[0, 4] = torch.nan, torch.inf
    dirty = errors(x, coefficients, coefficients)
    assert errors.compiled
    rest = [k for k in range(20) if k not in (3, 4)]
    for one, other in zip(clean, dirty, strict=True):
        assert torch.equal(one[:, rest], other[:, rest])
        assert torch.isfinite(other[:, rest]).all()
    assert not torch.isfinite(dirty.ball_error[0, 3:5]).any()
    assert dirty.condition_number[0, 3].isnan()


@over(KERNELS)
def test_gradient_error_is_that_of_the_partial_gradient(name: str) -> None:
    basis, x = basis_of(name, 6, 0.5), uniform(4, 2, low=0.3)
    coefficients = in_kernels(basis, x, Paper())
    staf = st.StaF(basis, (4,)).fit_(x, Paper())
    exact = torch.func.grad(lambda at: Paper()(at).sum())(x)
    expected = (staf.gradient(x.unsqueeze(-2)).squeeze(-2) - exact).norm(dim=-1)
    found = StateErrorPass(basis, Paper())(x, coefficients, coefficients).gradient_error
    torch.testing.assert_close(found, expected, rtol=1e-7, atol=1e-8)


def test_blocks_of_rows_give_the_metrics_of_the_whole_batch() -> None:
    basis, law = basis_of("exponential", 3), SteepestDescent()
    at = states()
    at[1, 60:] = torch.nan
    members = [Member(1, DT, 1.0), Member(2, DT, 2.0)]
    whole = ChaseMetrics(basis, Paper(), law, inner_steps=10, members=members)
    whole.add(st.chase(at, basis, Paper(), law, inner_steps=10))
    blocks = ChaseMetrics(basis, Paper(), law, inner_steps=10, members=members)
    for k in range(3):
        if k:
            blocks.next_rows()
        for result in chase_pieces(at[k : k + 1].split(41, dim=1), basis, Paper(), law, inner_steps=10):
            blocks.add(result)
    for one, other in zip(whole.summaries(), blocks.summaries(), strict=True):
        assert one == pytest.approx(other, rel=1e-12)
    assert any(found["settling_time"] for found in whole.summaries())
    assert whole.summaries()[1]["diverged_fraction"] == 0.5


def test_window_of_the_paper_starts_at_its_settling_time() -> None:
    """5.0 / 0.05 is 100.00000000000001 in floating point on some steps: the first time must not move."""
    for dt in (0.05, 0.01, 0.001, 0.1, 0.3):
        assert Member(1, dt, 30 * dt).first == 30
        assert math.ceil(30 * dt / dt - 1e-9) == 30


def test_tracking_is_measured_over_the_rows_that_did_not_diverge() -> None:
    frozen = tensor([math.inf, math.inf, 0.3, math.inf])
    state = uniform(4, 20, 4, seed=1)
    result = LoopResult(
        time=torch.arange(20).double(),
        state=state,
        control=uniform(4, 20, 1, seed=2),
        actor_weights=torch.zeros(4, 20, 0),
        critic_weights=torch.zeros(4, 20, 0),
        running_cost=uniform(4, 20, seed=3) + 2,
        identifier=torch.zeros(4, 20, 0),
        frozen_at=frozen,
    )
    optimal, kept = tensor([0.5, 2.0, 1.0, math.nan]), [0, 1, 3]
    truth, parameters = uniform(3, 2, seed=4), uniform(4, 20, 3, 2, seed=5)
    found = tracking_metrics(result, parameters, truth, optimal)
    assert found["cost"] == float(result.cost[kept].median())
    ratios = sorted((result.cost[:2] / optimal[:2]).tolist())
    assert found["cost_ratio"] in (ratios[0], pytest.approx(sum(ratios) / 2))
    assert found["final_error"] == float(state[kept, -2:, :2].norm(dim=-1).max())
    assert found["parameter_error"] == float((parameters[kept, -1] - truth).flatten(-2).norm(dim=-1).max())
    assert found["diverged_fraction"] == 0.25
    short = dataclasses.replace(result, state=state[:, :7])  # the last tenth of which is one time
    last = float(state[kept, 6, :2].norm(dim=-1).max())
    assert tracking_metrics(short, None, truth, None)["final_error"] == last
    bare = tracking_metrics(result, None, truth, None)
    assert bare["cost_ratio"] is None
    assert bare["parameter_error"] is None
    assert bare["cost"] == found["cost"]


@pytest.mark.parametrize("known", [True, False])
def test_a_closed_loop_is_measured_with_and_without_a_known_optimum(known: bool) -> None:
    state = 1e-4 * uniform(4, 20, 2, seed=1)
    result = LoopResult(
        time=torch.arange(20).double(),
        state=state,
        control=uniform(4, 20, 1, seed=2),
        actor_weights=torch.zeros(4, 20, 0),
        critic_weights=torch.zeros(4, 20, 0),
        running_cost=uniform(4, 20, seed=3) + 2,
        identifier=torch.zeros(4, 20, 0),
        frozen_at=tensor([math.inf, math.inf, 0.3, math.inf]),
    )
    optimal = tensor([0.5, 2.0, 1.0, math.nan]) if known else None
    found = adp_metrics(result, optimal_cost=optimal, control_error=None, value_error=None)
    assert found["cost"] == float(result.cost[[0, 1, 3]].median())
    assert found["diverged_fraction"] == 0.25
    assert found["regulated_fraction"] == 0.75
    assert found["final_state_norm"] == float(state[[0, 1, 3], -1].norm(dim=-1).max())
    if optimal is None:
        assert found["optimal_cost"] is found["cost_ratio"] is found["cost_ratio_max"] is None
    else:
        ratios = (result.cost[:2] / optimal[:2]).tolist()
        assert found["cost_ratio_max"] == max(ratios)
        assert found["cost_ratio_mean"] == pytest.approx(sum(ratios) / 2)


@pytest.mark.parametrize("larger", [True, False])
def test_a_number_that_is_reported_is_finite_and_the_right_way_round(larger: bool) -> None:
    class Own(Metric):
        name, larger_is_better = "own", larger

        def __call__(self, result: object, problem: object) -> torch.Tensor:
            return torch.zeros(1, 1)

    assert Own().from_badness(2.0) == (-2.0 if larger else 2.0)
    for lost in (math.nan, math.inf, -math.inf):
        assert Own().from_badness(lost) is None

"""Each law by its textbook property, and what all laws have in common."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers import changed, random_positive_definite, uniform
from helpers_laws import iterate, quadratic
from hypothesis import given, settings
from hypothesis import strategies as some
from torch import Tensor
from variants import DESCENDING, LAWS, RATED, over

from staf_torch import optim
from staf_torch.lanes.tree import flatten
from staf_torch.numerics.linalg import condition_number
from staf_torch.optim.objective import NativeError, Precomputed


def excess_path(law: optim.UpdateLaw, objective: NativeError, steps: int) -> Tensor:
    path = iterate(law, objective, torch.zeros_like(objective.values), steps)
    return objective.excess(path, torch.linalg.solve(objective.gram, objective.values))


@pytest.mark.parametrize("name", LAWS)
def test_every_law_treats_each_row_of_a_batch_alone(name: str) -> None:
    objective = quadratic()
    together = iterate(LAWS[name], objective, torch.zeros_like(objective.values), 6)
    poisoned = changed(objective, values=objective.values.clone())
    poisoned.values[3] = torch.nan
    beside = iterate(LAWS[name], poisoned, torch.zeros_like(objective.values), 6)
    others = [0, 1, 2, 4]
    assert torch.equal(beside[:, others], together[:, others])
    for row in (0, 4):
        known = Precomputed(*(None if f is None else f[row] for f in objective.precomputed))
        alone = NativeError(objective.gram[row], objective.values[row], known)
        path = iterate(LAWS[name], alone, torch.zeros_like(alone.values), 6)
        torch.testing.assert_close(together[:, row], path, rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize("name", LAWS)
def test_the_unit_of_the_weights_does_not_matter(name: str) -> None:
    law, objective = LAWS[name], quadratic()
    if name == "fixed absolute step":
        pytest.skip("its step is stated in the unit of the weights")
    factor = torch.linspace(0.5, 3.0, 5, dtype=torch.float64)[:, None]
    row = None if objective.precomputed.row is None else objective.precomputed.row / factor
    scaled = NativeError(objective.gram / factor[..., None], objective.values, Precomputed(row=row))
    scaled = changed(scaled, precomputed=changed(scaled.precomputed, sampled=objective.precomputed.sampled))
    weights = torch.zeros_like(objective.values)
    state = law.begin(objective, weights, law.init(weights))
    for _ in range(3):
        weights, state = law.step(objective, weights, state)
    other, other_state = weights * factor, law.rescale(state, factor)
    for _ in range(3):
        weights, state = law.step(objective, weights, state)
        other, other_state = law.step(scaled, other, other_state)
    torch.testing.assert_close(other, weights * factor, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("name", LAWS)
def test_what_a_law_needs_may_be_known_beforehand_or_found_on_the_spot(name: str) -> None:
    objective = quadratic()
    low_high = torch.stack(objective.spectrum(), dim=-1)
    ideal = objective.minimiser()
    inverse = torch.linalg.inv(objective.gram)
    known = changed(objective.precomputed, extremes=low_high, ideal=ideal, inverse=inverse)
    assert LAWS[name].needs <= set(Precomputed.__annotations__)
    zero = torch.zeros_like(objective.values)
    given = changed(objective, precomputed=known)
    torch.testing.assert_close(iterate(LAWS[name], given, zero, 5), iterate(LAWS[name], objective, zero, 5))


@pytest.mark.parametrize("name", DESCENDING)
def test_a_descent_law_never_raises_the_excess(name: str) -> None:
    excess = excess_path(DESCENDING[name], quadratic(condition=1e4), 40)
    assert bool((excess[1:] <= excess[:-1] * (1 + 1e-9) + 1e-20).all())


@pytest.mark.parametrize("count", [1, 6])
def test_conjugate_gradients_are_exact_after_as_many_iterations_as_weights(count: int) -> None:
    excess = excess_path(optim.ConjugateGradient(), quadratic(count=count), count + 5)
    assert bool((excess[count:] < 1e-20 * excess[0]).all())
    for law in (optim.Exact(), optim.PreconditionedDescent("core")):
        excess = excess_path(law, quadratic(count=count), 1)
        assert bool((excess[1] < 1e-24 * excess[0]).all())


def test_jacobi_takes_one_iteration_on_a_diagonal_gram_matrix() -> None:
    diagonal = torch.tensor([1.0, 10.0, 300.0], dtype=torch.float64)
    objective = NativeError(torch.diag(diagonal), torch.ones(3, dtype=torch.float64))
    path = iterate(optim.PreconditionedDescent("jacobi"), objective, torch.zeros(3).double(), 1)
    torch.testing.assert_close(path[1], 1 / diagonal)


@pytest.mark.parametrize(("name", "power"), [("heavy ball", 2), ("nesterov", 1)])
def test_momentum_converges_at_its_rate(name: str, power: int) -> None:
    excess = excess_path(LAWS[name], quadratic(condition=400.0), 150)
    q = 400.0**-0.5
    rate = ((1 - q) / (1 + q)) ** 2 if power == 2 else (1 - q)
    measured = (excess[150] / excess[50]) ** 0.01
    assert bool((measured < rate * 1.05).all())


@pytest.mark.parametrize("name", ["heavy ball", "nesterov", "barzilai-borwein"])
def test_a_law_that_could_blow_up_stays_bounded_under_restarts(name: str) -> None:
    law, objective = LAWS[name], quadratic(condition=1e6)
    weights = torch.zeros_like(objective.values)
    none = objective.excess(weights, objective.minimiser())
    for _ in range(25):  # two iterations from rest, over and over: plain heavy ball grows ninefold each time
        weights = iterate(law, objective, weights, 2)[-1]
    assert bool((objective.excess(weights, objective.minimiser()) < 100 * none).all())


def test_an_absolute_step_that_is_too_long_gives_way_to_the_line_search() -> None:
    objective = quadratic()
    zero = torch.zeros_like(objective.values)
    guarded = iterate(optim.FixedStep(1e3, relative=False), objective, zero, 3)
    torch.testing.assert_close(guarded, iterate(optim.SteepestDescent(), objective, zero, 3))


def test_barzilai_borwein_never_ends_a_time_step_worse_than_it_began() -> None:
    excess = excess_path(optim.BarzilaiBorwein(), quadratic(batch=20, condition=1e5), 60)
    assert bool((excess <= excess[0] * (1 + 1e-9)).all())


def test_recursive_least_squares_is_the_batch_fit_to_all_samples() -> None:
    noise, prior = 0.3, 7.0
    law = optim.RecursiveLeastSquares(process_noise=0.0, measurement_noise=noise, prior=prior)
    objectives = [quadratic(seed=seed) for seed in range(4)]
    weights = torch.zeros_like(objectives[0].values)
    state = law.init(weights)
    for objective in objectives:
        state = law.begin(objective, weights, state)
        weights, state = law.step(objective, weights, state)
    information = torch.eye(4).double() / prior + sum(o.gram @ o.gram / noise for o in objectives)
    right = sum((o.curvature(o.values) / noise for o in objectives), torch.zeros(()).double())
    torch.testing.assert_close(weights, torch.linalg.solve(information, right))
    torch.testing.assert_close(state[0], torch.linalg.inv(information))


def test_recursive_least_squares_is_the_kalman_filter_of_drifting_weights() -> None:
    law = optim.RecursiveLeastSquares(process_noise=0.5, measurement_noise=0.2, prior=2.0)
    gram = torch.tensor([[3.0]]).double()
    mean, variance, weights = 0.0, 2.0, torch.zeros(1).double()
    state = law.init(weights)
    for sample in (1.0, -2.0, 0.5):
        objective = NativeError(gram, torch.tensor([sample]).double())
        state = law.begin(objective, weights, state)
        weights, state = law.step(objective, weights, state)
        variance += 0.5
        gain = 3 * variance / (9 * variance + 0.2)
        mean, variance = mean + gain * (sample - 3 * mean), (1 - 3 * gain) * variance
    torch.testing.assert_close(weights, torch.tensor([mean]).double())
    torch.testing.assert_close(state[0], torch.tensor([[variance]]).double())


def test_normalised_lms_projects_onto_the_weights_that_reproduce_the_sample() -> None:
    objective = quadratic()
    row, sampled = objective.sample()
    start = torch.ones_like(objective.values)
    moved = iterate(optim.NormalisedLMS(), objective, start, 1)[-1]
    torch.testing.assert_close((row * moved).sum(-1), sampled)
    along = (moved - start) / row  # parallel to the row: the nearest such weights
    torch.testing.assert_close(along, along[:, :1].expand_as(along))


@pytest.mark.parametrize("name", LAWS)
def test_weights_that_are_ideal_stay_finite_and_stay(name: str) -> None:
    objective = quadratic()
    ideal = objective.minimiser()
    row = objective.precomputed.row
    assert row is not None
    at_ideal = changed(objective.precomputed, sampled=(row * ideal).sum(-1))
    path = iterate(LAWS[name], changed(objective, precomputed=at_ideal), ideal, 5)
    slack = 0.05 if name == "recursive least squares" else 1e-12  # its prior pulls towards zero
    torch.testing.assert_close(path[-1], ideal, rtol=slack, atol=slack)


@pytest.mark.parametrize("name", LAWS)
def test_a_zero_quadratic_moves_nothing(name: str) -> None:
    law, zero = LAWS[name], torch.zeros(2, 3, dtype=torch.float64)
    objective = NativeError(torch.zeros(2, 3, 3).double(), zero, Precomputed(row=zero, sampled=zero[:, 0]))
    weights, state = zero, law.begin(objective, zero, law.init(zero))
    for _ in range(3):
        weights, state = law.step(objective, weights, state)
        assert torch.equal(weights, zero)
        assert all(bool(part.isfinite().all()) for part in flatten(state)[0])  # for the steps to come


@pytest.mark.parametrize("momentum", [0.0, 0.5, 0.9])
def test_heavy_ball_takes_the_steps_with_which_it_converges_and_no_others(momentum: float) -> None:
    def radius(step: float) -> float:  # of the map (a, a before) where the curvature is largest
        return float(np.abs(np.linalg.eigvals([[1 + momentum - step, -momentum], [1.0, 0.0]])).max())

    most = 2 * (1 + momentum)
    assert radius(0.99 * most) < 1 < radius(1.01 * most)
    assert optim.HeavyBall(0.99 * most, momentum).step_size == 0.99 * most
    with pytest.raises(ValueError, match=r"must be below 2 \(1 \+ momentum\)"):
        optim.HeavyBall(most, momentum)


# Random quadratics.

SEEDS = some.integers(0, 2**31)


def problem(seed: int, batch: int = 6, size: int = 4, log_condition: float = 3.0) -> NativeError:
    gram = random_positive_definite(seed, batch, size=size, log_condition=log_condition)
    return NativeError(gram, uniform(batch, size, seed=seed + 1))


@given(seed=SEEDS)
def test_line_search_is_the_exact_minimiser_along_the_gradient(seed: int) -> None:
    objective, a = problem(seed), uniform(6, 4, seed=seed + 2)
    new, _ = optim.SteepestDescent().step(objective, a, ())
    g, moved = objective.descent(a), new - a
    length = (moved * g).sum(-1, keepdim=True) / g.square().sum(-1, keepdim=True)
    torch.testing.assert_close(moved, length * g, rtol=1e-9, atol=1e-14)  # it moves along g
    slope = (objective.descent(new) * g).sum(-1)  # and the derivative along g vanishes there
    assert (slope.abs() <= 1e-10 * g.square().sum(-1)).all()


def test_gradient_through_a_zero_step_is_finite() -> None:
    values = uniform(4, 3).requires_grad_()
    objective = NativeError(torch.eye(3, dtype=torch.float64).expand(4, 3, 3), values)
    new, _ = optim.SteepestDescent().step(objective, values.detach().clone(), ())
    (gradient,) = torch.autograd.grad(new.sum(), values)
    assert torch.isfinite(gradient).all()


@over(RATED)
@settings(max_examples=20)
@given(seed=SEEDS, log_condition=some.floats(0, 6))
def test_excess_contracts_at_the_promised_rate(name: str, seed: int, log_condition: float) -> None:
    law, objective = LAWS[name], problem(seed, log_condition=log_condition)
    rate = law.contraction(condition_number(objective.gram))
    assert rate is not None
    ideal = torch.linalg.solve(objective.gram, objective.values)
    a = uniform(6, 4, seed=seed + 2)
    rounding = 1e-13 * (ideal * objective.values).sum(-1).abs() * condition_number(objective.gram)
    for _ in range(5):
        new = law.step(objective, a, law.init(a))[0]
        bound = rate * objective.excess(a, ideal)
        assert (objective.excess(new, ideal) <= bound * (1 + 1e-9) + rounding).all()
        a = new


def native(objective: NativeError, a: Tensor) -> Tensor:
    """F(a) - |V|^2 = a'K a - 2 V(c)'a."""
    return torch.einsum("bi,bij,bj->b", a, objective.gram, a) - 2 * (objective.values * a).sum(-1)


def test_descent_curvature_and_excess_are_those_of_the_native_error() -> None:
    objective, a, v = problem(3, batch=4, size=5), uniform(4, 5), uniform(4, 5, seed=7)
    gradient = torch.func.grad(lambda at: native(objective, at).sum())(a)
    torch.testing.assert_close(objective.descent(a), -gradient, rtol=1e-12, atol=1e-10)
    change = objective.descent(a) - objective.descent(a + v)
    torch.testing.assert_close(objective.curvature(v), change / 2, rtol=1e-10, atol=1e-10)
    ideal = torch.linalg.solve(objective.gram, objective.values)
    expected = native(objective, a) - native(objective, ideal)
    torch.testing.assert_close(objective.excess(a, ideal), expected, rtol=1e-10, atol=1e-10)
    g = objective.descent(a)  # whose squared dual norm is four times the excess
    dual = (g * torch.linalg.solve(objective.gram, g)).sum(-1) / 4
    torch.testing.assert_close(objective.excess(a, ideal), dual, rtol=1e-9, atol=1e-10)

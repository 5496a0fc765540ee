"""Update laws on random quadratics."""

from __future__ import annotations

import pytest
import torch
from helpers import random_positive_definite, uniform
from hypothesis import given, settings
from hypothesis import strategies as some
from variants import DESCENDING, LAWS, RATED, over

from staf_torch.numerics.linalg import condition_number
from staf_torch.optim import SteepestDescent, UpdateLaw
from staf_torch.optim.objective import NativeError

SEEDS = some.integers(0, 2**31)


def problem(seed: int, batch: int = 6, size: int = 4, log_condition: float = 3.0) -> NativeError:
    gram = random_positive_definite(seed, batch, size=size, log_condition=log_condition)
    return NativeError(gram, uniform(batch, size, seed=seed + 1))


def run(law: UpdateLaw, objective: NativeError, weights: torch.Tensor, steps: int) -> torch.Tensor:
    state = law.init(weights)
    for _ in range(steps):
        weights, state = law.step(objective, weights, state)
    return weights


@given(seed=SEEDS)
def test_line_search_is_the_exact_minimiser_along_the_gradient(seed: int) -> None:
    objective, a = problem(seed), uniform(6, 4, seed=seed + 2)
    new, _ = SteepestDescent().step(objective, a, ())
    g, moved = objective.descent(a), new - a
    length = (moved * g).sum(-1, keepdim=True) / g.square().sum(-1, keepdim=True)
    torch.testing.assert_close(moved, length * g, rtol=1e-9, atol=1e-14)  # it moves along g
    slope = (objective.descent(new) * g).sum(-1)  # and the derivative along g vanishes there
    assert (slope.abs() <= 1e-10 * g.square().sum(-1)).all()


@over(DESCENDING)
def test_zero_gradient_gives_a_finite_zero_step(name: str) -> None:
    gram = torch.eye(3, dtype=torch.float64).expand(4, 3, 3)
    values = uniform(4, 3)
    objective = NativeError(gram, values)
    assert torch.equal(objective.descent(values), torch.zeros_like(values))
    law = LAWS[name]
    new, state = law.step(objective, values, law.init(values))
    assert torch.equal(new, values)
    assert all(torch.isfinite(part).all() for part in state)


def test_gradient_through_a_zero_step_is_finite() -> None:
    values = uniform(4, 3).requires_grad_()
    objective = NativeError(torch.eye(3, dtype=torch.float64).expand(4, 3, 3), values)
    new, _ = SteepestDescent().step(objective, values.detach().clone(), ())
    (gradient,) = torch.autograd.grad(new.sum(), values)
    assert torch.isfinite(gradient).all()


@over(RATED)
@given(seed=SEEDS, log_condition=some.floats(0, 6))
def test_excess_contracts_at_the_promised_rate(name: str, seed: int, log_condition: float) -> None:
    law, objective = LAWS[name], problem(seed, log_condition=log_condition)
    rate = law.contraction(condition_number(objective.gram))
    if rate is None:
        pytest.skip("the law promises no rate")
    ideal = torch.linalg.solve(objective.gram, objective.values)
    a = uniform(6, 4, seed=seed + 2)
    rounding = 1e-13 * (ideal * objective.values).sum(-1).abs() * condition_number(objective.gram)
    for _ in range(10):
        new = run(law, objective, a, 1)
        bound = rate * objective.excess(a, ideal)
        assert (objective.excess(new, ideal) <= bound * (1 + 1e-9) + rounding).all()
        a = new


@over(DESCENDING)
@settings(max_examples=10)
@given(seed=SEEDS)
def test_law_finds_the_ideal_weights(name: str, seed: int) -> None:
    objective = problem(seed, log_condition=0.5)
    ideal = torch.linalg.solve(objective.gram, objective.values)
    steps = 150 if name == "fixed absolute step" else 75  # one in twenty seeds needs more than 90 of it
    found = run(LAWS[name], objective, torch.zeros(6, 4, dtype=torch.float64), steps)
    torch.testing.assert_close(found, ideal, rtol=1e-8, atol=1e-10)


@over(name for name in DESCENDING if name != "fixed absolute step")  # whose step has a unit
@given(seed=SEEDS, exponent=some.integers(-40, 40))
def test_units_of_the_weights_do_not_matter(name: str, seed: int, exponent: int) -> None:
    """a -> s a with K -> K / s: powers of two, so that not one bit may change."""
    law, objective, scale = LAWS[name], problem(seed), 2.0**exponent
    other = NativeError(objective.gram / scale, objective.values)
    start = uniform(6, 4, seed=seed + 2)
    plain, state = law.step(objective, start, law.init(start))
    factor = torch.full((6, 1), scale, dtype=torch.float64)
    rescaled = law.rescale(state, factor)
    first = run(law, other, start * scale, 1)
    assert torch.equal(first, plain * scale)
    second, _ = law.step(objective, plain, state)
    again, _ = law.step(other, first, rescaled)
    assert torch.equal(again, second * scale)


@over(DESCENDING)
def test_rows_are_bit_for_bit_as_they_would_be_alone_even_beside_nan(name: str) -> None:
    law, objective, a = LAWS[name], problem(5), uniform(6, 4)
    together = run(law, objective, a, 5)
    poisoned = objective.values.clone()
    poisoned[3] = torch.nan
    beside = run(law, NativeError(objective.gram, poisoned), a, 5)
    for row in (0, 1, 2, 4, 5):
        alone = run(
            law, NativeError(objective.gram[row : row + 1], objective.values[row : row + 1]), a[[row]], 5
        )
        assert torch.equal(together[row], alone[0])
        assert torch.equal(beside[row], together[row])
    assert torch.isnan(beside[3]).all()


def native(objective: NativeError, a: torch.Tensor) -> torch.Tensor:
    """F(a) - |V|^2 = a'K a - 2 V(c)'a."""
    return torch.einsum("bi,bij,bj->b", a, objective.gram, a) - 2 * (objective.values * a).sum(-1)


def test_descent_is_minus_the_gradient_of_the_native_error() -> None:
    objective, a = problem(3, batch=4, size=5), uniform(4, 5)
    gradient = torch.func.grad(lambda at: native(objective, at).sum())(a)
    torch.testing.assert_close(objective.descent(a), -gradient, rtol=1e-12, atol=1e-10)


def test_curvature_is_half_the_second_derivative_along_a_direction() -> None:
    objective, a, v = problem(3, batch=4, size=5), uniform(4, 5), uniform(4, 5)
    change = objective.descent(a) - objective.descent(a + v)
    torch.testing.assert_close(objective.curvature(v), change / 2, rtol=1e-10, atol=1e-10)


def test_excess_is_the_native_error_above_its_minimum() -> None:
    objective, a = problem(3, batch=4, size=5), uniform(4, 5)
    ideal = torch.linalg.solve(objective.gram, objective.values)
    expected = native(objective, a) - native(objective, ideal)
    torch.testing.assert_close(objective.excess(a, ideal), expected, rtol=1e-10, atol=1e-10)
    assert torch.equal(objective.excess(ideal, ideal), torch.zeros(4).double())


def test_excess_is_a_quarter_of_the_squared_dual_norm_of_the_gradient() -> None:
    objective, a = problem(3, batch=4, size=5), uniform(4, 5)
    ideal, g = torch.linalg.solve(objective.gram, objective.values), objective.descent(a)
    dual = (g * torch.linalg.solve(objective.gram, g)).sum(-1) / 4
    torch.testing.assert_close(objective.excess(a, ideal), dual, rtol=1e-9, atol=1e-10)

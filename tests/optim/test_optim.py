"""Update laws on random quadratics."""

from __future__ import annotations

import torch
from helpers import random_positive_definite, uniform
from hypothesis import given, settings
from hypothesis import strategies as some
from variants import LAWS, RATED, over

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


def test_gradient_through_a_zero_step_is_finite() -> None:
    values = uniform(4, 3).requires_grad_()
    objective = NativeError(torch.eye(3, dtype=torch.float64).expand(4, 3, 3), values)
    new, _ = SteepestDescent().step(objective, values.detach().clone(), ())
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
        new = run(law, objective, a, 1)
        bound = rate * objective.excess(a, ideal)
        assert (objective.excess(new, ideal) <= bound * (1 + 1e-9) + rounding).all()
        a = new


def native(objective: NativeError, a: torch.Tensor) -> torch.Tensor:
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

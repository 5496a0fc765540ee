"""The quadratic of one state."""

from __future__ import annotations

import torch
from helpers import random_positive_definite, uniform

from staf_torch.optim.objective import NativeError


def problem(size: int = 5, batch: int = 4) -> NativeError:
    return NativeError(random_positive_definite(3, batch, size=size), uniform(batch, size, seed=4))


def native(objective: NativeError, a: torch.Tensor) -> torch.Tensor:
    """F(a) - |V|^2 = a'K a - 2 V(c)'a."""
    return torch.einsum("bi,bij,bj->b", a, objective.gram, a) - 2 * (objective.values * a).sum(-1)


def test_descent_is_minus_the_gradient_of_the_native_error() -> None:
    objective, a = problem(), uniform(4, 5)
    gradient = torch.func.grad(lambda at: native(objective, at).sum())(a)
    torch.testing.assert_close(objective.descent(a), -gradient, rtol=1e-12, atol=1e-10)


def test_curvature_is_half_the_second_derivative_along_a_direction() -> None:
    objective, a, v = problem(), uniform(4, 5), uniform(4, 5)
    change = objective.descent(a) - objective.descent(a + v)
    torch.testing.assert_close(objective.curvature(v), change / 2, rtol=1e-10, atol=1e-10)


def test_excess_is_the_native_error_above_its_minimum() -> None:
    objective, a = problem(), uniform(4, 5)
    ideal = torch.linalg.solve(objective.gram, objective.values)
    expected = native(objective, a) - native(objective, ideal)
    torch.testing.assert_close(objective.excess(a, ideal), expected, rtol=1e-10, atol=1e-10)
    assert torch.equal(objective.excess(ideal, ideal), torch.zeros(4).double())


def test_excess_is_a_quarter_of_the_squared_dual_norm_of_the_gradient() -> None:
    objective, a = problem(), uniform(4, 5)
    ideal, g = torch.linalg.solve(objective.gram, objective.values), objective.descent(a)
    dual = (g * torch.linalg.solve(objective.gram, g)).sum(-1) / 4
    torch.testing.assert_close(objective.excess(a, ideal), dual, rtol=1e-9, atol=1e-10)


def test_rows_are_bit_for_bit_as_they_would_be_alone() -> None:
    objective, a = problem(batch=33), uniform(33, 5)
    for row in range(33):
        alone = NativeError(objective.gram[row], objective.values[row])
        assert torch.equal(objective.descent(a)[row], alone.descent(a[row]))

"""Value bases and the points at which the Bellman error is asked."""

from __future__ import annotations

import pytest
import torch
from helpers_adp import COST, PLANT, staf_basis, uniform

from staf_torch import (
    AnchoredKernel,
    ConstantRadius,
    ExponentialKernel,
    GaussianKernel,
    StaFBasis,
    StateFollowingCenters,
    StateRadius,
    adp,
    rings,
)


@pytest.mark.parametrize("mode", ["total", "partial"])
@pytest.mark.parametrize("radius", [StateRadius(0.7, 1e-5), StateRadius(0.3, 0.2, 2.0), ConstantRadius(0.2)])
def test_closed_form_gradient_equals_automatic_differentiation(mode: str, radius: torch.nn.Module) -> None:
    basis = StaFBasis(AnchoredKernel(ExponentialKernel()), StateFollowingCenters(rings(6), radius))
    value = adp.StaFValueBasis(basis, mode)
    y, x = uniform(7, 1.5).reshape(7, 1, 2), uniform(7, 1.5, seed=1).reshape(7, 1, 2)
    assert value._closed
    torch.testing.assert_close(value.gradient(y, x), value._automatic(y, x), rtol=1e-12, atol=1e-13)
    torch.testing.assert_close(value(y, x), basis(y.unsqueeze(-2), x).squeeze(-2), rtol=1e-13, atol=1e-15)


@pytest.mark.parametrize(
    "basis",
    [
        staf_basis(),
        staf_basis("partial"),
        staf_basis("total", AnchoredKernel(GaussianKernel(0.8))),
        staf_basis("partial", GaussianKernel(0.8)),
        adp.QuadraticBasis(2),
        adp.RBFGridBasis(2, points=3),
        adp.RBFGridBasis(2, points=3, flat=False),
    ],
    ids=["staf", "staf-partial", "gaussian", "gaussian-partial", "quadratic", "rbf", "rbf-value-only"],
)
def test_gradient_of_every_basis_is_a_difference_quotient(basis: adp.ValueBasis) -> None:
    y = uniform(6, 1.5)
    moves = getattr(basis, "mode", "partial") == "total"
    step = 1e-6
    for axis in range(2):
        h = torch.zeros(2, dtype=torch.float64)
        h[axis] = step
        centers = (y + h, y - h) if moves else (y, y)
        quotient = (basis(y + h, centers[0]) - basis(y - h, centers[1])) / (2 * step)
        torch.testing.assert_close(basis.gradient(y, y)[..., axis], quotient, rtol=1e-7, atol=1e-8)
    assert basis(y, y).shape == (6, basis.count)


def test_bellman_error_of_the_optimum_is_zero_in_the_quadratic_basis() -> None:
    basis = adp.QuadraticBasis(2)
    optimum = torch.tensor([0.5, 0.0, 1.0], dtype=torch.float64)  # x1^2 / 2 + x2^2
    x = uniform(50, 2.0).unsqueeze(-2)
    terms = adp.bellman_terms(basis, PLANT, COST, x, x, optimum.expand(50, 3))
    assert adp.bellman_error(terms, optimum).abs().max() < 1e-12


@pytest.mark.parametrize(
    "extrapolation", [adp.RandomPoints(3, 0.2), adp.QuadraturePoints(4, 2, 0.2, "fixed")]
)
def test_extrapolated_points_stay_in_their_box_and_their_weights_sum_to_one(
    extrapolation: adp.Extrapolation,
) -> None:
    x = uniform(9, 1.0)
    draws = 2 * torch.rand(9, extrapolation.draws, 2, dtype=torch.float64) - 1
    points = extrapolation(x, draws)
    assert points.shape == (9, extrapolation.count, 2)
    assert (points - x.unsqueeze(-2)).abs().max() <= 0.2
    assert float(extrapolation.weights.sum()) == pytest.approx(1.0)


def test_box_around_the_origin_stays_there() -> None:
    rule = adp.RandomPoints(2, 0.5, around="origin")
    draws = 2 * torch.rand(9, 2, 2, dtype=torch.float64) - 1
    torch.testing.assert_close(rule(uniform(9, 2.0), draws), 0.5 * draws, rtol=0, atol=0)


def test_flat_rbf_basis_has_neither_value_nor_gradient_at_the_origin() -> None:
    at = torch.zeros(1, 2, dtype=torch.float64)
    for flat in (True, False):
        basis = adp.RBFGridBasis(2, flat=flat)
        assert basis(at, at).abs().max() < 1e-15
        assert (float(basis.gradient(at, at).abs().max()) < 1e-15) is flat


def test_quadrature_takes_the_mean_over_the_box() -> None:
    rule = adp.QuadraturePoints(7, 2, 0.5)
    points = rule(torch.zeros(1, 2, dtype=torch.float64), torch.zeros(1, 0, 2))[0]
    mean = (rule.weights * points[:, 0].pow(6) * points[:, 1].pow(4)).sum()
    assert float(mean) == pytest.approx(0.5**10 / 35, rel=1e-12)


@pytest.mark.parametrize("basis", [adp.QuadraticBasis(2), adp.RBFGridBasis(2)], ids=["quadratic", "grid"])
def test_a_global_basis_starts_near_the_square(basis: adp.ValueBasis) -> None:
    weights = torch.tensor(basis.weights_near_square(), dtype=torch.float64)
    y = uniform(50, 1.0)
    torch.testing.assert_close(basis.value(weights, y), y.square().sum(-1), rtol=0, atol=0.05)
    assert not basis.follows_state
    assert adp.LeadingCoordinates(staf_basis(), 4).follows_state

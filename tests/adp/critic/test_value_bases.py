"""Bases of a value function and the points at which the Bellman error is computed, beside their formulas."""

from __future__ import annotations

import itertools
import math
from typing import Any

import pytest
import torch
from helpers import tensor, uniform
from helpers_adp import staf_basis
from torch import Tensor

import staf_torch as st
from staf_torch import adp
from staf_torch.centers import Radius


def test_quadratic_functions_are_the_products_of_the_coordinates() -> None:
    y = uniform(4, 3, seed=1)
    pairs = list(itertools.combinations_with_replacement(range(3), 2))
    basis = adp.QuadraticBasis(3)
    assert (basis.count, basis.dim, basis.follows_state) == (6, 3, False)
    torch.testing.assert_close(basis(y, 9 * y), torch.stack([y[:, i] * y[:, j] for i, j in pairs], -1))
    torch.testing.assert_close(
        basis.value(torch.arange(6).double(), y), (torch.arange(6) * basis(y, y)).sum(-1)
    )
    weights = dict(zip(pairs, basis.weights_near_square(), strict=True))
    for (i, j), weight in weights.items():
        assert weight == pytest.approx(float(i == j), abs=1e-9)


@pytest.mark.parametrize(("width", "flat"), [(None, True), (0.7, False)])
def test_bumps_on_a_grid_are_those_of_the_formula(width: float | None, flat: bool) -> None:
    basis = adp.RBFGridBasis(2, 3, 1.5, width, flat=flat)
    wide = 1.5 if width is None else width
    y = uniform(4, 2, seed=1)
    columns = []
    for c in itertools.product((-1.5, 0.0, 1.5), repeat=2):
        center = tensor(c)
        zero = math.exp(-float(center @ center) / (2 * wide**2))
        bump = (-(y - center).square().sum(-1) / (2 * wide**2)).exp()
        columns.append(bump - zero - ((y @ center) * zero / wide**2 if flat else 0.0))
    torch.testing.assert_close(basis(y, y), torch.stack(columns, -1))
    slopes = torch.func.vmap(torch.func.jacrev(lambda at: basis(at, at)))(y)
    torch.testing.assert_close(basis.gradient(y, y), slopes)
    at = torch.zeros(1, 2).double()
    assert float(basis(at, at).abs().max()) < 1e-15
    assert (float(basis.gradient(at, at).abs().max()) < 1e-15) is flat


class Growing(Radius):
    """A user's radius: of its slope the library knows nothing."""

    def forward(self, x: Tensor) -> Tensor:
        return 0.2 + 0.3 * x[..., 0].square()


@pytest.mark.filterwarnings("ignore:StaFBasis of GaussianKernel has the same values at every state")
@pytest.mark.parametrize("mode", ["total", "partial"])
@pytest.mark.parametrize(
    ("kernel", "radius"),
    [
        (st.AnchoredKernel(st.ExponentialKernel()), 0.4),
        (st.AnchoredKernel(st.ExponentialKernel()), Growing()),
        (st.GaussianKernel(0.8), st.StateRadius(0.7, 0.2, gain=1.5)),
    ],
)
def test_functions_around_the_state_and_their_slopes(kernel: st.Kernel, radius: Any, mode: str) -> None:
    centers = st.StateFollowingCenters(st.rings(3), radius)
    basis = adp.StaFValueBasis(st.StaFBasis(kernel, centers), mode)
    x, y = uniform(4, 2, seed=1), uniform(4, 2, seed=2)
    assert basis.follows_state
    share = 1.0 if mode == "total" else 0.0  # of a move of y by which the centers move, too
    torch.testing.assert_close(basis(y, x), kernel(y.unsqueeze(-2), centers(x)).squeeze(-2))
    for at in (x, y):
        rows = zip(at, x, strict=True)
        moved = [(lambda h, y=y, x=x: basis(y + h, x + share * h)) for y, x in rows]
        slopes = torch.stack([torch.func.jacrev(row)(torch.zeros(2).double()) for row in moved])
        torch.testing.assert_close(basis.gradient(at, x), slopes, rtol=1e-11, atol=1e-12)
    assert basis.gradient(y, x).shape == (4, 3, 2)


def test_leading_coordinates_are_those_of_the_error() -> None:
    basis = adp.LeadingCoordinates(adp.QuadraticBasis(2), 4)
    y, x = uniform(3, 4, seed=1), uniform(3, 4, seed=2)
    inner = adp.QuadraticBasis(2)
    torch.testing.assert_close(basis(y, x), inner(y[:, :2], x[:, :2]))
    found = basis.gradient(y, x)
    torch.testing.assert_close(found[..., :2], inner.gradient(y[:, :2], x[:, :2]))
    assert not found[..., 2:].any()
    assert adp.LeadingCoordinates(staf_basis(), 4).follows_state


@pytest.mark.parametrize("basis", [adp.QuadraticBasis(2), adp.RBFGridBasis(2)], ids=["quadratic", "grid"])
def test_a_global_basis_starts_near_the_square(basis: adp.ValueBasis) -> None:
    weights = torch.tensor(basis.weights_near_square(), dtype=torch.float64)
    y = uniform(50, 2, seed=0)
    torch.testing.assert_close(basis.value(weights, y), y.square().sum(-1), rtol=0, atol=0.05)
    assert not basis.follows_state


@pytest.mark.parametrize("around", ["state", "origin"])
def test_points_are_the_cube_scaled_around_the_state_or_the_origin(around: str) -> None:
    x = uniform(3, 2, seed=1)
    middle = x if around == "state" else 0 * x
    drawn = uniform(3, 4, 2, seed=2)
    points = adp.RandomPoints(4, 0.3, around=around)
    torch.testing.assert_close(points(x, drawn), middle.unsqueeze(1) + 0.3 * drawn)
    assert (points.count, points.draws, points.moving, points.weights.tolist()) == (4, 4, True, [0.25] * 4)
    rule = adp.QuadraturePoints(3, 2, 0.3, "fixed", around=around)
    node = math.sqrt(0.6)
    grid = tensor(list(itertools.product((-node, 0.0, node), repeat=2)))
    torch.testing.assert_close(rule(x, x.new_zeros(3, 0, 2)), middle.unsqueeze(1) + 0.3 * grid)
    masses = [a * b / 4 for a, b in itertools.product((5 / 9, 8 / 9, 5 / 9), repeat=2)]
    torch.testing.assert_close(rule.weights, tensor(masses))
    assert (rule.count, rule.draws, rule.moving) == (9, 0, False)
    if around == "state":
        shrinking = st.StateRadius(0.5, 0.1)
        found = adp.RandomPoints(4, shrinking)(x, drawn)
        torch.testing.assert_close(found, x.unsqueeze(1) + shrinking(x)[:, None, None] * drawn)

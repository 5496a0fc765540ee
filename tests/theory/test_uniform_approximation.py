"""Near-best polynomials, grids and suprema on balls."""

from __future__ import annotations

import math

import pytest
import torch
from helpers import tensor, uniform
from helpers_theory import random_offsets
from torch import Tensor

from staf_torch import theory
from staf_torch.centers import probe_points
from staf_torch.centers.layouts import monomials
from staf_torch.theory.uniform_approximation import ball_grid, near_best, supremum


def test_near_best_polynomial_of_a_power_is_chebyshevs() -> None:
    """The best approximation of t^(d+1) on [-1, 1] by degree d leaves 2^-d, and nothing can be better."""
    z = torch.cos(torch.linspace(0, math.pi, 400, dtype=torch.float64)).unsqueeze(-1)
    for degree in range(7):
        f = z[:, 0] ** (degree + 1)
        tolerance = torch.full((1,), 2.0**-degree * 1.01, dtype=torch.float64)
        fit = near_best(z, degree, f.unsqueeze(0), torch.ones(1, 400).double(), tolerance)
        assert fit.lower <= 2.0**-degree * (1 + 1e-9)
        assert 2.0**-degree * (1 - 1e-3) <= fit.error <= 2.0**-degree * 1.05
        left = f - (monomials(z, degree) @ fit.coefficients[0])
        torch.testing.assert_close(left.abs().max(), fit.error[0])


def test_rows_of_a_fit_do_not_depend_on_the_other_rows() -> None:
    z = ball_grid(2, 5, 24)
    f = torch.stack([(z @ torch.tensor(a).double()).exp() for a in ([1.0, 0.0], [0.3, -0.7], [2.0, 1.0])])
    weight, inexact = torch.ones_like(f), torch.full((3,), 1e9, dtype=torch.float64)
    squares = near_best(z, 3, f, weight, inexact).error  # the first iterate: least squares
    for share in ([1.5, 1.1, 1.2], [1.1, 1.5, 1.2]):  # of it: one row is done at once, others later
        tolerance = squares * torch.tensor(share).double()
        together = near_best(z, 3, f, weight, tolerance)
        assert (together.error <= tolerance).all()
        for row in range(3):
            alone = near_best(z, 3, f[row : row + 1], weight[:1], tolerance[row : row + 1])
            torch.testing.assert_close(
                alone.coefficients[0], together.coefficients[row], rtol=1e-9, atol=1e-12
            )


@pytest.mark.parametrize("dim", [1, 2, 5])
def test_grid_and_covering_lie_in_their_balls(dim: int) -> None:
    grid = ball_grid(dim, 4, 16)
    assert grid[0].norm() == 0
    assert grid.norm(dim=-1).max() <= 1 + 1e-15
    states = theory.disc(2.0, dim=dim, count=20, center=[1.0] * dim)
    assert states.shape == (20, dim)
    assert torch.equal(states[0], torch.ones(dim).double())
    torch.testing.assert_close(states, 1 + 2 * probe_points(20, dim))
    assert (states - 1).norm(dim=-1).max() <= 2 + 1e-12


@pytest.mark.parametrize(("dim", "radius"), [(1, 20.0), (2, 0.5), (3, 0.01)])
def test_supremum_climbs_to_peaks_between_the_points_of_the_grid(dim: int, radius: float) -> None:
    generator = torch.Generator().manual_seed(dim)
    peaks = random_offsets(0.5, 1, 4, dim, seed=dim)[0]
    height = 1 + torch.rand(len(peaks), generator=generator).double()

    def bumps(z: Tensor) -> Tensor:
        distance = (0.5 / radius * z - peaks.unsqueeze(-2)).square().sum(-1)  # (D, P)
        return height.unsqueeze(-1) * torch.exp(-30 * distance)

    found = supremum(bumps, radius * ball_grid(dim, 3, 9), radius)
    torch.testing.assert_close(found, height, rtol=1e-4, atol=0)


def test_near_best_with_weights_is_the_best_that_linear_programming_finds() -> None:
    scipy_optimize = pytest.importorskip("scipy.optimize")
    draw = torch.Generator().manual_seed(0)
    z = ball_grid(2, 4, 16)
    f = (z @ torch.randn(2, dtype=torch.float64, generator=draw)).exp()
    weight = 10 ** (2 * torch.rand(len(z), dtype=torch.float64, generator=draw) - 1)
    columns = weight[:, None] * monomials(z, 2)
    aim, ones = weight * f, torch.ones(len(z), 1, dtype=torch.float64)
    matrix = torch.cat((torch.cat((columns, -ones), 1), torch.cat((-columns, -ones), 1))).numpy()
    cost = [0.0] * columns.shape[1] + [1.0]
    best = scipy_optimize.linprog(cost, matrix, torch.cat((aim, -aim)).numpy(), bounds=(None, None)).fun
    fit = near_best(z, 2, f[None], weight[None], torch.tensor([1.02 * best]).double())
    assert 0.9 * best <= float(fit.lower) <= best * (1 + 1e-9)
    assert best * (1 - 1e-9) <= float(fit.error) <= 1.1 * best
    left = (weight * (f - monomials(z, 2) @ fit.coefficients[0])).abs().max()
    torch.testing.assert_close(left, fit.error[0])


def test_a_polynomial_is_found_and_its_rounding_is_enough() -> None:
    z = ball_grid(2, 4, 16)
    exact = uniform(4, 10, seed=9) * 2.0 ** tensor([[-60], [-30], [0], [30]])
    f = exact @ monomials(z, 3).mT
    found = near_best(z, 3, f, torch.ones_like(f), torch.zeros(4).double())
    size = f.abs().amax(-1)
    torch.testing.assert_close(found.coefficients / size[:, None], exact / size[:, None], rtol=0, atol=1e-12)
    assert bool((found.error < 1e-14 * size).all())
    assert bool((found.lower <= found.error).all())

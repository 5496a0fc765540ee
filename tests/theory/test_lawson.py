"""Lawson's iteration, the search for a supremum and the grids of balls, each beside a loop in NumPy."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from helpers import tensor, uniform
from torch import Tensor

from staf_torch import theory
from staf_torch.centers import probe_points
from staf_torch.centers.layouts import monomials
from staf_torch.theory import uniform_approximation
from staf_torch.theory.uniform_approximation import ball_grid, near_best, supremum


@pytest.mark.parametrize(("shells", "directions"), [(1, 1), (1, 5), (4, 6), (5, 1)])
def test_points_of_a_grid_are_those_of_the_formula(shells: int, directions: int) -> None:
    radii = [math.cos(math.pi * k / (2 * shells)) for k in range(shells)]
    line = [0.0, *(side * r for r in radii for side in (1, -1))]
    plane = [(0.0, 0.0)]
    for k, r in enumerate(radii):
        turns = [2 * math.pi * (j + (0.5 if k % 2 else 0.0)) / directions for j in range(directions)]
        plane += [(r * math.cos(turn), r * math.sin(turn)) for turn in turns]
    for dim, points in ((1, tensor(line)[:, None]), (2, tensor(plane))):
        grid = ball_grid(dim, shells, directions)
        torch.testing.assert_close(grid, points, rtol=1e-14, atol=1e-15)
    for dim in (3, 4):
        grid = ball_grid(dim, shells, directions)
        assert grid.dtype == torch.float64
        assert grid.shape == (1 + shells * directions, dim)
        for shell, r in zip(grid[1:].view(shells, directions, dim), radii, strict=True):
            torch.testing.assert_close(shell.norm(dim=-1), torch.full((directions,), r).double())
        cloud = probe_points(1 + shells * directions, dim)[1:]
        cosine = torch.nn.functional.cosine_similarity(grid[1:], cloud)
        torch.testing.assert_close(cosine, torch.ones(shells * directions).double())


def test_a_grid_of_no_points_is_refused() -> None:
    for given, name in (((0, 1, 1), "dim"), ((1, 0, 1), "shells"), ((1, 1, 0), "directions")):
        with pytest.raises(ValueError, match=rf"ball_grid\({name}=...\)` must be at least 1; got 0"):
            ball_grid(*given)


def test_a_disc_is_of_the_plane_unless_said_and_stands_where_it_is_said() -> None:
    assert theory.disc().shape == (97, 2)
    assert float(theory.disc().norm(dim=-1).max()) == pytest.approx(1.0)
    moved = theory.disc(0.5, dim=3, count=30, center=[0.1, 0.2, 0.3])
    assert torch.equal(moved[0], tensor([0.1, 0.2, 0.3]))
    torch.testing.assert_close(moved, tensor([0.1, 0.2, 0.3]) + theory.disc(0.5, dim=3, count=30))
    assert theory.disc(dim=1, count=2).shape == (2, 1)
    for name, wrong in (("dim", 0), ("count", 1)):
        with pytest.raises(ValueError, match=rf"`disc\({name}=...\)` must be at least"):
            theory.disc(**{name: wrong})  # type: ignore[arg-type]


# --- Lawson's iteration -------------------------------------------------------------------------------------


def lawson(
    columns: np.ndarray, f: np.ndarray, weight: np.ndarray, tolerance: float = 0.0, iterations: int = 25
) -> tuple[np.ndarray, float, float]:
    """Weighted least squares again and again, each row alone: the best fit, its error, the lower bound.

    Without a tolerance to the end.
    """
    count = len(f)
    share = np.full(count, 1 / count)
    best, error, lower = np.zeros(columns.shape[1]), np.abs(weight * f).max(), 0.0
    for _ in range(iterations):
        scale = np.sqrt(share) * weight
        fit = np.linalg.lstsq(columns * scale[:, None], f * scale, rcond=None)[0]
        left = np.abs(weight * (f - columns @ fit))
        if left.max() < error and error > 0.7 * tolerance:
            best, error = fit, left.max()
        lower = max(lower, math.sqrt((share * left**2).sum()))
        if tolerance and (error <= 0.7 * tolerance or lower > tolerance):
            break
        share = share * left + 1e-9 * left.max() / count
        share = share / share.sum()
    return best, error, lower


def problem(seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """Points of the plane, three waves there, and weights from a tenth to ten."""
    z = ball_grid(2, 4, 16)
    f = (uniform(3, 2, low=-3, high=3, seed=seed) @ z.mT).sin() + uniform(3, 1, seed=seed + 1)
    return z, f, 10 ** uniform(3, len(z), seed=seed + 2)


@pytest.mark.parametrize("degree", [1, 2, 3])
@pytest.mark.parametrize("share", [0.1, 0.97, 1.01, 1.3, 1.6, 2.0, 9.0])
def test_near_best_polynomials_are_those_of_the_iteration_written_out(degree: int, share: float) -> None:
    """Of tolerances that cannot be met, that are met at the end, soon, and at once."""
    z, f, weight = problem(20 + degree)
    columns = monomials(z, degree).numpy()
    for row in range(3):
        args = columns, f[row].numpy(), weight[row].numpy()
        tolerance = share * lawson(*args)[2]
        best, error, lower = lawson(*args, tolerance)
        found = near_best(z, degree, f[row : row + 1], weight[row : row + 1], tensor([tolerance]))
        torch.testing.assert_close(found.coefficients[0], tensor(best), rtol=1e-10, atol=1e-11)
        torch.testing.assert_close(found.error[0], tensor(error), rtol=1e-10, atol=0)
        torch.testing.assert_close(found.lower[0], tensor(lower), rtol=1e-10, atol=0)


def test_an_iteration_that_never_ends_is_given_25() -> None:
    z, f, weight = problem(7)
    args = monomials(z, 2).numpy(), f[0].numpy(), weight[0].numpy()
    tolerance = 1.2 * lawson(*args)[2]  # neither met nor hopeless
    results = [lawson(*args, tolerance, iterations=k) for k in (24, 25, 26)]
    found = near_best(z, 2, f[:1], weight[:1], tensor([tolerance]))
    torch.testing.assert_close(found.lower[0], tensor(results[1][2]), rtol=1e-10, atol=0)
    assert len({round(result[2], 9) for result in results}) == 3


@pytest.mark.parametrize("power", [-40, 40])
def test_near_best_polynomials_scale_with_the_function(power: int) -> None:
    z, f, weight = problem(3)
    tolerance, scale = tensor([0.5, 1.0, 3.0]), 2.0**power
    one = near_best(z, 2, f, weight, tolerance)
    other = near_best(z, 2, scale * f, weight, scale * tolerance)
    for name in ("coefficients", "error", "lower"):
        torch.testing.assert_close(getattr(other, name), scale * getattr(one, name), rtol=1e-12, atol=0)


def test_a_polynomial_is_found_and_its_rounding_is_enough() -> None:
    z = ball_grid(2, 4, 16)
    exact = uniform(4, 10, seed=9) * 2.0 ** tensor([[-60], [-30], [0], [30]])
    f = exact @ monomials(z, 3).mT
    found = near_best(z, 3, f, torch.ones_like(f), torch.zeros(4).double())
    size = f.abs().amax(-1)
    torch.testing.assert_close(found.coefficients / size[:, None], exact / size[:, None], rtol=0, atol=1e-12)
    assert bool((found.error < 1e-14 * size).all())
    assert bool((found.lower <= found.error).all())


def test_a_row_that_is_good_enough_as_zero_stays_zero() -> None:
    z, f, weight = problem(5)
    size = (weight * f).abs().amax(-1)
    found = near_best(z, 2, f, weight, size / 0.69)
    assert float(found.coefficients.abs().max()) == 0.0
    torch.testing.assert_close(found.error, size)
    found = near_best(z, 2, f, weight, size / 0.71)
    assert bool((found.coefficients.abs().amax(-1) > 0).all())
    assert bool((found.error < size).all())


def test_blocks_of_rows_stop_by_themselves(monkeypatch: pytest.MonkeyPatch) -> None:
    """One that is hopeless ends the iteration of those beside it, and of no others."""
    z, f, weight = problem(11)
    columns = monomials(z, 2).numpy()
    late = [1.05 * lawson(columns, f[k].numpy(), weight[k].numpy())[2] for k in (1, 2)]  # never well within
    tolerance = tensor([1e-9, *late])
    monkeypatch.setattr(uniform_approximation, "_BLOCK", 1)
    found = near_best(z, 2, f, weight, tolerance)
    for row in range(3):
        one = slice(row, row + 1)
        alone = near_best(z, 2, f[one], weight[one], tolerance[one])
        for part, whole in zip(alone, found, strict=True):
            torch.testing.assert_close(part, whole[one], rtol=1e-8, atol=1e-12)
    monkeypatch.undo()
    together = near_best(z, 2, f, weight, tolerance)
    assert float((together.lower / found.lower - 1).abs().max()) > 1e-3


# --- suprema ------------------------------------------------------------------------------------------------


def climb(f: Callable[[np.ndarray], float], grid: np.ndarray, radius: float) -> float:
    """From the eight largest values on a grid, 16 times along the best axis, or by half the step."""
    dim = grid.shape[1]
    values = np.array([f(z) for z in grid])
    tops = []
    for start in np.argsort(-values, kind="stable")[:8]:
        z, best, step = grid[start], values[start], radius / 4
        for _ in range(16):
            trials = []
            for axis in range(dim):
                for side in (1, -1):
                    trial = z + side * step * np.eye(dim)[axis]
                    length = np.linalg.norm(trial)
                    trials.append(trial * radius / length if length > radius else trial)
            gains = [f(trial) for trial in trials]
            if max(gains) > best:
                best = max(gains)
                z = trials[int(np.argmax(gains))]
            else:
                step = step / 2
        tops.append(best)
    return float(max(tops))


@pytest.mark.parametrize("radius", [0.2, 3.0])
@pytest.mark.parametrize(("dim", "shells", "directions"), [(1, 2, 2), (1, 6, 2), (2, 2, 5), (3, 3, 7)])
def test_a_supremum_is_that_of_the_search_written_out(
    dim: int, shells: int, directions: int, radius: float
) -> None:
    rates = (uniform(3, dim, seed=3) * 4 + 1) / radius
    aims = 1.3 * radius * uniform(3, dim, seed=4)

    def bumps(z: Tensor) -> Tensor:  # peaks inside the ball and outside, and waves between
        far = (z - aims.unsqueeze(-2)) / radius
        waves: Tensor = (rates.unsqueeze(-2) * z).sum(-1).sin()
        return waves - far.square().sum(-1)

    grid = radius * ball_grid(dim, shells, directions)
    calls: list[torch.Size] = []

    def counted(z: Tensor) -> Tensor:
        calls.append(z.shape)
        return bumps(z)

    found = supremum(counted, grid, radius)
    assert calls == [grid.shape] + 16 * [torch.Size((3, min(8, len(grid)) * 2 * dim, dim))]
    for row in range(3):

        def one(z: np.ndarray, row: int = row) -> float:
            return float(bumps(tensor(z)[None])[row, 0])

        assert float(found[row]) == pytest.approx(climb(one, grid.numpy(), radius), rel=1e-9)


def test_a_number_that_is_none_on_the_grid_is_told_of_its_function_only() -> None:
    grid = ball_grid(2, 3, 6)

    def function(z: Tensor) -> Tensor:
        values = z.sum(-1).expand(2, *z.shape[-2:-1]) if z.dim() == 2 else z.sum(-1)
        broken = (z.norm(dim=-1) == 0).expand_as(values) & tensor([[0.0], [1.0]]).bool()
        return torch.where(broken, torch.nan, values)

    found = supremum(function, grid, 1.0)
    assert found[0] == pytest.approx(math.sqrt(2), rel=1e-6)
    assert math.isnan(found[1])

"""Uniform approximation on balls: points, suprema, and near-best polynomials for many functions at once."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ..centers import probe_points
from ..centers.layouts import monomials
from ..numerics.checks import integer, positive_real, vector
from ..signs import Sign

_STARTS = 8  # points of the grid from which a supremum is sought
_CLIMBS = 16
_ITERATIONS = 25
_ENOUGH = 0.7  # of the tolerance: an error that needs no further improvement
_BLOCK = 2**21  # numbers in the largest temporary
_FLOOR = 1e-9  # of the mean weight: no point is ever dropped for good


def ball_grid(dim: int, shells: int, directions: int) -> Tensor:
    """The origin and ``shells`` spheres of the closed unit ball, crowded towards its surface: (1 + shells
    directions, dim), float64, the origin first.

    The radii are cos(pi k / (2 shells)), so that with the origin each diameter carries Chebyshev-like nodes.
    In the plane every circle has ``directions`` equally spaced angles, every other circle turned by half a
    step; on a line there are two directions; in space the directions of all shells together are a
    low-discrepancy sequence.
    """
    for name, value in (("dim", dim), ("shells", shells), ("directions", directions)):
        integer("ball_grid", name, value, least=1)
    radii = torch.cos(torch.arange(shells, dtype=torch.float64, device="cpu") * (math.pi / (2 * shells)))
    points = (radii[:, None, None] * _directions(dim, shells, directions)).reshape(-1, dim)
    return torch.cat((points.new_zeros(1, dim), points))


def _directions(dim: int, shells: int, directions: int) -> Tensor:
    """Unit vectors, (shells or 1, directions, dim)."""
    if dim == 1:
        return torch.tensor([[[1.0], [-1.0]]], dtype=torch.float64, device="cpu")
    if dim == 2:
        turned = 0.5 * (torch.arange(shells, dtype=torch.float64, device="cpu") % 2)
        steps = torch.arange(directions, dtype=torch.float64, device="cpu") + turned[:, None]
        angle = steps * (2 * math.pi / directions)
        return torch.stack((angle.cos(), angle.sin()), dim=-1)
    cloud = probe_points(shells * directions + 1, dim)[1:]
    unit: Tensor = cloud / cloud.norm(dim=-1, keepdim=True)
    return unit.reshape(shells, directions, dim)


def supremum(function: Callable[[Tensor], Tensor], grid: Tensor, radius: float) -> Tensor:
    """max f_j(z) over |z| <= radius for each of D functions: the largest values on a grid of the ball (P,
    n), then uphill; (D,), NaN where a value on the grid is.

    From the points of the grid with the largest values a pattern search climbs on, in steps along the axes
    that are halved where none of them gains; points that leave the ball go back to its surface. f maps
    offsets (P, n), the same for all, or (D, P, n), to values (D, P).
    """
    values = function(grid)
    best, where = values.topk(min(_STARTS, len(grid)))  # NaN counts as the largest
    z = grid[where]  # (D, K, n)
    axes = torch.eye(grid.shape[-1], dtype=grid.dtype, device=grid.device)
    axes = torch.cat((axes, -axes))
    step = torch.full_like(best, 0.25 * radius)
    for _ in range(_CLIMBS):
        trial = z.unsqueeze(-2) + step[..., None, None] * axes  # (D, K, 2n, n)
        trial = trial * (radius / trial.norm(dim=-1, keepdim=True).clamp(min=radius))
        gained, which = function(trial.flatten(1, 2)).unflatten(1, trial.shape[1:3]).max(-1)
        better = gained > best
        chosen = trial.gather(-2, which[..., None, None].expand(*which.shape, 1, trial.shape[-1])).squeeze(-2)
        z = torch.where(better.unsqueeze(-1), chosen, z)
        best = torch.where(better, gained, best)
        step = torch.where(better, step, 0.5 * step)
    return best.amax(-1)


def disc(
    radius: float = 1.0, *, dim: int = 2, count: int = 97, center: Sequence[float] | None = None
) -> Tensor:
    """States that cover the closed ball |x - center| <= radius, for a domain D.

    Example:
        >>> disc(1.0).shape
        torch.Size([97, 2])

        Shown by `staf experiment=exponential_bound`.

    Args:
        radius: of the domain, positive, in the units of the state.
        dim: n; 2 is a disc.
        count: states, at least 2. Two thirds of them are on the boundary in the plane, half in space:
            what is asked of a state is hardest there, for the exponential kernel.
        center: n numbers; the origin if None.

    Returns:
        (count, dim), float64, the center first.

    Raises:
        ValueError: if an argument breaks its rule.
    """
    extent = positive_real("disc", "radius", radius)
    integer("disc", "dim", dim, least=1)
    middle = [0.0] * dim if center is None else vector("disc", "center", center, dim)
    offset = torch.tensor(middle, dtype=torch.float64, device="cpu")
    return offset + extent * probe_points(integer("disc", "count", count, least=2), dim)


class NearBest(NamedTuple):
    """Polynomials sum_a c_a z^a, |a| <= degree, one a row."""

    coefficients: Tensor  # (D, C), monomials graded by degree
    error: Tensor  # (D,) largest weighted error on the points of the fit
    lower: Tensor  # (D,) no polynomial of this degree has a smaller one there


@Sign("near_best")
def near_best(points: Tensor, degree: int, values: Tensor, weight: Tensor, tolerance: Tensor) -> NearBest:
    """Return the best polynomials p of the degree that were met in minimising max_j weight_j |f(z_j) -
    p(z_j)|, row by row: z (P, n) well inside what is numerically fine for monomials, the unit ball, f and
    weights (D, P), the error to reach (D,).

    Lawson's iteration: weighted least squares whose weights are multiplied by the errors they left. The
    error of every weighted fit bounds the best uniform error from below, so a row that cannot meet its
    tolerance is known early; the iteration then stops for all, as the degree is of no use. A row that is
    well within its tolerance is left as it is.

    Source: Lawson, "Contributions to the theory of linear least maximum approximation", UCLA (1961); Rice
    and Usow, "The Lawson algorithm and extensions", Math. Comp. 22 (1968).
    """
    orthonormal, triangle = torch.linalg.qr(monomials(points, degree))
    rows = max(1, _BLOCK // orthonormal.numel())
    blocks = zip(values.split(rows), weight.split(rows), tolerance.split(rows), strict=True)
    fits = [_lawson(orthonormal, *block) for block in blocks]
    coefficients, error, lower = (torch.cat(parts) for parts in zip(*fits, strict=True))
    solved = torch.linalg.solve_triangular(triangle, coefficients.mT, upper=True).mT
    return NearBest(solved, error, lower)


def _lawson(
    orthonormal: Tensor, f: Tensor, weight: Tensor, tolerance: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """`near_best` in a basis whose columns are orthonormal over the points: (P, C), (D, P)."""
    share = torch.full_like(f, 1 / f.shape[-1])  # of each point in the squared error, sums to one
    gamma = f.new_zeros(f.shape[0], orthonormal.shape[1])
    best, error, lower = gamma, (weight * f).abs().amax(-1), torch.zeros_like(tolerance)
    rounding = 8 * torch.finfo(f.dtype).eps * error
    enough = torch.maximum(_ENOUGH * tolerance, rounding)
    for _ in range(_ITERATIONS):
        # The correction of the last fit, not the fit anew: its rounding errors then shrink with it.
        pull = share * weight.square()
        residual = f - gamma @ orthonormal.mT
        gram = (orthonormal.mT * pull.unsqueeze(-2)) @ orthonormal
        factor, failed = torch.linalg.cholesky_ex(gram)
        step = torch.cholesky_solve(((pull * residual) @ orthonormal).unsqueeze(-1), factor).squeeze(-1)
        gamma = torch.where((failed == 0).unsqueeze(-1), gamma + step, gamma)
        left = weight * (f - gamma @ orthonormal.mT).abs()
        worst = left.amax(-1)
        better = (worst < error) & (error > enough)  # a row that is done stays as it is
        best, error = torch.where(better.unsqueeze(-1), gamma, best), torch.where(better, worst, error)
        lower = torch.maximum(lower, (share * left.square()).sum(-1).sqrt().where(failed == 0, 0.0))
        if bool((error <= enough).all()) or bool((lower > tolerance + rounding).any()):
            break
        share = share * left + _FLOOR * worst.unsqueeze(-1) / f.shape[-1]
        share = share / share.sum(-1, keepdim=True).clamp(min=torch.finfo(f.dtype).tiny)
    return best, error, lower

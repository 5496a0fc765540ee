"""Near-best uniform approximation by polynomials on a ball, for many functions at once."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ..centers.ball import exponents

_ITERATIONS = 25
_ENOUGH = 0.7  # of the tolerance: an error that needs no further improvement
_BLOCK = 2**21  # numbers in the largest temporary
_FLOOR = 1e-9  # of the mean weight: no point is ever dropped for good


class NearBest(NamedTuple):
    """Polynomials sum_a c_a z^a, |a| <= degree, one a row."""

    coefficients: Tensor  # (D, C), monomials graded by degree
    error: Tensor  # (D,) largest weighted error on the points of the fit
    lower: Tensor  # (D,) no polynomial of this degree has a smaller one there


def graded_exponents(dim: int, degree: int) -> Tensor:
    """All multi-indices a with |a| <= degree, graded: (C(n + degree, n), n), int64."""
    return torch.cat([exponents(dim, k) for k in range(degree + 1)])


def monomials(points: Tensor, degree: int) -> Tensor:
    """z^a = prod_i z_i^{a_i}, |a| <= degree, graded: (..., P, n) -> (..., P, C)."""
    powers = torch.stack([points**k for k in range(degree + 1)], dim=-1)
    rows = graded_exponents(points.shape[-1], degree).to(points.device)
    result = powers[..., 0, rows[:, 0]]
    for axis in range(1, points.shape[-1]):
        result = result * powers[..., axis, rows[:, axis]]
    return result


def near_best(points: Tensor, degree: int, values: Tensor, weight: Tensor, tolerance: Tensor) -> NearBest:
    """Minimise max_j weight_j |f(z_j) - p(z_j)| over the polynomials p of the degree, row by row.

    Lawson's iteration: weighted least squares whose weights are multiplied by the errors they left.
    The error of every weighted fit bounds the best uniform error from below, so a row that cannot meet
    its tolerance is known early; the iteration then stops for all, as the degree is of no use. A row that
    is well within its tolerance is left as it is.

    Args:
        points: z, (P, n), well inside what is numerically fine for monomials: the unit ball.
        degree: of the polynomials.
        values: f(z_j), (D, P).
        weight: positive, (D, P).
        tolerance: the error to reach, (D,).

    Returns:
        The best polynomials that were met.

    Source: Lawson, "Contributions to the theory of linear least maximum approximation", UCLA (1961);
    Rice and Usow, "The Lawson algorithm and extensions", Math. Comp. 22 (1968).
    """
    orthonormal, triangle = torch.linalg.qr(monomials(points, degree))
    rows = max(1, _BLOCK // orthonormal.numel())
    blocks = zip(values.split(rows), weight.split(rows), tolerance.split(rows), strict=True)
    found = [_lawson(orthonormal, *block) for block in blocks]
    coefficients, error, lower = (torch.cat(parts) for parts in zip(*found, strict=True))
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

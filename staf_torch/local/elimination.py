"""Degree by degree: which combinations of point values see nothing of the lower polynomials."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from ..centers.ball import exponents

_SINGULAR = 1e-12  # of the monomials' Fischer norm 1: below this a direction belongs to a higher degree


class Elimination(NamedTuple):
    """Orthonormal functionals lambda_j(p) = sum_i q_ij p(u_i), with lambda_j(p) = 0 for every polynomial
    of degree below k_j, ordered by k_j."""

    functionals: Tensor  # q, (M, M), orthonormal columns
    strengths: Tensor  # sigma_j > 0, (M,): norm of lambda_j on the homogeneous polynomials of degree k_j
    degrees: tuple[int, ...]  # k_j, M of them, non-decreasing


def eliminate(directions: Tensor) -> Elimination:
    """The functionals of the points u_i: (M, n), distinct, max |u_i| = 1.

    The monomial matrix u_i^alpha sqrt(k! / alpha!), |alpha| = k, is reduced one degree k at a time by
    orthogonal row operations; the left singular vectors of what is left of degree k are the functionals
    of degree k, and the rest goes on to degree k + 1. Distinct points are told apart by some degree
    below M, so that the process ends.

    Source: de Boor and Ron, "The least solution for the polynomial interpolation problem", Math. Z. 210
    (1992); Fornberg, Larsson and Flyer, SIAM J. Sci. Comput. 33 (2011).
    """
    count = directions.shape[0]
    rest = torch.eye(count, dtype=directions.dtype, device=directions.device)
    functionals, strengths, degrees = [], [], []
    degree = 0
    while rest.shape[1] > 0:
        left, sigma, _ = torch.linalg.svd(rest.mT @ _homogeneous(directions, degree), full_matrices=True)
        rank = int((sigma > _SINGULAR).sum())
        functionals.append(rest @ left[:, :rank])
        strengths.append(sigma[:rank])
        degrees += [degree] * rank
        rest = rest @ left[:, rank:]
        degree += 1
        if degree > count:
            raise ValueError(
                f"`StateFollowingCenters(directions=...)` must be told apart by polynomials: {rest.shape[1]} "
                f"of {count} directions coincide with others to rounding."
            )
    return Elimination(torch.cat(functionals, dim=1), torch.cat(strengths), tuple(degrees))


def _homogeneous(directions: Tensor, degree: int) -> Tensor:
    """u_i^alpha sqrt(k! / alpha!) for all |alpha| = k, so that rows have the norm |u_i|^k: (M, C)."""
    alpha = exponents(directions.shape[1], degree)
    norm = [
        math.sqrt(math.factorial(degree) / math.prod(math.factorial(a) for a in row))
        for row in alpha.tolist()
    ]
    powers = directions.unsqueeze(-2) ** alpha.to(directions)
    return powers.prod(-1) * torch.tensor(norm, dtype=directions.dtype, device=directions.device)

"""Degree by degree: which combinations of point values see nothing of the lower polynomials."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ..centers.ball import exponents

_SINGULAR = 1e-12  # of the monomials' Fischer norm 1: below this a direction belongs to a higher degree


class Elimination(NamedTuple):
    """Orthonormal functionals lambda_j(p) = sum_i q_ij p(u_i), with lambda_j(p) = 0 for every polynomial
    of degree below k_j, ordered by k_j."""

    functionals: Tensor  # q, (..., M, M), orthonormal columns
    strengths: Tensor  # sigma_j > 0, (..., M): norm of lambda_j on the homogeneous polynomials of degree k_j
    degrees: tuple[int, ...]  # k_j, M of them, non-decreasing


class Degrees(NamedTuple):
    """What of an elimination stays the same under every projective map of the points."""

    sizes: tuple[int, ...]  # functionals of each degree 0, 1, ...
    columns: tuple[tuple[int, ...], ...]  # as many monomials of that degree, independent on the points


def eliminate(directions: Tensor, sizes: Sequence[int] | None = None) -> Elimination:
    """The functionals of the points u_i: (..., M, n), distinct, max |u_i| = 1.

    The monomial matrix u_i^alpha sqrt(k! / alpha!), |alpha| = k, is reduced one degree k at a time by
    orthogonal row operations; the left singular vectors of what is left of degree k are the functionals
    of degree k, and the rest goes on to degree k + 1. Distinct points are told apart by some degree
    below M, so that the process ends.

    Args:
        directions: (..., M, n).
        sizes: how many functionals each degree has; found from the singular values where it is not
            given, which takes directions without batch dimensions.

    Raises:
        ValueError: if points coincide to rounding.

    Source: de Boor and Ron, "The least solution for the polynomial interpolation problem", Math. Z. 210
    (1992); Fornberg, Larsson and Flyer, SIAM J. Sci. Comput. 33 (2011).
    """
    count = directions.shape[-2]
    rest = torch.eye(count, dtype=directions.dtype, device=directions.device)
    functionals, strengths, degrees = [], [], []
    for degree in itertools.count():
        monomials = _homogeneous(directions, degree)
        left, sigma, _ = torch.linalg.svd(rest.mT @ monomials, full_matrices=True)
        size = int((sigma > _SINGULAR).sum()) if sizes is None else sizes[degree]
        functionals.append(rest @ left[..., :size])
        strengths.append(sigma[..., :size])
        degrees += [degree] * size
        rest = rest @ left[..., size:]
        if rest.shape[-1] == 0:
            break
        if degree > count:
            raise ValueError(
                f"`StateFollowingCenters(directions=...)` must be told apart by polynomials: "
                f"{rest.shape[-1]} of {count} directions coincide with others to rounding."
            )
    return Elimination(torch.cat(functionals, dim=-1), torch.cat(strengths, dim=-1), tuple(degrees))


def degrees_of(directions: Tensor) -> Degrees:
    """The degrees of the points u_i, (M, n), and monomials that tell them apart."""
    found = eliminate(directions)
    sizes = tuple(found.degrees.count(k) for k in range(found.degrees[-1] + 1))
    columns, taken = [], 0
    for degree, size in enumerate(sizes):
        rest = found.functionals[:, taken : taken + size].mT @ _homogeneous(directions, degree)
        columns.append(_independent(rest, size))
        taken += size
    return Degrees(sizes, tuple(columns))


def follow(functionals: Tensor, directions: Tensor, degrees: Degrees) -> Tensor:
    """The functionals as a smooth function of the points, equal to what was given at the points themselves.

    The singular vectors of `eliminate` turn freely within a degree and have no derivative; what matters is
    that they kill the lower polynomials. q - A (A'A)^-1 A'q does so for the monomials A of lower degree at
    all points nearby, and is q where q was found.

    Args:
        functionals: q, constants, (..., M, M).
        directions: u, (..., M, n).
        degrees: of the points.
    """
    lower: list[Tensor] = []
    moved, taken = [], 0
    for degree, (size, columns) in enumerate(zip(degrees.sizes, degrees.columns, strict=True)):
        block = functionals[..., taken : taken + size]
        if lower and size:
            a = torch.cat(lower, dim=-1)
            # Not `solve_ex`, whose forward derivative is wrong under vmap in torch 2.13.
            block = block - a @ (torch.linalg.inv_ex(a.mT @ a).inverse @ (a.mT @ block))
        moved.append(block.expand(*directions.shape[:-1], size))
        lower.append(_homogeneous(directions, degree)[..., list(columns)])
        taken += size
    return torch.cat(moved, dim=-1)


def _independent(matrix: Tensor, count: int) -> tuple[int, ...]:
    """Greedy choice of columns, each the farthest from the span of those before it."""
    rest, chosen = matrix.clone(), []
    for _ in range(count):
        column = int(rest.square().sum(0).argmax())
        chosen.append(column)
        unit = rest[:, column] / rest[:, column].norm()
        rest = rest - unit[:, None] * (unit @ rest)
    return tuple(chosen)


def _homogeneous(directions: Tensor, degree: int) -> Tensor:
    """u_i^alpha sqrt(k! / alpha!) for all |alpha| = k, so that rows have the norm |u_i|^k: (..., M, C)."""
    alpha = exponents(directions.shape[-1], degree)
    norm = [math.sqrt(math.factorial(degree) / math.prod(map(math.factorial, row))) for row in alpha.tolist()]
    # By products and not by pow, whose second derivative at 0 is NaN for the exponents 0 and 1.
    powers = [torch.ones_like(directions)]
    for _ in range(degree):
        powers.append(powers[-1] * directions)
    table = torch.stack(powers, dim=-1)  # (..., M, n, degree + 1)
    monomials = torch.tensor(norm, dtype=directions.dtype, device=directions.device)
    for axis, exponent in enumerate(alpha.unbind(-1)):
        monomials = monomials * table[..., axis, exponent.to(directions.device)]
    return monomials

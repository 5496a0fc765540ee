"""Degree by degree: which combinations of point values see nothing of the lower polynomials."""

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..centers.layouts import exponents
from ..lanes.per_row.objects import rows

_SINGULAR = 1e-12  # of the monomials' Fischer norm 1: below this a direction belongs to a higher degree


class Elimination(NamedTuple):
    """Orthonormal functionals lambda_j(p) = sum_i q_ij p(u_i), with lambda_j(p) = 0 for every polynomial
    of degree below k_j, ordered by k_j."""

    functionals: Tensor  # q, (..., M, M), orthonormal columns
    strengths: Tensor  # sigma_j > 0, (..., M): norm of lambda_j on the homogeneous polynomials of degree k_j
    degrees: tuple[int, ...]  # k_j, M of them, non-decreasing


class Degrees(NamedTuple):
    """The degrees that determine the local basis of points; every projective map of the points keeps them."""

    monomials: tuple[tuple[tuple[int, ...], ...], ...]
    """Exponents of as many monomials of degree 0, 1, ... as tell the points apart at that degree."""
    reach: float
    """max |u_i| when the degrees were found, the unit of length of the basis."""

    @classmethod
    def of(cls, record: dict[str, Any]) -> Degrees:
        """From `_asdict`, also where tuples have become lists."""
        monomials = (tuple(tuple(row) for row in block) for block in record["monomials"])
        reach = record["reach"]
        if isinstance(reach, list):  # of directions of a row's own
            return cls(tuple(monomials), rows(torch.tensor(reach, dtype=torch.float64, device="cpu")))
        return cls(tuple(monomials), float(reach))

    def sizes(self) -> tuple[int, ...]:
        """Number of functionals of each degree."""
        return tuple(len(block) for block in self.monomials)

    def each(self) -> tuple[int, ...]:
        """k_j, the degree of every functional: M of them, non-decreasing."""
        return tuple(k for k, block in enumerate(self.monomials) for _ in block)


def eliminate(directions: Tensor) -> Elimination:
    """The functionals of the points u_i: (M, n), distinct, max |u_i| = 1.

    The monomial matrix u_i^alpha sqrt(k! / alpha!), |alpha| = k, is reduced one degree k at a time by
    orthogonal row operations; the left singular vectors of what is left of degree k are the functionals
    of degree k, and the rest goes on to degree k + 1. Distinct points are told apart by some degree
    below M, so that the process ends.

    Raises:
        ValueError: if points coincide to rounding.

    Source: de Boor and Ron, "The least solution for the polynomial interpolation problem", Math. Z. 210
    (1992); Fornberg, Larsson and Flyer, SIAM J. Sci. Comput. 33 (2011).
    """
    count = directions.shape[-2]
    rest = torch.eye(count, dtype=directions.dtype, device=directions.device)
    functionals, strengths, degrees = [], [], []
    for degree in range(count + 2):  # two more than any needs, for rounding
        monomials = homogeneous(directions, degree)
        left, sigma, _ = torch.linalg.svd(rest.mT @ monomials, full_matrices=True)
        size = int((sigma > _SINGULAR).sum())
        functionals.append(rest @ left[..., :size])
        strengths.append(sigma[..., :size])
        degrees += [degree] * size
        rest = rest @ left[..., size:]
        if rest.shape[-1] == 0:
            break
    else:
        raise ValueError(
            f"`StateFollowingCenters(directions=...)` must be told apart by polynomials: "
            f"{rest.shape[-1]} of {count} directions coincide with others to rounding."
        )
    return Elimination(torch.cat(functionals, dim=-1), torch.cat(strengths, dim=-1), tuple(degrees))


def degrees_of(directions: Tensor) -> Degrees:
    """The degrees of the points u_i, (M, n), and monomials that tell them apart.

    Raises:
        ValueError: if points coincide to rounding.
    """
    points = directions.detach().double()
    reach = float(points.norm(dim=-1).max()) or 1.0  # one center at the state itself
    points = points / reach
    found = eliminate(points)
    monomials, taken = [], 0
    for degree in range(found.degrees[-1] + 1):
        size = found.degrees.count(degree)
        rest = found.functionals[:, taken : taken + size].mT @ homogeneous(points, degree)
        alpha = _exponents(points.shape[-1], degree)
        monomials.append(tuple(alpha[k] for k in _independent(rest, size)))
        taken += size
    return Degrees(tuple(monomials), reach)


def functionals_of(points: Tensor, degrees: Degrees) -> Elimination:
    """Functionals as in `eliminate`, as a smooth function of the points that has one value.

    The singular vectors of `eliminate` turn freely within a degree: coefficients in that basis would mean
    another function on another machine, and the basis would have no derivative. Here the functionals are
    the orthogonal factor of the chosen monomials, by ascending degree, with a positive diagonal: column j
    is orthogonal to all polynomials of lower degree.

    Args:
        points: u, (..., M, n), as many as the degrees were found for.
        degrees: which monomials.
    """
    chosen = tuple(row for block in degrees.monomials for row in block)
    q, r = torch.linalg.qr(_monomials(points, chosen))
    diagonal = r.diagonal(dim1=-2, dim2=-1)
    q = torch.where(diagonal.unsqueeze(-2) < 0, -q, q)
    strengths, start = [], 0
    for size in degrees.sizes():
        block = r[..., start : start + size, start : start + size]
        # torch 2.9 keeps the dimension where one number without memory (device meta) is summed up.
        strengths.append(block.norm(dim=-1) if size > 1 else block.abs().squeeze(-1))
        start += size
    return Elimination(q, torch.cat(strengths, dim=-1), degrees.each())


def _independent(matrix: Tensor, count: int) -> tuple[int, ...]:
    """Greedy choice of columns far from the span of those before it, the same whatever the rounding."""
    rest, chosen = matrix.clone(), []
    for _ in range(count):
        square = rest.square().sum(0)
        # The first that is long enough and not the longest: symmetric layouts have ties.
        column = int((square >= 0.37 * square.max()).to(torch.int8).argmax())
        chosen.append(column)
        unit = rest[:, column] / rest[:, column].norm()
        rest = rest - unit[:, None] * (unit @ rest)
    return tuple(sorted(chosen))


def homogeneous(directions: Tensor, degree: int) -> Tensor:
    """u_i^alpha sqrt(k! / alpha!) for all |alpha| = k, so that rows have the norm |u_i|^k: (..., M, C)."""
    return _monomials(directions, _exponents(directions.shape[-1], degree))


def _exponents(dim: int, degree: int) -> tuple[tuple[int, ...], ...]:
    """Return `exponents` as numbers."""
    # torch.compile warns of a cache that it does not see.
    return (_exponents_of if torch.compiler.is_compiling() else _kept_exponents)(dim, degree)


def _exponents_of(dim: int, degree: int) -> tuple[tuple[int, ...], ...]:
    return tuple(map(tuple, exponents(dim, degree).tolist()))


def _scales(alpha: tuple[tuple[int, ...], ...]) -> tuple[float, ...]:
    """sqrt(k! / alpha!), k = |alpha|, of each."""
    return (_scales_of if torch.compiler.is_compiling() else _kept_scales)(alpha)


def _scales_of(alpha: tuple[tuple[int, ...], ...]) -> tuple[float, ...]:
    factorials = [math.prod([math.factorial(a) for a in row]) for row in alpha]
    return tuple(math.sqrt(math.factorial(sum(row)) / x) for row, x in zip(alpha, factorials, strict=True))


_kept_exponents = functools.lru_cache(maxsize=256)(_exponents_of)
_kept_scales = functools.lru_cache(maxsize=256)(_scales_of)


def _monomials(points: Tensor, alpha: tuple[tuple[int, ...], ...]) -> Tensor:
    """u_i^alpha sqrt(k! / alpha!), k = |alpha|: (..., M, n) -> (..., M, C)."""
    table = _powers(points, max([sum(row) for row in alpha]))
    monomials = torch.tensor(_scales(alpha), dtype=points.dtype, device=points.device)
    for axis in range(points.shape[-1]):
        monomials = monomials * table[..., axis, [row[axis] for row in alpha]]
    return monomials


def _powers(points: Tensor, top: int) -> Tensor:
    """1, u, ..., u^top: (..., top + 1). By products: the second derivative of pow is NaN at 0^0 and 0^1."""
    powers = [torch.ones_like(points)]
    for _ in range(top):
        powers.append(powers[-1] * points)
    return torch.stack(powers, dim=-1)

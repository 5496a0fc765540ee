"""Well-spread directions in the unit ball of any dimension: approximate Fekete points."""

from __future__ import annotations

import itertools
import math

import torch
from torch import Tensor

from .._checks import integer

_CANDIDATES = 4000
_EXCHANGES = 2000


def ball(count: int, dim: int) -> Tensor:
    """Approximate Fekete points of the closed unit ball.

    Unisolvent for polynomials of degree <= k whenever count = C(dim + k, k). Deterministic: the points
    are chosen among a fixed low-discrepancy cloud by row pivoting of a polynomial Vandermonde matrix,
    then exchanged one by one as long as that increases its determinant.

    Args:
        count: M, at least 1; one point is the origin.
        dim: n, at least 1.

    Returns:
        (count, dim), float64.

    Raises:
        ValueError: if an argument is not a positive integer.

    Source: Bos, De Marchi, Sommariva and Vianello, "Computing multivariate Fekete and Leja points by
    numerical linear algebra", SIAM J. Numer. Anal. 48 (2010).
    """
    integer("ball", "count", count, least=1)
    integer("ball", "dim", dim, least=1)
    if count == 1:
        return torch.zeros(1, dim, dtype=torch.float64)
    degree = 0
    while math.comb(dim + degree, degree) < count:
        degree += 1
    cloud = _cloud(max(_CANDIDATES, 20 * count), dim)
    vandermonde = _orthonormal(_monomials(cloud, degree))
    chosen = _pivot_rows(vandermonde, count)
    if count == vandermonde.shape[1]:
        chosen = _exchange(vandermonde, chosen)
    return cloud[chosen]


def probe_points(count: int, dim: int) -> Tensor:
    """Points of the closed unit ball to take a supremum over, the origin first: (count, dim), float64.

    Errors of an interpolant are largest near the boundary. On a line the points are equidistant; in the
    plane two thirds of them are on the unit circle and the rest on two inner ones; in space half of them
    are on the sphere. Deterministic.
    """
    integer("probe_points", "count", count, least=2)
    if dim == 1:
        line = torch.linspace(-1, 1, count - 1, dtype=torch.float64).unsqueeze(-1)
        return torch.cat((line.new_zeros(1, 1), line))
    if dim > 2:
        return _cloud(count - 1, dim)
    inner, middle = (count - 1) // 12, (count - 1) // 4
    circles = [torch.zeros(1, 2, dtype=torch.float64)]
    for radius, points in ((1.0, count - 1 - middle - inner), (0.75, middle), (0.4, inner)):
        angle = torch.arange(points, dtype=torch.float64) * (2 * math.pi / max(1, points))
        circles.append(radius * torch.stack((angle.sin(), angle.cos()), dim=-1))
    return torch.cat(circles)


def exponents(dim: int, degree: int) -> Tensor:
    """All multi-indices of total degree exactly ``degree`` in ``dim`` variables: (C, dim), int64."""
    rows = [
        [combination.count(axis) for axis in range(dim)]
        for combination in itertools.combinations_with_replacement(range(dim), degree)
    ]
    return torch.tensor(rows, dtype=torch.int64).reshape(-1, dim)


def _cloud(size: int, dim: int) -> Tensor:
    """The origin, ``size``/2 points of the sphere and as many inside: a Kronecker sequence."""
    root = 2.0
    for _ in range(64):  # the positive root of g^(dim + 2) = g + 1: Roberts' generalised golden ratio
        root = (1 + root) ** (1 / (dim + 2))
    steps = torch.tensor([root ** -(k + 1) for k in range(dim + 1)], dtype=torch.float64)
    index = torch.arange(1, size + 1, dtype=torch.float64)
    uniform = (0.5 + index[:, None] * steps) % 1
    normal = torch.special.ndtri(uniform[:, :dim].clamp(1e-9, 1 - 1e-9))
    sphere = normal / normal.norm(dim=-1, keepdim=True)
    shell = torch.where(index % 2 == 0, 1.0, uniform[:, dim] ** (1 / dim))
    points = torch.cat((sphere.new_zeros(1, dim), sphere * shell[:, None]))
    cloud: Tensor = points / points.norm(dim=-1, keepdim=True).clamp(min=1.0)
    return cloud


def _monomials(points: Tensor, degree: int) -> Tensor:
    """x^alpha for |alpha| <= degree, graded: (N, n) -> (N, C(n + degree, degree))."""
    powers = torch.stack([points**k for k in range(degree + 1)], dim=-1)
    columns = torch.cat([exponents(points.shape[1], k) for k in range(degree + 1)])
    result = points.new_ones(points.shape[0], columns.shape[0])
    for axis in range(points.shape[1]):
        result *= powers[:, axis, columns[:, axis]]
    return result


def _orthonormal(vandermonde: Tensor) -> Tensor:
    """The same polynomials, orthonormal over the cloud; twice, so that rounding does not show."""
    once = torch.linalg.qr(vandermonde)[0]
    twice: Tensor = torch.linalg.qr(once)[0]
    return twice


def _pivot_rows(matrix: Tensor, count: int) -> Tensor:
    """Greedy choice of rows: each the farthest from the span of those before it."""
    rest = matrix.clone()
    chosen = []
    for _ in range(count):
        row = int(rest.square().sum(-1).argmax())
        chosen.append(row)
        direction = rest[row] / rest[row].norm()
        rest = rest - (rest @ direction)[:, None] * direction
    return torch.tensor(chosen)


def _exchange(matrix: Tensor, chosen: Tensor) -> Tensor:
    """Swap a chosen row for the candidate that multiplies |det| most, until none gains 1 %."""
    cardinal = matrix @ torch.linalg.inv(matrix[chosen])  # (N, M): 1 at its own row, 0 at the others
    for _ in range(_EXCHANGES):
        best = int(cardinal.abs().argmax())
        row, column = divmod(best, cardinal.shape[1])
        if float(cardinal[row, column].abs()) < 1.01:
            break
        chosen[column] = row
        update = cardinal[row].clone()
        update[column] -= 1.0
        cardinal = cardinal - cardinal[:, column, None] / cardinal[row, column] * update
    return chosen

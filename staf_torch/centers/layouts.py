"""Directions (M, n) in the closed unit ball: in closed form, or as approximate Fekete points."""

from __future__ import annotations

import functools
import itertools
import math
import warnings

import torch
from torch import Tensor

from ..numerics.checks import choice, integer
from ..signs import Sign

# count -> (points, radius) of each ring, from the outside in.
# Source: L. Bos, concentric spheres unisolvent for polynomials in the plane; MATH.md section 1.
_RINGS: dict[int, tuple[tuple[int, float], ...]] = {
    3: ((3, 1.0),),
    6: ((5, 1.0), (1, 0.0)),
    10: ((7, 1.0), (3, 0.43)),
    15: ((9, 1.0), (5, 0.63), (1, 0.0)),
    21: ((11, 1.0), (7, 0.75), (3, 0.28)),
    28: ((13, 1.0), (9, 0.82), (5, 0.46), (1, 0.0)),
}
RING_COUNTS = tuple(_RINGS)
"""Centers that `rings` has an arrangement for."""

_CANDIDATES = 4000  # points of the cloud that `ball` chooses from
_EXCHANGES = 2000


def _circle(count: int) -> Tensor:
    """(sin, cos) of equally spaced angles, from (0, 1) clockwise, as in the paper: (count, 2)."""
    angle = torch.arange(count, dtype=torch.float64, device="cpu") * (2 * math.pi / max(1, count))
    return torch.stack((angle.sin(), angle.cos()), dim=-1)


def rings(count: int) -> Tensor:
    """Concentric rings in the plane, unisolvent for polynomials of degree k, count = C(k+2, 2).

    Example:
        >>> rings(6).norm(dim=-1)
        tensor([1.0000, 1.0000, 1.0000, 1.0000, 1.0000, 0.0000], dtype=torch.float64)

        Shown by `staf centers=rings centers.count=6`.

    Args:
        count: 3, 6, 10, 15, 21 or 28.

    Returns:
        (count, 2), float64, the outer ring first. `rings(3)` is the paper's triangle.

    Raises:
        ValueError: for another count.
    """
    integer("rings", "count", count, least=1)
    choice("rings", "count", count, tuple(_RINGS))
    parts = [radius * _circle(points) for points, radius in _RINGS[count]]
    return torch.cat(parts)


def polygon(count: int) -> Tensor:
    """A regular polygon in the plane, u_i = (sin(2 pi i / M), cos(2 pi i / M)), the paper's order.

    Its points lie on a conic, so five or more of them are no better than second order: a warning
    says so.

    Example:
        >>> polygon(4).round(decimals=3)
        tensor([[ 0.,  1.],
                [ 1.,  0.],
                [ 0., -1.],
                [-1., -0.]], dtype=torch.float64)

        Shown by `staf centers=polygon centers.count=5`.

    Args:
        count: at least 1; one point is (0, 1).

    Returns:
        (count, 2), float64.

    Raises:
        ValueError: if ``count`` is not a positive integer.

    Source: Rosenfeld et al., section 7 (count = 3).
    """
    integer("polygon", "count", count, least=1)
    if count >= 5:
        warnings.warn(
            f"polygon({count}): the corners of a regular polygon lie on a conic, so five or more "
            "stay second-order accurate however many there are; rings(6), rings(10), ... gain an "
            "order each.",
            stacklevel=2,
        )
    return _circle(count)


def simplex(dim: int) -> Tensor:
    """The corners of a regular simplex on the unit sphere: dim + 1 points, u_i'u_j = -1/dim.

    Example:
        >>> simplex(2).shape, bool(simplex(3).sum(0).abs().max() < 1e-12)
        (torch.Size([3, 2]), True)

        Shown by `staf centers=simplex`.

    Args:
        dim: n, at least 1.

    Returns:
        (dim + 1, dim), float64.

    Raises:
        ValueError: if ``dim`` is not a positive integer.
    """
    integer("simplex", "dim", dim, least=1)
    # Corner k: coordinates built one axis at a time; each axis leaves the rest a smaller simplex.
    points = torch.zeros(dim + 1, dim, dtype=torch.float64, device="cpu")
    for axis in range(dim):
        rest = dim - axis
        height = math.sqrt(max(0.0, 1.0 - float(points[axis].square().sum())))
        points[axis, axis] = height
        points[axis + 1 :, axis] = -height / rest
    corners: Tensor = points / points.norm(dim=-1, keepdim=True)
    return corners


def cross_polytope(dim: int) -> Tensor:
    """The corners of the cross-polytope, +e_1, -e_1, +e_2, ...: 2 dim points.

    Example:
        >>> cross_polytope(2)
        tensor([[ 1.,  0.],
                [-1., -0.],
                [ 0.,  1.],
                [-0., -1.]], dtype=torch.float64)

        Shown by `staf centers=cross_polytope`.

    Args:
        dim: n, at least 1.

    Returns:
        (2 dim, dim), float64.

    Raises:
        ValueError: if ``dim`` is not a positive integer.
    """
    integer("cross_polytope", "dim", dim, least=1)
    axes = torch.eye(dim, dtype=torch.float64, device="cpu")
    return torch.stack((axes, -axes), dim=1).reshape(2 * dim, dim)


@Sign("a layout of centers in a ball")
def ball(count: int, dim: int) -> Tensor:
    """Approximate Fekete points of the closed unit ball.

    Unisolvent for polynomials of degree <= k whenever count = C(dim + k, k). Deterministic: the points
    are chosen among a fixed low-discrepancy cloud by row pivoting of a polynomial Vandermonde matrix,
    then exchanged one by one as long as that increases its determinant. A process chooses them once.

    Example:
        >>> directions = ball(10, dim=3)
        >>> directions.shape, bool((directions.norm(dim=-1) <= 1 + 1e-12).all())
        (torch.Size([10, 3]), True)

        Shown by `staf experiment=layouts`.

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
        return torch.zeros(1, dim, dtype=torch.float64, device="cpu")
    return _fekete(count, dim).clone()


def probe_points(count: int, dim: int) -> Tensor:
    """Points of the closed unit ball to take a supremum over, the origin first: (count, dim), float64.

    Errors of an interpolant are largest near the boundary. On a line the points are equidistant; in the
    plane two thirds of them are on the unit circle and the rest on two inner ones; in space half of them
    are on the sphere. Deterministic.

    Example:
        >>> points = probe_points(100, dim=2)
        >>> points.shape, bool((points.norm(dim=-1) <= 1 + 1e-12).all())
        (torch.Size([100, 2]), True)

        Shown by `staf experiment=ablation`.
    """
    integer("probe_points", "count", count, least=2)
    if dim == 1:
        line = torch.linspace(-1, 1, count - 1, dtype=torch.float64, device="cpu").unsqueeze(-1)
        return torch.cat((line.new_zeros(1, 1), line))
    if dim > 2:
        return _cloud(count - 1, dim)
    inner, middle = (count - 1) // 12, (count - 1) // 4
    circles = [torch.zeros(1, 2, dtype=torch.float64, device="cpu")]
    for radius, points in ((1.0, count - 1 - middle - inner), (0.75, middle), (0.4, inner)):
        circles.append(radius * _circle(points))
    return torch.cat(circles)


def exponents(dim: int, degree: int) -> Tensor:
    """All multi-indices of total degree exactly ``degree`` in ``dim`` variables: (C, dim), int64."""
    rows = [
        [combination.count(axis) for axis in range(dim)]
        for combination in itertools.combinations_with_replacement(range(dim), degree)
    ]
    return torch.tensor(rows, dtype=torch.int64, device="cpu").reshape(-1, dim)


def monomials(points: Tensor, degree: int) -> Tensor:
    """z^a = prod_i z_i^{a_i}, |a| <= degree, graded: (..., P, n) -> (..., P, C(n + degree, n))."""
    powers = torch.stack([points**k for k in range(degree + 1)], dim=-1)
    rows = torch.cat([exponents(points.shape[-1], k) for k in range(degree + 1)]).to(points.device)
    result = powers[..., 0, rows[:, 0]]
    for axis in range(1, points.shape[-1]):
        result = result * powers[..., axis, rows[:, axis]]
    return result


@functools.lru_cache(maxsize=128)
def _fekete(count: int, dim: int) -> Tensor:
    """The points of `ball`, whose choice takes up to seconds, kept: nobody else writes to these."""
    degree = 0
    while math.comb(dim + degree, degree) < count:
        degree += 1
    cloud = _cloud(max(_CANDIDATES, 20 * count), dim)
    vandermonde = monomials(cloud, degree)
    for _ in range(2):  # orthonormal over the cloud; twice, so that rounding does not show
        vandermonde = torch.linalg.qr(vandermonde)[0]
    chosen = _pivot_rows(vandermonde, count)
    if count == vandermonde.shape[1]:
        chosen = _exchange(vandermonde, chosen)
    return cloud[chosen]


def _cloud(size: int, dim: int) -> Tensor:
    """The origin, ``size``/2 points of the sphere and as many inside: a Kronecker sequence."""
    root = 2.0
    for _ in range(64):  # the positive root of g^(dim + 2) = g + 1: Roberts' generalised golden ratio
        root = (1 + root) ** (1 / (dim + 2))
    steps = torch.tensor([root ** -(k + 1) for k in range(dim + 1)], dtype=torch.float64, device="cpu")
    index = torch.arange(1, size + 1, dtype=torch.float64, device="cpu")
    uniform = (0.5 + index[:, None] * steps) % 1
    normal = torch.special.ndtri(uniform[:, :dim].clamp(1e-9, 1 - 1e-9))
    sphere = normal / normal.norm(dim=-1, keepdim=True)
    shell = torch.where(index % 2 == 0, 1.0, uniform[:, dim] ** (1 / dim))
    points = torch.cat((sphere.new_zeros(1, dim), sphere * shell[:, None]))
    cloud: Tensor = points / points.norm(dim=-1, keepdim=True).clamp(min=1.0)
    return cloud


def _pivot_rows(matrix: Tensor, count: int) -> Tensor:
    """Greedy choice of rows: each the farthest from the span of those before it."""
    rest = matrix.clone()
    chosen = []
    for _ in range(count):
        row = int(rest.square().sum(-1).argmax())
        chosen.append(row)
        direction = rest[row] / rest[row].norm()
        rest = rest - (rest @ direction)[:, None] * direction
    return torch.tensor(chosen, dtype=torch.int64, device="cpu")


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

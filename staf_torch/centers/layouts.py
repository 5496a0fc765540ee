"""Directions (M, n) in the closed unit ball, in closed form. `ball` is in a file of its own."""

from __future__ import annotations

import math
import warnings

import torch
from torch import Tensor

from .._checks import choice, integer

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


def _circle(count: int) -> Tensor:
    """(sin, cos) of equally spaced angles, from (0, 1) clockwise, as in the paper: (count, 2)."""
    angle = torch.arange(count, dtype=torch.float64) * (2 * math.pi / count)
    return torch.stack((angle.sin(), angle.cos()), dim=-1)


def rings(count: int) -> Tensor:
    """Concentric rings in the plane, unisolvent for polynomials of degree k, count = C(k+2, 2).

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

    Args:
        dim: n, at least 1.

    Returns:
        (dim + 1, dim), float64.

    Raises:
        ValueError: if ``dim`` is not a positive integer.
    """
    integer("simplex", "dim", dim, least=1)
    # Corner k: coordinates built one axis at a time; each axis leaves the rest a smaller simplex.
    points = torch.zeros(dim + 1, dim, dtype=torch.float64)
    for axis in range(dim):
        rest = dim - axis
        height = math.sqrt(max(0.0, 1.0 - float(points[axis].square().sum())))
        points[axis, axis] = height
        points[axis + 1 :, axis] = -height / rest
    corners: Tensor = points / points.norm(dim=-1, keepdim=True)
    return corners


def cross_polytope(dim: int) -> Tensor:
    """The corners of the cross-polytope, +e_1, -e_1, +e_2, ...: 2 dim points.

    Args:
        dim: n, at least 1.

    Returns:
        (2 dim, dim), float64.

    Raises:
        ValueError: if ``dim`` is not a positive integer.
    """
    integer("cross_polytope", "dim", dim, least=1)
    axes = torch.eye(dim, dtype=torch.float64)
    return torch.stack((axes, -axes), dim=1).reshape(2 * dim, dim)

"""Points to fit and to measure on: of a ball around the state, and of a domain of states."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from .._checks import integer, positive_real, vector
from ..centers import probe_points


def ball_grid(dim: int, shells: int, directions: int) -> Tensor:
    """The origin and ``shells`` spheres of the closed unit ball, crowded towards its surface.

    The radii are cos(pi k / (2 shells)), so that with the origin each diameter carries Chebyshev-like
    nodes. In the plane every circle has ``directions`` equally spaced angles, every other circle turned
    by half a step; on a line there are two directions; in space the directions of all shells together
    are a low-discrepancy sequence.

    Args:
        dim: n, at least 1.
        shells: at least 1.
        directions: of each shell, at least 1.

    Returns:
        (1 + shells directions, dim), float64, the origin first.

    Raises:
        ValueError: if an argument is not a positive integer.
    """
    for name, value in (("dim", dim), ("shells", shells), ("directions", directions)):
        integer("ball_grid", name, value, least=1)
    radii = torch.cos(torch.arange(shells, dtype=torch.float64) * (math.pi / (2 * shells)))
    points = (radii[:, None, None] * _directions(dim, shells, directions)).reshape(-1, dim)
    return torch.cat((points.new_zeros(1, dim), points))


def _directions(dim: int, shells: int, directions: int) -> Tensor:
    """Unit vectors, (shells or 1, directions, dim)."""
    if dim == 1:
        return torch.tensor([[[1.0], [-1.0]]], dtype=torch.float64)
    if dim == 2:
        turned = 0.5 * (torch.arange(shells, dtype=torch.float64) % 2)
        steps = torch.arange(directions, dtype=torch.float64) + turned[:, None]
        angle = steps * (2 * math.pi / directions)
        return torch.stack((angle.cos(), angle.sin()), dim=-1)
    cloud = probe_points(shells * directions + 1, dim)[1:]
    unit: Tensor = cloud / cloud.norm(dim=-1, keepdim=True)
    return unit.reshape(shells, directions, dim)


def disc(
    radius: float = 1.0, *, dim: int = 2, count: int = 97, center: Sequence[float] | None = None
) -> Tensor:
    """States that cover the closed ball |x - center| <= radius, for a domain D.

    Example:
        >>> disc(1.0).shape
        torch.Size([97, 2])

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
    offset = torch.tensor(middle, dtype=torch.float64)
    return offset + extent * probe_points(integer("disc", "count", count, least=2), dim)

"""Points to fit and to measure on: of a ball around the state, and of a domain of states."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from .._checks import integer, positive_real, vector
from ..centers import probe_points

_STARTS = 8  # points of the grid from which a supremum is sought
_CLIMBS = 16


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


def supremum(function: Callable[[Tensor], Tensor], grid: Tensor, radius: float) -> Tensor:
    """max f_j(z) over |z| <= radius for each of D functions: the largest values on a grid, then uphill.

    From the points of the grid with the largest values a pattern search climbs on, in steps along the axes
    that are halved where none of them gains; points that leave the ball go back to its surface.

    Args:
        function: f, offsets (P, n), the same for all, or (D, P, n), to values (D, P).
        grid: of the ball, (P, n).
        radius: of the ball.

    Returns:
        (D,), NaN where a value on the grid is.
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

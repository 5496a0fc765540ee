"""Quadratic functions on a box: their minimum, exactly, for a few unknowns."""

from __future__ import annotations

import itertools

import torch
from torch import Tensor

LARGEST = 4  # unknowns: every one is at its lower bound, free, or at its upper bound, 3^m cases
_LOW, _FREE, _HIGH = -1, 0, 1


def faces(count: int) -> Tensor:
    """Return which unknowns are at a bound, for every face of a box: (3^m, m) of -1, 0 (free) and 1."""
    cases = itertools.product((_FREE, _LOW, _HIGH), repeat=count)
    return torch.tensor(list(cases), dtype=torch.int64, device="cpu").reshape(-1, count)


def face_inverses(curvature: Tensor) -> Tensor:
    """Return, for every face, the inverse of the curvature of the free unknowns, 0 in the others: H (...,
    m, m), symmetric positive definite, -> (..., 3^m, m, m)."""
    free = (faces(curvature.shape[-1]) == _FREE).to(curvature)
    both = free.unsqueeze(-1) * free.unsqueeze(-2)
    fixed = torch.diag_embed(1 - free)
    inverses: Tensor = both * torch.linalg.inv(both * curvature.unsqueeze(-3) + fixed)
    return inverses


def box_minimum(
    curvature: Tensor, slope: Tensor, low: Tensor, high: Tensor, inverses: Tensor | None = None
) -> Tensor:
    """Return argmin of u'Hu / 2 + c'u over low <= u <= high, exactly: H (..., m, m), symmetric positive
    definite, m at most 4; c and the limits (..., m), infinite for none -> (..., m), NaN where c or H is.

    The minimum of one unknown is clipped. For more, the minima of the 3^m faces, clipped, are compared: that
    of the right face is among them, and no other can be lower. ``inverses`` are those of `face_inverses`,
    where H is known beforehand.

    Raises:
        ValueError: if m is larger than 4.
    """
    size = slope.shape[-1]
    if size > LARGEST:
        raise ValueError(f"`box_minimum(slope=...)` must have at most {LARGEST} unknowns; got {size}.")
    if size == 1:
        return _clip(-slope / curvature[..., 0], low, high)
    inverses = face_inverses(curvature) if inverses is None else inverses
    low, high = low.expand_as(slope), high.expand_as(slope)
    best = value = None
    for face, sides in enumerate(faces(size).tolist()):
        ends = torch.stack(
            [
                torch.zeros_like(slope[..., i]) if side == _FREE else (low, high)[side == _HIGH][..., i]
                for i, side in enumerate(sides)
            ],
            dim=-1,
        )
        known = torch.isfinite(ends)
        ends = torch.where(known, ends, 0.0)
        free = ends - _product(inverses[..., face, :, :], slope + _product(curvature, ends))
        tried = _clip(free, low, high)
        cost = ((0.5 * _product(curvature, tried) + slope) * tried).sum(-1)
        cost = torch.where(known.all(-1), cost, torch.inf)
        if best is None or value is None:
            best, value = tried, cost  # the first face is the inside: NaN stays NaN
            continue
        lower = cost < value
        best = torch.where(lower.unsqueeze(-1), tried, best)
        value = torch.where(lower, cost, value)
    assert best is not None
    return best


def minimum_and_slopes(
    curvature: Tensor, slope: Tensor, cross: Tensor, low: Tensor, high: Tensor
) -> tuple[Tensor, Tensor]:
    """Return `box_minimum` of u'Hu / 2 + (c + C x)'u at x = 0, C (B, m, n), and du/dx there, 0 for inputs at
    a bound: (B, m), (B, m, n)."""
    u = box_minimum(curvature, slope, low, high)
    free = ((u > low) & (u < high)).to(curvature)
    masked = curvature * free.unsqueeze(-1) * free.unsqueeze(-2) + torch.diag_embed(1 - free)
    inverse = 1 / masked if masked.shape[-1] == 1 else torch.linalg.inv(masked)
    return u, -(inverse.unsqueeze(-1) * (free.unsqueeze(-1) * cross).unsqueeze(-3)).sum(-2)


def _clip(u: Tensor, low: Tensor, high: Tensor) -> Tensor:
    return torch.minimum(torch.maximum(u, low), high)


def _product(matrix: Tensor, x: Tensor) -> Tensor:
    # By broadcasting, which a compiler fuses.
    return (matrix * x.unsqueeze(-2)).sum(-1)

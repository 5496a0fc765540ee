"""Differences of states with coordinates that are angles."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor


def wrap(difference: Tensor, periodic: Sequence[int]) -> Tensor:
    """The difference with its periodic coordinates in [-pi, pi]: (..., n) -> (..., n).

    Where it lies there already, not a bit of it changes.

    Args:
        difference: of two states, in rad where periodic.
        periodic: the coordinates that are angles; a negative index counts from the end.
    """
    if not periodic:
        return difference
    turn = turns(difference.shape[-1], periodic)
    return difference - turn.to(difference) * (difference / (2 * math.pi)).round()


def turns(size: int, periodic: Sequence[int]) -> Tensor:
    """2 pi where a coordinate is an angle, else 0: (size,)."""
    angles = {index % size for index in periodic}
    return torch.tensor([2 * math.pi if k in angles else 0.0 for k in range(size)], dtype=torch.float64)

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
    size = difference.shape[-1]
    angles = {index % size for index in periodic}
    if len(angles) == size:
        return _wrapped(difference)
    columns = [_wrapped(x) if k in angles else x for k, x in enumerate(difference.unbind(-1))]
    return torch.stack(columns, dim=-1)


def _wrapped(angle: Tensor) -> Tensor:
    return angle - 2 * math.pi * (angle / (2 * math.pi)).round()

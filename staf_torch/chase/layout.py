"""How a piece of time lies in memory."""

from __future__ import annotations

from torch import Tensor


def batch_last(states: Tensor) -> Tensor:
    """The same (B, C, n), stored as (n, C, B): a coordinate is then one contiguous array, trajectories
    are the lanes of every vector instruction, and whatever is computed elementwise stays so."""
    return states.permute(2, 1, 0).contiguous().permute(2, 1, 0)

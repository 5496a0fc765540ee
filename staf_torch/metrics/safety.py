"""Metrics of the constraints of a closed loop."""

from __future__ import annotations

import torch
from torch import Tensor

from ..adp import LoopResult


def constraint_metrics(result: LoopResult, margin: Tensor) -> dict[str, float | None]:
    """The metrics of h >= 0 over the recorded times.

    Args:
        result: the closed loop.
        margin: the smallest h over the constraints at the recorded times, (B, T).

    Returns:
        ``minimum_margin``: the smallest h over rows and times; ``constraint_violations``: the rows with h < 0
        or h unknown at a time, and those that diverged, as a row of `systems.Barrier` that leaves its box.
    """
    known = torch.where(margin.isnan(), torch.inf, margin)
    left = (known < 0).any(-1) | margin.isnan().any(-1) | result.diverged
    least = float(known.min())
    return {
        "minimum_margin": least if abs(least) < float("inf") else None,
        "constraint_violations": float(left.sum()),
    }

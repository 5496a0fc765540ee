"""Constraints of a box: one h a coordinate."""

from __future__ import annotations

import math
from collections.abc import Sequence

from .safety_filter import Constraint


def walls(low: Sequence[float], high: Sequence[float]) -> list[Constraint]:
    """h of every coordinate with a wall, in its units: (x - low)(high - x)/(high - low), or the distance to
    its one wall.

    Args:
        low: of the n coordinates, -inf for no wall.
        high: likewise, inf for none.
    """
    pairs = enumerate(zip(low, high, strict=True))
    return [_within(k, *pair) for k, pair in pairs if not all(map(math.isinf, pair))]


def _within(k: int, low: float, high: float) -> Constraint:
    if math.isinf(low) or math.isinf(high):
        return lambda x, t: high - x[:, k] if math.isinf(low) else x[:, k] - low
    return lambda x, t: (x[:, k] - low) * (high - x[:, k]) / (high - low)

"""Quantiles that `torch.func.vmap` batches, of the values that are known."""

from __future__ import annotations

import torch
from torch import Tensor


def known_quantile(values: Tensor, share: float, *, lower: bool = False) -> Tensor:
    """Return the quantile of the values that are not NaN, (P,) -> (); NaN where there are none.

    Args:
        values: at least one.
        share: in [0, 1].
        lower: whether to return the value below, else both neighbours are interpolated linearly.
    """
    ordered = values.sort().values  # NaN last
    last = (values == values).sum() - 1
    place = (share * last.clamp(min=0).to(values)).unsqueeze(0)
    below = ordered.gather(0, place.floor().long())[0]
    if lower:
        return below
    return torch.lerp(below, ordered.gather(0, place.ceil().long())[0], (place - place.floor())[0])

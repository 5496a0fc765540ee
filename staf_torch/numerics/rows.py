"""Rows of a batch: one of two values in each, and quantiles of values that are known."""

from __future__ import annotations

from typing import TypeVar

import torch
from torch import Tensor

Some = TypeVar("Some", bound=tuple[Tensor, ...])


def chosen(rows: Tensor, new: Some, old: Some) -> Some:
    """The tensors of ``new`` in ``rows`` (B,), those of ``old`` in the others."""

    def pick(a: Tensor, b: Tensor) -> Tensor:
        return torch.where(rows.reshape(-1, *[1] * (a.dim() - 1)), a, b)

    picked = map(pick, new, old)
    return type(new)(*picked) if hasattr(new, "_fields") else type(new)(picked)


def known_quantile(values: Tensor, share: float, *, lower: bool = False) -> Tensor:
    """Return the quantile of the values that are not NaN, (P,) -> (); NaN where there are none. With
    ``lower`` it is the value below, else both neighbours are interpolated linearly."""
    ordered = values.sort().values  # NaN last
    last = (values == values).sum() - 1
    place = (share * last.clamp(min=0).to(values)).unsqueeze(0)
    below = ordered.gather(0, place.floor().long())[0]
    if lower:
        return below
    return torch.lerp(below, ordered.gather(0, place.ceil().long())[0], (place - place.floor())[0])

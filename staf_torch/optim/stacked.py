"""One update law in place of several of one type."""

from __future__ import annotations

import copy
from collections.abc import Sequence

import torch

from .base import UpdateLaw


def stack_laws(laws: Sequence[UpdateLaw], rows: Sequence[int], like: torch.Tensor) -> UpdateLaw:
    """The law whose numbers that differ are tensors (B, 1): law i's for the next ``rows[i]`` rows.

    Args:
        laws: of one type.
        rows: of each, at least 1; B is their sum.
        like: has the dtype and the device.

    Raises:
        ValueError: if they differ in more than numbers.
    """
    first = laws[0]
    stacked = copy.copy(first)
    if any(type(law) is not type(first) or vars(law).keys() != vars(first).keys() for law in laws):
        raise ValueError("`stack_laws(laws=...)` must be of one type.")
    counts = torch.tensor(rows, device=like.device)
    for name, value in vars(first).items():
        values = [vars(law)[name] for law in laws]
        if all(other == value for other in values):
            continue
        if not all(isinstance(other, float) for other in values):
            raise ValueError(f"`stack_laws(laws=...)` must agree in `{name}`, which is no number.")
        each = torch.tensor(values, dtype=like.dtype, device=like.device).repeat_interleave(counts)
        setattr(stacked, name, each.unsqueeze(-1))
    return stacked

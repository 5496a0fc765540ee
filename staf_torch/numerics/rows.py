"""Rows of a batch: one of two values in each."""

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

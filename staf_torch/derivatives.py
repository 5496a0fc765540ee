"""Derivatives of functions of rows by autograd, where no closed form is at hand."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor


def row_jacobian(function: Callable[[Tensor], Tensor], at: Tensor) -> tuple[Tensor, Tensor]:
    """Values and derivatives of a function of rows, in which no row sees another.

    One backward pass for every entry of an output, whatever the number of rows.

    Args:
        function: (..., n) -> (..., *outputs).
        at: (..., n), with all the leading dimensions of the values.

    Returns:
        (..., *outputs) and (..., *outputs, n).
    """
    values, pull = torch.func.vjp(function, at)[:2]
    outputs = values.shape[at.dim() - 1 :]
    if not outputs:
        return values, pull(torch.ones_like(values))[0]
    units = torch.eye(math.prod(outputs), dtype=values.dtype, device=values.device)
    rows = [pull(unit.reshape(outputs).expand_as(values).contiguous())[0] for unit in units.unbind(0)]
    return values, torch.stack(rows, dim=-2).unflatten(-2, outputs)

"""Derivatives in forward mode: where there are fewer coordinates than values, the cheaper way."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable

import torch
from torch import Tensor

from .linalg import row_jacobian


@functools.cache
def use_forward_mode() -> None:
    """Let torch load what its forward mode needs, without its warning about its own `torch.jit.script`."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*torch.jit.script")
        torch.func.jvp(
            torch.sin, (torch.zeros(1, device="cpu").double(),), (torch.ones(1, device="cpu").double(),)
        )


def jacobian(function: Callable[[Tensor], Tensor], y: Tensor) -> Tensor:
    """ds_i/dy_j of a function of every row by itself, (..., n) -> (..., M): (..., M, n).

    A derivative along every coordinate where there are fewer of these than values, else one pass backwards a
    value; backwards, too, where an operation of a user's own has no derivative in forward mode, and where
    the batch is traced as any: forward mode asks torch for its size as a number.
    """
    use_forward_mode()
    units = torch.eye(y.shape[-1], dtype=y.dtype, device=y.device)
    if not any(isinstance(size, torch.SymInt) for size in y.shape):
        try:
            values, first = torch.func.jvp(function, (y,), (units[0].expand_as(y).clone(),))[:2]
            if len(units) <= values.shape[-1]:
                rest = [torch.func.jvp(function, (y,), (unit.expand_as(y).clone(),))[1] for unit in units[1:]]
                return torch.stack([first, *rest], dim=-1)
        except RuntimeError:  # NotImplementedError is one; what else is wrong is so backwards, too
            pass
    return row_jacobian(function, y)[1]

"""How V(c) and the Gram matrix change along a trajectory."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..basis import StaFBasis, Target


class GramRates(NamedTuple):
    """V(c(x)) and e^{-g} K(c(x)) at the states x, and their derivatives along dx."""

    values: Tensor  # (..., M)
    gram: Tensor  # (..., M, M)
    values_rate: Tensor  # (..., M)
    gram_rate: Tensor  # (..., M, M)


def gram_rates(basis: StaFBasis, target: Target, x: Tensor, dx: Tensor) -> GramRates:
    """Both by one forward-mode product.

    Args:
        basis: kernel and centers.
        target: V.
        x: states, (..., n).
        dx: direction of the states, (..., n); velocities give derivatives by time.
    """

    def structure(at: Tensor) -> tuple[Tensor, Tensor]:
        gram = basis.gram_structure(at).scaled()
        return basis.values(at, target), gram.expand(*x.shape[:-1], basis.count, basis.count)

    (values, gram), (values_rate, gram_rate) = along(structure, x, dx)
    return GramRates(values, gram, values_rate, gram_rate)


def along(function: Callable[[Tensor], Any], x: Tensor, dx: Tensor) -> tuple[Any, Any]:
    """f(x) and its derivative along dx, in forward mode: torch.func.jvp without the warning that torch 2.13
    gives itself on first use, which would end a program in which warnings are errors."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*torch.jit.script", category=DeprecationWarning)
        primal, tangent = torch.func.jvp(function, (x,), (dx,))[:2]
    return primal, tangent

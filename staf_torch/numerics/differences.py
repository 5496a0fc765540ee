"""Derivatives of functions that can only be called: central differences, all probes in one call."""

from __future__ import annotations

import operator
from collections.abc import Callable

import torch
from torch import Tensor

STEP = 6e-6  # the cube root of the rounding error: a central difference is then good to its square


Apart = Callable[[Tensor, Tensor], Tensor]
"""The difference of two values of a function."""


def central_slopes(
    function: Callable[[Tensor], Tensor],
    at: Tensor,
    scale: Tensor | None = None,
    apart: Apart = operator.sub,
) -> Tensor:
    """The Jacobian of a batched function at one point, from 2n rows in one call.

    Args:
        function: (B, n) -> (B, k).
        at: (n,), float64.
        scale: (n,), positive, of the unknowns: a step is 6e-6 of it; by default max(1, |at|).
        apart: the difference of two values, (B, k), (B, k) -> (B, k).

    Returns:
        (k, n).
    """
    size = at.abs().clamp(min=1.0) if scale is None else scale
    steps = torch.diag(STEP * size)
    probes = torch.cat((at + steps, at - steps))
    ahead, behind = function(probes).chunk(2)
    widths = (probes[: len(at)] - probes[len(at) :]).diagonal()  # as represented, not as wanted
    return (apart(ahead, behind) / widths.unsqueeze(-1)).mT

"""The weights' own differential equation."""

from __future__ import annotations

import torch
from torch import Tensor

from ..._checks import choice
from ...basis import StaFBasis, Target
from ..rates import gram_rates
from .base import Parts, Predictor


class Tangent(Predictor):
    """One step of w' = K^-1 (d/dt V(c) - K' w), the implicit derivative of K(c) w = V(c), from w = a_k.

    V(c) and K are differentiated along the trajectory by one forward-mode product. No model of the plant
    is asked for: x_{k+1} is known on arrival there, when the prediction is made. Both orders are affine
    in the weights, and their parts are computed in bulk, with u = K^-1 dV(c) and J = K^-1 dK:

    ``order=1``: Euler at x_k, a <- a + u - J a along dx = (x_{k+1} - x_{k-1}) / 2 = dt x' + O(dt^3)
        (forward at the first step). It leaves an excess O(dt^4) to correct.
    ``order=2``: the midpoint rule at (x_k + x_{k+1}) / 2, a <- a + u - J (a + (u - J a) / 2) along
        dx = x_{k+1} - x_k. It leaves O(dt^6) at the same cost.

    K and the weights are those of the chase, e^{-g} K and e^g w: K w = V(c) all the same, and where g(x) is
    steep the paper's weights would change by orders of magnitude in a step.

    Under one iteration of steepest descent the first order is chaotic: perturbations of 1e-14 of the
    initial weights change its ultimate excess between 5e-5 and 1.7e-4 in the paper's simulation. The second
    leaves 1e-11 there.

    Args:
        order: 1 or 2.

    Raises:
        ValueError: for another order.

    The target and the kernel must be differentiable in forward mode.
    """

    def __init__(self, order: int = 2) -> None:
        choice("Tangent", "order", order, (1, 2))
        self.order = order

    def prepare(self, basis: StaFBasis, target: Target, states: Tensor, start: int) -> Parts:
        before, x, after = states[:, :-2], states[:, 1:-1], states[:, 2:]
        if self.order == 2:
            advance, relax = _tangent(basis, target, (x + after) / 2, after - x)
            return advance - _apply(relax, advance) / 2, relax - relax @ relax / 2
        first = torch.arange(start, start + x.shape[1], device=x.device) == 1
        return _tangent(basis, target, x, torch.where(first[:, None], after - x, (after - before) / 2))

    def predict(self, parts: Parts, weights: Tensor, previous: Tensor, unit: Tensor) -> Tensor:
        advance, relax = parts
        return weights + advance - _apply(relax, weights)


def _tangent(basis: StaFBasis, target: Target, x: Tensor, dx: Tensor) -> tuple[Tensor, Tensor]:
    """K^-1 dV(c) and K^-1 dK at the states x along dx, with e^{-g} K for K: (B, C, M), (B, C, M, M)."""
    rates = gram_rates(basis, target, x, dx)
    space = basis.local(x)
    columns = [space.scaled_weights(space.fit(column)) for column in rates.gram_rate.unbind(-1)]
    return space.scaled_weights(space.fit(rates.values_rate)), torch.stack(columns, dim=-1)


def _apply(matrix: Tensor, vector: Tensor) -> Tensor:
    return (matrix * vector.unsqueeze(-2)).sum(-1)

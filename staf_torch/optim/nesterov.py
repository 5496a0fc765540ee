"""Nesterov's momentum."""

from __future__ import annotations

import torch
from torch import Tensor

from ..numerics.checks import fail, non_negative, positive_real, real
from .base import LawState, UpdateLaw, worse_than_none
from .fixed_step import over_lipschitz
from .objective import Objective


class Nesterov(UpdateLaw):
    """y = a + beta v, a <- y + s g(y) / L, v <- a - a_before, L = 2 lambda_max(K); v passes from one time
    step to the next.

    By default beta = (1 - q) / (1 + q) with q = kappa^(-1/2) of the spectrum at hand; with s = 1 the excess
    then shrinks by 1 - q an iteration up to a constant, though not in every single one: there is no
    `UpdateLaw.contraction`. In rows whose y is worse than zero weights, F(y) > F(0), the velocity is dropped:
    what is left is a plain gradient step, which lowers F.

    Example:
        >>> basis = StaFBasis(GaussianKernel(), StateFollowingCenters(rings(3), radius=0.5))
        >>> states = torch.tensor([[[1.0, 0.5]]]).double().expand(1, 20, 2)  # at rest: (B, T, n)
        >>> excess = chase(states, basis, targets.Paper(), optim.Nesterov(), inner_steps=2).excess[0]
        >>> bool(excess[-1] < 0.5 * excess[0])
        True

        Shown by `staf optimizer=nesterov`.

    Args:
        step: s, in units of 1 / L, 0 < s <= 1.
        momentum: beta, in [0, 1); None for the value above.

    Raises:
        ValueError: if an argument breaks its rule.

    Source: Nesterov, "Lectures on Convex Optimization" (2018), section 2.2.1, constant-step scheme III.
    """

    needs = frozenset({"extremes"})

    def __init__(self, step: float = 1.0, momentum: float | None = None) -> None:
        self.step_size: float = positive_real("Nesterov", "step", step)
        if step > 1:
            raise fail("Nesterov", "step", "must be at most 1 in units of 1/L", step)
        if momentum is not None:
            non_negative("Nesterov", "momentum", momentum)
            momentum = real("Nesterov", "momentum", momentum)
            if momentum >= 1:
                raise fail("Nesterov", "momentum", "must be below 1", momentum)
        self.momentum = momentum

    def init(self, weights: Tensor) -> LawState:
        return (torch.zeros_like(weights),)

    def step(self, objective: Objective, weights: Tensor, state: LawState) -> tuple[Tensor, LawState]:
        (velocity,) = state
        ahead = weights + self._momentum(objective) * velocity
        g = objective.descent(ahead)
        moved = ahead + self.step_size * over_lipschitz(objective, g)
        lost = worse_than_none(objective, ahead, g)
        return moved, (torch.where(lost, 0.0, moved - weights),)

    def _momentum(self, objective: Objective) -> Tensor | float:
        """beta: (..., 1), or the stated number."""
        if self.momentum is not None:
            return self.momentum
        low, high = (value.unsqueeze(-1) for value in objective.spectrum())
        q = torch.where(low > 0, low / torch.where(high > 0, high, 1.0), 0.0).sqrt()
        return (1 - q) / (1 + q)

    def with_step_size(self, size: float) -> Nesterov:
        return Nesterov(size, self.momentum)

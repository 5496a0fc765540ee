"""Polyak's momentum."""

from __future__ import annotations

import torch
from torch import Tensor

from ..numerics.checks import fail, non_negative, positive_real, real
from .base import LawState, UpdateLaw, line_search, worse_than_none
from .objective import Objective


class HeavyBall(UpdateLaw):
    """v <- beta v + s g / L, a <- a + v, L = 2 lambda_max(K); v passes from one time step to the next.

    By default the optimal pair for the spectrum at hand, s = 4 / (1 + q)^2 and
    beta = ((1 - q) / (1 + q))^2 with q = kappa^(-1/2), whose excess shrinks by beta an iteration in the
    limit, though not in every single one: there is no
    `UpdateLaw.contraction`. That s is above the 2 at which
    descent without momentum diverges, so a velocity reset at every time step blows up, and none is
    offered. In rows that nevertheless came to be worse than zero weights, F(a) > F(0), the exact line
    search replaces the step and the velocity is dropped; so F stays bounded.

    Example:
        >>> basis = StaFBasis(GaussianKernel(), StateFollowingCenters(rings(3), radius=0.5))
        >>> states = torch.tensor([[[1.0, 0.5]]]).double().expand(1, 20, 2)  # at rest: (B, T, n)
        >>> excess = chase(states, basis, targets.Paper(), optim.HeavyBall(), inner_steps=2).excess[0]
        >>> bool(excess[-1] < 0.1 * excess[0])
        True

        Shown by `staf optimizer=heavy_ball`.

    Args:
        step: s, in units of 1 / L, 0 < s < 2 (1 + momentum); None for the optimal pair.
        momentum: beta, in [0, 1); given with ``step`` or not at all.

    Raises:
        ValueError: if an argument breaks its rule.

    Source: Polyak, "Some methods of speeding up the convergence of iteration methods" (1964).
    """

    needs = frozenset({"extremes"})

    def __init__(self, step: float | None = None, momentum: float | None = None) -> None:
        if (step is None) != (momentum is None):
            raise fail("HeavyBall", "momentum", "must be given with `step` or not at all", momentum)
        if step is not None:
            step = positive_real("HeavyBall", "step", step)
            non_negative("HeavyBall", "momentum", momentum)
            momentum = real("HeavyBall", "momentum", momentum)
            if momentum >= 1:
                raise fail("HeavyBall", "momentum", "must be below 1", momentum)
            if step >= 2 * (1 + momentum):
                raise fail("HeavyBall", "step", "must be below 2 (1 + momentum), or it diverges", step)
        self.step_size = step
        self.momentum = momentum

    def init(self, weights: Tensor) -> LawState:
        return (torch.zeros_like(weights),)

    def step(self, objective: Objective, weights: Tensor, state: LawState) -> tuple[Tensor, LawState]:
        (velocity,) = state
        g = objective.descent(weights)
        low, high = (value.unsqueeze(-1) for value in objective.spectrum())
        used = high > 0
        high = torch.where(used, high, 1.0)
        if self.step_size is None or self.momentum is None:
            q = torch.where(low > 0, low / high, 0.0).sqrt()
            step, momentum = 4 / (1 + q).square(), ((1 - q) / (1 + q)).square()
        else:
            one = torch.ones_like(high)
            step, momentum = one * self.step_size, one * self.momentum
        moved = momentum * velocity + torch.where(used, step * g / (2 * high), 0.0)
        lost = worse_than_none(objective, weights, g)
        descent = line_search(objective, g, g) * g
        moved_on = weights + torch.where(lost, descent, moved)
        return moved_on, (torch.where(lost, 0.0, moved),)

    def with_step_size(self, size: float) -> HeavyBall:
        if self.momentum is None:
            return super().with_step_size(size)  # type: ignore[return-value]
        return HeavyBall(size, self.momentum)

"""Conjugate gradients."""

from __future__ import annotations

import torch
from torch import Tensor

from .base import LawState, UpdateLaw, line_search
from .objective import Objective


class ConjugateGradient(UpdateLaw):
    """p <- g + (g'g / g_before'g_before) p, a <- a + lambda p with the exact line search; restarted, p = 0,
    at every new objective.

    The excess after j iterations is the least that any j gradient steps can reach: zero after M of them
    up to rounding, and at most 4 ((sqrt(kappa) - 1) / (sqrt(kappa) + 1))^(2j) times what it was. Each
    iteration gains at least what steepest descent would. The line search uses the gradient itself, not
    its recursion, so that iterations beyond M never raise F.

    Example:
        >>> basis = StaFBasis(GaussianKernel(), StateFollowingCenters(rings(3), radius=0.5))
        >>> states = torch.tensor([[[1.0, 0.5]]]).double().expand(1, 20, 2)  # at rest: (B, T, n)
        >>> excess = chase(states, basis, targets.Paper(), optim.ConjugateGradient(), inner_steps=1).excess[0]
        >>> bool(excess[-1] < 1e-3 * excess[0])
        True

        Shown by `staf optimizer=conjugate_gradient`.

    Source: Hestenes and Stiefel, "Methods of conjugate gradients for solving linear systems" (1952).
    """

    def init(self, weights: Tensor) -> LawState:
        return torch.zeros_like(weights), torch.zeros_like(weights[..., 0])

    def begin(self, objective: Objective, weights: Tensor, state: LawState) -> LawState:
        return self.init(weights)

    def step(self, objective: Objective, weights: Tensor, state: LawState) -> tuple[Tensor, LawState]:
        direction, before = state
        g = objective.descent(weights)
        slope = torch.linalg.vecdot(g, g)
        started = before > 0
        ratio = torch.where(started, slope / torch.where(started, before, 1.0), 0.0)
        direction = g + ratio.unsqueeze(-1) * direction
        return weights + line_search(objective, g, direction) * direction, (direction, slope)

    def rescale(self, state: LawState, factor: Tensor) -> LawState:
        return state  # gradients, which a change of the weights' unit leaves alone

    def contraction(self, condition_number: Tensor) -> Tensor:
        return ((condition_number - 1) / (condition_number + 1)).square()

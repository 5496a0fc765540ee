"""The paper's update law."""

from __future__ import annotations

import torch
from torch import Tensor

from ..lanes import repeat
from .base import LawState, UpdateLaw, line_search
from .objective import Objective


class SteepestDescent(UpdateLaw):
    """a <- a + lambda g, g = 2 V(c) - 2 K a, lambda = g'g / (2 g'K g), the exact line search.

    Each iteration multiplies the excess by at most ((kappa - 1) / (kappa + 1))^2 (Kantorovich). At the
    ideal weights, where lambda is 0/0, the step is zero.

    Example:
        >>> basis = StaFBasis(GaussianKernel(), StateFollowingCenters(rings(3), radius=0.5))
        >>> states = torch.tensor([[[1.0, 0.5]]]).double().expand(1, 20, 2)  # at rest: (B, T, n)
        >>> excess = chase(states, basis, targets.Paper(), optim.SteepestDescent(), inner_steps=2).excess[0]
        >>> bool(excess[-1] < 0.5 * excess[0])
        True

        Shown by `staf optimizer=steepest_descent`.

    Source: Rosenfeld et al., eq. (6) and (7).
    """

    def step(self, objective: Objective, weights: Tensor, state: LawState) -> tuple[Tensor, LawState]:
        g = objective.descent(weights)
        return weights + line_search(objective, g, g) * g, state

    def iterate(
        self, objective: Objective, weights: Tensor, state: LawState, count: int
    ) -> tuple[Tensor, LawState]:
        """``count`` iterations with the residual carried along, g <- g - 2 lambda K g: one product each."""

        def once(carry: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
            weights, g = carry
            curved = objective.curvature(g)
            slope, curvature = torch.linalg.vecdot(g, g), torch.linalg.vecdot(g, curved)
            usable = curvature > 0
            twice = torch.where(usable, slope / torch.where(usable, curvature, 1.0), 0.0).unsqueeze(-1)
            return weights + (twice / 2) * g, g - twice * curved

        if type(self).step is not SteepestDescent.step:  # a law of its own
            return super().iterate(objective, weights, state, count)
        if count:
            weights, _ = repeat(count, once, (weights, objective.descent(weights)))
        return weights, state

    def contraction(self, condition_number: Tensor) -> Tensor:
        return ((condition_number - 1) / (condition_number + 1)).square()

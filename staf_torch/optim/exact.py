"""No iteration at all."""

from __future__ import annotations

import torch
from torch import Tensor

from .base import LawState, UpdateLaw
from .objective import Objective


class Exact(UpdateLaw):
    """a <- w = K^-1 V(c), by the factor of the local space: one iteration, whatever a was.

    A direct solve for V(c), not a correction K^-1 (V - K a): where the weights are large and cancel, K a
    alone costs more digits than the solve. The paper's own premise, an iteration in place of a solve,
    saves nothing for the few centers of a StaF basis; this law is the yardstick for the others.

    Example:
        >>> basis = StaFBasis(GaussianKernel(), StateFollowingCenters(rings(3), radius=0.5))
        >>> states = torch.tensor([[[1.0, 0.5]]]).double()  # (B, T, n)
        >>> result = chase(states, basis, targets.Paper(), optim.Exact(), inner_steps=1)
        >>> bool(result.excess.max() < 1e-9)
        True

        Shown by `staf optimizer=exact`.

    Source: Rosenfeld et al., the normal equations of section 6.
    """

    needs = frozenset({"ideal"})

    def step(self, objective: Objective, weights: Tensor, state: LawState) -> tuple[Tensor, LawState]:
        return objective.minimiser(), state

    def products(self, count: int, iterations: int) -> int:
        return iterations

    def contraction(self, condition_number: Tensor) -> Tensor:
        return torch.zeros_like(condition_number)

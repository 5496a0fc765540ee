"""The online case: one sample of V a time step."""

from __future__ import annotations

import torch
from torch import Tensor

from ..numerics.checks import fail, positive_real
from .base import LawState, UpdateLaw
from .objective import Objective


class NormalisedLMS(UpdateLaw):
    """a <- a + s (V(x) - V^(x)) sigma / sigma'sigma, sigma_i = k(x, c_i(x)): only V at the state is measured.

    With s = 1 the new weights are the nearest to a that reproduce the sample: a projection, so iterations
    beyond one change nothing. The distance to any weights that reproduce it never grows for 0 < s < 2.
    One sample a time step says nothing about the gradient of V; along a trajectory that does not excite
    all M directions, the error at the state is small and the error on the ball is not.

    Example:
        >>> basis = StaFBasis(GaussianKernel(), StateFollowingCenters(rings(3), radius=0.5))
        >>> states = torch.tensor([[[1.0, 0.5]]]).double()  # (B, T, n)
        >>> result = chase(states, basis, targets.Paper(), optim.NormalisedLMS(), inner_steps=1)
        >>> bool((result.value - result.estimate).abs().max() < 1e-9)  # V at the state itself
        True

        Shown by `staf optimizer=normalised_lms`.

    Args:
        step: s, 0 < s < 2.

    Raises:
        ValueError: if ``step`` breaks its rule.

    Source: Haykin, "Adaptive Filter Theory" (2002), chapter 6; Kaczmarz (1937).
    """

    needs = frozenset({"row", "sampled"})

    def __init__(self, step: float = 1.0) -> None:
        self.step_size: float = positive_real("NormalisedLMS", "step", step)
        if self.step_size >= 2:
            raise fail("NormalisedLMS", "step", "must be below 2, or it diverges", step)

    def step(self, objective: Objective, weights: Tensor, state: LawState) -> tuple[Tensor, LawState]:
        row, sampled = objective.sample()
        power = torch.linalg.vecdot(row, row)
        error = sampled - torch.linalg.vecdot(row, weights)
        length = torch.where(power > 0, error / torch.where(power > 0, power, 1.0), 0.0)
        return weights + self.step_size * length.unsqueeze(-1) * row, state

    def products(self, count: int, iterations: int) -> int:
        return 0

    @property
    def title(self) -> str:
        return "normalised LMS"

    def with_step_size(self, size: float) -> NormalisedLMS:
        return NormalisedLMS(size)

"""Gradient descent with a step that does not look at the slope."""

from __future__ import annotations

import torch
from torch import Tensor

from ..numerics.checks import fail, positive_real
from .base import LawState, UpdateLaw, line_search
from .objective import Objective


class FixedStep(UpdateLaw):
    """a <- a + s g / L, L = 2 lambda_max(K), or a <- a + s g with an absolute step s.

    With a relative step, 0 < s < 2, the excess shrinks by max(|1 - s|, |1 - s / kappa|)^2 an iteration.
    An absolute step above 2 / L would grow without end: in the rows and iterations where it would
    raise F, the exact line search takes its place.

    Example:
        >>> basis = StaFBasis(GaussianKernel(), StateFollowingCenters(rings(3), radius=0.5))
        >>> states = torch.tensor([[[1.0, 0.5]]]).double().expand(1, 20, 2)  # at rest: (B, T, n)
        >>> excess = chase(states, basis, targets.Paper(), optim.FixedStep(step=1.0), inner_steps=2).excess[0]
        >>> bool(excess[-1] < 0.9 * excess[0])
        True

        Shown by `staf optimizer=fixed_step`.

    Args:
        step: s, positive; below 2 if relative.
        relative: whether s is in units of 1 / L.

    Raises:
        ValueError: if ``step`` breaks its rule.

    Source: Nesterov, "Lectures on Convex Optimization" (2018), section 2.1.5.
    """

    def __init__(self, step: float = 1.0, relative: bool = True) -> None:
        self.step_size: float = positive_real("FixedStep", "step", step)
        if relative and self.step_size >= 2:
            raise fail("FixedStep", "step", "must be below 2 in units of 1/L, or it diverges", step)
        self.relative = relative
        if relative:
            self.needs = frozenset({"extremes"})

    def step(self, objective: Objective, weights: Tensor, state: LawState) -> tuple[Tensor, LawState]:
        g = objective.descent(weights)
        if self.relative:
            return weights + self.step_size * over_lipschitz(objective, g), state
        best = line_search(objective, g, g)
        # F(a + s g) <= F(a) up to twice the exact line search.
        length = torch.where(self.step_size <= 2 * best, self.step_size, best)
        return weights + length * g, state

    def contraction(self, condition_number: Tensor) -> Tensor | None:
        if not self.relative:
            return None
        slow = (1 - self.step_size / condition_number).abs()
        return torch.clamp(slow, min=abs(1 - self.step_size)).square()

    def with_step_size(self, size: float) -> FixedStep:
        return FixedStep(size, self.relative)


def over_lipschitz(objective: Objective, g: Tensor) -> Tensor:
    """g / L with L = 2 lambda_max(K), the Lipschitz constant of grad F; zero where K is zero."""
    high = objective.spectrum()[1].unsqueeze(-1)
    return torch.where(high == 0, 0.0, g / (2 * torch.where(high == 0, 1.0, high)))

"""Barzilai and Borwein's step, kept from spiking."""

from __future__ import annotations

import torch
from torch import Tensor

from .base import LawState, UpdateLaw, line_search
from .objective import Objective


class BarzilaiBorwein(UpdateLaw):
    """a <- a + lambda g, with lambda the exact line search of the iteration before.

    On a quadratic that is the step s's / s'y of s = a - a_before, y = grad F(a) - grad F(a_before). It is not
    monotone, and along a moving objective it spikes. Two safeguards, row by row: the first iteration at
    a new objective is the exact line search, and so is every iteration that would lift F above its value
    when that objective began. So the excess after a time step never exceeds the excess before it. The
    plain method converges R-linearly; no rate an iteration is known.

    Example:
        >>> basis = StaFBasis(GaussianKernel(), StateFollowingCenters(rings(3), radius=0.5))
        >>> states = torch.tensor([[[1.0, 0.5]]]).double().expand(1, 20, 2)  # at rest: (B, T, n)
        >>> excess = chase(states, basis, targets.Paper(), optim.BarzilaiBorwein(), inner_steps=2).excess[0]
        >>> bool(excess[-1] < 1e-3 * excess[0])
        True

        Shown by `staf optimizer=barzilai_borwein`.

    Source: Barzilai and Borwein, "Two-point step size gradient methods", IMA J. Numer. Anal. 8 (1988);
    Raydan, "On the Barzilai and Borwein choice of steplength", IMA J. Numer. Anal. 13 (1993).
    """

    def init(self, weights: Tensor) -> LawState:
        zero = torch.zeros_like(weights[..., :1])
        return zero, zero  # (..., 1): the length to take, 0 for none; F(a) - F where it began

    def begin(self, objective: Objective, weights: Tensor, state: LawState) -> LawState:
        return self.init(weights)

    def step(self, objective: Objective, weights: Tensor, state: LawState) -> tuple[Tensor, LawState]:
        retarded, rise = state
        g = objective.descent(weights)
        best = line_search(objective, g, g)
        slope = torch.linalg.vecdot(g, g).unsqueeze(-1)

        def change(length: Tensor) -> Tensor:
            """F(a + length g) - F(a), from F(a + best g) - F(a) = -best g'g / 2."""
            relative = length / torch.where(best > 0, best, 1.0)
            gained: Tensor = best * slope * relative * (relative / 2 - 1)
            return gained

        usable = (retarded > 0) & (best > 0) & (rise + change(retarded) <= 0)
        length = torch.where(usable, retarded, best)
        return weights + length * g, (best, rise + change(length))

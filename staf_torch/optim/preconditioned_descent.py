"""Steepest descent in a better metric."""

from __future__ import annotations

import torch
from torch import Tensor

from ..numerics.checks import choice
from .base import LawState, UpdateLaw, line_search
from .objective import Objective


class PreconditionedDescent(UpdateLaw):
    """a <- a + lambda p, p = P g, with the exact line search lambda = g'p / (2 p'K p).

    ``core``: P = S^-1 K0^-1 S^-1, descent in the scaled basis S a preconditioned by K0^-1, which is factored
    once for all states where the kernel and the radius allow it. As K = S K0 S there, one iteration
    reaches the ideal weights up to the rounding of P: it is the exact solve, reached by a correction.
    ``jacobi``: P = diag(K)^-1, free of charge, and of little use here: in the flat limit the diagonal of K
    is nearly constant. The excess shrinks by ((kappa - 1) / (kappa + 1))^2 with kappa of P K.

    Example:
        >>> basis = StaFBasis(GaussianKernel(), StateFollowingCenters(rings(3), radius=0.5))
        >>> states = torch.tensor([[[1.0, 0.5]]]).double()  # (B, T, n)
        >>> result = chase(states, basis, targets.Paper(), optim.PreconditionedDescent(), inner_steps=1)
        >>> bool(result.excess.max() < 1e-9)  # radial kernels: the core is K
        True

        Shown by `staf optimizer=preconditioned_descent`.

    Args:
        preconditioner: ``core`` or ``jacobi``.

    Raises:
        ValueError: for another preconditioner.

    Source: Saad, "Iterative Methods for Sparse Linear Systems" (2003), section 9.2.
    """

    def __init__(self, preconditioner: str = "core") -> None:
        choice("PreconditionedDescent", "preconditioner", preconditioner, ("core", "jacobi"))
        self.preconditioner = preconditioner
        if preconditioner == "core":
            self.needs = frozenset({"inverse"})

    def step(self, objective: Objective, weights: Tensor, state: LawState) -> tuple[Tensor, LawState]:
        g = objective.descent(weights)
        if self.preconditioner == "core":
            direction = objective.solve(g)
        else:
            diagonal = objective.gram.diagonal(dim1=-2, dim2=-1)
            direction = torch.where(diagonal > 0, g / torch.where(diagonal > 0, diagonal, 1.0), 0.0)
        return weights + line_search(objective, g, direction) * direction, state

    def products(self, count: int, iterations: int) -> int:
        return (2 if self.preconditioner == "core" else 1) * iterations + 1

    @property
    def title(self) -> str:
        return f"{super().title} ({self.preconditioner})"

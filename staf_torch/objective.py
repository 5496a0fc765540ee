"""The quadratic that the update laws descend."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import torch
from torch import Tensor


class Objective(Protocol):
    """A convex quadratic F(a) in (..., M), one a row, given by its slope and its curvature."""

    def descent(self, weights: Tensor) -> Tensor:
        """g = -grad F(a): (..., M) -> (..., M)."""

    def curvature(self, direction: Tensor) -> Tensor:
        """K v, half the Hessian of F times v: (..., M) -> (..., M)."""


class NativeError(NamedTuple):
    """F(a, c) = ||V - sum_i a_i k(., c_i)||^2 = ||V||^2 - 2 V(c)'a + a'K a, up to ||V||^2.

    Source: Rosenfeld et al., section 6.
    """

    gram: Tensor  # K, (..., M, M)
    values: Tensor  # V(c), (..., M)

    def curvature(self, direction: Tensor) -> Tensor:
        """K v: (..., M) -> (..., M). Row by row, so that a row's bits do not depend on the batch."""
        return (self.gram * direction.unsqueeze(-2)).sum(-1)

    def descent(self, weights: Tensor) -> Tensor:
        """g = 2 V(c) - 2 K a: (..., M) -> (..., M)."""
        return 2 * (self.values - self.curvature(weights))

    def excess(self, weights: Tensor, ideal: Tensor) -> Tensor:
        """F(a) - F(w) = (a - w)'K(a - w) for the ideal weights w: (..., M), (..., M) -> (...)."""
        difference = weights - ideal
        excess: Tensor = torch.linalg.vecdot(difference, self.curvature(difference))
        return excess

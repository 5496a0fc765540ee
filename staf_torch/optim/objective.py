"""The quadratic that the update laws descend."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from ..numerics.linalg import pivoted_cholesky


class Objective(Protocol):
    """A convex quadratic F(a) = const - 2 V'a + a'K a, one a row."""

    @property
    def gram(self) -> Tensor:
        """K, half the Hessian of F: (..., M, M)."""

    @property
    def values(self) -> Tensor:
        """V, half the descent direction at a = 0: (..., M)."""

    def descent(self, weights: Tensor) -> Tensor:
        """g = -grad F(a): (..., M) -> (..., M)."""

    def curvature(self, direction: Tensor) -> Tensor:
        """K v, half the Hessian of F times v: (..., M) -> (..., M)."""

    def spectrum(self) -> tuple[Tensor, Tensor]:
        """The smallest and the largest eigenvalue of K: (...), (...)."""

    def solve(self, values: Tensor) -> Tensor:
        """K^-1 v, as a preconditioner needs it: (..., M) -> (..., M)."""

    def minimiser(self) -> Tensor:
        """K^-1 V, as accurately as it can be had: (..., M)."""

    def sample(self) -> tuple[Tensor, Tensor]:
        """The one measurement of the online case: the row k(x, c_i), (..., M), and V(x), (...)."""


class Precomputed(NamedTuple):
    """Quantities of an objective that were computed in bulk for the laws; None where they were not.

    A law names in `needs` the fields that it will ask for.
    """

    extremes: Tensor | None = None  # (..., 2) smallest and largest eigenvalue of K
    ideal: Tensor | None = None  # (..., M) K^-1 V
    inverse: Tensor | None = None  # (..., M, M) K^-1, column by column from the local factor
    row: Tensor | None = None  # (..., M) k(x, c_i)
    sampled: Tensor | None = None  # (...) V(x)

    def at(self, k: int) -> Precomputed:
        """Return the fields of time k alone, where they are (B, C, ...)."""
        return Precomputed(*(None if field is None else field[:, k] for field in self))


class NativeError(NamedTuple):
    """F(a, c) = ||V - sum_i a_i k(., c_i)||^2 = ||V||^2 - 2 V(c)'a + a'K a, up to ||V||^2.

    Where K = S K0 S with one K0 for all rows, products may go through the factors: rows of many centers then
    share M^2 numbers, in place of M^2 numbers each.

    Source: Rosenfeld et al., section 6.
    """

    gram: Tensor  # K, (..., M, M)
    values: Tensor  # V(c), (..., M)
    precomputed: Precomputed = Precomputed()
    core: Tensor | None = None  # K0, (M, M); None for products with K itself
    scale: Tensor | None = None  # S, (..., M); None for ones

    def curvature(self, direction: Tensor) -> Tensor:
        """K v: (..., M) -> (..., M). Row by row, so that a row's bits do not depend on the batch."""
        matrix = self.gram if self.core is None else self.core
        if self.scale is None:
            return (matrix * direction.unsqueeze(-2)).sum(-1)
        return self.scale * (matrix * (self.scale * direction).unsqueeze(-2)).sum(-1)

    def descent(self, weights: Tensor) -> Tensor:
        """g = 2 V(c) - 2 K a: (..., M) -> (..., M)."""
        return 2 * (self.values - self.curvature(weights))

    def excess(self, weights: Tensor, ideal: Tensor) -> Tensor:
        """F(a) - F(w) = (a - w)'K(a - w) for the ideal weights w: (..., M), (..., M) -> (...)."""
        difference = weights - ideal
        excess: Tensor = torch.linalg.vecdot(difference, self.curvature(difference))
        return excess

    def spectrum(self) -> tuple[Tensor, Tensor]:
        """The smallest and the largest eigenvalue of K: (...), (...)."""
        spectrum = extremes(self.gram) if self.precomputed.extremes is None else self.precomputed.extremes
        return spectrum[..., 0], spectrum[..., 1]

    def solve(self, values: Tensor) -> Tensor:
        """K^-1 v: (..., M) -> (..., M)."""
        if self.precomputed.inverse is not None:
            return (self.precomputed.inverse * values.unsqueeze(-2)).sum(-1)
        factor = pivoted_cholesky(self.gram)
        return factor.solve_upper(factor.solve_lower(values))

    def minimiser(self) -> Tensor:
        """K^-1 V: (..., M)."""
        return self.solve(self.values) if self.precomputed.ideal is None else self.precomputed.ideal

    def sample(self) -> tuple[Tensor, Tensor]:
        """k(x, c_i) and V(x) at the state.

        Raises:
            ValueError: if the objective was made without them.
        """
        row, sampled = self.precomputed.row, self.precomputed.sampled
        if row is None or sampled is None:
            raise ValueError(
                "This law learns from V at the state alone: `NativeError(precomputed=...)` must have the "
                "fields `row` and `sampled`; got None."
            )
        return row, sampled


def extremes(gram: Tensor) -> Tensor:
    """Smallest and largest eigenvalue of K (..., M, M): (..., 2), NaN where K is not finite."""
    finite = ((gram * 0).flatten(-2).sum(-1) == 0)[..., None, None]  # 0 x is NaN where x is not finite
    identity = torch.eye(gram.shape[-1], dtype=gram.dtype, device=gram.device)
    values = torch.linalg.eigvalsh(torch.where(finite, gram, identity))
    return torch.where(finite.squeeze(-1), values[..., [0, -1]], torch.nan)

"""The Newton basis: for kernels without more structure."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ..kernels import Kernel
from ..linalg import PivotedCholesky, pivoted_cholesky
from .base import evaluate_scaled, from_scaled, scale, to_scaled, with_gradient


class NewtonSpace(NamedTuple):
    """span{k0(., d_i)} in its Newton basis, psi(z) = k0(z, d) P' L^-T with P K0 P' = L L'.

    The basis is orthonormal in the kernel's own norm (up to e^{g/2}), so no K0^-1 is ever formed. Where
    K0 is numerically singular the factor stops at its rank, and `rank` says so.

    Source: Muller and Schaback, "A Newton basis for kernel spaces", J. Approx. Theory 161 (2009).
    """

    kernel: Kernel
    state: Tensor  # x, (..., n)
    offsets: Tensor  # d, (..., M, n), or (M, n) for all states
    factor: PivotedCholesky  # of K0: without batch dimensions where one K0 serves all states

    @property
    def rank(self) -> Tensor:
        """Numerical rank of K0, () or (...)."""
        return self.factor.rank

    def fit(self, values: Tensor) -> Tensor:
        """beta = L^-1 P (e^{-s} V(c)): (..., M) -> (..., M), zero beyond the rank."""
        return self.factor.solve_lower(values * scale(self.kernel, self.state, self.offsets, -1.0))

    def evaluate(self, z: Tensor, coefficients: Tensor) -> Tensor:
        """V^(x + z): (..., P, n), (..., M) -> (..., P)."""
        b = self.factor.solve_upper(coefficients)
        return evaluate_scaled(self.kernel, self.offsets, self.state, z, b)

    def evaluate_with_gradient(self, z: Tensor, coefficients: Tensor) -> tuple[Tensor, Tensor]:
        """V^(x + z) and its gradient in z: (..., P, n), (..., M) -> (..., P), (..., P, n)."""
        return with_gradient(lambda at: self.evaluate(at, coefficients), z)

    def scaled_weights(self, coefficients: Tensor) -> Tensor:
        """e^g w: (..., M) -> (..., M)."""
        return self.factor.solve_upper(coefficients) * scale(self.kernel, self.state, self.offsets, -1.0)

    def weights(self, coefficients: Tensor) -> Tensor:
        """The paper's w: (..., M) -> (..., M); NaN in a row where it cannot be represented."""
        return from_scaled(self.kernel, self.state, self.scaled_weights(coefficients))

    def coefficients(self, weights: Tensor) -> Tensor:
        """beta = L' P (e^{g + s} w): (..., M) -> (..., M)."""
        scaled = to_scaled(self.kernel, self.state, weights)
        b = scaled * scale(self.kernel, self.state, self.offsets)
        permuted = b.gather(-1, self.factor.order.expand(b.shape))
        beta = (self.factor.factor.mT @ permuted.unsqueeze(-1)).squeeze(-1)
        return torch.where(self.factor.kept, beta, 0.0)


def newton_space(kernel: Kernel, x: Tensor, offsets: Tensor) -> NewtonSpace:
    """The space at the states x (..., n). One factorisation serves all states where the kernel is
    state-free and the offsets carry no batch: the core then has no batch dimensions."""
    return NewtonSpace(kernel, x, offsets, pivoted_cholesky(kernel.core(x, offsets, offsets)))

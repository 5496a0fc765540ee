"""The Newton basis: for kernels without more structure."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from ..kernels import Kernel
from ..numerics.linalg import PivotedCholesky, pivoted_cholesky
from .base import (
    at_points,
    evaluate_scaled,
    from_scaled,
    of_states,
    scale,
    scaled_gradient,
    to_scaled,
    with_gradient,
)


class NewtonSpace(NamedTuple):
    """span{k0(., d_i)}, held by the values at the centers and computed with in its Newton basis.

    The Newton basis k0(z, d) P' L^-T, with P K0 P' = L L', is orthonormal in the kernel's own norm (up to
    e^{g/2}), so no K0^-1 is ever formed. Where K0 is numerically singular the factor stops at its rank, and
    `rank` says so. The order P of the pivots jumps as the centers or the kernel change, so that coefficients
    in the Newton basis would too; the scaled values beta_i = e^{-s(d_i)} V^(c_i) do not.

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
        """beta = e^{-s} V(c): (..., M) -> (..., M)."""
        of_states("fit", "values", values, self.state, self.offsets.shape[-2])
        return values * scale(self.kernel, self.state, self.offsets, -1.0)

    def evaluate(self, z: Tensor, coefficients: Tensor) -> Tensor:
        """V^(x + z): (..., P, n), (..., M) -> (..., P)."""
        at_points("evaluate", z, coefficients, self.state, self.offsets.shape[-2])
        return evaluate_scaled(self.kernel, self.offsets, self.state, z, self._solve(coefficients))

    def evaluate_with_gradient(self, z: Tensor, coefficients: Tensor) -> tuple[Tensor, Tensor]:
        """V^(x + z) and its gradient in z: (..., P, n), (..., M) -> (..., P), (..., P, n)."""
        at_points("evaluate_with_gradient", z, coefficients, self.state, self.offsets.shape[-2])
        b = self._solve(coefficients)
        slope = self.kernel.core_gradient(self.state, z, self.offsets, b)
        if slope is None:
            return with_gradient(lambda at: evaluate_scaled(self.kernel, self.offsets, self.state, at, b), z)
        sums = (self.kernel.core(self.state, z, self.offsets) @ b.unsqueeze(-1)).squeeze(-1)
        return scaled_gradient(self.kernel, self.state, z, sums, slope)

    def scaled_weights(self, coefficients: Tensor) -> Tensor:
        """e^g w: (..., M) -> (..., M)."""
        of_states("scaled_weights", "coefficients", coefficients, self.state, self.offsets.shape[-2])
        return self._solve(coefficients) * scale(self.kernel, self.state, self.offsets, -1.0)

    def weights(self, coefficients: Tensor) -> Tensor:
        """The paper's w: (..., M) -> (..., M); NaN in a row where it cannot be represented."""
        return from_scaled(self.kernel, self.state, self.scaled_weights(coefficients))

    def coefficients(self, weights: Tensor) -> Tensor:
        """beta from the paper's w: (..., M) -> (..., M)."""
        of_states("coefficients", "weights", weights, self.state, self.offsets.shape[-2])
        scaled = to_scaled(self.kernel, self.state, weights)
        b = scaled * scale(self.kernel, self.state, self.offsets)
        core = self.kernel.core(self.state, self.offsets, self.offsets)
        return (core @ b.unsqueeze(-1)).squeeze(-1)

    def _solve(self, coefficients: Tensor) -> Tensor:
        """e^{g + s} w = K0^-1 beta, projected where the rank is below M: (..., M) -> (..., M)."""
        return self.factor.solve_upper(self.factor.solve_lower(coefficients))


def newton_space(kernel: Kernel, x: Tensor, offsets: Tensor) -> NewtonSpace:
    """The space at the states x (..., n). One factorisation serves all states where the kernel is
    state-free and the offsets carry no batch: the core then has no batch dimensions."""
    return NewtonSpace(kernel, x, offsets, pivoted_cholesky(kernel.core(x, offsets, offsets)))

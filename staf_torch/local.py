"""The span of the kernels around a state, in a basis in which it can be computed with.

Near the state x, with offsets z and d, a kernel is k(x+z, x+d) = e^{g} e^{s(z)} k0(z, d) e^{s(d)}
(`Kernel`). The approximation is held as

    V^(x + z) = e^{s(z)} sum_j psi_j(z) beta_j,

with psi a basis of span{k0(., d_i)}: finite where the paper's weights w = e^{-g - s(d)} b overflow.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from .centers import StateFollowingCenters
from .kernels import Kernel
from .linalg import PivotedCholesky, pivoted_cholesky


class LocalSpace(NamedTuple):
    """span{k(., c_i(x))} in its Newton basis, psi(z) = k0(z, d) P' L^-T with P K0 P' = L L'.

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
        """Numerical rank of K0, () or (...); below M the fit is a projection, not interpolation."""
        return self.factor.rank

    def fit(self, values: Tensor) -> Tensor:
        """Ideal coefficients beta from the values at the centers: (..., M) -> (..., M)."""
        return self.factor.solve_lower(values * self._scale(self.offsets, -1.0))

    def evaluate(self, z: Tensor, coefficients: Tensor) -> Tensor:
        """V^(x + z): (..., P, n), (..., M) -> (..., P)."""
        b = self.factor.solve_upper(coefficients)
        return evaluate_scaled(self.kernel, self.offsets, self.state, z, b)

    def scaled_weights(self, coefficients: Tensor) -> Tensor:
        """e^g w from beta, with w the paper's weights: (..., M) -> (..., M)."""
        return self.factor.solve_upper(coefficients) * self._scale(self.offsets, -1.0)

    def weights(self, coefficients: Tensor) -> Tensor:
        """The paper's w from beta: (..., M) -> (..., M). Zero where e^{-g} underflows."""
        return self.scaled_weights(coefficients) * self._inverse_gain()

    def coefficients(self, weights: Tensor) -> Tensor:
        """beta from the paper's w: (..., M) -> (..., M)."""
        b = weights * self._scale(self.offsets, 1.0) / self._inverse_gain()
        permuted = b.gather(-1, self.factor.order.expand(b.shape))
        beta = (self.factor.factor.mT @ permuted.unsqueeze(-1)).squeeze(-1)
        return torch.where(self.factor.kept, beta, 0.0)

    def _scale(self, z: Tensor, sign: float) -> Tensor:
        """e^{sign s(x, z)}: (..., P)."""
        s = self.kernel.log_scale(self.state, z)
        return z.new_ones(()) if s is None else (sign * s).exp()

    def _inverse_gain(self) -> Tensor:
        """e^{-g(x)}: (..., 1)."""
        g = self.kernel.log_gain(self.state)
        return self.state.new_ones(()) if g is None else (-g).exp().unsqueeze(-1)


def evaluate_scaled(kernel: Kernel, offsets: Tensor, x: Tensor, z: Tensor, b: Tensor) -> Tensor:
    """V^(x + z) = e^{s(x, z)} sum_i b_i k0(z, d_i).

    Args:
        kernel: the kernel.
        offsets: d, (..., M, n).
        x: states, (..., n).
        z: offsets of the points, (..., P, n).
        b: (..., M).

    Returns:
        (..., P).
    """
    sums = (kernel.core(x, z, offsets) @ b.unsqueeze(-1)).squeeze(-1)
    s = kernel.log_scale(x, z)
    return sums if s is None else sums * s.exp()


def local_space(kernel: Kernel, centers: StateFollowingCenters, x: Tensor) -> LocalSpace:
    """The local space at the states x (..., n). One factorisation serves all states where the kernel
    is state-free and the radius constant: the core then has no batch dimensions."""
    offsets = centers.offsets(x)
    return LocalSpace(kernel, x, offsets, pivoted_cholesky(kernel.core(x, offsets, offsets)))

"""The graded basis (RBF-QR): full accuracy at every radius, with the flat limit as its limit.

For k0(z, d) = exp(q z'd) with d_i = nu u_i, the functional lambda_j of `eliminate` kills all polynomials
of degree below k_j in u, hence all but the tail of the exponential series. What is left carries the
factor r^(2 k_j), r = sqrt(q) nu, which is divided out on paper. With zeta = z / nu,

    psi_j(zeta) = sum_i (q_ij / sigma_j) (zeta'u_i)^k k! phi_k(r^2 zeta'u_i),   k = k_j,

is analytic in r^2 and, at r = 0, a homogeneous polynomial of degree k_j: nothing small that was computed
is ever divided by.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from ..kernels import Kernel
from .base import from_scaled, in_blocks, scale, to_scaled
from .elimination import eliminate
from .interpolation import Interpolation
from .phi import phi


class GradedBasis(NamedTuple):
    """What depends on the directions alone, computed once, in float64."""

    directions: Tensor  # u, (M, n), scaled to max |u_i| = 1
    reach: Tensor  # (), the factor taken out of the directions
    weights: Tensor  # q_ij / sigma_j where k_j is degree number k, else 0: (M, K, M)
    functionals: Tensor  # q_ij / sigma_j, (M, M)
    degrees: tuple[int, ...]  # the K different degrees, ascending
    degree: Tensor  # k_j, (M,) int64
    factorial: Tensor  # k_j!, (M,)

    def ridges(self, zeta: Tensor, r2: Tensor) -> Tensor:
        """(zeta'u_i)^k k! phi_k(r^2 zeta'u_i): (..., P, n), (..., 1, 1) -> (..., P, M, K)."""
        tau = zeta @ self.directions.to(zeta).mT
        tails = phi(r2 * tau, self.degrees[-1])
        power, found = torch.ones_like(tau), []
        for k, tail in enumerate(tails):
            if k in self.degrees:
                found.append(power * tail)
            power = power * tau
        return torch.stack(found, dim=-1)

    def functions(self, zeta: Tensor, r2: Tensor) -> Tensor:
        """psi(zeta): (..., P, n), (..., 1, 1) -> (..., P, M)."""
        flat = self.weights.to(zeta).flatten(0, 1)
        return self.ridges(zeta, r2).flatten(-2) @ flat


def graded_basis(directions: Tensor) -> GradedBasis:
    """The graded basis of directions (M, n), distinct.

    Raises:
        ValueError: if directions coincide to rounding.
    """
    u = directions.double()
    reach = u.norm(dim=-1).max()
    reach = torch.where(reach > 0, reach, 1.0)  # a single center at the state itself
    u = u / reach
    found = eliminate(u)
    degrees = tuple(sorted(set(found.degrees)))
    weights = u.new_zeros(len(u), len(degrees), len(u))
    for j, k in enumerate(found.degrees):
        weights[:, degrees.index(k), j] = found.functionals[:, j] / found.strengths[j]
    degree = torch.tensor(found.degrees, device=u.device)
    factorial = torch.tensor([math.factorial(k) for k in found.degrees], dtype=u.dtype, device=u.device)
    return GradedBasis(u, reach, weights, weights.sum(1), degrees, degree, factorial)


class GradedSpace(NamedTuple):
    """span{k0(., d_i)} at the states x in its graded basis."""

    kernel: Kernel
    state: Tensor  # x, (..., n)
    offsets: Tensor  # d, (..., M, n), or (M, n) for all states
    basis: GradedBasis
    radius: Tensor  # nu * reach, (...) or () for all states
    rate: Tensor  # q, (...) or ()
    bound: Tensor | None  # sup of the radius over all states, where it is known
    constant: bool = False  # whether the radius is the same at all states of a row

    @property
    def rank(self) -> Tensor:
        """M; 1 where the radius is zero and all centers meet."""
        return torch.where(self.radius > 0, self.offsets.shape[-2], 1)

    def fit(self, values: Tensor) -> Tensor:
        """beta with sum_j psi_j(u_i) beta_j = e^{-s(d_i)} V(c_i): (..., M) -> (..., M)."""
        bound = None if self.bound is None or self.constant else self.rate * self.bound.square()
        interpolation = Interpolation.of(self.basis, self._r2, bound)

        def solve(values: Tensor, state: Tensor) -> Tensor:
            return interpolation.solve(scale(self.kernel, state, self.offsets, -1.0) * values)

        if not interpolation.shared or self.offsets.dim() > 2:
            return solve(values, self.state)
        return in_blocks(solve, values, self.state)

    def evaluate(self, z: Tensor, coefficients: Tensor) -> Tensor:
        """V^(x + z): (..., P, n), (..., M) -> (..., P)."""
        some = self.radius[..., None, None] > 0
        zeta = torch.where(some, z / torch.where(some, self.radius[..., None, None], 1.0), 0.0)
        ridges = self.basis.ridges(zeta, self._r2[..., None, None])
        sums = (ridges * self._ridge_weights(coefficients).unsqueeze(-3)).sum((-1, -2))
        return sums * scale(self.kernel, self.state, z)

    def scaled_weights(self, coefficients: Tensor) -> Tensor:
        """e^g w, w_i = e^{-g - s(d_i)} sum_j (q_ij / sigma_j) k_j! r^(-2 k_j) beta_j: (..., M) -> (..., M).

        Not finite where r^(-2 k_j) is not.
        """
        b = self._ridge_weights(coefficients * self._unscale()).sum(-1)
        return b * scale(self.kernel, self.state, self.offsets, -1.0)

    def weights(self, coefficients: Tensor) -> Tensor:
        """The paper's w: (..., M) -> (..., M); NaN in a row where it cannot be represented."""
        return from_scaled(self.kernel, self.state, self.scaled_weights(coefficients))

    def coefficients(self, weights: Tensor) -> Tensor:
        """beta from the paper's w: (..., M) -> (..., M)."""
        b = to_scaled(self.kernel, self.state, weights) * scale(self.kernel, self.state, self.offsets)
        full = self.basis.functionals  # orthogonal columns
        inverse = full / full.square().sum(0)
        return b @ inverse.to(b) / self._unscale()

    @property
    def _r2(self) -> Tensor:
        """r^2 = q nu^2, (...) or ()."""
        return self.rate.to(self.radius) * self.radius.square()

    def _ridge_weights(self, coefficients: Tensor) -> Tensor:
        """sum_j (q_ij / sigma_j) beta_j, apart for each degree: (..., M) -> (..., M, K)."""
        weights = self.basis.weights.to(coefficients)
        apart: Tensor = (coefficients @ weights.flatten(0, 1).mT).unflatten(-1, weights.shape[:2])
        return apart

    def _unscale(self) -> Tensor:
        """k_j! r^(-2 k_j): (..., M)."""
        factor: Tensor = self.basis.factorial.to(self.radius) * self._r2.unsqueeze(-1) ** -self.basis.degree
        return factor

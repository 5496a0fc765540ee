"""The graded basis (RBF-QR): full accuracy at every radius, with the flat limit as its limit.

For k0(z, d) = exp(q z'd) with d_i = nu u_i, the functional lambda_j of `functionals_of` kills all
polynomials of degree below k_j in u, hence all but the tail of the exponential series. What is left carries
the factor r^(2 k_j), r = sqrt(q) nu, which is divided out on paper. With zeta = z / nu,

    psi_j(zeta) = sum_i (q_ij / sigma_j) p_k(zeta'u_i),   p_k(t) = t^k k! phi_k(r^2 t),   k = k_j,

is analytic in r^2 and, at r = 0, a homogeneous polynomial of degree k_j: nothing small that was computed
is ever divided by. Its derivatives are of the same kind: p_k' = k p_{k-1} and p_0' = r^2 p_0.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ..kernels import Kernel
from .base import from_scaled, in_blocks, rows_last, scale, scaled_gradient, to_scaled
from .elimination import Degrees, degrees_of, functionals_of
from .interpolation import Interpolation
from .phi import phi


class GradedBasis(NamedTuple):
    """What depends on the directions alone, in float64."""

    directions: Tensor  # u, (M, n), in units of the reach
    reach: float  # the factor taken out of the directions
    functionals: Tensor  # q_ij / sigma_j, (M, M)
    weights: Tensor  # the same where k_j = k, else 0: (M, K, M), indexed i, k, j
    degrees: tuple[int, ...]  # 0, 1, ..., K - 1
    degree: Tensor  # k_j, (M,) int64
    factorial: Tensor  # k_j!, (M,)

    def functions(self, zeta: Tensor, r2: Tensor) -> Tensor:
        """psi(zeta): (..., P, n), (..., 1, 1) -> (..., P, M)."""
        parts = ridges(zeta @ self.directions.to(zeta).mT, r2, self.degrees[-1])
        return torch.stack(parts, dim=-1).flatten(-2) @ self.weights.to(zeta).flatten(0, 1)

    def narrow(self, like: Tensor) -> tuple[Tensor, Tensor]:
        """u / reach, (M, n), and the weights as (K M, M), indexed (k, i), j, in the dtype of ``like``."""
        spread = self.weights.transpose(0, 1).flatten(0, 1)
        return self.directions.to(like), spread.to(like)


def graded_basis(directions: Tensor, degrees: Degrees | None = None) -> GradedBasis:
    """The graded basis of directions (M, n), distinct; differentiable once their degrees are known.

    Raises:
        ValueError: if directions coincide to rounding.
    """
    degrees = degrees_of(directions) if degrees is None else degrees
    u = directions.double() / degrees.reach
    found = functionals_of(u, degrees)
    functionals = found.functionals / found.strengths.unsqueeze(-2)
    known = tuple(range(len(degrees.sizes)))
    degree = torch.tensor(degrees.each, device=u.device)
    members = degree == torch.tensor(known, device=u.device).unsqueeze(-1)  # (K, M)
    weights = functionals.unsqueeze(-2) * members
    factorial = torch.tensor([math.factorial(k) for k in degrees.each], dtype=u.dtype, device=u.device)
    return GradedBasis(u, degrees.reach, functionals, weights, known, degree, factorial)


def ridges(tau: Tensor, r2: Tensor, top: int) -> list[Tensor]:
    """p_k(tau) = tau^k k! phi_k(r^2 tau) for k = 0..top, of the shape of tau."""
    tails = phi(r2 * tau, top)
    power, found = tau, [tails[0]]
    for k, tail in enumerate(tails[1:], 1):
        found.append(power * tail)
        power = power * tau if k < top else power
    return found


class GradedSpace(NamedTuple):
    """span{k0(., d_i)} at the states x in its graded basis."""

    kernel: Kernel
    state: Tensor  # x, (..., n)
    nu: Tensor  # the radius of the centers, (...) or () for all states
    directions: Tensor  # u, (M, n), in the dtype of the state and in units of the radius
    units: Tensor  # of `GradedBasis.narrow`, (M, n), in the dtype of the state
    spread: Tensor  # of `GradedBasis.narrow`, (K M, M), in the dtype of the state
    basis: GradedBasis
    rate: Tensor  # q, (...) or ()
    bound: Callable[[], Tensor | None]  # sup of nu over all states, where q nu^2 is known to stay below 1
    meeting: bool  # whether nu may be zero, where all centers meet

    @property
    def offsets(self) -> Tensor:
        """d = nu u, (..., M, n), or (M, n) for all states."""
        return over_points(self.nu) * self.directions

    @property
    def radius(self) -> Tensor:
        """nu times the reach, (...) or () for all states."""
        return self.nu * self.basis.reach

    @property
    def rank(self) -> Tensor:
        """M; 1 where the radius is zero and all centers meet."""
        return torch.where(self.nu > 0, self.directions.shape[-2], 1)

    def fit(self, values: Tensor) -> Tensor:
        """beta with sum_j psi_j(u_i) beta_j = e^{-s(d_i)} V(c_i): (..., M) -> (..., M)."""
        # Where the radius of a row is the same at all its states, its own inverse is exact and as cheap.
        bound = self.bound() if self.meeting and self.nu.dim() > 0 else None
        if bound is not None:
            bound = self.rate * (bound * self.basis.reach).square()
        interpolation = Interpolation.of(self.basis, self._r2, bound)
        offsets = self.offsets

        def solve(values: Tensor, state: Tensor) -> Tensor:
            return interpolation.solve(scale(self.kernel, state, offsets, -1.0) * values)

        if not interpolation.shared or offsets.dim() > 2:
            return solve(values, self.state)
        return in_blocks(solve, values, self.state)

    def evaluate(self, z: Tensor, coefficients: Tensor) -> Tensor:
        """V^(x + z): (..., P, n), (..., M) -> (..., P)."""
        terms = self._terms(z, self._r2)
        return _sums(terms, self._ridge_weights(coefficients)) * scale(self.kernel, self.state, z)

    def evaluate_with_gradient(self, z: Tensor, coefficients: Tensor) -> tuple[Tensor, Tensor]:
        """V^(x + z) and its gradient in z, in closed form: (..., P, n), (..., M) -> (..., P), (..., P, n)."""
        r2, apart = self._r2, self._ridge_weights(coefficients)
        terms = self._terms(z, r2)
        sums = _sums(terms, apart)
        inner = terms[0] * (over_points(r2) * apart[0])
        for k in range(1, len(terms)):
            inner = torch.addcmul(inner, terms[k - 1], apart[k], value=k)
        slope = self._divided(rows_last(self.units.mT, inner))
        return scaled_gradient(self.kernel, self.state, z, sums, slope)

    def scaled_weights(self, coefficients: Tensor) -> Tensor:
        """e^g w, w_i = e^{-g - s(d_i)} sum_j (q_ij / sigma_j) k_j! r^(-2 k_j) beta_j: (..., M) -> (..., M).

        Not finite where r^(-2 k_j) is not.
        """
        b = (coefficients * self._unscale()) @ self.basis.functionals.to(coefficients).mT
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
        return self.rate.to(self.nu) * self.radius.square()

    def _divided(self, z: Tensor) -> Tensor:
        """z / radius, zero where the radius is: (..., P, n)."""
        radius = over_points(self.radius)
        if not self.meeting:
            return z / radius
        some = radius > 0
        return torch.where(some, z / torch.where(some, radius, 1.0), 0.0)

    def _terms(self, z: Tensor, r2: Tensor) -> list[Tensor]:
        """p_k(zeta'u_i) for k < K: (..., P, n) -> K of (..., P, M)."""
        return ridges(rows_last(self.units, self._divided(z)), over_points(r2), self.basis.degrees[-1])

    def _ridge_weights(self, coefficients: Tensor) -> tuple[Tensor, ...]:
        """sum_j (q_ij / sigma_j) beta_j, apart for each degree: (..., M) -> K of (..., 1, M)."""
        count = len(self.basis.degrees)
        together = rows_last(self.spread.to(coefficients), coefficients)
        apart: tuple[Tensor, ...] = together.unsqueeze(-2).chunk(count, -1)
        return apart

    def _unscale(self) -> Tensor:
        """k_j! r^(-2 k_j): (..., M)."""
        factor: Tensor = self.basis.factorial.to(self.nu) * self._r2.unsqueeze(-1) ** -self.basis.degree
        return factor


def over_points(value: Tensor) -> Tensor:
    """(...) -> (..., 1, 1), and a number as it is."""
    return value if value.dim() == 0 else value[..., None, None]


def _sums(terms: list[Tensor], apart: Sequence[Tensor]) -> Tensor:
    """sum_ik p_k(i) c_k(i): (..., P)."""
    total = terms[0] * apart[0]
    for term, weight in zip(terms[1:], apart[1:], strict=True):
        total = torch.addcmul(total, term, weight)
    return total.sum(-1)

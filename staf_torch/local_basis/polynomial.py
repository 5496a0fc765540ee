"""The finite graded basis of the polynomial kernel.

With s = bias + |x|^2, a(z) = 1 + x'z / s and H = I - x x'/s = L L', a projective change of the offsets,
z^ = L'z / (sqrt(s) a(z)), turns the kernel around x into a function of one inner product,

    (bias + (x+z)'(x+d))^p = s^p a(z)^p a(d)^p (1 + z^'d^)^p.

Projective maps keep the polynomials of each degree, so the elimination of `graded` serves again, with the
binomial series in place of the exponential one; only its points d^ now depend on the state.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from ..kernels import PolynomialKernel
from .base import at_points, of_states
from .elimination import Degrees, functionals_of


class PolynomialSpace(NamedTuple):
    """span{k(., c_i(x))} of a polynomial kernel at the states x in its graded basis, where no functional is
    of a degree above the kernel's and the bias is positive."""

    kernel: PolynomialKernel
    state: Tensor  # x, (..., n)
    offsets: Tensor  # d, (..., M, n), or (M, n) for all states
    directions: Tensor  # d^ / radius, (..., M, n)
    radius: Tensor  # about max |d^_i|, (...); zero where all centers meet
    weights_: Tensor  # q_ij / sigma_j, (..., M, M)
    degrees: tuple[int, ...]  # k_j, ascending, M of them

    @property
    def rank(self) -> Tensor:
        """M; 1 where the radius is zero and all centers meet."""
        return torch.where(self.radius > 0, self.offsets.shape[-2], 1)

    def fit(self, values: Tensor) -> Tensor:
        """beta with sum_j psi_j(d_i) beta_j = V(c_i), one step of refinement: (..., M) -> (..., M)."""
        of_states("fit", "values", values, self.state, self.offsets.shape[-2])
        scaled = values / self._a(self.offsets) ** self.kernel.degree
        ones = torch.ones_like(self.directions[..., 0])
        nodal = self._functions(self.directions, ones)
        inverse = torch.linalg.inv_ex(nodal).inverse
        first = _apply(inverse, scaled)
        return first + _apply(inverse, scaled - _apply(nodal, first))

    def evaluate(self, z: Tensor, coefficients: Tensor) -> Tensor:
        """V^(x + z): (..., P, n), (..., M) -> (..., P)."""
        at_points("evaluate", z, coefficients, self.state, self.offsets.shape[-2])
        return _apply(self._functions(self._zeta(z), self._a(z)), coefficients)

    def evaluate_with_gradient(self, z: Tensor, coefficients: Tensor) -> tuple[Tensor, Tensor]:
        """V^(x + z) and its gradient in z: (..., P, n), (..., M) -> (..., P), (..., P, n)."""
        at_points("evaluate_with_gradient", z, coefficients, self.state, self.offsets.shape[-2])
        a, tau = self._a(z).unsqueeze(-1), self._zeta(z) @ self.directions.mT
        value, by_tau, by_a = torch.zeros_like(tau), torch.zeros_like(tau), torch.zeros_like(tau)
        p, r2 = self.kernel.degree, self.radius[..., None, None].square()
        for k in dict.fromkeys(self.degrees):
            members = [j for j, degree in enumerate(self.degrees) if degree == k]
            apart = _apply(self.weights_[..., members], coefficients[..., members]).unsqueeze(-2)
            for power in range(k, p + 1):
                share = (math.comb(p, power) / math.comb(p, k)) * r2 ** (power - k) * apart
                value = value + share * a ** (p - power) * tau**power
                if power > 0:
                    by_tau = by_tau + power * share * a ** (p - power) * tau ** (power - 1)
                if power < p:
                    by_a = by_a + (p - power) * share * a ** (p - power - 1) * tau**power
        s = _square(self.kernel, self.state)[..., None, None]
        # zeta is linear in z through a symmetric matrix.
        slope = (
            self._zeta(by_tau @ self.directions) + by_a.sum(-1, keepdim=True) * self.state.unsqueeze(-2) / s
        )
        return value.sum(-1), slope

    def scaled_weights(self, coefficients: Tensor) -> Tensor:
        """The paper's w: (..., M) -> (..., M); this kernel has no gain."""
        of_states("scaled_weights", "coefficients", coefficients, self.state, self.offsets.shape[-2])
        p = self.kernel.degree
        b = _apply(self.weights_, coefficients * self._unscale())
        s = _square(self.kernel, self.state).unsqueeze(-1)
        return b / (s * self._a(self.offsets)) ** p

    def weights(self, coefficients: Tensor) -> Tensor:
        """The paper's w: (..., M) -> (..., M); NaN in a row where it cannot be represented."""
        w = self.scaled_weights(coefficients)
        return torch.where(torch.isfinite(w).all(-1, keepdim=True), w, torch.nan)

    def coefficients(self, weights: Tensor) -> Tensor:
        """beta from the paper's w: (..., M) -> (..., M)."""
        of_states("coefficients", "weights", weights, self.state, self.offsets.shape[-2])
        s = _square(self.kernel, self.state).unsqueeze(-1)
        b = weights * (s * self._a(self.offsets)) ** self.kernel.degree
        inverse = self.weights_ / self.weights_.square().sum(-2, keepdim=True)
        return _apply(inverse.mT, b) / self._unscale()

    def _zeta(self, z: Tensor) -> Tensor:
        """a(z) z^ / radius, zero where all centers meet: (..., P, n)."""
        radius = self.radius[..., None, None]
        some = radius > 0
        return torch.where(some, _root(self.kernel, self.state, z) / torch.where(some, radius, 1.0), 0.0)

    def _a(self, z: Tensor) -> Tensor:
        return _projection(self.kernel, self.state, z)

    def _functions(self, zeta: Tensor, a: Tensor) -> Tensor:
        """psi_j = sum_i (q_ij/sigma_j) sum_{l >= k} C(p,l)/C(p,k) a^(p-l) r^(2(l-k)) (zeta'u_i)^l, k = k_j.

        Args:
            zeta: a(z) z^ / radius, (..., P, n).
            a: (..., P).

        Returns:
            (..., P, M).
        """
        p = self.kernel.degree
        tau, r2 = zeta @ self.directions.mT, self.radius[..., None, None].square()
        columns = []
        for k in dict.fromkeys(self.degrees):
            tail = torch.zeros_like(tau)
            for power in range(p, k - 1, -1):
                share = math.comb(p, power) / math.comb(p, k)
                tail = tail * r2 * tau + share * a.unsqueeze(-1) ** (p - power)
            members = [j for j, degree in enumerate(self.degrees) if degree == k]
            columns.append((tau**k * tail) @ self.weights_[..., members])
        return torch.cat(columns, dim=-1)

    def _unscale(self) -> Tensor:
        """1 / (C(p, k_j) r^(2 k_j)): (..., M)."""
        p, like = self.kernel.degree, self.radius
        degree = torch.tensor(self.degrees, dtype=torch.int64, device=like.device)
        binomial = torch.tensor([math.comb(p, k) for k in self.degrees], dtype=like.dtype, device=like.device)
        return self.radius.square().unsqueeze(-1) ** -degree / binomial


def polynomial_space(
    kernel: PolynomialKernel, x: Tensor, radius: Tensor, directions: Tensor, degrees: Degrees
) -> PolynomialSpace:
    """The space at the states x (..., n).

    Args:
        kernel: with a positive bias, and of no lower degree than any of ``degrees``.
        x: (..., n).
        radius: nu(x), (...) or ().
        directions: u, (M, n).
        degrees: of the directions, and so of the projected ones at every state.
    """
    offsets = radius[..., None, None] * directions
    points = _root(kernel, x, offsets) / _projection(kernel, x, offsets).unsqueeze(-1)
    # Close to max |d^_i|, and smooth; any scale of this size would do.
    size = radius * degrees.reach / _square(kernel, x).sqrt()
    wide, scale = points.double(), size.double()[..., None, None]
    # Where all centers meet, or a state is not finite, the directions keep the algebra defined.
    usable = torch.isfinite(scale) & (scale > 0)
    scaled = torch.where(usable, wide / torch.where(usable, scale, 1.0), directions.double())
    found = functionals_of(scaled, degrees)
    weights = found.functionals / found.strengths.unsqueeze(-2)
    return PolynomialSpace(kernel, x, offsets, scaled.to(x), size, weights.to(x), degrees.each())


def _square(kernel: PolynomialKernel, x: Tensor) -> Tensor:
    """s = bias + |x|^2: (..., n) -> (...)."""
    return kernel.shift().to(x) + x.square().sum(-1)


def _projection(kernel: PolynomialKernel, x: Tensor, z: Tensor) -> Tensor:
    """a(z) = 1 + x'z / s: (..., n), (..., P, n) -> (..., P)."""
    return 1 + (z * x.unsqueeze(-2)).sum(-1) / _square(kernel, x).unsqueeze(-1)


def _root(kernel: PolynomialKernel, x: Tensor, z: Tensor) -> Tensor:
    """L'z / sqrt(s) with the symmetric root L of H: (..., n), (..., P, n) -> (..., P, n).

    L = I - (1 - sqrt(bias / s)) x x'/|x|^2, with (1 - sqrt(bias/s)) / |x|^2 = 1 / (s (1 + sqrt(bias/s))),
    which has no 0/0 at the origin.
    """
    s = _square(kernel, x)
    ratio = (kernel.shift().to(x) / s).sqrt()
    along = (z * x.unsqueeze(-2)).sum(-1) / (s * (1 + ratio)).unsqueeze(-1)
    return (z - along.unsqueeze(-1) * x.unsqueeze(-2)) / s.sqrt()[..., None, None]


def _apply(matrix: Tensor, vector: Tensor) -> Tensor:
    """(..., P, M), (..., M) -> (..., P)."""
    return (matrix @ vector.unsqueeze(-1)).squeeze(-1)

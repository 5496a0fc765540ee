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
from .base import at_points, from_scaled, in_blocks, of_states, rows_last, scale, scaled_gradient, to_scaled
from .elimination import Degrees, degrees_of, functionals_of

_NODES = 24
SERIES_BELOW = 1.0  # up to this r^2 the inverse is taken from its Chebyshev series


class GradedBasis(NamedTuple):
    """Quantities of the graded basis that depend on the directions alone, in float64."""

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
    known = tuple(range(len(degrees.sizes())))
    degree = torch.tensor(degrees.each(), dtype=torch.int64, device=u.device)
    members = degree == torch.tensor(known, dtype=torch.int64, device=u.device).unsqueeze(-1)  # (K, M)
    weights = functionals.unsqueeze(-2) * members
    factorial = torch.tensor([math.factorial(k) for k in degrees.each()], dtype=u.dtype, device=u.device)
    return GradedBasis(u, degrees.reach, functionals, weights, known, degree, factorial)


def ridges(tau: Tensor, r2: Tensor, top: int) -> list[Tensor]:
    """p_k(tau) = tau^k k! phi_k(r^2 tau) for k = 0..top, of the shape of tau."""
    tails = phi(r2 * tau, top)
    power, found = tau, [tails[0]]
    for k, tail in enumerate(tails[1:], 1):
        found.append(power * tail)
        power = power * tau if k < top else power
    return found


class Interpolation(NamedTuple):
    """Psi^-1 with Psi_ij = psi_j(u_i), as the product T^-1 Q' of the functionals Q and T = Q' Psi.

    T(r^2) is block upper triangular at r = 0 with a well-conditioned diagonal, and analytic in r^2. Taken one
    after the other, the two products keep the digits that Psi^-1 in one matrix, with its large entries of
    both signs, would lose. For one radius T^-1 is one matrix; along a trajectory it is a Chebyshev series in
    r^2, set up once, so that nothing is factored again.
    """

    functionals: Tensor  # Q', (M, M)
    inverse: Tensor  # T^-1: (M, M), (..., M, M), or the series (N, M, M), (..., 1, N, M, M)
    chebyshev: Tensor | None  # T_m(r^2), (..., N), where `inverse` is a series

    @classmethod
    def of(cls, basis: GradedBasis, r2: Tensor, bound: Tensor | None) -> Interpolation:
        """For the radii r^2, () or (...), in float64.

        Args:
            basis: of the functionals.
            r2: r^2.
            bound: over all states, () or (..., 1) where every row has its own; None where it is not known,
                or r^2 the same at all states. Without one every r^2 is inverted by itself; one of more than
                1 gives NaN.
        """
        wide = r2.double()
        u, functionals = basis.directions.to(wide.device), basis.functionals.to(wide.device).mT
        if wide.dim() == 0 or bound is None:
            nodal = basis.functions(u, wide[..., None, None])
            return cls(functionals, _inverse(functionals @ nodal), None)
        index = torch.arange(_NODES, dtype=torch.float64, device=u.device)
        angles = (index + 0.5) * (torch.pi / _NODES)
        transform = (index[:, None] * angles).cos() * (2 / _NODES)
        transform[0] *= 0.5
        # The bound is a constant of the series, not a quantity to differentiate.
        upper = bound.detach().double().to(u.device)
        upper = torch.where(upper <= SERIES_BELOW, upper, torch.nan)
        if upper.dim() > 0 and upper.shape[-1] != 1:
            upper = upper.amax()
        nodes = 0.5 * upper[..., None] * (1 + angles.cos())
        nodal = basis.functions(u, nodes[..., None, None])
        series = torch.einsum("mk,...kij->...mij", transform, _inverse(functionals @ nodal))
        return cls(functionals, series, _chebyshev(2 * wide / upper - 1))

    def shared(self) -> bool:
        """Return whether one matrix is used at all states."""
        return self.inverse.dim() == 2

    def solve(self, values: Tensor) -> Tensor:
        """Psi^-1 v: (..., M) -> (..., M), computed in float64 whatever the dtype of v."""
        wide = values.double()
        if self.shared() and wide.dim() == 2:  # the same with rows last, which is faster
            return (self.inverse @ (self.functionals @ wide.mT)).mT.to(values.dtype)
        return self._apply_inverse(wide @ self.functionals.mT).to(values.dtype)

    def _apply_inverse(self, vector: Tensor) -> Tensor:
        if self.chebyshev is not None:
            columns = self.inverse.flatten(-3, -2).mT  # (M, N M): one product for all terms of the series
            columns = (
                columns if columns.dim() == 2 else columns.squeeze(-3)
            )  # a row's own, for all its states
            terms: Tensor = (vector @ columns).unflatten(-1, self.inverse.shape[-3:-1])
            return (terms * self.chebyshev.unsqueeze(-1)).sum(-2)
        if self.inverse.dim() == 2:
            return vector @ self.inverse.mT
        if self.inverse.dim() == vector.dim() + 1 and self.inverse.shape[-3] == 1:
            return vector @ self.inverse.squeeze(-3).mT  # a row's own, for all its states
        return (self.inverse @ vector.unsqueeze(-1)).squeeze(-1)


def _chebyshev(at: Tensor) -> Tensor:
    """T_0..T_{N-1}: (...) -> (..., N), by recurrence, which is differentiable at the ends."""
    terms = [torch.ones_like(at), at]
    for _ in range(_NODES - 2):
        terms.append(2 * at * terms[-1] - terms[-2])
    return torch.stack(terms, dim=-1)


def _inverse(matrix: Tensor) -> Tensor:
    """Row by row; a matrix that is not finite gives one that is not, and no error for the others."""
    inverse: Tensor = torch.linalg.inv_ex(matrix).inverse
    return inverse


class GradedSpace(NamedTuple):
    """span{k0(., d_i)} at the states x in its graded basis."""

    kernel: Kernel
    state: Tensor  # x, (..., n)
    nu: Tensor  # the radius of the centers, (...) or () for all states
    radius: Tensor  # nu times the reach, (...) or ()
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
        # As centers.offsets: a compiler then knows them equal.
        return self.nu[..., None, None] * self.directions

    @property
    def rank(self) -> Tensor:
        """M; 1 where the radius is zero and all centers meet."""
        return torch.where(self.nu > 0, self.directions.shape[-2], 1)

    def fit(self, values: Tensor) -> Tensor:
        """beta with sum_j psi_j(u_i) beta_j = e^{-s(d_i)} V(c_i): (..., M) -> (..., M)."""
        of_states("fit", "values", values, self.state, self.directions.shape[-2])
        # Where the radius of a row is the same at all its states, its own inverse is exact and as cheap.
        bound = self.bound() if self.meeting and self.nu.dim() > 0 else None
        if bound is not None:
            bound = self.rate * (bound * self.basis.reach).square()
        interpolation = Interpolation.of(self.basis, self._r2(), bound)
        offsets = self.offsets

        def solve(values: Tensor, state: Tensor) -> Tensor:
            return interpolation.solve(scale(self.kernel, state, offsets, -1.0) * values)

        if not interpolation.shared() or offsets.dim() > 2:
            return solve(values, self.state)
        return in_blocks(solve, values, self.state)

    def evaluate(self, z: Tensor, coefficients: Tensor) -> Tensor:
        """V^(x + z): (..., P, n), (..., M) -> (..., P)."""
        at_points("evaluate", z, coefficients, self.state, self.directions.shape[-2])
        terms = self._terms(z, self._r2())
        return _sums(terms, self._ridge_weights(coefficients)) * scale(self.kernel, self.state, z)

    def evaluate_with_gradient(self, z: Tensor, coefficients: Tensor) -> tuple[Tensor, Tensor]:
        """V^(x + z) and its gradient in z, in closed form: (..., P, n), (..., M) -> (..., P), (..., P, n)."""
        at_points("evaluate_with_gradient", z, coefficients, self.state, self.directions.shape[-2])
        r2, apart = self._r2(), self._ridge_weights(coefficients)
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
        of_states("scaled_weights", "coefficients", coefficients, self.state, self.directions.shape[-2])
        b = (coefficients * self._unscale()) @ self.basis.functionals.to(coefficients).mT
        return b * scale(self.kernel, self.state, self.offsets, -1.0)

    def weights(self, coefficients: Tensor) -> Tensor:
        """The paper's w: (..., M) -> (..., M); NaN in a row where it cannot be represented."""
        return from_scaled(self.kernel, self.state, self.scaled_weights(coefficients))

    def coefficients(self, weights: Tensor) -> Tensor:
        """beta from the paper's w: (..., M) -> (..., M)."""
        of_states("coefficients", "weights", weights, self.state, self.directions.shape[-2])
        b = to_scaled(self.kernel, self.state, weights) * scale(self.kernel, self.state, self.offsets)
        full = self.basis.functionals  # orthogonal columns
        inverse = full / full.square().sum(0)
        return b @ inverse.to(b) / self._unscale()

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
        return together.unsqueeze(-2).chunk(count, -1)

    def _unscale(self) -> Tensor:
        """k_j! r^(-2 k_j): (..., M)."""
        degree = self.basis.degree.to(self.nu.device)
        return self.basis.factorial.to(self.nu) * self._r2().unsqueeze(-1) ** -degree


def over_points(value: Tensor) -> Tensor:
    """(...) -> (..., 1, 1), and a number as it is."""
    return value if value.dim() == 0 else value[..., None, None]


def _sums(terms: list[Tensor], apart: Sequence[Tensor]) -> Tensor:
    """sum_ik p_k(i) c_k(i): (..., P)."""
    total = terms[0] * apart[0]
    for term, weight in zip(terms[1:], apart[1:], strict=True):
        total = torch.addcmul(total, term, weight)
    return total.sum(-1)


def phi(t: Tensor, top: int) -> list[Tensor]:
    """Return f_k(t) = k! phi_k(t), k = 0..top, with phi_k(t) = sum_j t^j / (k + j)!, so that f_0 = exp.

    For |t| <= 1 by the Taylor series of f_top and, downwards, f_{k-1} = 1 + t f_k / k; beyond that upwards
    from the exponential, which loses a factor k! of accuracy at |t| = 1 and nothing far out.

    Returns:
        top + 1 tensors of the shape of t.
    """
    exponential = t.exp()
    if top == 0:
        return [exponential]
    one, terms = torch.ones_like(t), _terms(top, t.dtype)
    small = t.clamp(-1.0, 1.0)
    near = small == t
    tail = torch.add(one, small, alpha=1 / (top + terms))
    for j in range(top + terms - 1, top, -1):
        tail = torch.addcmul(one, tail, small, value=1 / j)
    below = [tail]
    for k in range(top, 1, -1):
        below.append(torch.addcmul(one, below[-1], small, value=1 / k))
    large = torch.where(near, one, t)
    found, above = [exponential], exponential
    for k in range(top):
        above = torch.sub(above, one) / large
        above = torch.add(above, above, alpha=k) if k else above
        found.append(torch.where(near, below[top - 1 - k], above))
    return found


def _terms(top: int, dtype: torch.dtype) -> int:
    """N with the first neglected term of f_top, top! t^(N+1) / (top + N + 1)!, below rounding at |t| = 1."""
    small, term, count = (5e-17 if dtype == torch.float64 else 3e-8), 1.0, 0
    while term > small:
        count += 1
        term /= top + count
    return count

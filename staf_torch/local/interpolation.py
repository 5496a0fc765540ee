"""From values at the centers to coefficients in the graded basis."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import torch
from torch import Tensor

_NODES = 24
_ANALYTIC = 1.0  # up to this r^2 the inverse is taken from its Chebyshev series


class _Basis(Protocol):
    @property
    def directions(self) -> Tensor: ...

    @property
    def functionals(self) -> Tensor: ...

    def functions(self, zeta: Tensor, r2: Tensor) -> Tensor: ...


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
    def of(cls, basis: _Basis, r2: Tensor, bound: Tensor | None) -> Interpolation:
        """For the radii r^2, () or (...), in float64.

        Args:
            basis: of the functionals.
            r2: r^2.
            bound: over all states, () or (..., 1) where every row has its own; None where it is not known,
                or r^2 the same at all states. Without one, or beyond 1, every r^2 is inverted by itself.
        """
        wide = r2.double()
        u, functionals = basis.directions.to(wide.device), basis.functionals.to(wide.device).mT
        if wide.dim() == 0 or bound is None or not bool((bound <= _ANALYTIC).all()):
            nodal = basis.functions(u, wide[..., None, None])
            return cls(functionals, _inverse(functionals @ nodal), None)
        index = torch.arange(_NODES, dtype=torch.float64, device=u.device)
        angles = (index + 0.5) * (torch.pi / _NODES)
        transform = (index[:, None] * angles).cos() * (2 / _NODES)
        transform[0] *= 0.5
        # The bound is a constant of the series, not a quantity to differentiate.
        upper = bound.detach().double().to(u.device)
        if upper.dim() > 0 and upper.shape[-1] != 1:
            upper = upper.amax()
        nodes = 0.5 * upper[..., None] * (1 + angles.cos())
        nodal = basis.functions(u, nodes[..., None, None])
        series = torch.einsum("mk,...kij->...mij", transform, _inverse(functionals @ nodal))
        return cls(functionals, series, _chebyshev(2 * wide / upper - 1))

    @property
    def shared(self) -> bool:
        """Whether one matrix serves all states."""
        return self.chebyshev is None and self.inverse.dim() == 2

    def solve(self, values: Tensor) -> Tensor:
        """Psi^-1 v: (..., M) -> (..., M), computed in float64 whatever the dtype of v."""
        wide = values.double()
        if self.shared and wide.dim() == 2:  # the same with rows last, which is faster
            return (self.inverse @ (self.functionals @ wide.mT)).mT.to(values.dtype)
        return self._apply_inverse(wide @ self.functionals.mT).to(values.dtype)

    def _apply_inverse(self, vector: Tensor) -> Tensor:
        if self.chebyshev is not None:
            columns = self.inverse.flatten(-3, -2).mT  # (M, N M): one product for all terms of the series
            columns = (
                columns if columns.dim() == 2 else columns.squeeze(-3)
            )  # a row's own, for all its states
            terms: Tensor = (vector @ columns).unflatten(-1, self.inverse.shape[-3:-1])
            total: Tensor = (terms * self.chebyshev.unsqueeze(-1)).sum(-2)
            return total
        if self.inverse.dim() == 2:
            return vector @ self.inverse.mT
        if self.inverse.dim() == vector.dim() + 1 and self.inverse.shape[-3] == 1:
            return vector @ self.inverse.squeeze(-3).mT  # a row's own, for all its states
        product: Tensor = (self.inverse @ vector.unsqueeze(-1)).squeeze(-1)
        return product


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

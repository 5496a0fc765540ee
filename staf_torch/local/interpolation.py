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

    def functions(self, zeta: Tensor, r2: Tensor) -> Tensor: ...


class Interpolation(NamedTuple):
    """Psi(r^2), Psi_ij = psi_j(u_i), and its inverse, as they depend on the radius.

    Both are analytic in r^2 on the whole half-line, r = 0 included. For one radius they are one matrix
    each; along a trajectory they are Chebyshev series in r^2, set up once, so that nothing is factored
    again.
    """

    nodal: Tensor  # Psi: (M, M), (..., M, M), or the series (N, M, M)
    inverse: Tensor  # Psi^-1, likewise
    chebyshev: Tensor | None  # T_m(r^2), (..., N), where `nodal` and `inverse` are series

    @classmethod
    def of(cls, basis: _Basis, r2: Tensor, bound: Tensor | None, dtype: torch.dtype) -> Interpolation:
        """For the radii r^2, () or (...), with their known bound over all states, if any.

        Set up in float64 and rounded to ``dtype`` at the end. Without a bound, or beyond a bound of 1, each
        radius of a batch is inverted by itself.
        """
        wide = r2.double()
        u = basis.directions.to(wide.device)
        if wide.dim() == 0 or bound is None or not bool(bound <= _ANALYTIC):
            nodal = basis.functions(u, wide[..., None, None])
            return cls(nodal.to(dtype), _inverse(nodal).to(dtype), None)
        index = torch.arange(_NODES, dtype=torch.float64, device=u.device)
        angles = (index + 0.5) * (torch.pi / _NODES)
        transform = (index[:, None] * angles).cos() * (2 / _NODES)
        transform[0] *= 0.5
        # The bound is a constant of the series, not a quantity to differentiate.
        upper = bound.detach().double().to(u.device)
        nodal = basis.functions(u, (0.5 * upper * (1 + angles.cos()))[:, None, None])
        series = [torch.einsum("mk,kij->mij", transform, samples) for samples in (nodal, _inverse(nodal))]
        polynomials = _chebyshev(2 * wide / upper - 1)
        return cls(series[0].to(dtype), series[1].to(dtype), polynomials.to(dtype))

    @property
    def shared(self) -> bool:
        """Whether one matrix serves all states."""
        return self.chebyshev is None and self.nodal.dim() == 2

    def solve(self, values: Tensor) -> Tensor:
        """Psi^-1 v with one step of refinement, which makes the residual, not Psi^-1, set the error."""
        if self.shared and values.dim() == 2:  # the same in fused products, rows last: a third faster
            columns = values.mT
            first = self.inverse @ columns
            return torch.addmm(first, self.inverse, torch.addmm(columns, self.nodal, first, alpha=-1)).mT
        first = self._apply(self.inverse, values)
        return first + self._apply(self.inverse, values - self._apply(self.nodal, first))

    def _apply(self, matrix: Tensor, vector: Tensor) -> Tensor:
        if self.chebyshev is not None:
            columns = matrix.flatten(0, 1).mT  # (M, N M): one product for all terms of the series
            terms: Tensor = (vector @ columns).unflatten(-1, (matrix.shape[0], matrix.shape[1]))
            total: Tensor = (terms * self.chebyshev.unsqueeze(-1)).sum(-2)
            return total
        if matrix.dim() == 2:
            return vector @ matrix.mT
        product: Tensor = (matrix @ vector.unsqueeze(-1)).squeeze(-1)
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

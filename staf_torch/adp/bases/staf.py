"""The StaF basis in the actor-critic laws."""

from __future__ import annotations

import torch
from torch import Tensor

from ..._checks import choice
from ...basis import StaFBasis
from ...centers import StateRadius
from ...kernels import AnchoredKernel, ExponentialKernel
from .base import ValueBasis


class StaFValueBasis(ValueBasis):
    """s_i(y; x) = k(y, c_i(x)).

    Its gradient at y = x is either of two, which differ by O(1):
        ``partial``: d/dy with the centers frozen;
        ``total``: d/dx of k(x, c_i(x)), the centers moving with the state (the published laws). At
        points y other than x the centers move along, y - x staying what it is.

    For the anchored exponential kernel exp(y'c) - 1 both are in closed form, with c_i = x + nu(x) u_i:

        partial = e^{y'c_i} c_i,   total = e^{y'c_i} (c_i + y + grad nu(x) u_i'y);

    every other kernel is differentiated automatically.

    Args:
        basis: kernel and centers.
        gradient: ``total`` or ``partial``.

    Raises:
        ValueError: if an argument breaks its rule.
    """

    def __init__(self, basis: StaFBasis, gradient: str = "total") -> None:
        super().__init__()
        if not isinstance(basis, StaFBasis):
            raise ValueError(f"`StaFValueBasis(basis=...)` must be a StaFBasis; got {basis!r}.")
        choice("StaFValueBasis", "gradient", gradient, ("total", "partial"))
        self.basis = basis
        self.mode = gradient
        self.count, self.dim = basis.count, basis.dim
        kernel, radius = basis.kernel, basis.centers.radius
        closed = isinstance(kernel, AnchoredKernel) and isinstance(kernel.kernel, ExponentialKernel)
        self._closed = closed and (
            gradient == "partial" or radius.constant or isinstance(radius, StateRadius)
        )

    def forward(self, y: Tensor, x: Tensor) -> Tensor:
        if self._closed:
            return (y.unsqueeze(-2) * self._centers(x)).sum(-1).expm1()
        values: Tensor = self.basis(y.unsqueeze(-2), x)
        return values.squeeze(-2)

    def gradient(self, y: Tensor, x: Tensor) -> Tensor:
        return self._closed_form(y, x) if self._closed else self._automatic(y, x)

    def _centers(self, x: Tensor) -> Tensor:
        return x.unsqueeze(-2) + self.basis.centers.offsets(x)

    def _closed_form(self, y: Tensor, x: Tensor) -> Tensor:
        c = self._centers(x)
        size = (y.unsqueeze(-2) * c).sum(-1, keepdim=True).exp()  # (..., M, 1)
        if self.mode == "partial":
            return size * c
        along = c + y.unsqueeze(-2)
        radius = self.basis.centers.radius
        if isinstance(radius, StateRadius):
            directions = self.basis.centers.directions.to(x)
            reach = (directions * y.unsqueeze(-2)).sum(-1, keepdim=True)  # u_i'y, (..., M, 1)
            along = along + reach * _slope(radius, x).unsqueeze(-2)
        return size * along

    def _automatic(self, y: Tensor, x: Tensor) -> Tensor:
        """One backward pass a basis function: a (..., M, n) Jacobian without a loop over the batch."""
        if self.mode == "total":
            # y and x move together: the derivative along y = y0 + h, x = x0 + h.
            values, pull = torch.func.vjp(lambda h: self(y + h, x + h), torch.zeros_like(y))[:2]
        else:
            values, pull = torch.func.vjp(lambda at: self(at, x), y)[:2]
        selectors = torch.eye(self.count, dtype=values.dtype, device=values.device)
        rows = [pull(selector.expand(values.shape))[0] for selector in selectors]
        return torch.stack(rows, dim=-2)


def _slope(radius: StateRadius, x: Tensor) -> Tensor:
    """grad nu = 2 radius (1 - gain offset) x / (1 + gain x'x)^2: (..., n)."""
    one = 1 + radius.gain * x.square().sum(-1, keepdim=True)
    return 2 * radius.radius * (1 - radius.gain * radius.offset) / one.square() * x

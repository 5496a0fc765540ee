"""`StaF`: a local approximation as a torch module."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from ._checks import choice, trailing
from .basis import StaFBasis, Target
from .local import local_space

_MODES = ("partial", "total_frozen_weights", "total")


class StaF(nn.Module):
    """V^(y; x) = sum_i w_i k(y, c_i(x)) around one state x a batch entry.

    The parameters are coefficients in the local basis at x, which stay finite where the paper's
    weights w overflow; `weights` derives w from them.

    Example:
        >>> basis = StaFBasis(ExponentialKernel(), StateFollowingCenters(rings(6), radius=0.1))
        >>> staf = StaF(basis, batch_shape=(2,))
        >>> x = torch.tensor([[1.0, 0.0], [0.0, 1.0]], dtype=torch.float64)
        >>> staf.fit_(x, targets.Paper())(x.unsqueeze(-2)).shape
        torch.Size([2, 1])

    Args:
        basis: kernel and centers.
        batch_shape: leading dimensions (...), independent approximations side by side.
    """

    def __init__(self, basis: StaFBasis, batch_shape: tuple[int, ...] = ()) -> None:
        super().__init__()
        self.basis = basis
        like = basis.centers.directions
        self.coefficients = nn.Parameter(like.new_zeros(*batch_shape, basis.count))
        self.register_buffer("state", like.new_zeros(*batch_shape, basis.dim))
        self.state: Tensor
        self._target: Target | None = None

    @property
    def weights(self) -> Tensor:
        """The paper's w: (..., M)."""
        return self.basis.local(self.state).weights(self.coefficients)

    def fit_(self, x: Tensor, target: Target) -> StaF:
        """Move to the states x (..., n) and take the ideal coefficients of ``target`` there.

        Raises:
            ValueError: if x is not of the shape (*batch_shape, n).
        """
        trailing("StaF.fit_", "x", x, dims=1, last=self.basis.dim)
        if x.shape != self.state.shape:
            raise ValueError(
                f"`StaF.fit_(x=...)` must have the shape {tuple(self.state.shape)}; got {tuple(x.shape)}."
            )
        with torch.no_grad():
            self.state.copy_(x)
            values = self.basis.values(self.state, target)
            self.coefficients.copy_(self.basis.local(self.state).fit(values))
        self._target = target
        return self

    def forward(self, y: Tensor) -> Tensor:
        """V^(y; x): (..., P, n) -> (..., P)."""
        trailing("StaF", "y", y, dims=2, last=self.basis.dim)
        z = y - self.state.unsqueeze(-2)
        values: Tensor = self.basis.local(self.state).evaluate(z, self.coefficients)
        return values

    def gradient(self, y: Tensor, mode: str = "partial", target: Target | None = None) -> Tensor:
        """Gradient of V^ at y: (..., P, n) -> (..., P, n).

        Modes, which differ by O(1):
            ``partial``: d/dy with the centers frozen at x.
            ``total_frozen_weights``: the state moves with y (y - x fixed), the weights w do not.
                For the exponential kernel with constant offsets: partial + y V^(y).
            ``total``: the weights are the ideal ones at every state; needs the target, by default
                that of the last `fit_`.

        Raises:
            ValueError: for another mode, or ``total`` without a target.
        """
        choice("StaF.gradient", "mode", mode, _MODES)
        trailing("StaF.gradient", "y", y, dims=2, last=self.basis.dim)
        if mode == "partial":
            return _gradient(self, y)
        z = (y - self.state.unsqueeze(-2)).unsqueeze(-2)  # (..., P, 1, n): one point a state
        x = self.state.unsqueeze(-2).expand(y.shape)
        if mode == "total_frozen_weights":
            return _gradient(lambda moved: self._frozen(moved, z), x)
        chosen = self._target if target is None else target
        if chosen is None:
            raise ValueError(
                '`StaF.gradient(mode="total")` needs a target: pass `target=...` or call `fit_`.'
            )
        return _gradient(lambda moved: self._moving(moved, z, chosen), x)

    def _frozen(self, moved: Tensor, z: Tensor) -> Tensor:
        """V^(x~ + z; x~) with w of x: (..., P, n), (..., P, 1, n) -> (..., P)."""
        weights = self.weights.unsqueeze(-2).unsqueeze(-2)
        sigma = self.basis(moved.unsqueeze(-2) + z, moved)
        values: Tensor = (sigma * weights).sum(-1).squeeze(-1)
        return values

    def _moving(self, moved: Tensor, z: Tensor, target: Target) -> Tensor:
        """V^(x~ + z; x~) with the ideal weights of x~: (..., P, n), (..., P, 1, n) -> (..., P)."""
        space = local_space(self.basis.kernel, self.basis.centers, moved)
        coefficients = space.fit(self.basis.values(moved, target))
        return space.evaluate(z, coefficients).squeeze(-1)


def _gradient(function: Callable[[Tensor], Tensor], at: Tensor) -> Tensor:
    """Row-wise gradient of (..., n) -> (...): (..., n)."""
    gradient: Tensor = torch.func.grad(lambda point: function(point).sum())(at)
    return gradient

"""`StaF`: a local approximation as a torch module."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from ._checks import choice, trailing
from .basis import StaFBasis, Target

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
        """The paper's w: (..., M).

        Raises:
            ValueError: if they cannot be represented in this dtype; the coefficients can.
        """
        w = self.basis.local(self.state).weights(self.coefficients)
        lost = torch.isnan(w).any(-1) & torch.isfinite(self.coefficients).all(-1)
        if bool(lost.any()):
            rows = lost.nonzero().tolist() if lost.dim() else []
            where = f" of the batch entries {rows[:5]}" if rows else ""
            raise ValueError(
                f"`StaF.weights`{where} must be representable in {w.dtype}, but e^(-x'x) or a power of the "
                f"radius leaves its range: use `StaF.coefficients`, or the Gaussian kernel; "
                f"got |x| up to {float(self.state.norm(dim=-1).max()):.4g}."
            )
        return w

    def fit_(self, x: Tensor, target: Target) -> StaF:
        """Move to the states x (..., n) and take the ideal coefficients of ``target`` there.

        A row whose samples are not finite gets coefficients that are not.

        Raises:
            ValueError: if x is not of the shape (*batch_shape, n), or the target returns another shape; the
                module then stays as it was.
        """
        trailing("StaF.fit_", "x", x, dims=1, last=self.basis.dim)
        if x.shape != self.state.shape:
            raise ValueError(
                f"`StaF.fit_(x=...)` must have the shape {tuple(self.state.shape)}; got {tuple(x.shape)}."
            )
        with torch.no_grad():
            x = x.to(self.state)
            self.basis.check_reach(x)
            coefficients = self.basis.local(x).fit(self.basis.values(x, target))
            self.state.copy_(x)
            self.coefficients.copy_(coefficients)
        self._target = target
        return self

    def forward(self, y: Tensor) -> Tensor:
        """V^(y; x): (..., P, n) -> (..., P)."""
        trailing("StaF", "y", y, dims=2, last=self.basis.dim)
        return self.at_offsets(y - self.state.unsqueeze(-2))

    def at_offsets(self, z: Tensor) -> Tensor:
        """V^(x + z; x): (..., P, n) -> (..., P).

        For radii near the rounding of x, where y - x has no digits left.
        """
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
        function = self._along(y, mode, target)
        return _gradient(function, torch.zeros_like(y))

    def hessian(self, y: Tensor, mode: str = "partial", target: Target | None = None) -> Tensor:
        """Second derivatives of V^ at y, in the modes of `gradient`: (..., P, n) -> (..., P, n, n)."""
        function = self._along(y, mode, target)
        rows = [
            _gradient(lambda step, i=i: _gradient(function, step)[..., i], torch.zeros_like(y))  # type: ignore[misc]
            for i in range(y.shape[-1])
        ]
        return torch.stack(rows, dim=-2)

    def _along(self, y: Tensor, mode: str, target: Target | None) -> Callable[[Tensor], Tensor]:
        """V^ as a function of a step from y, (..., P, n) -> (..., P), with what moves in this mode."""
        choice("StaF.gradient", "mode", mode, _MODES)
        trailing("StaF.gradient", "y", y, dims=2, last=self.basis.dim)
        if mode == "partial":
            return lambda step: self(y + step)
        if mode == "total_frozen_weights":
            return lambda step: self._frozen(y, step)
        chosen = self._target if target is None else target
        if chosen is None:
            raise ValueError(
                '`StaF.gradient(mode="total")` needs a target: pass `target=...` or call `fit_`.'
            )
        return lambda step: self._moving(y, step, chosen)

    def _frozen(self, y: Tensor, step: Tensor) -> Tensor:
        """V^(y + h; x + h) with w of x: (..., P, n), (..., P, n) -> (..., P)."""
        rule = self.basis.kernel.follow(y, step) if self.basis.centers.radius.constant else None
        if rule is not None:
            # In coefficients, which keep their digits where w is huge and cancels.
            log_factor, shift = rule
            values: Tensor = log_factor.exp() * self(y + shift)
            return values
        moved = self.state.unsqueeze(-2) + step
        sigma = self.basis((y + step).unsqueeze(-2), moved)
        total: Tensor = (sigma * self.weights.unsqueeze(-2).unsqueeze(-2)).sum(-1).squeeze(-1)
        return total

    def _moving(self, y: Tensor, step: Tensor, target: Target) -> Tensor:
        """V^(y + h; x + h) with the ideal weights of x + h: (..., P, n), (..., P, n) -> (..., P)."""
        moved = self.state.unsqueeze(-2) + step
        space = self.basis.local(moved)
        coefficients = space.fit(self.basis.values(moved, target))
        z = (y - self.state.unsqueeze(-2)).unsqueeze(-2)
        values: Tensor = space.evaluate(z, coefficients).squeeze(-1)
        return values


def _gradient(function: Callable[[Tensor], Tensor], at: Tensor) -> Tensor:
    """Row-wise gradient of (..., n) -> (...): (..., n)."""
    gradient: Tensor = torch.func.grad(lambda point: function(point).sum())(at)
    return gradient

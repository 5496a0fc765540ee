"""Interface of a local space, independent of the basis that represents it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import torch
from torch import Tensor

from ..kernels import Kernel
from ..numerics.checks import beside_batch, trailing
from ..numerics.derivatives import row_jacobian

_ROWS = 4096  # rows a block: the temporaries of one stay in the inner caches


class LocalSpace(Protocol):
    """span{k(., c_i(x))} at the states x, with coefficients beta in a basis that can be computed with.

    V^(x + z) = e^{s(x, z)} sum_j psi_j(z) beta_j, finite where the paper's weights w overflow.
    """

    @property
    def offsets(self) -> Tensor:
        """d, (..., M, n), or (M, n) for all states."""

    @property
    def rank(self) -> Tensor:
        """(...) or (): dimension of the span that is kept; below M the fit is a projection."""

    def fit(self, values: Tensor) -> Tensor:
        """The ideal coefficients from the values at the centers: (..., M) -> (..., M)."""

    def evaluate(self, z: Tensor, coefficients: Tensor) -> Tensor:
        """V^(x + z): (..., P, n), (..., M) -> (..., P)."""

    def evaluate_with_gradient(self, z: Tensor, coefficients: Tensor) -> tuple[Tensor, Tensor]:
        """V^(x + z) and its gradient in z: (..., P, n), (..., M) -> (..., P), (..., P, n)."""

    def scaled_weights(self, coefficients: Tensor) -> Tensor:
        """e^{g(x)} w, with w the paper's weights: (..., M) -> (..., M)."""

    def weights(self, coefficients: Tensor) -> Tensor:
        """The paper's w: (..., M) -> (..., M); NaN in a row where it cannot be represented."""

    def coefficients(self, weights: Tensor) -> Tensor:
        """beta from the paper's w: (..., M) -> (..., M)."""


def of_states(call: str, name: str, value: Tensor, state: Tensor, last: int, dims: int = 1) -> None:
    """Refuse what is not beside the states of a space.

    Args:
        call: the method, for the message, and so is ``name`` its argument.
        value: (..., last), of so many dimensions beside those of the states.
        state: x, (..., n).
        last: size of its last dimension.
        dims: of it that belong to no batch.

    Raises:
        ValueError: that names both sizes.
    """
    shape = value.shape
    if len(shape) < dims or shape[-1] != last:
        trailing(f"StaFBasis.local(x).{call}", name, value, dims, last)
    if shape[:-dims] != state.shape[:-1]:
        beside_batch(f"StaFBasis.local(x).{call}", name, value, dims, state.shape[:-1], "x is")


def at_points(call: str, z: Tensor, coefficients: Tensor, state: Tensor, count: int) -> None:
    """Refuse points z (..., P, n) and coefficients (..., M) that are not beside the states (..., n)."""
    of_states(call, "z", z, state, state.shape[-1], dims=2)
    of_states(call, "coefficients", coefficients, state, count)
    if z.shape[:-2] != coefficients.shape[:-1]:
        beside_batch(
            f"StaFBasis.local(x).{call}", "coefficients", coefficients, 1, z.shape[:-2], "z is for points of"
        )


def with_gradient(function: Callable[[Tensor], Tensor], z: Tensor) -> tuple[Tensor, Tensor]:
    """A function (..., P, n) -> (..., P) or (k, ..., P), and its gradient by autograd in a last dimension."""
    leading = z.dim() - 1

    def outputs_last(at: Tensor) -> Tensor:
        values = function(at)
        return values if values.dim() == leading else values.movedim(0, -1)

    values, gradient = row_jacobian(outputs_last, z)
    return (values, gradient) if values.dim() == leading else (values.movedim(-1, 0), gradient.movedim(-2, 0))


def rows_last(matrix: Tensor, rows: Tensor) -> Tensor:
    """rows matrix', (M, K), (..., K) -> (..., M), with the rows last in memory.

    What follows elementwise then runs along the many rows, and not along the few centers.
    """
    if rows.dim() <= 2:
        return (matrix @ rows.mT).mT if rows.dim() == 2 else matrix @ rows
    together: Tensor = (matrix @ rows.flatten(0, -2).mT).mT
    product: Tensor = together.unflatten(0, rows.shape[:-1])
    return product


def scale(kernel: Kernel, x: Tensor, z: Tensor, sign: float = 1.0) -> Tensor:
    """e^{sign s(x, z)}: (..., P), or () where s is zero."""
    s = kernel.log_scale(x, z)
    return z.new_ones(()) if s is None else (sign * s).exp()


def scaled_gradient(
    kernel: Kernel, x: Tensor, z: Tensor, sums: Tensor, slope: Tensor
) -> tuple[Tensor, Tensor]:
    """e^{s(z)} v(z) and its gradient from v (..., P) and its gradient (..., P, n)."""
    along = kernel.log_scale_gradient(x, z)
    if along is None:
        return sums, slope
    factor = scale(kernel, x, z)
    value = sums * factor
    return value, torch.addcmul(slope * factor.unsqueeze(-1), value.unsqueeze(-1), along)


def in_blocks(function: Callable[[Tensor, Tensor], Tensor], values: Tensor, state: Tensor) -> Tensor:
    """A function of rows (..., M) and (..., n), called with a few thousand rows at a time.

    Over a large batch its temporaries are otherwise written to memory and read again one by one, which
    takes longer than the arithmetic.
    """
    # Not torch.broadcast_shapes, whose first call imports sympy for half a second.
    shape = torch.broadcast_tensors(values[..., 0], state[..., 0])[0].shape
    if shape.numel() <= _ROWS:
        return function(values, state)
    rows = values.expand(*shape, -1).flatten(0, -2).split(_ROWS)
    states = state.expand(*shape, -1).flatten(0, -2).split(_ROWS)
    # Joined with the rows last, as the blocks are laid out: whole lines are copied.
    blocks = [function(*pair).mT for pair in zip(rows, states, strict=True)]
    together: Tensor = torch.cat(blocks, dim=-1).mT.unflatten(0, shape)
    return together


def from_scaled(kernel: Kernel, x: Tensor, scaled: Tensor) -> Tensor:
    """w = e^{-g(x)} (e^{g(x)} w), (..., M); NaN in a row in which w overflows or all of it underflows."""
    g = kernel.log_gain(x)
    if g is None:
        return torch.where(torch.isfinite(scaled), scaled, torch.nan)
    factor = (-g).exp().unsqueeze(-1)
    w = scaled * factor
    lost = (factor < torch.finfo(factor.dtype).tiny) & (scaled != 0).any(-1, keepdim=True)
    return torch.where(torch.isfinite(w) & ~lost, w, torch.nan)


def to_scaled(kernel: Kernel, x: Tensor, weights: Tensor) -> Tensor:
    """e^{g(x)} w: (..., M), zero for a zero weight at any state."""
    g = kernel.log_gain(x)
    return weights if g is None else torch.where(weights == 0, 0.0, weights * g.exp().unsqueeze(-1))


def evaluate_scaled(kernel: Kernel, offsets: Tensor, x: Tensor, z: Tensor, b: Tensor) -> Tensor:
    """V^(x + z) = e^{s(x, z)} sum_i b_i k0(z, d_i).

    Args:
        kernel: the kernel.
        offsets: d, (..., M, n).
        x: states, (..., n).
        z: offsets of the points, (..., P, n).
        b: e^{g + s(d)} w, (..., M).

    Returns:
        (..., P).
    """
    sums = (kernel.core(x, z, offsets) @ b.unsqueeze(-1)).squeeze(-1)
    return sums * scale(kernel, x, z)

"""Derivatives of the ideal weights in centers and state: implicit differentiation of K(c) W = V(c)."""

from __future__ import annotations

import torch
from torch import Tensor

from ..lanes.gradients import grad
from ..numerics.checks import trailing
from ..numerics.derivatives import row_jacobian
from .basis import StaFBasis, Target


def weight_jacobian(basis: StaFBasis, x: Tensor, target: Target) -> Tensor:
    """dW_k / dc_{i,l} of the ideal weights at the states x, each center moved by itself.

    With d_{1,l} k the derivative in the l-th entry of the first argument, for every i and l

        K dW = e_i (d_l V(c_i) - sum_j d_{1,l} k(c_i, c_j) W_j) - d_{1,l} k(c_i, .) W_i,

    all right-hand sides solved at once in the local space. The kernel must be differentiable away from the
    diagonal; on it k(c_i, c_i) moves as a whole.

    Args:
        basis: kernel and centers.
        x: states, (..., n).
        target: V, differentiable.

    Returns:
        (..., M, M, n), indexed k, i, l. A row in which the weights cannot be represented is NaN. W grows like
        a power of 1 / r, and the digits that its cancellation costs are lost here too.

    Raises:
        ValueError: if x is not (..., n), or the target returns another shape.

    Source: Rosenfeld et al., section 5, by the implicit function theorem.
    """
    trailing("weight_jacobian", "x", x, dims=1, last=basis.dim)
    return _solve(basis, x, _sources(basis, x, target))


def state_jacobian(basis: StaFBasis, x: Tensor, target: Target) -> Tensor:
    """dW_k / dx_p = sum_{i,l} dW_k / dc_{i,l} dc_{i,l} / dx_p, dc_i / dx = I + u_i grad nu(x)'.

    The right-hand sides of `weight_jacobian` are summed before they are solved: n solves instead of M n.

    Args:
        basis: kernel and centers, at a constant or a moving radius.
        x: states, (..., n).
        target: V, differentiable.

    Returns:
        (..., M, n). A row in which the weights cannot be represented is NaN.

    Raises:
        ValueError: if x is not (..., n), or the target returns another shape.
    """
    trailing("state_jacobian", "x", x, dims=1, last=basis.dim)
    sources = _sources(basis, x, target)
    slope = grad(lambda at: basis.centers.radius(at).sum())(x)  # grad nu, (..., n)
    outward = (sources * basis.centers.directions.to(x)).sum((-1, -2))  # along u_i, (..., M)
    moved = sources.sum(-2) + outward.unsqueeze(-1) * slope.unsqueeze(-2)
    return _solve(basis, x, moved.unsqueeze(-2)).squeeze(-2)


def _sources(basis: StaFBasis, x: Tensor, target: Target) -> Tensor:
    """dV - dK W for every movement of a center: (..., M, M, n), the row of K first."""
    centers = basis.centers(x)
    weights = basis.ideal_weights(x, target)
    slopes = row_jacobian(lambda at: basis.kernel(at, centers), centers)[
        1
    ]  # d_{1,l} k(c_i, c_j), (..., i, j, l)
    direct = grad(lambda at: target(at).sum())(centers)
    own = direct - (slopes * weights[..., None, :, None]).sum(-2)  # (..., i, l)
    identity = torch.eye(basis.count, dtype=x.dtype, device=x.device).unsqueeze(-1)
    sources: Tensor = identity * own.unsqueeze(-3) - (slopes * weights[..., None, None]).transpose(-3, -2)
    return sources


def _solve(basis: StaFBasis, x: Tensor, sources: Tensor) -> Tensor:
    """K^-1 applied to the third dimension from the right: (..., M, I, n) -> (..., M, I, n)."""
    space = basis.local(x)
    # The sides in front: there they broadcast against whatever has the dimensions of the states.
    sides = sources.flatten(-2).movedim(-1, 0)
    solved: Tensor = space.weights(space.fit(sides)).movedim(0, -1).unflatten(-1, sources.shape[-2:])
    return solved

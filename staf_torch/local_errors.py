"""How far a local approximation is from V on its ball: suprema and gradients, in bulk over states."""

from __future__ import annotations

import torch
from torch import Tensor

from .basis import StaFBasis, Target
from .centers import probe_points
from .local import evaluate_scaled

PROBES = 97  # points of the ball to take a supremum over; in the plane 64 of them on its edge
_BLOCK = 2**18  # numbers in a temporary of `ball_error`, so that it stays in cache


def ball_error(basis: StaFBasis, target: Target, x: Tensor, coefficients: Tensor) -> Tensor:
    """sup |V - V^| over a fixed set of points of the closed ball of radius nu(x) around x.

    Args:
        x: states, (..., T, n).
        coefficients: b of `ChaseResult.coefficients`, (..., T, M).

    Returns:
        (..., T).
    """
    probes = probe_points(PROBES, basis.dim).to(x)
    times = max(1, _BLOCK // (PROBES * max(1, x.numel() // x.shape[-2])))
    blocks = zip(x.split(times, dim=-2), coefficients.split(times, dim=-2), strict=True)
    return torch.cat([_ball_error(basis, target, probes, *block) for block in blocks], dim=-1)


def _ball_error(basis: StaFBasis, target: Target, probes: Tensor, x: Tensor, b: Tensor) -> Tensor:
    nu, offsets = basis.centers.radius(x)[..., None, None], basis.centers.offsets(x)
    worst = x.new_zeros(x.shape[:-1])
    for some in probes.split(64):
        z = nu * some
        estimate = evaluate_scaled(basis.kernel, offsets, x, z, b)
        error = (target(x.unsqueeze(-2) + z) - estimate).abs().amax(-1)
        worst = torch.maximum(worst, error)
    return worst


def gradient_error(basis: StaFBasis, target: Target, x: Tensor, coefficients: Tensor) -> Tensor:
    """|grad V - grad V^| at the state, with the centers frozen: (..., n), (..., M) -> (...)."""
    offsets = basis.centers.offsets(x)

    def estimate(z: Tensor) -> Tensor:
        return evaluate_scaled(basis.kernel, offsets, x, z.unsqueeze(-2), coefficients)

    approximate, exact = _gradient(estimate, torch.zeros_like(x)), _gradient(target, x.detach())
    error: Tensor = (exact - approximate).norm(dim=-1)
    return error


def _gradient(function: Target, at: Tensor) -> Tensor:
    """grad f, row by row: (..., n). Not by torch.func, whose first use imports the compiler for a second."""
    with torch.enable_grad():
        at = at.clone().requires_grad_()
        values = function(at)
        if not values.requires_grad:  # a constant
            return torch.zeros_like(at).detach()
        (gradient,) = torch.autograd.grad(values.sum(), at)
    return gradient

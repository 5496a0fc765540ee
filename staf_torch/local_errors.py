"""How far a local approximation is from V on its ball: suprema and gradients, in bulk over states."""

from __future__ import annotations

import torch
from torch import Tensor

from .basis import StaFBasis, Target
from .centers import probe_points
from .local import evaluate_scaled, scale

_PROBES = 97  # points of the ball to take a supremum over; in the plane 64 of them on its edge
_BLOCK = 2**18  # numbers in a temporary of `ball_error`, so that it stays in cache


def ball_error(basis: StaFBasis, target: Target, x: Tensor, coefficients: Tensor) -> Tensor:
    """sup |V - V^| over a fixed set of points of the closed ball of radius nu(x) around x.

    Args:
        x: states, (..., T, n).
        coefficients: b of `ChaseResult.coefficients`, (..., T, M).

    Returns:
        (..., T).
    """
    probes = probe_points(_PROBES, basis.dim).to(x)
    times = max(1, _BLOCK // (_PROBES * max(1, x.numel() // x.shape[-2])))
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


def ball_floor_error(basis: StaFBasis, target: Target, x: Tensor) -> Tensor:
    """`ball_error` with the ideal weights, in the local basis: without the rounding of large weights.

    Args:
        x: states, (..., T, n).

    Returns:
        (..., T).
    """
    return BallFloor(basis, target)(x)


class BallFloor:
    """`ball_floor_error` of consecutive pieces (B, T, n) of the same rows; what they share is set up once."""

    def __init__(self, basis: StaFBasis, target: Target) -> None:
        self._basis, self._target = basis, target
        self._begun = False
        self._shared: Tensor | None = None

    def __call__(self, x: Tensor) -> Tensor:
        basis, probes = self._basis, probe_points(_PROBES, self._basis.dim).to(x)
        if not self._begun:
            self._begun, self._shared = True, _shared_functions(basis, x, probes)
        row = _PROBES * (1 if self._shared is not None else basis.count)  # numbers in a temporary of `_floor`
        times = max(1, _BLOCK // (row * max(1, x.numel() // x.shape[-1] // x.shape[-2])))
        blocks = x.split(times, dim=-2)
        return torch.cat([_floor(basis, self._target, probes, self._shared, some) for some in blocks], dim=-1)


def _shared_functions(basis: StaFBasis, x: Tensor, probes: Tensor) -> Tensor | None:
    """psi at the probes of the ball where radius and core do not depend on the state, else None: (M, P), or
    (..., M, P) where each row has its own. One product then evaluates all states of a row."""
    origin = torch.zeros_like(x[..., :1, :]).expand(*x.shape[:-2], 2, -1)
    offsets, core = basis.centers.offsets(origin), basis.gram_structure(origin).core
    if any(part.dim() > 2 and part.shape[-3] > 1 for part in (offsets, core)):
        return None
    origin = origin[..., :1, :] if offsets.dim() > 2 or core.dim() > 2 else origin.new_zeros(1, basis.dim)
    space, z = basis.local(origin), basis.centers.radius(origin)[..., None, None] * probes
    ones = torch.eye(basis.count, dtype=x.dtype, device=x.device)
    gain = scale(basis.kernel, origin, z)
    found = [space.evaluate(z, one.expand(*origin.shape[:-1], -1)) / gain for one in ones]
    return torch.stack(found, dim=-2).squeeze(-3)


def _floor(basis: StaFBasis, target: Target, probes: Tensor, shared: Tensor | None, x: Tensor) -> Tensor:
    z = basis.centers.radius(x)[..., None, None] * probes
    space = basis.local(x)
    fitted = space.fit(basis.values(x, target))
    estimate = space.evaluate(z, fitted) if shared is None else fitted @ shared * scale(basis.kernel, x, z)
    worst: Tensor = (target(x.unsqueeze(-2) + z) - estimate).abs().amax(-1)
    return worst


def gradient_error(basis: StaFBasis, target: Target, x: Tensor, coefficients: Tensor) -> Tensor:
    """|grad V - grad V^| at the state, with the centers frozen: (..., n), (..., M) -> (...)."""
    offsets = basis.centers.offsets(x)

    def estimate(z: Tensor) -> Tensor:
        return evaluate_scaled(basis.kernel, offsets, x, z.unsqueeze(-2), coefficients).sum()

    approximate = torch.func.grad(estimate)(torch.zeros_like(x))
    exact = torch.func.grad(lambda at: target(at).sum())(x)
    error: Tensor = (exact - approximate).norm(dim=-1)
    return error

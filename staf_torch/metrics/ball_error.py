"""How far a local approximation is from V on its ball, and the error that the ideal weights leave there."""

from __future__ import annotations

import torch
from torch import Tensor

from ..approximation.basis import StaFBasis, Target
from ..centers import probe_points
from ..local_basis import NewtonSpace, evaluate_scaled, scale

PROBES = 97  # points of the ball to take a supremum over; in the plane 64 of them on its edge
_BLOCK = 2**18  # numbers in a temporary, so that it stays in cache


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


class BallFloor:
    """max over the closed ball of radius nu(x) of |V - V^| with the ideal weights, in the local basis.

    The best that kernel, radius and layout allow, without the rounding of large weights. Called with
    consecutive pieces of the same rows; what they share is set up once.

    Args:
        basis: of V^.
        target: V.
        points: of the ball over which the maximum is taken, at least 2.
    """

    def __init__(self, basis: StaFBasis, target: Target, points: int) -> None:
        self._basis, self._target, self._points = basis, target, points
        self._begun = False
        self._shared: Tensor | None = None

    def __call__(self, x: Tensor) -> Tensor:
        """At the states (..., T, n): (..., T)."""
        basis, probes = self._basis, probe_points(self._points, self._basis.dim).to(x)
        if not self._begun:
            self._begun, self._shared = True, _shared_functions(basis, x, probes)
        row = self._points * (1 if self._shared is not None else basis.count)  # numbers in a temporary
        times = max(1, _BLOCK // (row * max(1, x.numel() // x.shape[-1] // x.shape[-2])))
        blocks = x.split(times, dim=-2)
        return torch.cat([_floor(basis, self._target, probes, self._shared, some) for some in blocks], dim=-1)


def _shared_functions(basis: StaFBasis, x: Tensor, probes: Tensor) -> Tensor | None:
    """psi at the probes of the ball where radius and core do not depend on the state, else None: (M, P), or
    (..., M, P) where each row has its own. One product then evaluates all states of a row.

    None for a Newton space too: its coefficients are nodal values, and cardinal functions, one by one, lose
    the digits that a smooth V keeps.
    """
    if isinstance(basis.local(x[..., :1, :]), NewtonSpace):
        return None
    origin = torch.zeros_like(x[..., :1, :]).expand(*x.shape[:-2], 2, -1)
    offsets, core = basis.centers.offsets(origin), basis.gram_structure(origin).core
    if any(part.dim() > 2 and part.shape[-3] > 1 for part in (offsets, core)):
        return None
    origin = origin[..., :1, :] if offsets.dim() > 2 or core.dim() > 2 else origin.new_zeros(1, basis.dim)
    space, z = basis.local(origin), basis.centers.radius(origin)[..., None, None] * probes
    ones = torch.eye(basis.count, dtype=x.dtype, device=x.device)
    gain = scale(basis.kernel, origin, z)
    values = [space.evaluate(z, one.expand(*origin.shape[:-1], -1)) / gain for one in ones]
    return torch.stack(values, dim=-2).squeeze(-3)


def _floor(basis: StaFBasis, target: Target, probes: Tensor, shared: Tensor | None, x: Tensor) -> Tensor:
    z = basis.centers.radius(x)[..., None, None] * probes
    space = basis.local(x)
    fitted = space.fit(basis.values(x, target))
    estimate = space.evaluate(z, fitted) if shared is None else fitted @ shared * scale(basis.kernel, x, z)
    worst: Tensor = (target(x.unsqueeze(-2) + z) - estimate).abs().amax(-1)
    return worst

"""Attainable accuracy of an approximation at a state, and its conditioning."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ..centers import probe_points
from ..numerics.checks import integer
from ..numerics.linalg import condition_number, pivoted_cholesky
from .basis import StaFBasis, Target


class Conditioning(NamedTuple):
    """Conditioning of the Gram matrix that plain linear algebra would invert at the states x."""

    core_condition: Tensor  # kappa(K0), () or (...): the state-free part
    condition: Tensor  # kappa(K(c(x))), (...)
    effective_rank: Tensor  # int64, () or (...): pivots of K0 above rounding; M means Cholesky still works
    rank: Tensor  # int64, () or (...): of the local basis that the library uses


def conditioning(basis: StaFBasis, x: Tensor) -> Conditioning:
    """Condition numbers and ranks at the states x (..., n).

    Condition numbers beyond 1 / eps are inf or rounding error.
    """
    structure = basis.gram_structure(x)
    return Conditioning(
        condition_number(structure.core),
        condition_number(structure.scaled()).expand(x.shape[:-1]),
        pivoted_cholesky(structure.core).rank,
        basis.local(x).rank,
    )


def cardinal_functions(basis: StaFBasis, x: Tensor, z: Tensor) -> Tensor:
    """l_i(z) with V^(x + z) = sum_i l_i(z) V(c_i): (..., n), (..., P, n) -> (..., P, M)."""
    space = basis.local(x)
    identity = torch.eye(basis.count, dtype=x.dtype, device=x.device)
    fits = [space.fit(row.expand(*x.shape[:-1], basis.count)) for row in identity.unbind(0)]
    return torch.stack([space.evaluate(z, fit) for fit in fits], dim=-1)


def lebesgue_constant(basis: StaFBasis, x: Tensor, points: int = 500) -> Tensor:
    """max over the closed ball of radius nu(x) of sum_i |l_i|: (..., n) -> (...).

    The factor by which errors of the samples V(c_i), rounding included, can grow in V^.

    Raises:
        ValueError: if ``points`` is not an integer of at least 2.
    """
    z = _ball(basis, x, integer("lebesgue_constant", "points", points, least=2))
    return cardinal_functions(basis, x, z).abs().sum(-1).amax(-1)


def sup_error(basis: StaFBasis, x: Tensor, target: Target, points: int = 500) -> Tensor:
    """max over the closed ball of radius nu(x) of |V - V^| with the ideal weights: (..., n) -> (...).

    Over ``points`` fixed points of the ball, the state and its boundary among them.

    Raises:
        ValueError: if ``points`` is not an integer of at least 2, or the target returns another shape.
    """
    z = _ball(basis, x, integer("sup_error", "points", points, least=2))
    space = basis.local(x)
    estimate = space.evaluate(z, space.fit(basis.values(x, target)))
    return (target(x.unsqueeze(-2) + z) - estimate).abs().amax(-1)


def _ball(basis: StaFBasis, x: Tensor, points: int) -> Tensor:
    """Points of the ball as offsets: (..., P, n), or (P, n) for all states."""
    offsets: Tensor = basis.centers.radius(x)[..., None, None] * probe_points(points, basis.dim).to(x)
    return offsets

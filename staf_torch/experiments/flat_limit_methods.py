"""The ways to solve for the interpolant that `flat_limit` compares."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from ..basis import StaFBasis, Target
from ..local import evaluate_scaled, newton_space

JITTER = 1e-12
Method = Callable[[StaFBasis, Target, Tensor, Tensor], Tensor]
"""Basis, V, x (n,), offsets z (P, n) to V^(x + z) (P,): not finite where the method fails."""


def cholesky(basis: StaFBasis, target: Target, x: Tensor, z: Tensor, jitter: float = 0.0) -> Tensor:
    """K0 + jitter I = L L' and two triangular solves."""
    structure = basis.gram_structure(x)
    scale = torch.ones(()).to(x) if structure.scale is None else structure.scale
    identity = torch.eye(basis.count, dtype=x.dtype)
    factor, info = torch.linalg.cholesky_ex(structure.core + jitter * identity)
    right = basis.values(x, target) / scale
    b = torch.cholesky_solve(right.unsqueeze(-1), factor).squeeze(-1)
    value = evaluate_scaled(basis.kernel, basis.centers.offsets(x), x, z, b)
    return torch.where(info == 0, value, torch.nan)


def jittered(basis: StaFBasis, target: Target, x: Tensor, z: Tensor) -> Tensor:
    """The usual remedy: the diagonal of K0 raised by 1e-12."""
    return cholesky(basis, target, x, z, JITTER)


def pivoted(basis: StaFBasis, target: Target, x: Tensor, z: Tensor) -> Tensor:
    """The library's Newton basis, cut off at the numerical rank of K0."""
    space = newton_space(basis.kernel, x, basis.centers.offsets(x))
    return space.evaluate(z, space.fit(basis.values(x, target)))


def graded(basis: StaFBasis, target: Target, x: Tensor, z: Tensor) -> Tensor:
    """What the library uses for these kernels."""
    space = basis.local(x)
    return space.evaluate(z, space.fit(basis.values(x, target)))


METHODS: dict[str, Method] = {
    "cholesky": cholesky,
    "jitter": jittered,
    "pivoted": pivoted,
    "graded": graded,
}
LABELS = {
    "cholesky": "Cholesky",
    "jitter": "Cholesky, jitter 1e-12",
    "pivoted": "pivoted Cholesky",
    "graded": "graded basis",
}

"""Batched small symmetric linear algebra. Each matrix of a batch is treated alone; none can raise
for the others: what cannot be computed is NaN, or a rank below the size, in its own row."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class PivotedCholesky(NamedTuple):
    """P K P' = L L' with the largest remaining diagonal entry first, cut off at the rank."""

    factor: Tensor  # (..., M, M) lower triangular L in pivoted order; identity beyond the rank
    order: Tensor  # (..., M) int64: row k of L belongs to row order[k] of K
    rank: Tensor  # (...) int64: pivots above the tolerance

    @property
    def kept(self) -> Tensor:
        """(..., M) bool in pivoted order: whether the pivot was above the tolerance."""
        size = self.factor.shape[-1]
        return torch.arange(size, device=self.rank.device) < self.rank.unsqueeze(-1)

    def solve_lower(self, values: Tensor) -> Tensor:
        """L^-1 P v, zero beyond the rank: (..., M) -> (..., M)."""
        shape = torch.broadcast_tensors(self.order, values)[0].shape
        permuted = values.expand(shape).gather(-1, self.order.expand(shape))
        solved = torch.linalg.solve_triangular(self.factor, permuted.unsqueeze(-1), upper=False)
        return torch.where(self.kept, solved.squeeze(-1), 0.0)

    def solve_upper(self, coefficients: Tensor) -> Tensor:
        """P' L^-T beta, with beta zero beyond the rank: (..., M) -> (..., M)."""
        solved = torch.linalg.solve_triangular(
            self.factor.mT, torch.where(self.kept, coefficients, 0.0).unsqueeze(-1), upper=True
        ).squeeze(-1)
        solved = torch.where(self.kept, solved, 0.0)
        order = self.order.expand(solved.shape)
        return torch.zeros_like(solved).scatter(-1, order, solved)


def pivoted_cholesky(gram: Tensor) -> PivotedCholesky:
    """Factor K (..., M, M), symmetric positive semidefinite, stopping at its numerical rank.

    A pivot is dropped when it is at most M eps times the largest diagonal entry: below that it is
    rounding error. No jitter is added. A matrix with a non-finite entry has rank 0.
    """
    size = gram.shape[-1]
    scale = gram.diagonal(dim1=-2, dim2=-1).amax(-1)
    tolerance = size * torch.finfo(gram.dtype).eps * scale
    rest = gram
    open_ = torch.ones(gram.shape[:-1], dtype=torch.bool, device=gram.device)
    alive = torch.isfinite(gram).all(-1).all(-1)
    columns, order, rank = [], [], torch.zeros_like(scale, dtype=torch.int64)
    for _ in range(size):
        diagonal = rest.diagonal(dim1=-2, dim2=-1)
        pivot = torch.where(open_, diagonal, -torch.inf).argmax(-1, keepdim=True)  # (..., 1)
        value = diagonal.gather(-1, pivot).squeeze(-1)
        alive = alive & (value > tolerance)
        column = rest.gather(-1, pivot.unsqueeze(-2).expand(*rest.shape[:-1], 1)).squeeze(-1)
        root = torch.where(alive, value, 1.0).sqrt().unsqueeze(-1)
        column = torch.where(alive.unsqueeze(-1) & open_, column / root, 0.0)
        rest = rest - column.unsqueeze(-1) * column.unsqueeze(-2)
        open_ = open_.scatter(-1, pivot, False)
        columns.append(column)
        order.append(pivot)
        rank = rank + alive
    order_ = torch.cat(order, dim=-1)
    unpivoted = torch.stack(columns, dim=-1)
    factor = unpivoted.gather(-2, order_.unsqueeze(-1).expand(unpivoted.shape))
    dropped = torch.arange(size, device=gram.device) >= rank.unsqueeze(-1)
    return PivotedCholesky(factor + torch.diag_embed(dropped.to(factor)), order_, rank)


def condition_number(gram: Tensor) -> Tensor:
    """lambda_max / lambda_min of K (..., M, M) -> (...): inf where not definite, NaN where not finite.

    Meaningful up to 1 / eps; beyond that it is inf or rounding error.
    """
    finite = torch.isfinite(gram).all(-1).all(-1)
    identity = torch.eye(gram.shape[-1], dtype=gram.dtype, device=gram.device)
    values = torch.linalg.eigvalsh(torch.where(finite[..., None, None], gram, identity))
    low, high = values[..., 0], values[..., -1]
    ratio = torch.where(low > 0, high / low, torch.inf)
    return torch.where(finite, ratio, torch.nan)

"""Semidefinite matrices factored with pivots, each treated alone, the passes a loop of a compiled program."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ..lanes import scan

_Elimination = tuple[Tensor, Tensor, Tensor, Tensor]
_IN_REGISTERS = 8  # rows of a matrix that a compiled program writes out entry by entry


class PivotedCholesky(NamedTuple):
    """P K P' = L L' with the largest remaining diagonal entry first, cut off at the rank."""

    factor: Tensor  # (..., M, M) lower triangular L in pivoted order; identity beyond the rank
    order: Tensor  # (..., M) int64: row k of L belongs to row order[k] of K
    rank: Tensor  # (...) int64: pivots above the tolerance

    def kept(self) -> Tensor:
        """(..., M) bool in pivoted order: whether the pivot was above the tolerance."""
        size = self.factor.shape[-1]
        return torch.arange(size, device=self.rank.device) < self.rank.unsqueeze(-1)

    def solve_lower(self, values: Tensor) -> Tensor:
        """L^-1 P v, zero beyond the rank: (..., M) -> (..., M)."""
        shape = torch.broadcast_tensors(self.order, values)[0].shape
        permuted = values.expand(shape).gather(-1, self.order.expand(shape))
        solved = torch.linalg.solve_triangular(self.factor, permuted.unsqueeze(-1), upper=False)
        return torch.where(self.kept(), solved.squeeze(-1), 0.0)

    def solve_upper(self, coefficients: Tensor) -> Tensor:
        """P' L^-T beta, with beta zero beyond the rank: (..., M) -> (..., M)."""
        solved = torch.linalg.solve_triangular(
            self.factor.mT, torch.where(self.kept(), coefficients, 0.0).unsqueeze(-1), upper=True
        ).squeeze(-1)
        solved = torch.where(self.kept(), solved, 0.0)
        order = self.order.expand(solved.shape)
        return torch.zeros_like(solved).scatter(-1, order, solved)


def pivoted_cholesky(gram: Tensor) -> PivotedCholesky:
    """Factor K (..., M, M), symmetric positive semidefinite, stopping at its numerical rank.

    A pivot is dropped when it is at most M eps times the largest diagonal entry: below that it is
    rounding error. No jitter is added. A matrix with a non-finite entry has rank 0.
    """
    size = gram.shape[-1]
    if torch.compiler.is_compiling() and gram.requires_grad:
        # I^-1 K is K, by a call that inductor fuses with nothing. Fused with what makes K, torch 2.13
        # differentiates the elimination wrongly: AnchoredKernel, M = 3, learned directions and width, errors
        # of 2 to 12 times the gradient.
        identity = torch.eye(size, dtype=gram.dtype, device=gram.device)
        gram = torch.linalg.solve_triangular(identity, gram, upper=False)
    scale = gram.diagonal(dim1=-2, dim2=-1).amax(-1)
    tolerance = size * torch.finfo(gram.dtype).eps * scale
    places = torch.arange(size, device=gram.device)

    def eliminate(carry: _Elimination, _: Tensor) -> tuple[_Elimination, tuple[Tensor, Tensor]]:
        rest, open_, alive, rank = carry
        diagonal = rest.diagonal(dim1=-2, dim2=-1)
        pivot = torch.where(open_, diagonal, -torch.inf).argmax(-1, keepdim=True)  # (..., 1)
        value = diagonal.gather(-1, pivot).squeeze(-1)
        alive = alive & (value > tolerance)
        column = rest.gather(-1, pivot.unsqueeze(-2).expand(*rest.shape[:-1], 1)).squeeze(-1)
        root = torch.where(alive, value, 1.0).sqrt().unsqueeze(-1)
        column = torch.where(alive.unsqueeze(-1) & open_, column / root, 0.0)
        rest = rest - column.unsqueeze(-1) * column.unsqueeze(-2)
        return (rest, open_.scatter(-1, pivot, False), alive, rank + alive), (column, pivot.squeeze(-1))

    open_ = torch.ones(gram.shape[:-1], dtype=torch.bool, device=gram.device)
    alive = torch.isfinite(gram).all(-1).all(-1)
    start = gram, open_, alive, torch.zeros_like(scale, dtype=torch.int64)
    (_, _, _, rank), (columns, pivots) = scan(eliminate, start, places, dim=0, unrolled=size <= _IN_REGISTERS)
    unpivoted, order = columns.movedim(0, -1), pivots.movedim(0, -1)
    factor = unpivoted.gather(-2, order.unsqueeze(-1).expand(unpivoted.shape))
    dropped = places >= rank.unsqueeze(-1)
    return PivotedCholesky(factor + torch.diag_embed(dropped.to(factor)), order, rank)


def newton_basis(gram: Tensor) -> Tensor:
    """C = P'L^-T of K0 (..., M, M), with zero columns beyond the rank: (..., M, M)."""
    factor = pivoted_cholesky(gram)
    units = torch.eye(gram.shape[-1], dtype=gram.dtype, device=gram.device)
    columns = [factor.solve_upper(unit.expand(factor.order.shape)) for unit in units]
    return torch.stack(columns, dim=-1)

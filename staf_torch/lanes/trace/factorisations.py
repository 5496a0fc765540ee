"""Dense factorisations of small matrices in plain torch operations that have a scalar form: (..., M, M).

LAPACK exchanges rows where a pivot asks for it. Rows in lanes have pivots of their own, so nothing may
branch on one: a row is chosen by comparing and selecting, and places are compared in place of exchanged. Up
to `LARGE` entries an elimination is written out and lives in registers; above, Cholesky's and the one under
a triangle are an operation of a program, in place. Others are loops, in which a matrix moves on
by a column after each pass, so that the text knows the first pivot alone. Eliminations by columns: Golub and
Van Loan, Matrix Computations, ch. 3 to 5.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.utils._python_dispatch import _disable_current_modes

from .graph import REAL, WIDE
from .loops import repeat, tracer_of
from .tracer import LARGE, Tracer

_WRITTEN = 12  # rows at most of matrices in batches whose factors are written out


def in_memory(matrix: Tensor) -> bool:
    """Return whether a matrix stays in memory."""
    return matrix.shape[-1] * matrix.shape[-2] > LARGE


def _is_long(matrix: Tensor) -> bool:
    """Return whether a factorisation of a batch is a loop: written out, it takes a compiler too long."""
    return in_memory(matrix) and matrix.shape[-1] > _WRITTEN


def cholesky(gram: Tensor, *, upper: bool = False, check_errors: bool = False) -> tuple[Tensor, Tensor]:
    """L with L L' = K, and 0 or, where a pivot is not positive, its place: (...)."""
    where = _of_one(gram) if in_memory(gram) else None
    if where is not None:
        factor, failed = _cholesky_in_place(gram, *where)
    else:
        factor, failed = (_rolled_cholesky if _is_long(gram) else _cholesky_by_columns)(gram)
    return factor.mT.clone() if upper else factor, failed.to(torch.int32)


def _cholesky_by_columns(gram: Tensor) -> tuple[Tensor, Tensor]:
    rest, columns = gram, []
    failed = torch.zeros_like(gram[..., 0, 0], dtype=torch.int32)
    for k in range(gram.shape[-1]):
        pivot = rest[..., k, k]
        failed = torch.where((failed == 0) & ~(pivot > 0), k + 1, failed)
        below = rest[..., k:, k] / pivot.sqrt().unsqueeze(-1)
        column = torch.cat((torch.zeros_like(gram[..., :k, k]), below), dim=-1)
        columns.append(column)
        rest = rest - column.unsqueeze(-1) * column.unsqueeze(-2)
    return torch.stack(columns, dim=-1), failed


def _cholesky_in_place(gram: Tensor, tracer: Tracer, kind: str) -> tuple[Tensor, Tensor]:
    with _disable_current_modes():
        factor, failed = torch.linalg.cholesky_ex(gram.detach())
    found = tracer.on_matrix("cholesky", tracer.nodes(gram, kind).reshape(gram.shape[-2:]), kind)
    tracer.attach(factor, found[:-1].reshape(factor.shape))
    return factor, tracer.attach(torch.empty_like(factor[..., 0, 0]), found[-1].reshape(failed.shape))


def triangular(
    matrix: Tensor, right: Tensor, *, upper: bool, left: bool = True, unitriangular: bool = False
) -> Tensor:
    """T^-1 B: (..., M, M), (..., M, P); B T^-1 where not ``left``."""
    if not left:
        return triangular(matrix.mT, right.mT, upper=not upper, unitriangular=unitriangular).mT.clone()
    where = _of_one(matrix, right) if in_memory(matrix) else None
    if where is not None or _is_long(matrix):
        if upper:  # an upper triangle from behind is a lower one
            matrix, right = matrix.flip(-1, -2), right.flip(-2)
        if where is not None:
            solution = _triangular_in_place(matrix, right, unitriangular, *where)
        else:
            solution = _rolled_triangular(matrix, right, unitriangular)
        return solution.flip(-2) if upper else solution
    size = matrix.shape[-1]
    found: dict[int, Tensor] = {}
    for i in reversed(range(size)) if upper else range(size):
        row = right[..., i, :]
        for j, known in found.items():
            row = row - matrix[..., i, j, None] * known
        found[i] = row if unitriangular else row / matrix[..., i, i, None]
    return torch.stack([found[i] for i in range(size)], dim=-2)


def _triangular_in_place(lower: Tensor, right: Tensor, unit: bool, tracer: Tracer, kind: str) -> Tensor:
    with _disable_current_modes():
        given = lower.detach(), right.detach()
        known = torch.linalg.solve_triangular(*given, upper=False, unitriangular=unit).contiguous()
    sides = [tracer.nodes(part, kind).reshape(part.shape[-2:]) for part in (lower, right)]
    rows = np.concatenate(sides, axis=1)
    found = tracer.on_matrix("substitute_unit" if unit else "substitute", rows, kind)
    return tracer.attach(known, found.reshape(rows.shape)[:, len(rows) :].reshape(known.shape))


def cholesky_solve(right: Tensor, factor: Tensor, upper: bool = False) -> Tensor:
    """K^-1 B from a factor of K."""
    lower = factor.mT if upper else factor
    return triangular(lower.mT, triangular(lower, right, upper=False), upper=True)


def inverse(matrix: Tensor, *, check_errors: bool = False) -> tuple[Tensor, Tensor]:
    """A^-1, by elimination with pivots of the largest size in a column, and 0: (...)."""
    size = matrix.shape[-1]
    identity = torch.eye(size, dtype=matrix.dtype, device=matrix.device).expand_as(matrix)
    if in_memory(matrix):
        return solve(matrix, identity)[0], torch.zeros_like(matrix[..., 0, 0], dtype=torch.int32)
    whole = torch.cat((matrix, identity), dim=-1)
    for k in range(size):
        best, chosen = whole[..., k, :], whole[..., k, k].abs()
        others = []
        for i in range(k + 1, size):
            row = whole[..., i, :]
            larger = (row[..., k].abs() > chosen).unsqueeze(-1)
            chosen = torch.where(larger.squeeze(-1), row[..., k].abs(), chosen)
            best, row = torch.where(larger, row, best), torch.where(larger, best, row)
            others.append(row)
        best = best / best[..., k, None]
        above = [whole[..., i, :] for i in range(k)]
        cleared = [row - row[..., k, None] * best for row in (*above, *others)]
        whole = torch.stack([*cleared[:k], best, *cleared[k:]], dim=-2)
    failed = torch.zeros_like(matrix[..., 0, 0], dtype=torch.int32)
    return whole[..., size:].clone(), failed


def solve_definite(matrix: Tensor, right: Tensor) -> Tensor:
    """M^-1 b for M positive definite, read below its diagonal alone: (..., M, M), (..., M) -> (..., M).

    Row by row: what `lower` meets are short vectors, so that no number goes through memory, and a third of
    the operations of an elimination of the whole matrix are left.
    """
    rows = [matrix[..., i, : i + 1] for i in range(right.shape[-1])]
    found = list[tuple[Tensor, Tensor]]()  # y_k and l_k in x_k = y_k - l_k'(x_k+1, ...)
    while len(rows) > 1:
        column = torch.cat([row[..., :1] for row in rows[1:]], dim=-1)
        factor, y = column / rows[0], right[..., :1] / rows[0]
        found.append((y, factor))
        right = right[..., 1:] - column * y
        rows = [row[..., 1:] - factor[..., i, None] * column[..., : i + 1] for i, row in enumerate(rows[1:])]
    x = right / rows[0]
    for y, factor in reversed(found):
        x = torch.cat((y - (factor * x).sum(-1, keepdim=True), x), dim=-1)
    return x


def solve(
    matrix: Tensor, right: Tensor, *, left: bool = True, check_errors: bool = False
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """A^-1 B, by elimination with pivots of the largest size in a column: (..., M, M), (..., M, P).

    B A^-1 where not ``left``, (..., P, M). In the place of the factor and the pivots that torch returns
    besides, for derivatives alone, are A and -1. The last is 0, or the place of a pivot that is 0.
    """
    if not left:
        solution, _, pivots, failed = solve(matrix.mT, right.mT)
        return solution.mT.clone(), matrix.clone(), pivots, failed
    vector = right.dim() == 1 or right.shape == matrix.shape[:-1]  # as torch tells them apart
    columns = right.unsqueeze(-1) if vector else right
    size, width = matrix.shape[-1], columns.shape[-1]
    place = torch.arange(size, dtype=matrix.dtype, device=matrix.device)
    # Not torch.broadcast_shapes, whose first call imports sympy for half a second.
    batch = np.broadcast_shapes(matrix.shape[:-2], columns.shape[:-2])
    both = matrix.expand(*batch, size, size), columns.expand(*batch, size, width)
    zero = torch.zeros_like(torch.cat(both, dim=-1)[..., 0])

    def eliminate(carry: tuple[Tensor, Tensor, Tensor, Tensor]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        whole, order, done, failed = carry
        # The row of the largest entry in column 0, of those that have not been chosen: order is its pass.
        best = torch.where(order < 0, whole[..., 0].abs(), -1.0).argmax(-1, keepdim=True)
        chosen = (place == best).unsqueeze(-1)
        row = torch.where(chosen, whole, 0.0).sum(-2)
        failed = torch.where((failed == 0) & (row[..., 0] == 0), done + 1, failed)
        row = (row / row[..., :1]).unsqueeze(-2)
        whole = torch.where(chosen, row, whole - whole[..., :1] * row)
        order = torch.where(chosen.squeeze(-1), done.unsqueeze(-1), order)
        return torch.cat((whole[..., 1:], whole[..., :1]), dim=-1), order, done + 1, failed

    start = torch.cat(both, dim=-1), zero - 1, zero[..., 0], zero[..., 0].clone()
    whole, order, _, failed = repeat(size, eliminate, start)
    # After as many passes the columns of B come first; row i holds the unknown of its pass.
    belongs = order.unsqueeze(-2) == place.unsqueeze(-1)
    solution = torch.where(belongs.unsqueeze(-1), whole[..., :width].unsqueeze(-3), 0.0).sum(-2)
    pivots = torch.full_like(matrix[..., 0], -1).int()
    for _ in range(failed.dim() - matrix.dim() + 2):  # a matrix of several right sides
        failed = failed[0]
    return solution.squeeze(-1) if vector else solution, matrix.clone(), pivots, failed.int()


def solve_again(
    matrix: Tensor, pivots: Tensor, right: Tensor, *, left: bool = True, adjoint: bool = False
) -> Tensor:
    """A^-1 B, or A'^-1 B, from what `solve` has returned in the place of a factor, in its derivative."""
    return solve(matrix.mT if adjoint else matrix, right, left=left)[0]


def orthogonal(matrix: Tensor, mode: str = "reduced") -> tuple[Tensor, Tensor]:
    """Q and R of a square matrix by Householder's reflections."""
    if in_memory(matrix):
        return _rolled_orthogonal(matrix)
    size = matrix.shape[-1]
    rest = matrix
    q = torch.eye(size, dtype=matrix.dtype, device=matrix.device).expand_as(matrix)
    for k in range(size - 1):
        column = rest[..., k:, k]
        length = column.square().sum(-1).sqrt()
        head = torch.where(column[..., 0] < 0, column[..., 0] - length, column[..., 0] + length)
        vector = torch.cat((head.unsqueeze(-1), column[..., 1:]), dim=-1)
        square = vector.square().sum(-1)
        factor = torch.where(square > 0, 2 / torch.where(square > 0, square, 1.0), 0.0)
        v = torch.cat((torch.zeros_like(rest[..., :k, k]), vector), dim=-1)
        scaled = factor.unsqueeze(-1) * v
        rest = rest - scaled.unsqueeze(-1) * (v.unsqueeze(-1) * rest).sum(-2, keepdim=True)
        q = q - (q * v.unsqueeze(-2)).sum(-1, keepdim=True) * scaled.unsqueeze(-2)
    return q.clone(), rest.triu()


def _signs_and_pivots(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """The sign of the permutation, (...), and the pivots, (..., M), of an elimination with row exchanges."""
    rest, pivots = matrix, []
    sign = torch.ones_like(matrix[..., 0, 0])
    while rest.shape[-1]:
        best = rest[..., 0, :]
        others = []
        for i in range(1, rest.shape[-1]):
            row = rest[..., i, :]
            larger = row[..., :1].abs() > best[..., :1].abs()
            sign = torch.where(larger.squeeze(-1), -sign, sign)
            best, row = torch.where(larger, row, best), torch.where(larger, best, row)
            others.append(row)
        pivot = best[..., 0]
        pivots.append(pivot)
        below = best[..., 1:] / torch.where(pivot == 0, 1.0, pivot).unsqueeze(-1)
        cleared = [row[..., 1:] - row[..., :1] * below for row in others]
        rest = torch.stack(cleared, dim=-2) if cleared else rest[..., :0, :0]
    return sign, torch.stack(pivots, dim=-1)


def determinant(matrix: Tensor) -> Tensor:
    """det A: (..., M, M) -> (...)."""
    sign, pivots = _signs_and_pivots(matrix)
    return sign * pivots.prod(-1)


def log_determinant(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """The sign of det A and log |det A|: (..., M, M) -> (...), (...)."""
    sign, pivots = _signs_and_pivots(matrix)
    return sign * pivots.sign().prod(-1), pivots.abs().log().sum(-1)


def log_of_determinant(matrix: Tensor) -> Tensor:
    sign, size = log_determinant(matrix)
    return torch.where(sign < 0, torch.nan, size)


def _rolled_cholesky(gram: Tensor) -> tuple[Tensor, Tensor]:
    size = gram.shape[-1]
    place = torch.arange(size, dtype=gram.dtype, device=gram.device)
    zero = torch.zeros_like(gram[..., 0])

    def eliminate(carry: tuple[Tensor, Tensor, Tensor, Tensor]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        rest, factor, done, failed = carry  # row i is row done + i, cyclically
        pivot = rest[..., 0, 0]
        failed = torch.where((failed == 0) & ~(pivot > 0), done + 1, failed)
        open_ = place < size - done.unsqueeze(-1)
        column = torch.where(open_, rest[..., 0] / pivot.sqrt().unsqueeze(-1), 0.0)
        rest = rest - column.unsqueeze(-1) * column.unsqueeze(-2)
        rest = torch.constant_pad_nd(rest[..., 1:, 1:], [0, 1, 0, 1])
        factor = torch.cat((factor[..., 1:], column.unsqueeze(-1)), dim=-1)
        return rest, torch.cat((factor[..., 1:, :], factor[..., :1, :]), dim=-2), done + 1, failed

    start = gram.clone(), torch.zeros_like(gram), zero[..., 0], zero[..., 0].clone()
    _, factor, _, failed = repeat(size, eliminate, start)
    return factor, failed


def _rolled_triangular(lower: Tensor, right: Tensor, unit: bool) -> Tensor:
    size = lower.shape[-1]
    place = torch.arange(size, dtype=lower.dtype, device=lower.device)
    done = torch.zeros_like((lower[..., 0, :1] + right[..., 0, :1])[..., 0])
    batch = done.shape

    def substitute(carry: tuple[Tensor, Tensor, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        matrix, rows, done = carry  # row i is row done + i, cyclically
        found = rows[..., :1, :]
        found = found if unit else found / matrix[..., :1, :1]
        open_ = (place < size - done.unsqueeze(-1)).unsqueeze(-1)
        rows = torch.where(open_, rows - matrix[..., :1] * found, rows)
        matrix = torch.cat((matrix[..., 1:, :], matrix[..., :1, :]), dim=-2)
        matrix = torch.cat((matrix[..., 1:], matrix[..., :1]), dim=-1)
        return matrix, torch.cat((rows[..., 1:, :], found), dim=-2), done + 1

    start = lower.expand(*batch, size, size).clone(), right.expand(*batch, *right.shape[-2:]).clone(), done
    solution: Tensor = repeat(size, substitute, start)[1]
    return solution


def _rolled_orthogonal(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Q and R of a square matrix by Householder's reflections: (..., M, M), (..., M, M)."""
    size = matrix.shape[-1]
    place = torch.arange(size, dtype=matrix.dtype, device=matrix.device)

    def reflect(carry: tuple[Tensor, Tensor, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        rest, q, done = carry  # column i of the rest is column done + i, cyclically
        here, open_ = place == done.unsqueeze(-1), place >= done.unsqueeze(-1)
        column = torch.where(open_, rest[..., 0], 0.0)
        length = column.square().sum(-1, keepdim=True).sqrt()
        head = torch.where(column < 0, column - length, column + length)
        vector = torch.where(here, head, column)
        square = vector.square().sum(-1, keepdim=True)
        scaled = torch.where(square > 0, 2 / torch.where(square > 0, square, 1.0), 0.0) * vector
        rest = rest - scaled.unsqueeze(-1) * (vector.unsqueeze(-1) * rest).sum(-2, keepdim=True)
        q = q - (q * vector.unsqueeze(-2)).sum(-1, keepdim=True) * scaled.unsqueeze(-2)
        return torch.cat((rest[..., 1:], rest[..., :1]), dim=-1), q, done + 1

    identity = torch.eye(size, dtype=matrix.dtype, device=matrix.device).expand_as(matrix)
    start = matrix.clone(), identity.clone(), torch.zeros_like(matrix[..., 0, 0])
    rest, q, _ = repeat(size - 1, reflect, start)
    return q, torch.cat((rest[..., 1:], rest[..., :1]), dim=-1).triu()


def _of_one(*matrices: Tensor) -> tuple[Tracer, str] | None:
    """Return the tracer of single matrices that an operation in place serves, and the type of its numbers."""
    tracer = next(filter(None, map(tracer_of, matrices)), None)
    alone = all(matrix.shape[:-2].numel() == 1 for matrix in matrices)
    if tracer is None or not alone or not any(map(tracer.traced, matrices)):
        return None
    kinds = {tracer.kind(matrix.dtype) for matrix in matrices}
    return (tracer, kinds.pop()) if kinds in ({REAL}, {WIDE}) else None

"""The factorisations of `eliminations` for matrices of many entries: a loop takes one row or column a pass.

Written out, a factor of 15 x 15 numbers is a thousand lines of a program. Here a pass works on the whole
matrix in memory and then moves all rows one place up, so that the text knows one pass alone.
"""

from __future__ import annotations

import torch
from torch import Tensor

from .combinators import repeat


def cholesky(gram: Tensor) -> tuple[Tensor, Tensor]:
    """L with L L' = K, and 0 or, where a pivot is not positive, its place: (..., M, M), (...)."""
    size = gram.shape[-1]
    place, zero = _places(gram), torch.zeros_like(gram[..., 0])

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
    return factor, failed.to(torch.int32)


def triangular(lower: Tensor, right: Tensor, *, unitriangular: bool) -> Tensor:
    """T^-1 B of a lower triangle: (..., M, M), (..., M, P)."""
    size = lower.shape[-1]
    place, done = _places(lower), torch.zeros_like((lower[..., 0, :1] + right[..., 0, :1])[..., 0])
    batch = done.shape

    def substitute(carry: tuple[Tensor, Tensor, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        matrix, rows, done = carry  # row i is row done + i, cyclically
        found = rows[..., :1, :]
        found = found if unitriangular else found / matrix[..., :1, :1]
        open_ = (place < size - done.unsqueeze(-1)).unsqueeze(-1)
        rows = torch.where(open_, rows - matrix[..., :1] * found, rows)
        matrix = torch.cat((matrix[..., 1:, :], matrix[..., :1, :]), dim=-2)
        matrix = torch.cat((matrix[..., 1:], matrix[..., :1]), dim=-1)
        return matrix, torch.cat((rows[..., 1:, :], found), dim=-2), done + 1

    start = lower.expand(*batch, size, size).clone(), right.expand(*batch, *right.shape[-2:]).clone(), done
    solution: Tensor = repeat(size, substitute, start)[1]
    return solution


def orthogonal(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Q and R of a square matrix by Householder's reflections: (..., M, M), (..., M, M)."""
    size, place = matrix.shape[-1], _places(matrix)

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


def tridiagonal(gram: Tensor) -> tuple[list[Tensor], list[Tensor]]:
    """The diagonal of Q'KQ, M of (...), and the squares of the entries beside it, M - 1 of (...)."""
    size = gram.shape[-1]

    def reflect(carry: tuple[Tensor, Tensor, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        matrix, diagonal, squares = carry  # what is done lies in zeros at the end
        column, rest = matrix[..., 1:, 0], matrix[..., 1:, 1:]
        square = column.square().sum(-1, keepdim=True)
        root = square.sqrt()
        head = torch.where(column[..., :1] < 0, column[..., :1] - root, column[..., :1] + root)
        vector = torch.cat((head, column[..., 1:]), dim=-1)
        length = vector.square().sum(-1, keepdim=True)
        factor = torch.where(length > 0, 2 / torch.where(length > 0, length, 1.0), 0.0)
        image = factor * (rest * vector.unsqueeze(-2)).sum(-1)
        image = image - 0.5 * factor * (image * vector).sum(-1, keepdim=True) * vector
        both = vector.unsqueeze(-1) * image.unsqueeze(-2)
        diagonal = torch.cat((diagonal[..., 1:], matrix[..., 0, :1]), dim=-1)
        squares = torch.cat((squares[..., 1:], square), dim=-1)
        return torch.constant_pad_nd(rest - both - both.mT, [0, 1, 0, 1]), diagonal, squares

    zero = torch.zeros_like(gram[..., 0, : size - 2])
    rest, diagonal, squares = repeat(size - 2, reflect, (gram.clone(), zero, zero.clone()))
    last = [rest[..., 0, 0], rest[..., 1, 1]]
    return [*diagonal.unbind(-1), *last], [*squares.unbind(-1), rest[..., 1, 0].square()]


def _places(matrix: Tensor) -> Tensor:
    return torch.arange(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device)

"""Eigenvalues and eigenvectors of small symmetric matrices in torch operations that have a scalar form.

With vectors: Jacobi's rotations, M/2 disjoint pairs a pass (Brent and Luk, 1985), a fixed number of sweeps.
Values alone: Householder's tridiagonal form and bisection (Barth, Martin and Wilkinson, 1967), each value by
itself. The QR iteration of LAPACK takes as many passes as a matrix needs, and shifts that a row chooses: in
lanes all rows would wait for the slowest one, and branch.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor
from torch.utils._python_dispatch import _disable_current_modes

from .factorisations import in_memory
from .graph import NARROW, REAL
from .loops import repeat, tracer_of


def eigen(gram: Tensor, UPLO: str = "L", compute_v: bool = True) -> tuple[Tensor, Tensor]:
    """The eigenvalues of symmetric matrices, ascending, and eigenvectors in columns, by Jacobi's rotations.

    Torch asks for vectors also where a caller wants none; see `step`.

    One pass rotates the pairs (0, 1), (2, 3), ... at once and then moves all indices but the first one
    place on, so that after size - 1 passes every pair has met: Brent and Luk (1985).
    """
    count = gram.shape[-1]
    size = count + count % 2
    if size > count:  # one more, which no rotation touches
        gram = torch.constant_pad_nd(gram, [0, 1, 0, 1])
    top, bottom = list(range(0, size, 2)), list(range(1, size, 2))
    if size > 2:
        top, bottom = [top[0], bottom[0], *top[1:-1]], [*bottom[1:], top[-1]]
    following = [place for pair in zip(top, bottom, strict=True) for place in pair]

    def rotate(carry: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
        matrix, vectors = carry
        diagonal = matrix.diagonal(dim1=-2, dim2=-1)
        between = matrix.diagonal(offset=1, dim1=-2, dim2=-1)[..., 0::2]
        some = between != 0
        theta = (diagonal[..., 1::2] - diagonal[..., 0::2]) / (2 * torch.where(some, between, 1.0))
        tangent = 1 / (theta.abs() + (theta.square() + 1).sqrt())
        tangent = torch.where(some, torch.where(theta < 0, -tangent, tangent), 0.0)
        cosine = 1 / (tangent.square() + 1).sqrt()
        turned = _turn(_turn(matrix, cosine, tangent * cosine).mT, cosine, tangent * cosine)
        moved = turned[..., following, :][..., following]
        return moved, _turn(vectors, cosine, tangent * cosine)[..., following, :]

    units = torch.eye(size, dtype=gram.dtype, device=gram.device).expand_as(gram)
    passes = (size - 1) * (4 + count.bit_length())
    matrix, vectors = repeat(passes, rotate, (gram.clone(), units.clone()))
    values = matrix.diagonal(dim1=-2, dim2=-1)[..., :count].clone()
    columns = vectors[..., :count, :count].clone()  # row k is the eigenvector of value k
    # Neighbours change places, the even pairs and the odd ones in turn, as often as there are values.
    values, columns = repeat((count + 1) // 2, _exchange, (values, columns))
    return values, columns.mT


def _exchange(carry: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    values, rows = carry
    for start in (0, 1):
        end = start + (values.shape[-1] - start) // 2 * 2
        if end > start:
            a, b = values[..., start:end:2], values[..., start + 1 : end : 2]
            p, q = rows[..., start:end:2, :], rows[..., start + 1 : end : 2, :]
            wrong = (a > b).unsqueeze(-1)
            pairs = torch.stack((torch.minimum(a, b), torch.maximum(a, b)), dim=-1).flatten(-2)
            moved = torch.stack((torch.where(wrong, q, p), torch.where(wrong, p, q)), dim=-2).flatten(-3, -2)
            values = torch.cat((values[..., :start], pairs, values[..., end:]), dim=-1)
            rows = torch.cat((rows[..., :start, :], moved, rows[..., end:, :]), dim=-2)
    return values, rows


def eigenvalues(gram: Tensor) -> Tensor:
    """The eigenvalues of symmetric matrices, ascending, each to some eps |K|: (..., M, M) -> (..., M).

    Householder's reflections to a tridiagonal matrix, then a bisection for each eigenvalue that counts the
    negative pivots of T - s I. Where only the extremes are used, a compiled program finds no others.

    Source: Barth, Martin and Wilkinson, Numerische Mathematik 9 (1967).
    """
    if in_memory(gram):
        diagonal, squares, largest = _in_memory(gram)
    else:
        largest = _largest(gram)
        diagonal, squares = _tridiagonal(gram / largest)
    size, real = len(diagonal), torch.finfo(gram.dtype)
    beside = [square.sqrt() for square in squares]
    zero = torch.zeros_like(diagonal[0])
    reach = [a + b for a, b in zip([zero, *beside], [*beside, zero], strict=True)]
    low = torch.stack([d - r for d, r in zip(diagonal, reach, strict=True)], dim=-1).amin(-1, keepdim=True)
    high = torch.stack([d + r for d, r in zip(diagonal, reach, strict=True)], dim=-1).amax(-1, keepdim=True)
    smallest = real.tiny * torch.stack([zero + 1, *squares], dim=-1).amax(-1, keepdim=True)
    rank = torch.arange(size, dtype=gram.dtype, device=gram.device)

    def halve(ends: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
        low, high = ends
        middle = low + 0.5 * (high - low)
        below, pivot = torch.zeros_like(middle), torch.ones_like(middle)
        for k, d in enumerate(diagonal):
            pivot = d.unsqueeze(-1) - middle - (squares[k - 1].unsqueeze(-1) / pivot if k else 0.0)
            negative = pivot < smallest
            below = below + negative.to(below)
            pivot = torch.where(negative, torch.minimum(pivot, -smallest), pivot)
        enough = below > rank
        return torch.where(enough, low, middle), torch.where(enough, middle, high)

    passes = 3 - round(math.log2(real.eps))
    low, high = repeat(
        passes, halve, (low.expand(*low.shape[:-1], size).clone(), high.expand_as(gram[..., 0]).clone())
    )
    values: Tensor = largest.squeeze(-1) * (low + 0.5 * (high - low))
    return values


def _tridiagonal(gram: Tensor) -> tuple[list[Tensor], list[Tensor]]:
    """The diagonal of Q'KQ, M of (...), and the squares of the entries beside it, M - 1 of (...)."""
    rest, diagonal, squares = gram, [], []
    while rest.shape[-1] > 2:
        diagonal.append(rest[..., 0, 0])
        column, rest = rest[..., 1:, 0], rest[..., 1:, 1:]
        square = column.square().sum(-1)
        squares.append(square)
        head = torch.where(column[..., 0] < 0, column[..., 0] - square.sqrt(), column[..., 0] + square.sqrt())
        vector = torch.cat((head.unsqueeze(-1), column[..., 1:]), dim=-1)
        length = vector.square().sum(-1)
        factor = torch.where(length > 0, 2 / torch.where(length > 0, length, 1.0), 0.0).unsqueeze(-1)
        image = factor * (rest * vector.unsqueeze(-2)).sum(-1)
        image = image - 0.5 * factor * (image * vector).sum(-1, keepdim=True) * vector
        both = vector.unsqueeze(-1) * image.unsqueeze(-2)
        rest = rest - both - both.mT
    diagonal += rest.diagonal(dim1=-2, dim2=-1).unbind(-1)
    return diagonal, squares + [rest[..., k + 1, k].square() for k in range(rest.shape[-1] - 1)]


def _turn(matrix: Tensor, cosine: Tensor, sine: Tensor) -> Tensor:
    """Rotate the rows 2 k and 2 k + 1: (..., M, M), (..., M / 2)."""
    partner = [k ^ 1 for k in range(matrix.shape[-2])]
    c = torch.stack((cosine, cosine), dim=-1).flatten(-2).unsqueeze(-1)
    s = torch.stack((-sine, sine), dim=-1).flatten(-2).unsqueeze(-1)
    return c * matrix + s * matrix[..., partner, :]


def _in_memory(gram: Tensor) -> tuple[list[Tensor], list[Tensor], Tensor]:
    """Return `_tridiagonal` of a matrix over its largest entry, and the entry: an operation of programs.

    It stays below the diagonal of one triangle in memory, of which the text of a loop reads and writes a
    quarter of what passes over whole matrices do.
    """
    largest = _largest(gram)
    with _disable_current_modes():
        diagonal, squares = _tridiagonal(gram.detach() / largest.detach())
        values = torch.stack([*diagonal, *squares, largest.detach()[..., 0, 0]], dim=-1)
    tracer = tracer_of(gram)
    if tracer is None or not tracer.traced(gram):
        diagonal, squares = _tridiagonal(gram / largest)
        return diagonal, squares, largest
    kind, size = tracer.kind(gram.dtype), gram.shape[-1]
    held = REAL if kind == NARROW else kind
    nodes = tracer.nodes(gram, held)
    every = [tracer.on_matrix("tridiagonal", each, held) for each in nodes.reshape(-1, size, size)]
    found = tracer.cast(np.stack(every).reshape(values.shape), kind)
    *parts, last = tracer.attach(values, found).unbind(-1)
    return parts[:size], parts[size:], last[..., None, None]


def _largest(gram: Tensor) -> Tensor:
    """The largest |entry|, (..., 1, 1), by which its squares neither overflow nor vanish; 1 of zeros."""
    largest = gram.abs().amax((-2, -1), keepdim=True)
    return torch.where(largest > 0, largest, 1.0)

"""Sums over rows in a fixed order, and the tensors in which an adjoint leaves what it finds.

Rows are summed by 64 and halves first, and then these sums by halves: the bits depend on the number of rows
alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ..calls.planned_call import fresh, rows_innermost
from ..tree import Shared

UNIT = 64
"""Rows that are summed first, whatever the threads."""


class AtTimes:
    """Gradients by what times bring, put together of blocks of rows and times.

    Args:
        leaves: what they are by.
        rows, times: all of them.
        like: dtype and device.
    """

    def __init__(self, leaves: Sequence[Any], rows: int, times: int, like: Tensor) -> None:
        self.leaves, self.like = leaves, like
        self._found: list[Tensor] = []
        for leaf in leaves:
            shared = isinstance(leaf, Shared)
            shape, count = leaf.tensor.shape[1:] if shared else leaf.shape[2:], -(-rows // UNIT)
            self._found.append(empty_rows(like, count if shared else rows, (times,), shape))

    def rooms(self, rows: slice, times: slice) -> list[Tensor]:
        """Return where those of a block are written to."""
        count, length = rows.stop - rows.start, times.stop - times.start
        return [
            empty_rows(self.like, count, (length,), leaf.tensor.shape[1:])
            if isinstance(leaf, Shared)
            else found[rows, times]
            for leaf, found in zip(self.leaves, self._found, strict=True)
        ]

    def put(self, rows: slice, times: slice, slopes: Sequence[Tensor]) -> None:
        """Add those of a block, (rows, times, ...), that are not in their place."""
        for leaf, slope, found in zip(self.leaves, slopes, self._found, strict=True):
            if isinstance(leaf, Shared):
                found[rows.start // UNIT : -(-rows.stop // UNIT), times] = by_units(slope)
            elif slope.data_ptr() != found[rows, times].data_ptr():
                found[rows, times] = slope

    def joined(self) -> list[Tensor]:
        """Return those of all rows and times."""
        pairs = zip(self.leaves, self._found, strict=True)
        return [
            halved(x, 0).to(of.tensor.dtype) if isinstance(of, Shared) else x.to(of.dtype) for of, x in pairs
        ]


def empty_rows(like: Tensor, rows: int, times: tuple[int, ...], shape: Sequence[int]) -> Tensor:
    """Return an empty tensor (rows, *times, *shape) in whose memory the rows are innermost."""
    size = torch.Size(shape).numel() * rows
    return fresh(like, *times, size).as_strided(*rows_innermost(rows, times, shape))


def by_units(x: Tensor) -> Tensor:
    """Sums over 64 rows each."""
    missing = -len(x) % UNIT
    if missing:
        x = torch.cat((x, x.new_zeros((missing, *x.shape[1:]))))
    return halved(x.unflatten(0, (-1, UNIT)), 1)


def halved(x: Tensor, dim: int) -> Tensor:
    """The sum over a dimension by halves: the same bits on any number of threads."""
    while (count := x.shape[dim]) > 1:
        half = count // 2
        both = x.narrow(dim, 0, half) + x.narrow(dim, half, half)
        x = torch.cat((both, x.narrow(dim, 2 * half, 1)), dim) if count % 2 else both
    return x.squeeze(dim)


def joined(parts: Sequence[Tensor]) -> Tensor:
    return parts[0] if len(parts) == 1 else torch.cat([*parts])


def split(leaves: Sequence[Any], sizes: Sequence[int]) -> list[list[Any]]:
    """Return consecutive parts of these sizes."""
    rest = iter(leaves)
    return [[next(rest) for _ in range(size)] for size in sizes]


def part(x: Tensor, rows: slice) -> Tensor:
    """Return some rows, the tensor itself where these are all."""
    return x if rows.stop - rows.start == len(x) else x[rows]

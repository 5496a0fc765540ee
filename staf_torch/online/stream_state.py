"""The state of streams: a table of what a filter has learned of each, and how it lies in memory."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import torch
from torch import Tensor

LANES = {"AVX512": 8, "AVX2": 4}.get(torch.backends.cpu.get_cpu_capability(), 2)
"""Streams whose numbers stand together: the double precision numbers of a vector register."""


@dataclasses.dataclass
class StreamState:
    """State of every stream, changed in place; streams are the last dimension.

    u is the mean of the weights, I - D their covariance: D, 0 <= D <= I, is what has been learned. The rows
    of the table: the anchor, x as last measured, u output by output and of an output that is always 1, D's
    lower triangle row by row; for every output the root mean square of its standardised errors, how many in
    a row were a surprise, how many were counted, mean and spread of y, its leaps in a row, y as last
    measured; then the running share of V that was unknown, and the largest |y| learned. In memory the numbers
    of `LANES` streams stand together, so that machine code reads them one after the other; on a device those
    of all streams, as its threads read them.
    """

    blocks: Tensor  # (ceil(S / LANES), 2 n + (K + 1) M + M (M + 1) / 2 + 7 K + 2, LANES); (1, ..., S)
    counts: Tensor  # learned, skipped, out of proportion in a row, learned since it began: (4, S) int64
    dim: int  # n
    count: int  # M
    outputs: int  # K

    @classmethod
    def empty(cls, like: Tensor, streams: int, dim: int, count: int, outputs: int) -> StreamState:
        """Nothing learned, at NaN: a stream's first sample puts it somewhere."""
        table = like.new_zeros(rows_of(dim, count, outputs), streams)
        table[: 2 * dim] = torch.nan
        counts = torch.zeros(4, streams, dtype=torch.int64, device=like.device)
        return cls(blocks_of(table), counts, dim, count, outputs)

    def with_table(self, table: Tensor, counts: Tensor) -> StreamState:
        """Other streams of these sizes."""
        return dataclasses.replace(self, blocks=blocks_of(table), counts=counts.contiguous())

    @property
    def streams(self) -> int:
        """S."""
        return self.counts.shape[1]

    @property
    def dtype(self) -> torch.dtype:
        """Return the dtype of the table."""
        return self.blocks.dtype

    @property
    def table(self) -> Tensor:
        """A copy of the table, (rows, S)."""
        return self.blocks.transpose(0, 1).flatten(1)[:, : self.streams]

    def put(self, *pieces: Tensor) -> None:
        """Take these numbers, (rows, S), or pieces of them in turn."""
        table = pieces[0] if len(pieces) == 1 else torch.cat(pieces)
        self.blocks.copy_(blocks_of(table.to(self.blocks)))

    @property
    def sizes(self) -> tuple[int, int, int]:
        """n, M and K."""
        return self.dim, self.count, self.outputs

    def replace(self, rows: Tensor, other: StreamState) -> None:
        """Take the numbers of another state for the streams with these numbers."""
        table = self.table
        table[:, rows], self.counts[:, rows] = other.table, other.counts
        self.put(table)

    @property
    def heights(self) -> list[int]:
        """Rows of the parts, D's lower triangle for D."""
        n, m, k = self.sizes
        return [n, n, (k + 1) * m, m * (m + 1) // 2, *[k] * 7, 1, 1]

    def parts(self, table: Tensor) -> StateParts:
        """The rows of a table (..., S) by name: views, but for D."""
        m, k = self.count, self.outputs
        anchor, last, mean, lower, *rest = table.split(self.heights)
        row, column = torch.tril_indices(m, m, device=table.device)
        learned = table.new_empty(m, m, *table.shape[1:])
        learned[row, column] = learned[column, row] = lower
        return StateParts(anchor, last, mean.unflatten(0, (k + 1, m)), learned, *rest)

    def whole(self, parts: StateParts) -> Tensor:
        """The table with these rows."""
        row, column = torch.tril_indices(self.count, self.count, device=parts.learned.device)
        lower = parts._replace(learned=parts.learned[row, column])
        return torch.cat([part.reshape(-1, part.shape[-1]) for part in lower])


class StateParts(NamedTuple):
    """The rows of a `StreamState`."""

    anchor: Tensor  # (n, S)
    last: Tensor  # (n, S)
    mean: Tensor  # u, and behind it that of an output that is always 1, (K + 1, M, S)
    learned: Tensor  # (M, M, S)
    errors: Tensor  # root mean square in units of the deviation that was predicted, (K, S)
    surprises: Tensor  # in a row, (K, S)
    told: Tensor  # errors that were counted: those since y took a second value, (K, S)
    level: Tensor  # running mean of y, (K, S)
    spread: Tensor  # running deviation of y from it, (K, S)
    leaps: Tensor  # in a row, of y from it, (K, S)
    value: Tensor  # y as last measured, (K, S)
    usual: Tensor  # running share of the variance of V that was unknown at x, (1, S)
    largest: Tensor  # (1, S)


class Counts(NamedTuple):
    """Samples of every stream, (S,) int64."""

    learned: Tensor
    skipped: Tensor
    streak: Tensor  # out of proportion in a row
    since: Tensor  # learned since it began


def rows_of(dim: int, count: int, outputs: int) -> int:
    """Return the rows of the table of a `StreamState`."""
    return 2 * dim + (outputs + 1) * count + count * (count + 1) // 2 + 7 * outputs + 2


def blocks_of(table: Tensor, padding: float = 0.0) -> Tensor:
    """(rows, S) -> (ceil(S / LANES), rows, LANES), ``padding`` behind the last stream; (1, rows, S) of a
    device."""
    if not table.is_cpu:
        return table.unsqueeze(0).contiguous()
    short = -table.shape[1] % LANES
    padded = torch.nn.functional.pad(table, (0, short), value=padding)
    blocks: Tensor = padded.unflatten(1, (-1, LANES)).transpose(0, 1).contiguous()
    return blocks

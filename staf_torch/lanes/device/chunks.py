"""Histories for which a device has no room: a call in chunks of times, each brought to the processor.

The carry stays on the device and goes from one chunk to the next, so that the bits are those of one call.
"""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ...signs import Sign
from ..tree import Shared

_log = logging.getLogger(__name__)
_said = set[torch.device]()
_SHARE = 0.5  # of the free memory of a device that a chunk's results may take
_GIGA = 1e9


class Room(NamedTuple):
    """Shape, strides and dtype of a result with rows innermost, times second."""

    shape: tuple[int, ...]
    strides: tuple[int, ...]
    dtype: torch.dtype

    @property
    def bytes(self) -> int:
        """Bytes that it takes."""
        return math.prod(self.shape) * self.dtype.itemsize


def in_chunks(
    call: Callable[[Sequence[Any], int], Sequence[Tensor]],
    leaves: Sequence[Any],
    times: Sequence[bool],
    rooms: Sequence[Room],
    *,
    carries: int,
    steps: int,
    every: int,
    free: int,
    where: torch.device,
) -> list[Tensor] | None:
    """Return the carry after the last step, on the device, and the outputs, on the processor.

    Args:
        call: takes so many steps of inputs.
        leaves: the inputs, the carry last.
        times: for each of them, whether it has times.
        rooms: of all results, the carry first.
        carries: how many results are the carry.
        steps, every: of the whole call.
        free: bytes that are free on the device.
        where: the device.

    Returns:
        None where a single time does not fit, or the processor has no memory for the outputs.
    """
    outputs = rooms[carries:]
    size, recorded = sum(room.bytes for room in outputs), max(1, -(-steps // every))
    left = _SHARE * free - 2 * sum(room.bytes for room in rooms[:carries])
    count = int(left * recorded / size) if size else 0
    if count < 1 or size > _available():
        return None
    try:
        whole = [torch.empty_strided(*room[:2], dtype=room.dtype, device="cpu") for room in outputs]
    except RuntimeError:
        return None
    length, chunks = min(count, recorded) * every, -(-recorded // count)
    if where not in _said:
        _said.add(where)
        _log.warning(
            "a history of %.3g GB has no room on %s: it is on the processor, brought there in %d chunks",
            *(size / _GIGA, where, chunks),
        )
    given, names = [*leaves], len(leaves) - carries
    with Sign("chunks of times", chunks) as sign:
        for start in range(0, steps, length):
            stop = min(start + length, steps)
            for k, (leaf, timed) in enumerate(zip(leaves, times, strict=True)):
                if timed:
                    given[k] = _cut(leaf, start, stop)
            found = call(given, stop - start)
            given[names:] = found[:carries]
            for target, part in zip(whole, found[carries:], strict=True):
                target[:, start // every :][:, : part.shape[1]].copy_(part)
            sign.advance()
    return [*given[names:], *whole]


def _cut(leaf: Any, start: int, stop: int) -> Any:
    if type(leaf) is Shared:
        return Shared(leaf.tensor[start:stop])
    return leaf[:, start:stop]


def _available() -> float:
    """Return the bytes of memory that the processor has left, infinite where nobody says."""
    try:
        with open("/proc/meminfo", encoding="ascii") as lines:
            found = next(line for line in lines if line.startswith("MemAvailable"))
        return 1024.0 * int(found.split()[1])
    except (OSError, StopIteration, ValueError):
        pass
    try:
        return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    except (AttributeError, OSError, ValueError):
        return math.inf


def joined(pieces: Sequence[Tensor]) -> Tensor:
    """Return consecutive pieces of time (B, C, ...) as one tensor.

    On the processor where one of them is there, or a device has no room for all of them once more.
    """
    if len(pieces) == 1:
        return pieces[0]
    if len({piece.device for piece in pieces}) == 1:
        try:
            return torch.cat([*pieces], dim=1)
        except torch.OutOfMemoryError:
            pass
    return torch.cat([piece.cpu() for piece in pieces], dim=1)


def beside_history(x: Tensor, history: Tensor) -> Tensor:
    """Return a tensor where a history is; an operation of torch is spared where it is there already."""
    return x if x.is_cpu == history.is_cpu else x.to(history.device)


def rows_of(history: Tensor, rows: Tensor) -> Tensor:
    """Return these rows (R,) of a history where they are, also of one for which a device had no room."""
    return history[rows.to(history.device)].to(rows.device)


def with_rows(history: Tensor, rows: Tensor, others: Tensor) -> Tensor:
    """Return a history with others in the place of these rows (R,), where it is."""
    return history.index_copy(0, rows.to(history.device), others.to(history.device))

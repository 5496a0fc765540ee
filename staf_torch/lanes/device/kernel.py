"""Kernels of a program, and prepared calls of them: what `planned_call.PlannedCall` is for the processor.

A history for which a device has no room is computed in chunks of times, each brought to the processor.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import logging
import math
import struct
from collections.abc import Collection, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ...signs import Sign
from ..calls.planned_call import Compiled, rows_innermost, strides_of
from ..emit.cuda import in_arguments
from ..row_numbers import columns
from ..threads import Mutex
from ..tree import Shared, plain
from .cuda import CudaDevice
from .host import HostDevice, capturing

_MOST = 2**31 - 1  # of an offset of 32 bits
_OTHERS = 2048  # bytes of a kernel's arguments that are kept for others than its table


@functools.cache
def device(where: torch.device) -> HostDevice | CudaDevice:
    """Return what runs the kernels of tensors there.

    Raises:
        OSError: if the driver is missing.
    """
    return HostDevice() if where.type == "cpu" else CudaDevice(where.index)


class DeviceCall:
    """A prepared call of a kernel. Inputs are read where they lie, whatever their strides; nothing waits.

    Args:
        compiled: the program, whose call is the text of its kernel.
        leaves, times, rows, steps, every, once, backwards: as of `PlannedCall`.
        where: the device.
        whole: whether results must be there; else what does not fit comes to the processor.

    Attributes:
        structure: of the outputs.
        direct: whether a call reads nothing of its inputs but their addresses.
        text: of the kernel.

    Raises:
        OSError: if the kernel cannot be built or loaded.
    """

    def __init__(
        self,
        compiled: Compiled,
        leaves: Sequence[Any],
        times: Sequence[bool],
        *,
        rows: int,
        steps: int,
        every: int,
        once: int,
        where: torch.device,
        whole: bool = False,
        backwards: bool = False,
    ) -> None:
        self._steps, self._every, self._timed, self._whole = steps, every, times, whole
        self._compiled, self.structure, self._rows, self._once = compiled, compiled.structure, rows, once
        self._where = where
        leaves = self._with_columns(leaves)
        times = [*times[:once], *[False] * len(compiled.rows), *times[once:]]
        self._copied: list[int] = []  # inputs without one stride from entry to entry, or from elsewhere
        read = list[tuple[int, ...]]()
        for k, (leaf, timed) in enumerate(zip(leaves, times, strict=True)):
            tensor = plain(leaf)
            strides, lies = strides_of(leaf, timed, tensor.device == where and tensor.dim() > 0)
            read.append(strides)
            self._copied += [] if lies else [k]
        self._late = [(steps - 1) * time for _, time, *_ in read] if backwards else None
        if backwards:
            read = [(row, -time, *entries) for row, time, *entries in read]
        self.direct = not self._copied and not any(type(leaf) is Shared for leaf in leaves)
        recorded = -(-steps // every)
        self._rooms: list[Room | None] = [
            *(Room(*rows_innermost(rows, (), s), dtype) for s, dtype in compiled.carry),
            *(Room(*rows_innermost(rows, (recorded,), s), dtype) for s, dtype in compiled.outputs),
        ]
        most = max([s.numel() for s, _ in (*compiled.carry, *compiled.outputs)], default=1)
        reach = max([abs(entry) * entries for *_, entry, entries in read], default=0)
        wide = max(rows * (recorded + 1) * most, reach) > _MOST
        unit = all(entry == 1 or entries == 1 for *_, entry, entries in read)
        self._device: Any = device(where)
        self._all = [room for room in self._rooms if room is not None]
        self._bytes = sum(room.bytes for room in self._rooms if room is not None)
        table, room = compiled.table, self._device.arguments() - _OTHERS
        near = in_arguments(table.numel(), table.dtype == torch.float32)
        self._near = near and table.nbytes <= room
        far = near and not self._near
        kinds = (unit, "UNIT"), (far, "FAR"), (wide, "OFFSET long long")
        head = [f"#define {text}" for holds, text in kinds if holds]
        self.text = "\n".join([*head, compiled.call])
        self._kernel = self._device.compile(self.text)
        self._arguments(read, rows, steps, every)

    def _arguments(self, read: Sequence[tuple[int, ...]], rows: int, steps: int, every: int) -> None:
        table = self._compiled.table
        self._table: Tensor | None = None
        pointers, numbers = len(read) + len(self._rooms), table.tolist()
        kind = "f" if self._compiled.real == torch.float32 else "d"
        held = f"{len(numbers)}{kind}"
        if not self._near:
            self._table = table.to(self._where)
            numbers, held = [self._table.data_ptr()], "P"
        strides = [stride for slot in read for stride in slot[:3]]
        whole = struct.Struct(f"{pointers}P{held}{len(strides)}qq2i0q")
        self._record = ctypes.create_string_buffer(whole.size)
        whole.pack_into(self._record, 0, *[0] * pointers, *numbers, *strides, rows, steps, every)
        self._pack = struct.Struct(f"{pointers}P").pack_into
        self._lock = Mutex()

    def __call__(self, leaves: Sequence[Any]) -> list[Tensor]:
        """Return the carry after the last step and the outputs, all new, on the device's current stream.

        Args:
            leaves: inputs of the forms that the examples had.

        Raises:
            torch.OutOfMemoryError: if there is no memory for them, neither there nor on the processor.
        """
        if self._bytes > self._device.memory():
            return self._in_chunks(leaves)
        given = [leaf.tensor if type(leaf) is Shared else leaf for leaf in self._with_columns(leaves)]
        for k in self._copied:
            given[k] = given[k].to(self._where).contiguous()
        where = self._where
        try:
            rooms: list[Any] = [
                None if room is None else torch.empty_strided(*room[:2], dtype=room[2], device=where)
                for room in self._rooms
            ]
        except RuntimeError as error:  # of an earlier kernel, too, which is told as it is
            if not isinstance(error, torch.OutOfMemoryError) and "allocate memory" not in str(error):
                raise
            rooms = []
        if not rooms and self._rooms:
            return self._in_chunks(leaves)
        addresses = [0 if room is None else room.data_ptr() for room in rooms]
        starts = [*map(_address, given)]
        if self._late is not None:
            late = zip(starts, given, self._late, strict=True)
            starts = [start + x.element_size() * numbers for start, x, numbers in late]
        with self._lock:  # the driver copies the structure when it is called
            self._pack(self._record, 0, *starts, *addresses)
            self._device.launch(self._kernel, self._record, self._rows)
        if self._table is not None and capturing(self._table):
            _of_graphs[self._table.data_ptr()] = self._table
        return rooms

    def _in_chunks(self, leaves: Sequence[Any]) -> list[Tensor]:
        """Run in chunks of times, the outputs on the processor.

        The carry stays on the device and goes from one chunk to the next, so that the bits are those of one
        call.

        Raises:
            torch.OutOfMemoryError: where a single time does not fit, or the processor has no memory for the
                outputs.
        """
        carries, every, where = len(self._compiled.carry), self._every, self._where
        outputs = self._all[carries:]
        size, recorded = sum(room.bytes for room in outputs), max(1, -(-self._steps // every))
        whole, count = list[Tensor](), 0
        if size and not (self._whole or capturing(self._compiled.table.new_empty(0, device=where))):
            left = _SHARE * self._device.free() - 2 * sum(room.bytes for room in self._all[:carries])
            count = int(left * recorded / size)
        if count > 0 and size <= _available():
            with contextlib.suppress(RuntimeError):
                whole = [torch.empty_strided(*room[:2], dtype=room.dtype, device="cpu") for room in outputs]
        if not whole:
            raise torch.OutOfMemoryError(
                f"The results of this call take {self._bytes / 1e9:.3g} GB on {where}, for {self._rows} "
                f"rows and {recorded} recorded times; there is no room for them, nor in the processor's "
                "memory. Record fewer times (`every=`), leave the history out (`history=False`) where that "
                "is offered, or call for fewer rows or times in turn."
            )
        length, chunks = min(count, recorded) * every, -(-recorded // count)
        if where not in _said:
            _said.add(where)
            _log.warning(
                "a history of %.3g GB has no room on %s: it is on the processor, brought there in %d chunks",
                *(size / _GIGA, where, chunks),
            )
        given, names, made = [*leaves], len(leaves) - carries, dict[Any, DeviceCall]()
        sizes: dict[str, Any] = {"rows": self._rows, "every": every, "once": self._once, "where": where}
        with Sign("chunks of times", chunks) as sign:
            for start in range(0, self._steps, length):
                stop = min(start + length, self._steps)
                for k, (leaf, timed) in enumerate(zip(leaves, self._timed, strict=True)):
                    if timed:
                        given[k] = _cut(leaf, start, stop)
                form = stop - start, *(plain(leaf).stride() for leaf in given)
                if form not in made:
                    made[form] = DeviceCall(
                        self._compiled, given, self._timed, steps=stop - start, whole=True, **sizes
                    )
                found = made[form](given)
                given[names:] = found[:carries]
                for target, part in zip(whole, found[carries:], strict=True):
                    target[:, start // every :][:, : part.shape[1]].copy_(part)
                sign.advance()
        return [*given[names:], *whole]

    def leave_out(self, ends: Collection[int]) -> None:
        """Write nothing of these of the carry: None is in their place from now on."""
        for k in ends:
            self._rooms[k] = None
        self._bytes = sum(room.bytes for room in self._rooms if room is not None)

    def _with_columns(self, leaves: Sequence[Any]) -> Sequence[Any]:
        if not self._compiled.rows:
            return leaves
        return [*leaves[: self._once], *columns(self._compiled.rows, self._rows), *leaves[self._once :]]


_address = Tensor.data_ptr
_of_graphs: dict[int, Tensor] = {}
"""Tables that recorded graphs read at their addresses, whatever becomes of the call that made them."""


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

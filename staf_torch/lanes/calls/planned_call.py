"""Calls of a compiled program for inputs of fixed shapes: nothing is found out twice.

Machine code is given addresses and strides, so that inputs are read where they lie. The strides of a form are
found once and stand in a record; a call packs the addresses of its tensors, makes the tensors of the results,
rows innermost, and enters the code: some microseconds beside the arithmetic. An input of another dtype, or
whose entries do not lie evenly, is copied first.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import itertools
import mmap
import operator
import os
import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ...signs import Sign
from ..compilation.compiler import compiled
from ..row_numbers import RowNumbers, columns
from ..tree import Shared, plain

LARGE = 2**22  # bytes from which pages of two megabytes are worth asking for
_HUGE = 2**21
_MANY = 2**20  # rows times steps of a call that may take long


def fresh(like: Tensor, *shape: int) -> Tensor:
    """Return an empty tensor of a shape, of the dtype and device of another.

    A first write to ordinary pages costs more than the recursion that writes to them (4.8 megabytes took 3.2
    ms, of huge pages .6). The system gives huge ones, if it does, only to memory that begins where such a
    page may begin, and `malloc` does not: large tensors are mappings of their own, given back when the tensor
    goes.
    """
    size = torch.Size(shape).numel() * like.element_size()
    if like.device.type != "cpu" or size < LARGE or not hasattr(mmap, "MADV_HUGEPAGE"):
        return like.detach().new_empty(shape)
    try:  # private: a child process has its own
        memory = mmap.mmap(-1, -(-size // _HUGE) * _HUGE, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
        memory.madvise(mmap.MADV_HUGEPAGE)
    except OSError:  # no more mappings, or a system without huge pages
        return like.detach().new_empty(shape)
    return torch.frombuffer(memory, dtype=like.dtype, count=size // like.element_size()).view(shape)


class _Slot(ctypes.Structure):
    _fields_ = tuple((n, ctypes.c_int64) for n in ("row", "time", "entry", "entries"))


class _CallRecord(ctypes.Structure):
    _fields_ = (
        *((n, ctypes.c_int64) for n in ("rows", "times", "every")),
        *((n, ctypes.c_void_p) for n in ("table", "slots", "parallel", "again")),
    )


class _AgainRecord(ctypes.Structure):
    _fields_ = (
        *((n, ctypes.c_void_p) for n in ("run", "call", "data")),
        *((n, ctypes.c_int64) for n in ("inputs", "results")),
        ("to", ctypes.c_void_p),
    )


class Compiled(NamedTuple):
    """A program for inputs of some shapes and dtypes."""

    call: Any  # machine code, or the text of a kernel
    table: Tensor
    real: torch.dtype
    carry: tuple[tuple[torch.Size, torch.dtype], ...]  # of one row
    outputs: tuple[tuple[torch.Size, torch.dtype], ...]
    structure: Any  # of the outputs
    rows: tuple[RowNumbers, ...] = ()  # whose columns follow what a row has once


class PlannedCall:
    """A prepared call of a compiled program.

    Args:
        compiled: the program.
        leaves: examples of the inputs: what a row has once, what times bring, the carry.
        times: for each of them, whether a dimension of times comes first (after the rows).
        rows, steps, every: of the call.
        once: how many of the leaves a row has once.
        backwards: whether times are read and written from the last to the first.
        rooms: examples of tensors, rows innermost, that results are written into; none where they are new.

    Attributes:
        structure: of the outputs.
        direct: whether a call reads nothing of its inputs but their addresses.
        simple: whether it is direct, short, and its results are small and as they are written.
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
        once: int = 0,
        backwards: bool = False,
        rooms: Sequence[Tensor] = (),
    ) -> None:
        self._compiled, self.structure, self._rows_and_times = compiled, compiled.structure, rows * steps
        self._rows, self._once = rows, once
        if compiled.rows:
            leaves, times = self._with_columns(leaves), [*[False] * len(compiled.rows), *times]
        self._copied: list[int] = []  # inputs of another dtype, or without one stride from entry to entry
        slots = list[_Slot]()
        for k, (leaf, timed) in enumerate(zip(leaves, times, strict=True)):
            laid, lies = strides_of(leaf, timed, plain(leaf).dtype == compiled.real)
            slots.append(_Slot(*laid))
            self._copied += [] if lies else [k]
        self.direct = not self._copied and not any(type(leaf) is Shared for leaf in leaves)
        recorded = -(-steps // every)
        ends = [(*rows_innermost(rows, (), s), s.numel(), 0) for s, _ in compiled.carry]
        histories = [
            (*rows_innermost(rows, (recorded,), s), s.numel(), s.numel() * rows) for s, _ in compiled.outputs
        ]
        if rooms:
            strides = [room.stride() for room in rooms]
            kinds = [*[False] * len(ends), *[True] * len(histories)]
            slots += [
                _Slot(1, s[1] if at_times else 0, s[-1] if len(s) > 1 + at_times else 1, end[2])
                for s, at_times, end in zip(strides, kinds, (*ends, *histories), strict=True)
            ]
        else:
            slots += [_Slot(1, time, rows, entries) for _, _, entries, time in (*ends, *histories)]
        real = compiled.real
        self._late = self._reverse(slots, steps, recorded) if backwards else None
        self._rooms = [(shape, strides) for shape, strides, _, _ in (*ends, *histories)]
        self._dtypes = [
            (k, dtype) for k, (_, dtype) in enumerate((*compiled.carry, *compiled.outputs)) if dtype != real
        ]
        self._like = torch.empty(0, dtype=real, device="cpu")  # of large ones; whatever the default device is
        self._likes = [] if rooms else [self._without_memory(*each) for each in self._rooms]
        self._large = [k for k, like in enumerate(self._likes) if like is self._like]
        self.simple = self.direct and not (compiled.rows or self._large or self._dtypes or backwards or rooms)
        self.simple = self.simple and self._rows_and_times < _MANY
        self._packed = struct.Struct(f"{len(slots)}q").pack
        self._slots = (_Slot * max(len(slots), 1))(*slots)
        self._call = _CallRecord(rows, steps, every, compiled.table.data_ptr(), ctypes.addressof(self._slots))
        self._call.parallel = _parallel()
        self._reference = ctypes.addressof(self._call)

    def makes(self, leaves: Sequence[Any], to: Sequence[int]) -> Any:
        """Return what lets this program make inputs of times of another, a few rows at a time, from its own
        ``leaves``, of which every time is recorded.

        The other one reads them from the last time to the first: ``to`` says of each result, the carry before
        the outputs, which input of a time it is, or -1.
        """
        given = self._as_read(leaves)
        packed = ctypes.c_char_p(self._packed(*map(_address, given), *[0] * len(to)))
        places = (ctypes.c_int64 * len(to))(*to)
        run, data = (ctypes.cast(x, ctypes.c_void_p) for x in (self._compiled.call, packed))
        record = _AgainRecord(run, self._reference, data, len(given), len(to), ctypes.addressof(places))
        record.kept = self, given, packed, places
        return record

    def _without_memory(self, shape: Sequence[int], strides: Sequence[int]) -> Tensor:
        """Return a tensor of which nothing but its form may be read: `torch.empty_like` makes others.

        That takes two thirds of the time of `torch.empty_strided`, which reads shape and strides of Python.
        """
        if torch.Size(shape).numel() * self._like.element_size() >= LARGE:
            return self._like
        like = torch.empty_strided(shape, strides, dtype=self._like.dtype, device="cpu")
        like.untyped_storage().resize_(0)
        return like

    def _reverse(self, slots: list[_Slot], steps: int, recorded: int) -> list[int]:
        """Turn the times of all slots around; return the bytes from an address to that of the last time."""
        inputs = len(slots) - len(self._compiled.carry) - len(self._compiled.outputs)
        late, size = [], self._compiled.real.itemsize
        for k, slot in enumerate(slots):
            late.append(((steps if k < inputs else recorded) - 1) * slot.time * size)
            slot.time = -slot.time
        return late

    def __call__(self, leaves: Sequence[Any]) -> list[Tensor]:
        """Return the carry after the last step and the outputs, all new, of inputs of the forms that the
        examples had."""
        if self.simple:
            rooms = [*map(_empty_like, self._likes)]
            addresses = self._packed(*map(_address, leaves), *map(_address, rooms))
            self._compiled.call(self._reference, addresses, _threads())
            return rooms
        rooms = [*map(_empty_like, self._likes)]
        for k in self._large:
            shape, strides = self._rooms[k]
            rooms[k] = fresh(self._like, torch.Size(shape).numel()).as_strided(shape, strides)
        self.into(rooms, leaves)
        for k, dtype in self._dtypes:
            rooms[k] = rooms[k].to(dtype)
        return rooms

    def into(self, rooms: Sequence[Tensor], leaves: Sequence[Any], again: Any = None) -> None:
        """Write the carry after the last step and the outputs into tensors of the program's dtype, which
        are as the examples were or as a call makes them. ``again`` makes some of the inputs, of `makes`."""
        given, reference = self._as_read(leaves), self._reference
        if again is not None:
            call = _CallRecord.from_buffer_copy(self._call)  # another thread may be at this one
            call.again = ctypes.addressof(again)
            reference = ctypes.addressof(call)
        if self._late is None:
            addresses = self._packed(*map(_address, given), *map(_address, rooms))
        else:
            starts = map(_address, (*given, *rooms))
            addresses = self._packed(*map(operator.add, starts, self._late))
        if self._rows_and_times < _MANY:
            self._compiled.call(reference, addresses, torch.get_num_threads())
        else:
            with Sign("compiled code"):
                self._compiled.call(reference, addresses, torch.get_num_threads())

    def _as_read(self, leaves: Sequence[Any]) -> Sequence[Any]:
        """Return the inputs as compiled code reads them."""
        given = self._with_columns(leaves) if self._compiled.rows else leaves
        if not self.direct:
            given = [leaf.tensor if type(leaf) is Shared else leaf for leaf in given]
            for k in self._copied:
                given[k] = given[k].to(self._compiled.real).contiguous()
        return given

    def _with_columns(self, leaves: Sequence[Any]) -> list[Any]:
        return [*leaves[: self._once], *columns(self._compiled.rows, self._rows), *leaves[self._once :]]

    def of_states(self, *lead: int) -> Callable[..., Tensor] | None:
        """Return the function of the inputs to the only output of one time, (*lead, ...), where ``lead``
        are the rows, or nothing for a single row without that dimension; None if that is more than a call
        of machine code."""
        if not self.simple or len(self._rooms) != 1:
            return None
        size, _ = self._compiled.outputs[0]
        strides = inner_strides(size, self._rows)
        like = self._without_memory((*lead, *size), (*(1 for _ in lead), *strides))
        packed, call, reference, threads = self._packed, self._compiled.call, self._reference, _threads

        def found(*given: Tensor) -> Tensor:
            room = _empty_like(like)
            call(reference, packed(*map(_address, given), room.data_ptr()), threads())
            return room

        found.plan = self  # type: ignore[attr-defined]  # keeps what the reference leads to
        return found


_address, _threads, _empty_like = Tensor.data_ptr, torch.get_num_threads, torch.empty_like


def inner_strides(shape: Sequence[int], unit: int) -> tuple[int, ...]:
    """The strides of contiguous entries that lie ``unit`` numbers apart."""
    strides = []
    for size in reversed(shape):
        strides.append(unit)
        unit *= size
    return tuple(reversed(strides))


def rows_innermost(
    rows: int, times: tuple[int, ...], shape: Sequence[int]
) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """The shape (rows, *times, *shape) and strides of a tensor in whose memory the rows are innermost."""
    size = torch.Size(shape).numel() * rows
    return (rows, *times, *shape), (1, *[size for _ in times], *inner_strides(shape, rows))


def strides_of(leaf: Any, timed: bool, lies: bool = True) -> tuple[tuple[int, int, int, int], bool]:
    """The strides of an input from row to row, from time to time and from entry to entry, how many entries
    there are, and whether it is read where it lies: if not, these are those of a contiguous copy.

    Where ``timed`` a dimension of times comes first (after the rows); where ``lies``, it is read where it
    lies if its entries lie equally far apart, in their order.
    """
    shared, tensor = type(leaf) is Shared, plain(leaf)
    lead = 1 + timed - shared
    inner, strides = tensor.shape[lead:], tensor.stride()
    longer = [(n, stride) for n, stride in zip(inner, strides[lead:], strict=True) if n > 1]
    lies = lies and all(a[1] == b[0] * b[1] for a, b in itertools.pairwise(longer))
    if not lies:
        strides = inner_strides(tensor.shape, 1)
        longer = [(n, stride) for n, stride in zip(inner, strides[lead:], strict=True) if n > 1]
    row, time, entry = 0 if shared else strides[0], strides[lead - 1] if timed else 0, longer[-1:]
    return (row, time, entry[0][1] if entry else 1, inner.numel()), lies


@functools.cache
def _parallel() -> int | None:
    """The address of what runs a call on several threads, None where there is nothing but this one.

    Threads of our own: those of OpenMP, which torch runs on, spin until the last of them has come, which
    beside other busy processes takes 8 to 60 ms, whatever the call. Where the user binds OpenMP's threads to
    processors, ours would all stand on that of the caller, and OpenMP's serve.
    """
    entry: Any = None
    if not any(os.environ.get(name) for name in _BINDING):
        entry = compiled(Path(__file__).with_name("_threads.cpp"))
    if entry is None:
        with contextlib.suppress(OSError):
            entry = getattr(ctypes.CDLL(torch._C.__file__), "GOMP_parallel", None)
    return None if entry is None else ctypes.cast(entry, ctypes.c_void_p).value


_BINDING = ("OMP_PROC_BIND", "OMP_PLACES", "GOMP_CPU_AFFINITY")

"""Whether tensors are still what they were: written to, or given other memory."""

from __future__ import annotations

import copy
import ctypes
import operator
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..row_numbers import all_rows

_VERSION, _SHAPE = operator.attrgetter("_version"), operator.attrgetter("shape")
_BYTES = operator.methodcaller("tobytes")
_SMALL = 1 << 16  # bytes of a tensor that are compared at every call
_FEW = 64  # numbers of a larger one


def version(tensor: Tensor) -> int:
    """Return a number that is another one once the tensor was written to.

    Torch counts writes, but not those to tensors made in inference mode: of these it is the content.
    """
    tensor = all_rows(tensor)
    return hash(tensor.numpy(force=True).tobytes()) if tensor.is_inference() else tensor._version


class Writes:
    """The state of tensors now, to be compared later.

    Torch counts writes to a tensor, but none to ``tensor.data`` (``target.data.copy_(...)``) or by NumPy,
    nor that ``tensor.data = other`` gives it other memory, as `torch.nn.utils.vector_to_parameters` does. So
    memory of the processor is compared, too: all of it up to 64 kB a tensor and where torch counts nothing,
    64 numbers of a larger one. On a device it is torch's count alone, as looking waits.

    Args:
        tensors: numbers of rows among them.
    """

    def __init__(self, tensors: Sequence[Tensor]) -> None:
        self._tensors = [*map(all_rows, tensors)]
        self._placed = [tensor for tensor in self._tensors if _has_memory(tensor)]
        # Kept, so that other memory cannot come to lie at the same address meanwhile.
        self._memory = [tensor.untyped_storage() for tensor in self._placed]
        self._addresses = [*map(Tensor.data_ptr, self._placed)]
        self._shapes = [*map(_SHAPE, self._tensors)]
        self._views = list[memoryview]()
        self._samples = list[np.ndarray[Any, Any]]()
        for tensor, address in zip(self._placed, self._addresses, strict=True):
            if not tensor.is_cpu:
                continue
            size = tensor.element_size() * (1 + sum(map(_reach, tensor.shape, tensor.stride())))
            begin = tensor.element_size() * tensor.storage_offset()
            there = tensor.untyped_storage().nbytes() - begin  # a storage may have been cut off
            size = int(max(0, min(size, there)))
            memory = memoryview((ctypes.c_char * size).from_address(address))
            if size <= _SMALL or tensor.is_inference():
                self._views.append(memory)
            else:
                width = min(tensor.element_size(), 8)
                self._samples.append(np.frombuffer(memory, f"u{width}")[:: size // (width * _FEW)])
        # Torch also counts what moves no number: `matrix.t_()`.
        self._counted = [tensor for tensor in self._tensors if not tensor.is_inference()]
        self._look()

    def _look(self) -> None:
        self._versions = [*map(_VERSION, self._counted)]
        self._contents = [*map(bytearray, self._views)]  # equal to memory of the same bytes, at once
        self._parts = [*map(_BYTES, self._samples)]

    def again(self) -> Writes:
        """Return how the same tensors are now."""
        same = [*map(Tensor.data_ptr, self._placed)] == self._addresses
        if not same or [*map(_SHAPE, self._tensors)] != self._shapes:
            return Writes(self._tensors)
        now = copy.copy(self)
        now._look()
        return now

    def alike(self, other: Writes) -> bool:
        """Return whether tensors had the shapes that they had at another time."""
        return self._shapes == other._shapes

    def none(self) -> bool:
        """Return whether nothing was written since."""
        return (
            [*map(Tensor.data_ptr, self._placed)] == self._addresses  # first: memory may have been given back
            and self._contents == self._views
            and [*map(_VERSION, self._counted)] == self._versions
            and (not self._samples or [*map(_BYTES, self._samples)] == self._parts)
        )


def _reach(size: int, stride: int) -> int:
    return (size - 1) * stride


def _has_memory(tensor: Tensor) -> bool:
    """Return whether a tensor lies somewhere: sparse ones, those of a transform or a fake mode do not."""
    if tensor.layout is not torch.strided or tensor.is_nested or tensor.is_meta:
        return False
    try:
        return tensor.data_ptr() != 0
    except RuntimeError:
        return False

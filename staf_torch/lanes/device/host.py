"""The host in the place of a device: a kernel built by g++, with loops in the place of its grid.

Everything but the card is what runs on one: dispatch, strides, tables, caches, errors. For tests, and for
whoever wants to see a kernel's numbers without a card; one thread, and slower than what serves the processor.
"""

from __future__ import annotations

import contextlib
import ctypes
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ..calls import inputs
from ..compilation.compiler import library
from ..threads import Mutex

_FOLDER = Path(__file__).parent
_OPTIONS = ("-O1", "-march=native", "-std=c++17", "-shared", "-fPIC", "-w", "-ffp-contract=off")
_BEFORE = """#include <cmath>
using namespace std;
#define __global__
#define __device__ static
#define __constant__ static const
#define __grid_constant__
template <typename T> static inline T __ldg(const T *from) { return *from; }
struct Place { long long x; };
static thread_local Place blockIdx, blockDim, threadIdx;
"""
_AFTER = """
extern "C" void launch(const Call *call, long long blocks, long long threads) {
    blockDim.x = threads;
    for (blockIdx.x = 0; blockIdx.x < blocks; ++blockIdx.x)
        for (threadIdx.x = 0; threadIdx.x < threads; ++threadIdx.x) lanes_kernel(*call);
}
"""
_BLOCK = 32
_kernels: dict[str, Callable[..., None]] = {}
_lock = Mutex()


@contextlib.contextmanager
def host(memory: int = sys.maxsize) -> Iterator[None]:
    """Context: programs take the processor's tensors for those of a device, and run kernels built by g++.

    Example:
        >>> program = lanes.Program(lambda x, now, row: (0.5 * x, x))
        >>> with lanes.device.host():
        ...     program(torch.ones(1), steps=3)[1]
        tensor([[1.0000, 0.5000, 0.2500]])

        Shown by `staf_torch/lanes/DEVICE.md`.

    Of the whole process; what is tested is the way to a CUDA device without one.

    Args:
        memory: bytes that the results of a call may take at once.
    """
    global _memory
    before, inputs.processor, _memory = (inputs.processor, _memory), torch.device("cpu"), memory
    try:
        yield
    finally:
        inputs.processor, _memory = before


@contextlib.contextmanager
def recorded() -> Iterator[list[str]]:
    """Context: as `host`, and yields the texts of all kernels that calls of the block take.

    Example:
        >>> program = lanes.Program(lambda x, now, row: (0.5 * x, x))
        >>> with lanes.device.recorded() as texts:
        ...     end = program(torch.ones(1), steps=3)
        >>> len(texts)
        1

        Shown by `tests/gpu.py`.
    """
    global _taken
    before, _taken = _taken, list[str]()
    try:
        with host():
            yield _taken
    finally:
        _taken = before


@contextlib.contextmanager
def captured() -> Iterator[list[Callable[[], None]]]:
    """Context: as `host` while a graph is recorded, where no number can be read; yields the launches.

    Each is called to run its kernel again, with the arguments of the recording.

    Example:
        >>> program, x = lanes.Program(lambda x, now, row: (0.5 * x, x)), torch.ones(1)
        >>> with lanes.device.captured() as launches:
        ...     end, _ = program(x, steps=3)
        >>> x.fill_(8.0)
        tensor([8.])
        >>> launches[0]()
        >>> end
        tensor([1.])

        Shown by `tests/lanes/test_device.py`.
    """
    global _launches
    before, _launches = _launches, list[Callable[[], None]]()
    try:
        with host():
            yield _launches
    finally:
        _launches = before


def capturing(x: Tensor) -> bool:
    """Return whether no number of a tensor can be read, as what is done with it is recorded for a graph; on
    the meta device there is none."""
    if x.is_cuda:
        return torch.cuda.is_current_stream_capturing()
    if x.is_meta:
        return True
    return x.is_cpu and _launches is not None


_taken: list[str] | None = None
_launches: list[Callable[[], None]] | None = None
_memory = sys.maxsize


class HostDevice:
    """A device whose kernels g++ builds."""

    def compile(self, text: str) -> Callable[..., None]:
        """Return the kernel of a text.

        Raises:
            OSError: if there is no compiler, or it refuses the text.
        """
        with _lock:
            if _taken is not None and text not in _taken:
                _taken.append(text)
            found = _kernels.get(text)
            if found is None:
                path = library("kernel", _BEFORE + text + _AFTER, _OPTIONS, _FOLDER)
                found = ctypes.CDLL(str(path)).launch
                found.restype, found.argtypes = None, (ctypes.c_void_p, ctypes.c_longlong, ctypes.c_longlong)
                _kernels[text] = found
            return found

    def launch(self, kernel: Any, arguments: ctypes.Array[ctypes.c_char], rows: int) -> None:
        """Run a kernel for so many rows."""
        sizes = -(-rows // _BLOCK), _BLOCK
        if _launches is not None:
            copy = ctypes.create_string_buffer(arguments.raw, len(arguments))
            _launches.append(lambda: kernel(ctypes.addressof(copy), *sizes))
        kernel(ctypes.addressof(arguments), *sizes)

    def arguments(self) -> int:
        """Return the bytes that the arguments of a kernel may take: any."""
        return sys.maxsize

    def memory(self) -> int:
        """Return the bytes that results of a call may take."""
        return _memory

    def free(self) -> int:
        """Return the same: what is computed with is not counted."""
        return _memory

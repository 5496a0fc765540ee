"""Memory for a long history."""

from __future__ import annotations

import mmap

import torch
from torch import Tensor

LARGE = 2**22  # bytes from which pages of two megabytes are worth asking for
_HUGE = 2**21


def fresh(like: Tensor, *shape: int) -> Tensor:
    """Return an empty tensor.

    A first write to ordinary pages costs more than the recursion that writes to them (4.8 megabytes took 3.2
    ms, of huge pages .6). The system gives huge ones, if it does, only to memory that begins where such a
    page may begin, and `malloc` does not: large tensors are mappings of their own, given back when the tensor
    goes.

    Args:
        like: dtype and device.
        shape: of the tensor.
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

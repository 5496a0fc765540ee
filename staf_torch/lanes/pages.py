"""Memory for a long history."""

from __future__ import annotations

import ctypes
import functools
import mmap
from collections.abc import Callable

from torch import Tensor

LARGE = 2**22  # bytes from which huge pages are worth asking for
_PAGE = 2**12


@functools.cache
def _advise() -> Callable[..., int] | None:
    try:
        return ctypes.CDLL(None).madvise if hasattr(mmap, "MADV_HUGEPAGE") else None
    except (OSError, AttributeError):
        return None


def fresh(like: Tensor, *shape: int) -> Tensor:
    """An empty tensor. A first write to ordinary pages costs as much as the recursion that writes to them;
    the system is asked for huge ones, which it may give or not."""
    tensor = like.detach().new_empty(shape)
    size, advise = tensor.numel() * tensor.element_size(), _advise()
    if tensor.device.type == "cpu" and size >= LARGE and advise is not None:
        first = -(-tensor.data_ptr() // _PAGE) * _PAGE
        last = (tensor.data_ptr() + size) // _PAGE * _PAGE
        advise(ctypes.c_void_p(first), ctypes.c_size_t(last - first), mmap.MADV_HUGEPAGE)
    return tensor

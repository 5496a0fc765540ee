"""Blocks of rows on threads of their own.

Inside an operation torch splits the work and waits at a barrier, some forty times a piece; where another
program holds a core for a moment, every barrier waits for it. Rows need no barrier: each thread here takes
whole blocks of them, and what torch does inside a block stays on that thread.
"""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from types import TracebackType
from typing import Any

import torch
from torch.overrides import _len_torch_function_stack
from torch.utils._python_dispatch import _len_torch_dispatch_stack


@functools.cache
def openmp(name: str) -> Callable[..., None] | None:
    """A function of the OpenMP runtime that torch itself runs on; None where there is none."""
    try:
        return getattr(ctypes.CDLL(torch._C.__file__), name, None)
    except OSError:
        return None


def thread_count() -> int:
    """Threads for rows: torch's own number, 1 where something that is bound to this thread is at work."""
    modes = _len_torch_function_stack() + _len_torch_dispatch_stack()
    bound = modes > 0 or torch._C._functorch.maybe_current_level() is not None
    return 1 if bound or openmp("omp_set_num_threads") is None else torch.get_num_threads()


class Workers:
    """A pool of ``count`` threads whose torch operations run on the thread itself; 1 is the caller's own."""

    def __init__(self, count: int) -> None:
        self._pool = ThreadPoolExecutor(count, "staf", _alone) if count > 1 else None

    def map(self, function: Callable[..., Any], *arguments: Iterable[Any]) -> list[Any]:
        """`list(map(function, *arguments))`, in the gradient mode of the caller."""
        if self._pool is None:
            return list(map(function, *arguments))
        gradients = torch.is_grad_enabled()

        def work(*given: Any) -> Any:
            with torch.set_grad_enabled(gradients):
                return function(*given)

        return list(self._pool.map(work, *arguments))

    def __enter__(self) -> Workers:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)


def _alone() -> None:
    torch.get_num_threads()  # torch sets a new thread's number when it first asks for it
    set_threads = openmp("omp_set_num_threads")  # of the calling thread alone
    assert set_threads is not None
    set_threads(1)

"""Small operations of torch in one thread, where torch would take several."""

from __future__ import annotations

import contextlib
import ctypes
import functools
from collections.abc import Iterator
from typing import Any

import torch

ENTRIES = 512
"""Entries that a row of a program is taken to have, the most in an operation."""
_GRAIN = 32768  # entries from which torch itself takes a second thread for an operation entry by entry


@contextlib.contextmanager
def alone(entries: int) -> Iterator[None]:
    """Context: what this thread asks of torch takes one thread; nothing changes for other threads.

    `torch.linalg.matrix_exp` of two matrices 3 x 3 wakes all threads of OpenMP, which spin until the last has
    come: 8 ms in place of .1 beside other busy processes. The number is OpenMP's for the thread that sets it;
    `torch.set_num_threads` would change it for later threads, too.

    Args:
        entries: of the tensors; from `_GRAIN` on nothing changes.
    """
    openmp = None if entries >= _GRAIN or torch.compiler.is_compiling() else _openmp()
    if openmp is None or (before := openmp.omp_get_max_threads()) == 1:
        yield
        return
    openmp.omp_set_num_threads(1)
    try:
        yield
    finally:
        openmp.omp_set_num_threads(before)


@functools.cache
def _openmp() -> Any:
    """The OpenMP that torch runs on, None where it is another one."""
    with contextlib.suppress(OSError):
        library = ctypes.PyDLL(torch._C.__file__)
        if hasattr(library, "omp_set_num_threads") and hasattr(library, "omp_get_max_threads"):
            return library
    return None

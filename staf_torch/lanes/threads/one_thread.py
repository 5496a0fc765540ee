"""Small operations of torch in one thread, where torch would take several."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import importlib
from collections.abc import Callable, Iterator
from typing import Any, ParamSpec, TypeVar

import torch

_P = ParamSpec("_P")
_R = TypeVar("_R")
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
    mkl = _mkl()
    openmp.omp_set_num_threads(1)
    own = 0 if mkl is None else mkl(1)  # which `torch.set_num_threads` has told a number, too
    try:
        yield
    finally:
        openmp.omp_set_num_threads(before)
        if mkl is not None:
            mkl(own)


def small(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Decorate a function whose operations are all small, as those of a design: it takes one thread."""

    @functools.wraps(function)
    def in_one(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        with alone(0):
            return function(*args, **kwargs)

    return in_one


def small_in_scipy(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Decorate a function of `scipy.linalg` that small matrices are given to: OpenBLAS takes one thread.

    A Riccati equation of two states takes 1.2 ms so, 8 where other threads are woken for each product.
    The number is that of the whole process, for as long as the call takes.
    """

    @functools.wraps(function)
    def in_one(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        blas = _openblas()
        if blas is None or (before := blas.scipy_openblas_get_num_threads()) == 1:
            return function(*args, **kwargs)
        blas.scipy_openblas_set_num_threads(1)
        try:
            return function(*args, **kwargs)
        finally:
            blas.scipy_openblas_set_num_threads(before)

    return in_one


@functools.cache
def _openblas() -> Any:
    """The OpenBLAS that comes with SciPy, None where it runs on another library."""
    with contextlib.suppress(OSError, ImportError):
        library = ctypes.PyDLL(importlib.import_module("scipy.linalg._fblas").__file__)
        if hasattr(library, "scipy_openblas_set_num_threads"):
            return library
    return None


@functools.cache
def _mkl() -> Any:
    """The function of torch's MKL that sets the threads of the calling thread, and returns what was set."""
    return getattr(_openmp(), "MKL_Set_Num_Threads_Local", None)


@functools.cache
def _openmp() -> Any:
    """The OpenMP that torch runs on, None where it is another one."""
    with contextlib.suppress(OSError):
        library = ctypes.PyDLL(torch._C.__file__)
        if hasattr(library, "omp_set_num_threads") and hasattr(library, "omp_get_max_threads"):
            return library
    return None

"""Threads: locks of objects that they share, and small operations of torch that take one of them.

A lock is whole in a child process, and no part of a pickle or a copy.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import importlib
import os
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from typing import Any, ParamSpec, TypeVar

import torch

from .dependencies.walk import Derived

_P = ParamSpec("_P")
_R = TypeVar("_R")
ENTRIES = 512
"""Entries that a row of a program is taken to have, the most in an operation."""
_GRAIN = 32768  # entries from which torch itself takes a second thread for an operation entry by entry
Some = TypeVar("Some")


class Mutex(Derived):
    """Reentrant lock that is free in a child of a fork, whoever held it, and new in a copy of its owner."""

    def __init__(self) -> None:
        self._renew()
        _alive[id(self)] = self

    def _renew(self) -> None:
        self._lock = threading.RLock()

    def __enter__(self) -> None:
        self._lock.acquire()

    def __exit__(self, *_: object) -> None:
        self._lock.release()

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), ()


class ReadWriteLock(Mutex):
    """Lock that any number of readers hold at once, or one writer alone.

    A reader puts itself on a list, two operations of a dictionary, and waits for nobody but a writer that is
    at work. A writer takes the mutex, says so, and waits for the readers on the list; new ones wait for the
    mutex meanwhile. A fork waits for writers: its child has what they wrote whole.
    """

    def _renew(self) -> None:
        super()._renew()
        self._readers: dict[object, int] = {}  # and their threads
        self._writing = False

    def read(self, function: Callable[..., Some], *given: Any) -> Some:
        """Return function(*given) while nobody writes; who reads may read again, but not write."""
        reader = object()
        try:  # begins before the entry, and an interrupt leaves none behind
            self._readers[reader] = thread = threading.get_ident()
            if not self._writing or [*self._readers.values()].count(thread) > 1:
                return function(*given)  # nobody writes, or waits until this thread has read
        finally:
            self._readers.pop(reader, None)
        with self._lock:
            return function(*given)

    def write(self, function: Callable[..., Some], *given: Any) -> Some:
        """Return function(*given) while nobody else reads or writes."""
        with self._lock:
            before = self._writing
            try:
                self._writing = True
                while self._readers:
                    time.sleep(0)  # they come to an end: a new one waits
                return function(*given)
            finally:
                self._writing = before


_alive: weakref.WeakValueDictionary[int, Mutex] = weakref.WeakValueDictionary()
_held: list[ReadWriteLock] = []  # by the thread that forks


def _locks() -> list[Mutex]:
    found = (reference() for reference in _alive.valuerefs())
    return [lock for lock in found if lock is not None]


def _before_fork() -> None:
    for lock in _locks():
        if isinstance(lock, ReadWriteLock):
            lock.__enter__()
            _held.append(lock)


def _after_in_parent() -> None:
    while _held:
        _held.pop().__exit__()


def _after_in_child() -> None:
    _held.clear()
    for lock in _locks():
        lock._renew()


if hasattr(os, "register_at_fork"):  # nowhere else do processes fork
    os.register_at_fork(before=_before_fork, after_in_parent=_after_in_parent, after_in_child=_after_in_child)


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

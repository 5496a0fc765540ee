"""Locks of objects that threads share: whole in a child process, and no part of a pickle or a copy."""

from __future__ import annotations

import os
import threading
import time
import weakref
from collections.abc import Callable
from typing import Any, TypeVar

from ..dependencies.contents import Derived

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

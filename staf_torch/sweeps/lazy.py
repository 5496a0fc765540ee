"""Sequences whose entries are made when they are asked for: a sweep has up to a million jobs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar, overload

T = TypeVar("T")


class Lazy(Sequence[T]):
    """A function of every index as a sequence; slices are lists.

    Args:
        count: of the entries.
        make: makes the entry of an index, each time that it is asked for.
    """

    def __init__(self, count: int, make: Callable[[int], T]) -> None:
        self._indices, self._make = range(count), make

    def __len__(self) -> int:
        return len(self._indices)

    @overload
    def __getitem__(self, index: int) -> T: ...

    @overload
    def __getitem__(self, index: slice) -> list[T]: ...

    def __getitem__(self, index: int | slice) -> T | list[T]:
        if isinstance(index, slice):
            return [self._make(i) for i in self._indices[index]]
        return self._make(self._indices[index])

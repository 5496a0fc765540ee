"""Jobs whose objects differ in numbers alone as one call, with a row of numbers each."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch

from ..lanes.contents import Contents
from ..lanes.row_numbers import some_rows
from ..lanes.row_objects import merged
from ..results.files import grouped

_log = logging.getLogger(__name__)
_REFUSALS = (ValueError, TypeError, NotImplementedError, RuntimeError)
"""What objects raise that do not serve numbers of a row's own."""

Objects = tuple[Any, ...]
Call = Callable[[Sequence[int], Any, "RowsOfJobs"], None]


class RowsOfJobs:
    """The rows of a call, each with the numbers of its job.

    Args:
        kinds: of each job, the row of the numbers of its objects.
        counts: rows of each job.

    Attributes:
        differ: whether jobs have numbers of their own.
    """

    def __init__(self, kinds: Sequence[int], counts: Sequence[int]) -> None:
        self.differ = len(set(kinds)) > 1
        kind, count = (torch.tensor(each, dtype=torch.int64, device="cpu") for each in (kinds, counts))
        self._kind = kind.repeat_interleave(count)

    def of(self, rows: slice = slice(None)) -> contextlib.AbstractContextManager[None]:
        """Batches of the block hold these rows of the call."""
        return some_rows(self._kind[rows]) if self.differ else contextlib.nullcontext()


class ToldOnce:
    """Progress of calls, of which one that fails is made again in parts: nothing is told twice.

    Args:
        advance: is told how much more is done; None where nobody listens.
    """

    def __init__(self, advance: Callable[[int], None] | None) -> None:
        self._advance, self._ahead = advance, 0  # told by calls that failed

    @contextlib.contextmanager
    def call(self) -> Iterator[Callable[[int], None]]:
        """Yield what is told of a call's progress within the block."""
        told = 0

        def tell(count: int) -> None:
            nonlocal told
            told += count
            known = min(self._ahead, count)
            self._ahead -= known
            if self._advance is not None and count > known:
                self._advance(count - known)

        try:
            yield tell
        except BaseException:
            self._ahead += told
            raise


def in_calls(objects: Sequence[Objects], counts: Sequence[int], call: Call, *, apart: bool = False) -> None:
    """Make a call for each set of jobs whose objects differ in numbers alone.

    Where objects differ in more they are of several sets, and where a call refuses numbers of a row's own, as
    not all objects serve them, its jobs run one after the other: those of the same objects together.

    Args:
        objects: of each job; the same object for jobs that share it.
        counts: rows of each job.
        call: gets the jobs of a set by number, the objects that have the numbers of all, and their rows.
        apart: whether jobs of other objects never share a call.
    """
    same = grouped(range(len(objects)), lambda i: tuple(map(id, objects[i])))
    distinct = [objects[jobs[0]] for jobs in same.values()]

    def made(jobs: Sequence[int], found: Objects, kinds: Sequence[int]) -> None:
        call(jobs, found, RowsOfJobs(kinds, [counts[i] for i in jobs]))

    for some, joined in [([each], None) for each in distinct] if apart else _sets(distinct):
        each = [same[tuple(map(id, parts))] for parts in some]
        try:
            if joined is not None:
                kinds = [k for k, jobs in enumerate(each) for _ in jobs]
                made([i for jobs in each for i in jobs], joined, kinds)
                continue
        except _REFUSALS as error:
            _log.debug("%d jobs run one after the other: %s", len(some), error)
        for parts, jobs in zip(some, each, strict=True):
            made(jobs, parts, [0] * len(jobs))


def _sets(objects: Sequence[Objects]) -> list[tuple[Sequence[Objects], Objects | None]]:
    """Return the objects in sets, with those that have the numbers of all of a set; None of one alone."""
    if len(objects) == 1:
        return [(objects, None)]
    try:
        return [(objects, merged(objects))]
    except ValueError:  # they differ in more than numbers
        keys = [Contents(*each, telling=True).key for each in objects]
    sets = grouped(range(len(objects)), lambda i: (i,) if keys[i] is None else keys[i])
    if len(sets) == 1:
        return [([each], None) for each in objects]
    return [found for some in sets.values() for found in _sets([objects[i] for i in some])]

"""Jobs whose objects differ in numbers alone as one call, with a row of numbers each."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Hashable, Iterator, Sequence
from typing import Any, NamedTuple, TypeVar

import torch

from ..lanes.dependencies.contents import Contents
from ..lanes.per_row.objects import merged
from ..lanes.row_numbers import some_rows
from ..results.files import grouped

_log = logging.getLogger(__name__)
_REFUSALS = (ValueError, TypeError, NotImplementedError, RuntimeError)
"""What objects raise that do not serve numbers of a row's own."""

Objects = tuple[Any, ...]
R = TypeVar("R")
Advance = Callable[[int], None]


class RowsOfJobs:
    """The rows of a call, each with the numbers of its job.

    ``kinds`` has the row of numbers of each job, ``counts`` its rows; `differ` says whether jobs have numbers
    of their own.
    """

    def __init__(self, kinds: Sequence[int], counts: Sequence[int]) -> None:
        self.differ = len(set(kinds)) > 1
        kind, count = (torch.tensor(each, dtype=torch.int64, device="cpu") for each in (kinds, counts))
        self._kind = kind.repeat_interleave(count)

    def of(self, rows: slice = slice(None)) -> contextlib.AbstractContextManager[None]:
        """Batches of the block hold these rows of the call."""
        return some_rows(self._kind[rows]) if self.differ else contextlib.nullcontext()


class ToldOnce:
    """Progress of calls, of which one that fails is made again in parts: nothing is told twice."""

    def __init__(self, advance: Advance | None) -> None:
        self._advance, self._ahead = advance, 0  # told by calls that failed

    @contextlib.contextmanager
    def call(self) -> Iterator[Advance]:
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


class _Set(NamedTuple):
    """Jobs of one call."""

    jobs: list[int]
    objects: Objects  # with the numbers of all of them
    kinds: list[int]  # of each job, the row of its numbers
    alone: list[_Set]  # the calls in place of this one where it refuses numbers of a row's own


def in_calls(
    call: Callable[[Sequence[int], Any, RowsOfJobs, Advance | None], Sequence[R]],
    objects: Sequence[Objects],
    counts: Sequence[int],
    alike: Sequence[Hashable],
    advance: Advance | None = None,
) -> list[R]:
    """Return the results of jobs, of which those whose objects differ in numbers alone share a call.

    Where objects differ in more there are several calls, and where one refuses numbers of a row's own, as not
    all objects serve them, its jobs run one after the other: those of the same objects together.

    Args:
        call: gets the jobs by number, the objects that have the numbers of all, their rows, and `advance`.
        objects: of each job; the same object for jobs that share it.
        counts: rows of each job.
        alike: what jobs must have in common to share a call.
        advance: is told how much more is done; None where nobody listens.
    """
    found: dict[int, R] = {}
    told = ToldOnce(advance)
    groups = grouped(range(len(objects)), lambda i: alike[i]).values()
    waiting = [each for jobs in groups for each in _sets(jobs, objects)]
    while waiting:
        some = waiting.pop(0)
        rows = RowsOfJobs(some.kinds, [counts[i] for i in some.jobs])
        try:
            with told.call() as tell:
                results = call(some.jobs, some.objects, rows, None if advance is None else tell)
        except _REFUSALS as error:
            if not some.alone:
                raise
            _log.debug("%d jobs run one after the other: %s", len(some.alone), error)
            waiting[:0] = some.alone
        else:
            found.update(zip(some.jobs, results, strict=True))
    return [found[i] for i in range(len(objects))]


def _sets(jobs: Sequence[int], objects: Sequence[Objects]) -> list[_Set]:
    """Return the calls of jobs, in which objects are merged that differ in numbers alone."""
    same = grouped(jobs, lambda i: tuple(map(id, objects[i]))).values()
    return _joined([_Set(each, objects[each[0]], [0] * len(each), []) for each in same])


def _joined(alone: list[_Set]) -> list[_Set]:
    """Return calls of distinct objects as one, or as a few where objects differ in more than numbers."""
    if len(alone) == 1:
        return alone
    try:
        merged_objects = merged([each.objects for each in alone])
    except ValueError:  # they differ in more than numbers
        keys = [Contents(*each.objects, telling=True).key for each in alone]
        sets = grouped(range(len(alone)), lambda i: (i,) if keys[i] is None else keys[i]).values()
        if len(sets) == 1:
            return alone
        return [each for some in sets for each in _joined([alone[i] for i in some])]
    kinds = [kind for kind, each in enumerate(alone) for _ in each.jobs]
    return [_Set([job for each in alone for job in each.jobs], merged_objects, kinds, alone)]

"""The carry before every time, that a gradient needs: where results have it, it is read there.

The states of a trajectory and the weights of a chase are results and carry at once. What no result has is
written beside them. Results may be written over before the backward pass, which then computes it again.

Sums over rows in a fixed order, and the tensors in which an adjoint leaves what it finds.

Rows are summed by 64 and halves first, and then these sums by halves: the bits depend on the number of rows
alone.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from ..calls.planned_call import Compiled, fresh, rows_innermost
from ..trace.graph import Graph, Sizes
from ..tree import Shared

if TYPE_CHECKING:
    from ..texts import Trace

Watched = tuple[Tensor, int]
SAME, BEFORE, AFTER, NOWHERE = "same", "before", "after", "nowhere"
"""Where the numbers of a leaf before a step are: in the first carry, in an output of that time, in an output
of the time before, in the carry alone."""


def carried(
    graph: Graph, layout: Sizes, following: Sequence[int], outputs: Sequence[int]
) -> tuple[tuple[str, int], ...]:
    """Return where the numbers of each leaf of the carry of a traced program are, and in which output."""
    made = parts(outputs, layout.outputs)
    found = []
    for k, after in enumerate(parts(following, layout.carries)):

        def before(nodes: Sequence[int], k: int = k, size: int = len(after)) -> bool:
            inputs = [("state", (k, entry)) for entry in range(size)]
            return [(graph.op[node], graph.aux[node]) for node in nodes] == inputs

        met = (
            (BEFORE if before(nodes) else AFTER, j)
            for j, nodes in enumerate(made)
            if nodes == after or before(nodes)
        )
        found.append((SAME, 0) if before(after) else next(met, (NOWHERE, 0)))
    return tuple(found)


def parts(nodes: Sequence[int], sizes: Sequence[int]) -> list[list[int]]:
    """Return the nodes of each leaf, of those of all leaves and the ``sizes`` of each, in entries."""
    ends = itertools.accumulate(sizes, initial=0)
    return [[*nodes[a:b]] for a, b in itertools.pairwise(ends)]


def in_results(trace: Trace, results: int) -> frozenset[int]:
    """Return the leaves of the carry that never change, or that so many results have at all times."""
    pairs = enumerate(trace.carried)
    return frozenset(k for k, (where, j) in pairs if where == SAME or (where != NOWHERE and j < results))


class Rooms(NamedTuple):
    """Tensors of a forward pass, of the dtype of its program."""

    all: list[Tensor]  # that are written to; without memory where a carry is not wanted
    results: list[Tensor]  # those that are returned: the carry after the last time, and the results
    before: list[Tensor]  # the carry before every time, once written; of no meaning for leaves not kept
    watched: list[Watched]  # results that are part of it, without memory, and the writes torch has counted


class Keeping:
    """Recipe of the tensors of calls that keep the carry, on the processor.

    The outputs of ``compiled`` are the ``results``, or these and the carry before a step; ``keeps`` are the
    leaves of the carry that are wanted.
    """

    def __init__(
        self, compiled: Compiled, trace: Trace, keeps: frozenset[int], results: int, sizes: tuple[int, int]
    ) -> None:
        rows, times = sizes
        self._like, self._rows, self._times = torch.empty(0, dtype=compiled.real, device="cpu"), rows, times
        self._ends = [rows_innermost(rows, (), shape) for shape, _ in compiled.carry]
        places = [where if k in keeps else (NOWHERE, 0) for k, where in enumerate(trace.carried)]
        late = {j for where, j in places if where == AFTER}
        self._read = sorted({j for where, j in places if where not in (SAME, NOWHERE)})
        self._late = [k for k, (where, _) in enumerate(places) if where == AFTER]
        self._same = [k for k, (where, _) in enumerate(places) if where == SAME]
        self._made = dict[
            int, tuple[int, int, Sequence[int], Sequence[int]]
        ]()  # numbers, offset, shape, strides
        self._unwanted = dict[int, Tensor]()
        for j, (shape, _) in enumerate(compiled.outputs):
            if j < results or j in self._read:
                size = shape.numel() * rows
                more = size * (j in late)
                self._made[j] = size * times + more, more, *rows_innermost(rows, (times,), shape)
            else:
                self._unwanted[j] = self._like.new_empty((0, times, *shape))
        self._results = len(compiled.carry) + results
        self._before = list[tuple[int, Sequence[int], Sequence[int]] | Tensor]()
        for (shape, _), (where, j) in zip(compiled.carry, places, strict=True):
            if where in (SAME, NOWHERE):
                self._before.append(self._like.new_zeros(()).expand(rows, times, *shape))
            else:
                self._before.append((j, *rows_innermost(rows, (times,), shape)))

    def __call__(self, carry: Sequence[Tensor]) -> Rooms:
        """Return new tensors for a call with this carry before the first time."""
        like, memory, made = self._like, dict[int, Tensor](), dict[int, Tensor]()
        for j, (size, *form) in self._made.items():
            memory[j] = fresh(like, size)
            # No view of another tensor: torch would not let users write to it.
            made[j] = like.new_empty(0).set_(memory[j].untyped_storage(), *form)
        before = [
            form if isinstance(form, Tensor) else memory[form[0]].as_strided(*form[1:])
            for form in self._before
        ]
        for k in self._late:
            before[k][:, 0] = carry[k]
        for k in self._same:
            first = empty_rows(like, self._rows, (), carry[k].shape[1:]).copy_(carry[k])
            before[k] = first.unsqueeze(1).expand(before[k].shape)
        ends = [like.new_empty_strided(*form) for form in self._ends]
        outputs = made | self._unwanted
        rooms = [*ends, *(outputs[j] for j in range(len(outputs)))]
        results = rooms[: self._results]
        watched = [_watched(made[j]) for j in self._read if j < self._results - len(ends)]
        return Rooms(rooms, results, before, watched)


def unchanged(watched: Sequence[Watched]) -> bool:
    """Return whether nobody has written over results since."""
    return all(tensor._version == version for tensor, version in watched)


def _watched(result: Tensor) -> Watched:
    """Return an empty tensor that shares the count of writes to a result, and that count."""
    same = result.detach()
    same.data = result.new_empty(0)
    return same, same._version


UNIT = 64
"""Rows that are summed first, whatever the threads."""


class AtTimes:
    """Gradients by what times bring, put together of blocks of rows and times."""

    def __init__(self, leaves: Sequence[Any], rows: int, times: int, like: Tensor) -> None:
        self.leaves, self.like = leaves, like
        self._found: list[Tensor] = []
        for leaf in leaves:
            shared = isinstance(leaf, Shared)
            shape, count = leaf.tensor.shape[1:] if shared else leaf.shape[2:], -(-rows // UNIT)
            self._found.append(empty_rows(like, count if shared else rows, (times,), shape))

    def rooms(self, rows: slice, times: slice) -> list[Tensor]:
        """Return where those of a block are written to."""
        count, length = rows.stop - rows.start, times.stop - times.start
        return [
            empty_rows(self.like, count, (length,), leaf.tensor.shape[1:])
            if isinstance(leaf, Shared)
            else found[rows, times]
            for leaf, found in zip(self.leaves, self._found, strict=True)
        ]

    def put(self, rows: slice, times: slice, slopes: Sequence[Tensor]) -> None:
        """Add those of a block, (rows, times, ...), that are not in their place."""
        for leaf, slope, found in zip(self.leaves, slopes, self._found, strict=True):
            if isinstance(leaf, Shared):
                found[rows.start // UNIT : -(-rows.stop // UNIT), times] = by_units(slope)
            elif slope.data_ptr() != found[rows, times].data_ptr():
                found[rows, times] = slope

    def joined(self) -> list[Tensor]:
        """Return those of all rows and times."""
        pairs = zip(self.leaves, self._found, strict=True)
        return [
            halved(x, 0).to(of.tensor.dtype) if isinstance(of, Shared) else x.to(of.dtype) for of, x in pairs
        ]


def empty_rows(like: Tensor, rows: int, times: tuple[int, ...], shape: Sequence[int]) -> Tensor:
    """Return an empty tensor (rows, *times, *shape) in whose memory the rows are innermost."""
    size = torch.Size(shape).numel() * rows
    return fresh(like, *times, size).as_strided(*rows_innermost(rows, times, shape))


def by_units(x: Tensor) -> Tensor:
    """Sums over 64 rows each."""
    missing = -len(x) % UNIT
    if missing:
        x = torch.cat((x, x.new_zeros((missing, *x.shape[1:]))))
    return halved(x.unflatten(0, (-1, UNIT)), 1)


def halved(x: Tensor, dim: int) -> Tensor:
    """The sum over a dimension by halves: the same bits on any number of threads."""
    while (count := x.shape[dim]) > 1:
        half = count // 2
        both = x.narrow(dim, 0, half) + x.narrow(dim, half, half)
        x = torch.cat((both, x.narrow(dim, 2 * half, 1)), dim) if count % 2 else both
    return x.squeeze(dim)


def joined(parts: Sequence[Tensor]) -> Tensor:
    return parts[0] if len(parts) == 1 else torch.cat([*parts])


def split(leaves: Sequence[Any], sizes: Sequence[int]) -> list[list[Any]]:
    """Return consecutive parts of these sizes."""
    rest = iter(leaves)
    return [[next(rest) for _ in range(size)] for size in sizes]


def part(x: Tensor, rows: slice) -> Tensor:
    """Return some rows, the tensor itself where these are all."""
    return x if rows.stop - rows.start == len(x) else x[rows]

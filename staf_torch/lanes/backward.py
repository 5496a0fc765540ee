"""The backward pass of a program: blocks of rows, each from the last time to the first.

The adjoint needs the carry before every step. If the forward pass has not kept it, it is computed again: on
the CPU within the adjoint, of the few rows that it takes at once (`_driver.hpp`), elsewhere of all rows
before; and where that goes beyond the budget, the carries of some times first and then those between them.
Sums over rows are taken of 64 rows each by halves, and of these sums by halves: the order depends on the
number of rows alone.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from .adjoint_steps import Deciding, Differentiated, ReversedStep, Substituted, adjoint_step, deciding
from .call import fresh, inner_strides
from .given import Given
from .row_independence import undrawn
from .trace.captured_tensors import TableSlopes
from .trace.step import Step
from .tree import Shared, flatten, plain

if TYPE_CHECKING:
    from .adjoint import Ran
    from .program import Program

_UNIT = 64  # rows that are summed first, whatever the threads
_ROWS = 32  # that the adjoint takes at once, at most


class Backward:
    """The backward pass of one call.

    Args:
        ran: the call.
        tensors: inputs, captured tensors, columns of rows' numbers.
        needs: which of them have a gradient.
        ends: gradients by the carry and the outputs, None where there are none.

    Attributes:
        built: of the adjoint; None where there is none.
        slopes: by the carry before the first time, with the places of its leaves; none before `run`.
    """

    def __init__(
        self, ran: Ran, tensors: Sequence[Tensor], needs: Sequence[bool], ends: Sequence[Tensor | None]
    ) -> None:
        call = ran.call
        self._ran, self._call = ran, call
        self.slopes: list[tuple[int, Tensor]] = []
        sizes = (*call.sizes, len(ran.captured), len(ran.numbers))
        given = call.given(tensors[: sum(call.sizes)])
        self._row, self._now, self._carry = given.row, given.now, given.carry
        *_, self._captured, self._own = split(tensors, sizes)
        self._of_row, self._of_now, self._of_carry, of_captured, of_own = split(needs, sizes)
        self._of_captured = [k for k, need in enumerate(of_captured) if need]
        self._of_own = [k for k, need in enumerate(of_own) if need]
        self._end, self._ends = [*ends[: call.sizes[2]]], [*ends[call.sizes[2] :]]
        carry, usual = self._deciding()
        self._form = Differentiated(
            carry=carry,
            now=tuple(self._of_now),
            shared=tuple(isinstance(leaf, Shared) for leaf in self._now),
            row=tuple(self._of_row),
            captured=tuple(ran.order[id(ran.captured[k])] for k in self._of_captured),
            numbers=tuple(self._of_own),
            outputs=tuple(end is not None for end in self._ends),
        )
        # What sums over times are by, and whether all rows share it.
        summed = [
            (plain(x), isinstance(x, Shared)) for x, w in zip(self._row, self._of_row, strict=True) if w
        ]
        own = [(self._own[k], False) for k in self._of_own]
        self._table = self._slopes_of_table() if usual else None
        self._runs = None if self._table is None else self._table.runs
        self._summed: list[tuple[Tensor, bool]] = []
        if self._runs is not None:
            like = torch.empty(0, dtype=ran.built.compiled.real, device="cpu")
            self._summed = [*summed, *((like.new_empty(size), True) for _, size in self._runs), *own]
            self._build()
            self._runs = None if self.built is None else self._runs
        if self._runs is None:
            self._summed = [*summed, *((self._captured[k], True) for k in self._of_captured), *own]
            self._build()
        # Leaves of the carry that the adjoint reads: what comes at a time begins with them.
        times = () if self.built is None else self.built.trace.times
        self._needed = {k for k in times if k < len(self._carry)}
        call.needed.update(self._needed)
        used = [] if self.built is None else self.built.compiled.rows
        places = {id(numbers): k for k, numbers in enumerate(ran.numbers)}
        self._read = [self._own[places[id(numbers)]] for numbers in used]

    def _slopes_of_table(self) -> TableSlopes | None:
        """What finds slopes by captured tensors from those by numbers of the table; None without."""
        trace, wanted = self._ran.built.trace, tuple(self._ran.found[k] for k in self._of_captured)
        known = self._call.tables.get((id(trace.recipe.operations), wanted))
        if known is None and trace.recipe.repeats:
            known = TableSlopes(trace.recipe, [trace.recipe.found[k] for k in wanted])
            self._call.tables = {(id(trace.recipe.operations), wanted): known}  # keeps these alive
        return known

    def _build(self) -> None:
        """Build the adjoint: of single numbers, or by `torch.func.vjp`."""
        call, ran, runs = self._call, self._ran, self._runs
        self._structures: dict[str, Any] = {}
        few = slice(0, min(call.rows, _UNIT))
        begin = [leaf[few] for leaf in self._carry]
        given = self._given(few, slice(0, 1), self._slopes(few), [leaf.unsqueeze(1) for leaf in begin], None)
        self._on_processor = given.ordinary() is True
        kind = ("adjoint" if runs is None else "reverse"), self._form, *(runs or ())
        program = call.program.follower(kind, self._step, follows=ran.built.followed)
        self.built = program.built(given)

    def _deciding(self) -> Deciding:
        """What the adjoint depends on."""
        ends, outputs = ([end is not None for end in each] for each in (self._end, self._ends))
        known = self._call.deciding.get((*ends, *outputs))
        if known is None:
            try:
                own = [x[0].detach().requires_grad_(x.is_floating_point()) for x in self._own]
                others: dict[int, Tensor] = dict(zip(map(id, self._ran.numbers), own, strict=True))
                with Substituted(others), undrawn():
                    known = deciding(self._call.program.step, self._one(), own, ends, outputs)
            except Exception:  # of a step that is tried otherwise than it runs
                forms = self._ran.built.compiled.carry
                known = Deciding(tuple(dtype.is_floating_point for _, dtype in forms), usual=False)
            self._call.deciding[(*ends, *outputs)] = known
        return known

    def _one(self) -> Given:
        """Return one row and one time."""
        row = self._some(self._row, slice(0, 1), None)
        now = self._some(self._now, slice(0, 1), slice(0, 1))
        return Given([x[:1] for x in self._carry], now, row, self._call.structures, 1, 1)

    def _step(self, program: Program) -> Step:
        """Return the adjoint of a program's step: of the call's, or of that which it follows."""
        trace = self._ran.built.trace
        if self._runs is not None:
            one = self._one()
            carry, now, row = ([_copied(x) for x in part] for part in (one.carry, one.now, one.row))
            given = Given(carry, now, row, one.structures, 1, 1)
            return ReversedStep(program.step, given, self._form, tuple(self._runs))
        found = [program.in_place_of(trace.recipe.found[self._ran.found[k]]) for k in self._of_captured]
        numbers = [program.in_place_of(trace.rows[k]) for k in self._of_own]
        return adjoint_step(program.step, self._call.structures, self._form, found, numbers)

    def run(self, kept: Sequence[Tensor]) -> list[Tensor | None]:
        """Return the gradients by all tensors.

        Args:
            kept: the carry before every time, if the forward pass has kept it.
        """
        if not self._needed.issubset(self._ran.keeps):
            kept = []
        call, (rows, times) = self._call, self._blocks(bool(kept))
        slopes, sums = list[list[Tensor]](), list[list[Tensor]]()
        at_times = _AtTimes(
            [x for x, need in zip(self._now, self._of_now, strict=True) if need],
            call.rows,
            call.times,
            torch.empty(0, dtype=self._ran.built.compiled.real, device=self._device),
        )
        for start in range(0, call.rows, rows):
            block = slice(start, min(start + rows, call.rows))
            after, total = self._block(block, times, kept, at_times)
            slopes.append(after)
            pairs = zip(total, self._summed, strict=True)
            sums.append([_units(x) if shared else x for x, (_, shared) in pairs])
        carried = [_joined(parts) for parts in zip(*slopes, strict=True)]
        places = [k for k, decides in enumerate(self._form.carry) if decides]
        self.slopes = [*zip(places, carried, strict=True)]
        return self._sorted(
            carried,
            [_joined(parts) for parts in zip(*sums, strict=True)],
            at_times.joined(),
        )

    def _sorted(
        self, slopes: Sequence[Tensor], sums: Sequence[Tensor], at_times: Sequence[Tensor]
    ) -> list[Tensor | None]:
        """Gradients in the order of the tensors."""
        pairs = zip(sums, self._summed, strict=True)
        totals = iter([_halved(x, 0).to(of.dtype) if shared else x.to(of.dtype) for x, (of, shared) in pairs])
        times, carries = iter(at_times), iter(slopes)
        row = [next(totals) if need else None for need in self._of_row]
        now = [next(times) if need else None for need in self._of_now]
        each = [next(carries) if decides else None for decides in self._form.carry]
        carry = [x if need else None for x, need in zip(each, self._of_carry, strict=True)]
        of_captured = iter(self._by_captured(totals))
        captured = [next(of_captured) if k in self._of_captured else None for k in range(len(self._captured))]
        return [*row, *now, *carry, *captured, *self._numbers(totals)]

    def _by_captured(self, totals: Iterator[Tensor]) -> list[Tensor]:
        """Gradients by captured tensors, through the numbers of the table that follow from them."""
        if self._runs is None or self._table is None:
            return [next(totals) for _ in self._of_captured]
        return self._table(self._ran.read, [next(totals) for _ in self._runs])

    def _numbers(self, totals: Any) -> list[Tensor | None]:
        return [next(totals) if k in self._of_own else None for k in range(len(self._own))]

    def _blocks(self, kept: bool) -> tuple[int, int]:
        """Return how many rows, and how many times of theirs, are taken at once."""
        call, threads = self._call, torch.get_num_threads()
        unit, compiled = _UNIT * threads, self._ran.built.compiled
        size = max(1, sum(shape.numel() for shape, _ in compiled.carry) * compiled.real.itemsize)
        sums = sum((x.numel() if shared else x[0].numel()) for x, shared in self._summed) * 8
        most = self._ran.budget // (4 * sums + 1)  # rows of which the sums fit
        rows = max(unit, most // unit * unit)
        if kept:
            return rows, call.times
        # A thread of the CPU has a few rows' carries of all times at once, a device those of all rows.
        held = size * min(_ROWS * threads if self._on_processor else rows, call.rows)
        if held * call.times <= self._ran.budget:
            return rows, call.times
        times = min(call.times, max(math.isqrt(call.times) + 1, self._ran.budget // (2 * held)))
        begins = size * -(-call.times // times)
        return max(unit, min(rows, self._ran.budget // (2 * begins)) // unit * unit), times

    def _block(
        self, rows: slice, times: int, kept: Sequence[Tensor], at_times: _AtTimes
    ) -> tuple[list[Tensor], list[Tensor]]:
        """Run some rows from the last time to the first: gradients by their carry, and sums over times."""
        call = self._call
        starts = range(0, call.times, times)
        begins = [[leaf[rows] for leaf in self._carry]]
        if len(starts) > 1:
            found = self._carries(rows, slice(0, call.times), begins[0], times)
            begins = [[leaf[:, k] for leaf in found] for k in range(len(starts))]
        slopes, sums = self._slopes(rows), None
        for start, begin in zip(reversed(starts), reversed(begins), strict=True):
            piece = slice(start, min(start + times, call.times))
            before, again = [x[rows] for x in kept], None
            if not kept:
                before, again = self._again(rows, piece, begin)
            given = self._given(rows, piece, slopes, before, sums)
            own = [column[rows] for column in self._read]
            assert self.built is not None
            rooms = self._rooms(rows, piece, at_times)
            found = call.run(self.built, given, own, 1, back=True, rooms=rooms, again=again)
            slopes, sums, slow = split(found, (len(slopes), len(self._summed), len(at_times.leaves)))
            at_times.put(rows, piece, slow)
        return slopes, sums or []

    def _slopes(self, rows: slice) -> list[Tensor]:
        """Gradients by the carry after the last time."""
        triples = zip(self._carry, self._end, self._form.carry, strict=True)
        return [torch.zeros_like(x[rows]) if end is None else end[rows] for x, end, one in triples if one]

    def _carries(self, rows: slice, times: slice, begin: Sequence[Tensor], every: int) -> list[Tensor]:
        """The carry before times of some rows, computed again."""
        if not begin:
            return []
        given, own = self._once_more(rows, times, begin)
        return self._call.run(self._ran.built, given, own, every)[-len(begin) :]

    def _again(self, rows: slice, times: slice, begin: Sequence[Tensor]) -> tuple[list[Tensor], Any]:
        """The carry before times of some rows, and what makes it while the adjoint runs, if that is so."""
        if not self._on_processor or not begin:
            return self._carries(rows, times, begin, 1), None
        compiled, count = self._ran.built.compiled, len(begin)
        like = torch.empty(0, dtype=compiled.real, device="cpu")
        shape = rows.stop - rows.start, times.stop - times.start
        before = [empty_rows(like, shape[0], (1,), s).expand(*shape, *s) for s, _ in compiled.carry]
        to = [-1] * len(compiled.outputs) + [k if k in self._needed else -1 for k in range(count)]
        return before, self._call.again(self._ran.built, *self._once_more(rows, times, begin), to)

    def _once_more(self, rows: slice, times: slice, begin: Sequence[Tensor]) -> tuple[Given, list[Tensor]]:
        """Return the inputs of the call, of some rows and times, and its columns."""
        row, now = self._some(self._row, rows, None), self._some(self._now, rows, times)
        sizes = rows.stop - rows.start, times.stop - times.start
        return Given([*begin], now, row, self._call.structures, *sizes), [x[rows] for x in self._own]

    def _rooms(self, rows: slice, times: slice, at_times: _AtTimes) -> list[Tensor]:
        """Return the place of a block: outputs of times lie among those of all rows."""
        if not self._on_processor or self.built is None:
            return []
        like, count = at_times.like, rows.stop - rows.start
        ends = [empty_rows(like, count, (), shape) for shape, _ in self.built.compiled.carry]
        return [*ends, *at_times.rooms(rows, times)]

    def _some(self, leaves: Sequence[Any], rows: slice, times: slice | None) -> list[Any]:
        if times is None:
            return [leaf if isinstance(leaf, Shared) else leaf[rows] for leaf in leaves]
        return [Shared(x.tensor[times]) if isinstance(x, Shared) else x[rows, times] for x in leaves]

    def _given(
        self,
        rows: slice,
        times: slice,
        slopes: Sequence[Tensor],
        before: Sequence[Tensor],
        sums: Sequence[Tensor] | None,
    ) -> Given:
        """Return the inputs of the adjoint."""
        count, real = rows.stop - rows.start, self._ran.built.compiled.real
        if sums is None:
            shapes = [x.shape if shared else x.shape[1:] for x, shared in self._summed]
            sums = [torch.zeros((count, *shape), dtype=real, device=self._device) for shape in shapes]
        ends = [self._at(end, rows, times) for end in self._ends if end is not None]
        captured, own = list[Shared](), list[Tensor]()
        if self._runs is None:
            captured = [Shared(self._captured[k]) for k in self._of_captured]
            own = [self._own[k][rows] for k in self._of_own]
        carry = [*slopes], [*sums]
        now = [*before], self._some(self._now, rows, times), ends
        row = self._some(self._row, rows, None), captured, own
        if not self._structures:
            trees = {"carry": carry, "now": now, "row": row}
            self._structures = {n: flatten(tuple(map(tuple, tree)))[1] for n, tree in trees.items()}
        flat: list[list[Any]] = [[x for part in parts for x in part] for parts in (carry, now, row)]
        return Given(flat[0], flat[1], flat[2], self._structures, count, times.stop - times.start)

    @property
    def _device(self) -> torch.device:
        return plain(next(iter((*self._carry, *self._row, *self._now)))).device

    def _at(self, end: Tensor, rows: slice, times: slice) -> Tensor:
        """Gradients by an output at all times, some of which were recorded."""
        every = self._call.every
        if every == 1:
            return end[rows, times]
        first, last = -(-times.start // every), -(-times.stop // every)
        spread = end.new_zeros((rows.stop - rows.start, times.stop - times.start, *end.shape[2:]))
        spread[:, first * every - times.start :: every] = end[rows, first:last]
        return spread


class _AtTimes:
    """Gradients by what times bring, put together of blocks of rows and times.

    Args:
        leaves: what they are by.
        rows, times: all of them.
        like: dtype and device.
    """

    def __init__(self, leaves: Sequence[Any], rows: int, times: int, like: Tensor) -> None:
        self.leaves, self.like = leaves, like
        self._found: list[Tensor] = []
        for leaf in leaves:
            shared = isinstance(leaf, Shared)
            shape, count = leaf.tensor.shape[1:] if shared else leaf.shape[2:], -(-rows // _UNIT)
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
                found[rows.start // _UNIT : -(-rows.stop // _UNIT), times] = _units(slope)
            elif slope.data_ptr() != found[rows, times].data_ptr():
                found[rows, times] = slope

    def joined(self) -> list[Tensor]:
        """Return those of all rows and times."""
        pairs = zip(self.leaves, self._found, strict=True)
        return [
            _halved(x, 0).to(of.tensor.dtype) if isinstance(of, Shared) else x.to(of.dtype) for of, x in pairs
        ]


def empty_rows(like: Tensor, rows: int, times: tuple[int, ...], shape: Sequence[int]) -> Tensor:
    """Return an empty tensor (rows, *times, *shape) in whose memory the rows are innermost."""
    size = torch.Size(shape).numel() * rows
    strides = (1, *[size for _ in times], *inner_strides(shape, rows))
    return fresh(like, *times, size).as_strided((rows, *times, *shape), strides)


def _copied(leaf: Any) -> Any:
    """Return an input with memory of its own."""
    return Shared(leaf.tensor.clone()) if isinstance(leaf, Shared) else leaf.clone()


def _units(x: Tensor) -> Tensor:
    """Sums over 64 rows each."""
    missing = -len(x) % _UNIT
    if missing:
        x = torch.cat((x, x.new_zeros((missing, *x.shape[1:]))))
    return _halved(x.unflatten(0, (-1, _UNIT)), 1)


def _halved(x: Tensor, dim: int) -> Tensor:
    """The sum over a dimension by halves: the same bits on any number of threads."""
    while (count := x.shape[dim]) > 1:
        half = count // 2
        both = x.narrow(dim, 0, half) + x.narrow(dim, half, half)
        x = torch.cat((both, x.narrow(dim, 2 * half, 1)), dim) if count % 2 else both
    return x.squeeze(dim)


def _joined(parts: Sequence[Tensor]) -> Tensor:
    return parts[0] if len(parts) == 1 else torch.cat([*parts])


def split(leaves: Sequence[Any], sizes: Sequence[int]) -> list[list[Any]]:
    """Return consecutive parts of these sizes."""
    rest = iter(leaves)
    return [[next(rest) for _ in range(size)] for size in sizes]

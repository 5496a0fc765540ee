"""Gradients of a row program: forward compiled, backward by a second program, the adjoint of the step.

The adjoint reads the carry before every step where results have it. Of what they have not, the forward pass
keeps it where steps are long; where they are short, and memory is slower than arithmetic, the backward pass
computes it again (`backward`). Where nobody asks for a gradient, nothing is kept.

The line of the log on gradients in which rounding has grown over the times until nothing else is left.
"""

from __future__ import annotations

import contextlib
import functools
import re
from collections.abc import Hashable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from ..calls.choice import say
from ..calls.inputs import Given, Where, served
from ..calls.planned_call import Compiled, PlannedCall
from ..device.kernel import DeviceCall
from ..row_numbers import RowNumbers, columns
from ..tree import Shared, flatten, labels, plain, unflatten
from .backward import Backward
from .carries import Keeping, Watched, in_results, split, unchanged
from .growth import Slope, grown, say_grown
from .steps import Substituted

if TYPE_CHECKING:
    from ..program import Program
    from ..texts import Built


_WORTH = 10  # operations of a step for each byte of its carry: kept, it costs less than the step again
Plan = PlannedCall | DeviceCall
Choice = tuple[frozenset[int] | None, frozenset[int] | None]
_PATIENCE = 8  # calls that write carries for a gradient for which nobody asks, before others do without
_PLANS = 64  # calls of other shapes that are remembered
_MEBIBYTE = 2**20
_budget = 256 * _MEBIBYTE


@contextlib.contextmanager
def gradient_memory(mebibytes: float) -> Iterator[None]:
    """Let the gradient of a call keep so much memory within the block; 256 MiB by default.

    What does not fit is computed again by the backward pass, at one or two more forward passes.

    Example:
        >>> x0 = torch.ones(2, dtype=torch.float64, requires_grad=True)
        >>> program = lanes.Program(lambda x, now, row: (0.5 * x, x))
        >>> with lanes.gradient_memory(64):
        ...     program(x0, steps=3)[1].sum().backward()
        >>> x0.grad
        tensor([1.7500, 1.7500], dtype=torch.float64)

        Shown by `staf_torch/lanes/GRADIENTS.md`.

    Args:
        mebibytes: of the whole process.

    Raises:
        ValueError: if it is not positive.
    """
    global _budget
    if not mebibytes > 0:
        raise ValueError(f"`gradient_memory(mebibytes=...)` must be positive; got {mebibytes!r}.")
    before, _budget = _budget, int(mebibytes * _MEBIBYTE)
    try:
        yield
    finally:
        _budget = before


class Ran(NamedTuple):
    """Facts of one call that its backward pass needs beside the tensors."""

    call: GradientCall  # that was made
    where: Where  # its tensors are
    built: Built  # of the program that keeps carries
    order: dict[int, int]  # what the step reads, in an order that all processes share
    found: tuple[int, ...]  # places of the captured tensors with a gradient among those that the trace found
    captured: tuple[Tensor, ...]  # these tensors
    read: tuple[Tensor, ...]  # all that the trace found
    numbers: tuple[RowNumbers, ...]  # of rows that the step reads
    versions: tuple[tuple[Tensor, int], ...]  # of what the step reads and has no gradient
    keeps: frozenset[int] | None  # leaves of the carry that are kept, or that results have; None: nothing is
    written: frozenset[int] | None  # those of them that no result has; None where nobody asks for a gradient
    budget: int  # bytes


class GradientCall:
    """A call of a program of which gradients are wanted, for inputs of fixed forms."""

    def __init__(self, program: Program, given: Given, every: int) -> None:
        self.program, self.every, self.rows, self.times = program, every, given.rows, given.times
        self.structures = given.structures
        self.sizes = len(given.row), len(given.now), len(given.carry)
        self._shared = [isinstance(leaf, Shared) for leaf in (*given.row, *given.now, *given.carry)]
        self._plans: dict[Any, tuple[Compiled, Plan]] = {}
        self.followers: dict[Hashable, tuple[Program, tuple[Hashable, Any], Any]] = {}
        self._keepers: dict[Where, tuple[Program, Hashable]] = {}  # programs, and where what is built stands
        self._choices: dict[
            Hashable, tuple[Any, Choice]
        ] = {}  # with a trace, whose address is then used once
        self._keepings: dict[Hashable, Keeping] = {}
        self._place: tuple[Where, Hashable] = False, None  # of the program that keeps nothing
        self._refused, self._unasked = False, 0  # calls since a gradient was asked for
        self.adjoints = program.adjoints

    def __call__(self, leaves: Sequence[Any]) -> tuple[Any, Any] | None:
        """Return the carry and the outputs, None where the definition must compute them.

        Leaves are what a row has once, what times bring, and the carry.
        """
        if self._refused or not self.program.compile:
            return None
        tensors, where = [plain(leaf) for leaf in leaves], served(leaves)
        keeping, place = self._keepers.get(where, (None, None))
        built = None if keeping is None else keeping.latest(place)
        if keeping is None or built is None:
            given = self.given([tensor.detach() for tensor in tensors])
            found = self.program.keeping(given)
            if found is None:
                return None
            keeping, built = found
            self._keepers[where] = keeping, keeping.place(given)
        ran = self._ran(where, keeping, built)
        own = columns(ran.numbers, self.rows)
        rooms = iter(_Gradient.apply(ran, *tensors, *ran.captured, *own))  # type: ignore[no-untyped-call]
        outputs = ran.built.compiled.structure[1][0]  # beside them it has the carries
        return unflatten(self.structures["carry"], rooms), unflatten(outputs, rooms)

    def needed(self, trace: Any) -> set[int]:
        """Return the leaves of the carry that adjoints of a trace read; none before there was one."""
        found: set[int] = self.adjoints.setdefault(id(trace), (trace, set()))[1]
        return found

    def _ran(self, where: Where, keeping: Program, built: Built) -> Ran:
        read = [keeping.in_place_of(tensor) for tensor in built.trace.recipe.found]
        found = tuple(k for k, tensor in enumerate(read) if tensor.requires_grad)
        fixed = [t for t in read if not (t.requires_grad or t.is_inference())]
        keeps, written = self._keeps(where, built)
        return Ran(
            call=self,
            where=where,
            built=built,
            order={id(tensor): k for k, tensor in enumerate(keeping.reads())} if found else {},
            found=found,
            captured=tuple(read[k] for k in found),
            read=tuple(read),
            numbers=built.compiled.rows,
            versions=tuple((tensor, tensor._version) for tensor in fixed),
            keeps=keeps,
            written=written,
            budget=_budget,
        )

    def _keeps(self, where: Where, built: Built) -> Choice:
        """Return `Ran.keeps` and `Ran.written`."""
        trace, known = built.trace, self.adjoints.get(id(built.trace))
        key = id(trace), where, _budget, None if known is None else len(known[1])  # which only grows
        if key not in self._choices:
            if len(self._choices) >= _PLANS:
                self._choices.clear()
                self._keepings.clear()
            read = None if known is None else frozenset(known[1])
            self._choices[key] = trace, self._chosen(where, built, read)
        keeps, written = self._choices[key][1]
        if where is True and keeps and written and self._unasked >= _PATIENCE:
            return keeps - written, None
        return keeps, written

    def _chosen(self, where: Where, built: Built, known: frozenset[int] | None) -> Choice:
        """Return what is worth keeping of the leaves that adjoints read, as far as that is known."""
        compiled, needed, there = built.compiled, frozenset(range(self.sizes[2])), frozenset[int]()
        if where is True:
            needed = needed if known is None else known
            there = needed & in_results(built.trace, len(compiled.outputs) - self.sizes[2])
        written = needed - there
        size = sum(compiled.carry[k][0].numel() for k in written) * compiled.real.itemsize
        work = _work(built.trace.text.source)
        pays = work is None or work > _WORTH * size
        if self.every > 1 or not pays or size * self.rows * self.times > _budget:
            return None, None
        return (there, None) if where is True and known is None else (needed, written)

    def given(self, tensors: Sequence[Tensor]) -> Given:
        """Return the inputs of the program, of flat ones."""
        leaves = [Shared(x) if shared else x for x, shared in zip(tensors, self._shared, strict=True)]
        row, now, carry = split(leaves, self.sizes)
        return Given(carry, now, row, self.structures, self.rows, self.times)

    def run(
        self,
        where: Where,
        built: Built,
        given: Given,
        own: Sequence[Tensor],
        every: int,
        *,
        back: bool = False,
        rooms: Sequence[Tensor] = (),
        again: Any = None,
    ) -> list[Tensor]:
        """Run a program; return what it returns.

        On the CPU it writes to ``rooms``, if there are any, and ``again`` makes inputs of times.
        """
        plan, leaves = self._plan(where, built, given, own, every, back, rooms)
        if rooms and isinstance(plan, PlannedCall):
            plan.into(rooms, leaves, again)
            return [*rooms]
        found, carries = plan(leaves), len(given.carry)
        return (
            found if where is True or not back else [*found[:carries], *(x.flip(1) for x in found[carries:])]
        )

    def again(self, built: Built, given: Given, own: Sequence[Tensor], to: Sequence[int]) -> Any:
        """Return what makes inputs of the adjoint while that runs, on the CPU.

        ``to`` says of each result of the program, the carry before the outputs, which input of a time it is,
        or -1.
        """
        plan, leaves = self._plan(True, built, given, own, 1, False, ())
        assert isinstance(plan, PlannedCall)
        return plan.makes(leaves, to)

    def _plan(
        self,
        where: Any,
        built: Built,
        given: Given,
        own: Sequence[Tensor],
        every: int,
        back: bool,
        rooms: Sequence[Tensor],
    ) -> tuple[Plan, list[Any]]:
        """Return the prepared call of a program, and the inputs in its order."""
        leaves = [*given.row, *own, *given.now, *given.carry]
        forms = tuple([(x.shape, x.stride(), x.dtype) for x in map(plain, leaves)])
        key = id(built.trace), forms, given.times, every, tuple([room.stride() for room in rooms])
        compiled, plan = self._plans.get(key, (None, None))
        if plan is None or compiled is not built.compiled:
            if len(self._plans) >= _PLANS:
                self._plans.clear()
            once = len(given.row) + len(own)
            timed = [*[False] * once, *[True] * len(given.now), *[False] * len(given.carry)]
            alone, sizes = built.compiled._replace(rows=()), {"rows": given.rows, "steps": given.times}
            if isinstance(where, bool):
                plan = PlannedCall(alone, leaves, timed, **sizes, every=every, backwards=back, rooms=rooms)
            else:
                sizes |= {"every": every, "once": 0}
                plan = DeviceCall(alone, leaves, timed, **sizes, where=where, whole=True, backwards=back)
            self._plans[key] = built.compiled, plan
        return plan, leaves

    def forward(
        self, ran: Ran, tensors: Sequence[Tensor]
    ) -> tuple[list[Tensor], list[Tensor], list[Watched]]:
        """Return the carry with the outputs, the carries that are kept, and what of them results have."""
        given = self.given(tensors[: sum(self.sizes)])
        own = tensors[len(tensors) - len(ran.numbers) :]
        self._unasked += 1
        keeping, end = ran.built, len(ran.built.compiled.outputs)  # carries and outputs, before carries
        nothing = ran.keeps is None or (ran.written is not None and not ran.written)
        built = (self._plain(given, ran.where) if nothing else None) or keeping
        if ran.keeps is None or ran.where is not True:
            rooms = self.run(ran.where, built, given, own, self.every)
            return rooms[:end], [] if ran.keeps is None else rooms[end:], []
        compiled, results = built.compiled, end - self.sizes[2]
        key = id(keeping.trace), nothing, ran.keeps
        if key not in self._keepings:
            sizes = self.rows, self.times
            self._keepings[key] = Keeping(compiled, keeping.trace, ran.keeps, results, sizes)
        made = self._keepings[key](given.carry)
        self.run(True, built, given, own, 1, rooms=made.all)
        dtypes = [dtype for _, dtype in (*compiled.carry, *compiled.outputs)]
        found = [room.to(dtype) for room, dtype in zip(made.results, dtypes, strict=False)]
        return found, made.before, made.watched

    def _plain(self, given: Given, where: Where) -> Built | None:
        """Return the program that puts out nothing but results, None where there is none."""
        built = self.program.latest(self._place[1]) if self._place[0] == where else None
        if built is None:
            built, self._place = self.program.built(given), (where, self.program.place(given))
        return built

    def backward(
        self,
        ran: Ran,
        tensors: Sequence[Tensor],
        kept: Sequence[Tensor],
        needs: Sequence[bool],
        ends: Sequence[Tensor | None],
    ) -> list[Tensor | None]:
        """Return the gradients by the inputs, the captured tensors and the numbers of rows."""
        self._unasked = 0
        if any(tensor._version != version for tensor, version in ran.versions):
            raise RuntimeError(
                f"a tensor that {self.program.name} reads was modified by an inplace operation before the "
                "backward pass, which needs it as it was."
            )
        if torch.is_grad_enabled():
            say(self.program.name, "a derivative of a derivative is wanted")
            return self._by_definition(ran, tensors, needs, ends, again=True)
        adjoint = Backward(ran, [tensor.detach() for tensor in tensors], needs, ends)
        if adjoint.built is not None:
            found = adjoint.run(kept)
        else:
            self._refused = True
            with torch.enable_grad():
                found = self._by_definition(ran, tensors, needs, ends, again=False)
        some, made = ([part for part in parts if part is not None] for parts in (ends, found))
        pairs = zip(self._shared, found, strict=False)
        by_row = any(part is not None and not shared for shared, part in pairs)
        carried = [] if by_row else adjoint.slopes  # what is summed over rows names none of them
        if grown(self.program.name, some, [*made, *(x for _, x in carried)]):
            say_grown(self.program.name, some, self._named(ran, found, carried))
        return found

    def _named(
        self, ran: Ran, found: Sequence[Tensor | None], carried: Sequence[tuple[int, Tensor]]
    ) -> list[Slope]:
        """Return gradients, and those by leaves of the carry beside them, with what they are by."""
        names = [x for tree in ("row", "now", "carry") for x in labels(self.structures[tree], tree)]
        captured = [f"a tensor of the shape {tuple(tensor.shape)} that it reads" for tensor in ran.captured]
        kinds = [(name, not shared) for name, shared in zip(names, self._shared, strict=True)]
        kinds += [*((name, False) for name in captured), *[("numbers of rows", True)] * len(ran.numbers)]
        slopes = [Slope(name, x, of) for (name, of), x in zip(kinds, found, strict=True) if x is not None]
        first = self.sizes[0] + self.sizes[1]
        return [*slopes, *(Slope(names[first + k], x, by_row=True) for k, x in carried)]

    def _by_definition(
        self,
        ran: Ran,
        tensors: Sequence[Tensor],
        needs: Sequence[bool],
        ends: Sequence[Tensor | None],
        *,
        again: bool,
    ) -> list[Tensor | None]:
        """The gradients of the definition, which is computed once more."""
        count = sum(self.sizes)
        inputs = [x.view_as(x) if need else x for x, need in zip(tensors, needs, strict=True)]
        rest = iter(inputs[count:])
        others: dict[int, Tensor] = {id(tensor): next(rest) for tensor in ran.captured}
        others |= {id(numbers): RowNumbers(next(rest)) for numbers in ran.numbers}
        given = self.given(inputs[:count])
        row, now, carry = given.trees()
        with Substituted(others):
            found = self.program.definition(carry, now, row, steps=self.times, every=self.every)
        pairs = zip(flatten(found)[0], ends, strict=True)
        some = [(x, end) for x, end in pairs if end is not None and x.requires_grad]
        wanted = [x for x, need in zip(inputs, needs, strict=True) if need]
        if not some:
            return [None] * len(inputs)
        values, slopes = zip(*some, strict=True)
        gradients = iter(torch.autograd.grad(values, wanted, slopes, create_graph=again, allow_unused=True))
        return [next(gradients) if need else None for need in needs]


class _Gradient(torch.autograd.Function):
    """The results of a program, and their gradients."""

    @staticmethod
    def forward(ctx: Any, ran: Ran, *tensors: Tensor) -> tuple[Tensor, ...]:
        ctx.ran = ran
        ctx.set_materialize_grads(False)
        rooms, kept, ctx.watched = ran.call.forward(ran, [tensor.detach() for tensor in tensors])
        ctx.save_for_backward(*tensors, *kept)
        ctx.mark_non_differentiable(*[room for room in rooms if not room.is_floating_point()])
        return tuple(rooms)

    @staticmethod
    def backward(ctx: Any, *ends: Tensor | None) -> tuple[Tensor | None, ...]:
        saved, needs = ctx.saved_tensors, ctx.needs_input_grad[1:]
        if all(end is None for end in ends):
            return (None,) * (1 + len(needs))
        count = len(needs)
        kept = saved[count:] if unchanged(ctx.watched) else []
        return None, *ctx.ran.call.backward(ctx.ran, saved[:count], kept, needs, ends)


@functools.lru_cache(_PLANS)
def _work(source: str) -> int | None:
    """Return the operations of a step that a text tells; None for a kernel."""
    found = re.search(r"WORK_STEP = (\d+)", source)
    return None if found is None else int(found[1])

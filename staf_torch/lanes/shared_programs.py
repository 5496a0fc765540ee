"""Programs of which many differ in tensors alone: traced once, or never where the cache knows them.

What a step reads is written down as a key without floating-point tensors (`Contents`). A step of an equal key
takes over the text of the first, with a table of its own tensors' numbers. To look a program up by its class
and arguments would miss what a user's functions read beside.

Functions of the rows of a batch that a program serves: what stands behind a compiled method.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Hashable, Sequence
from operator import is_
from typing import Any, NamedTuple

from torch import Tensor

from .calls import inputs
from .calls.planned_call import PlannedCall
from .dependencies.contents import Contents, Writes, leads_by_copies, told_copies
from .prepared_call import Plan
from .program import Program
from .threads import Mutex
from .trace.loops import traced_as
from .trace.step import Step
from .tree import Tree

_log = logging.getLogger(__name__)


class _KeptModel(NamedTuple):
    """A program that was traced, and the last one that followed from it."""

    traced: Program
    found: list[Tensor]  # by the traced one
    last: Program
    tensors: list[Tensor]  # of the last
    writes: Writes  # to them
    signature: bytes | None
    methods: list[Any]  # of the library's classes that the step's objects are of


class SharedPrograms:
    """The latest programs of one kind.

    A step that differs from another in floating-point tensors alone takes over its text, and nothing is
    traced or compiled. Where all code that it runs is of this library or of torch, the trace also comes from
    the user's cache, where earlier processes left it.
    """

    def __init__(self, name: str, most: int = 64) -> None:
        self._name, self._most, self._warned = name, most, False
        self._lock = Mutex()
        self._models: dict[Hashable, _KeptModel] = {}
        self._latest: dict[Hashable, tuple[Program, Contents | None, tuple[Any, ...]]] = {}

    def unchanged(self, *owners: Any) -> Program | None:
        """Return the program that `of` last returned for these very owners, if they are as they were.

        A fiftieth of the time of `of`, which reads all of them again.
        """
        program, read, _ = self._latest.get(_identities(owners), (None, None, None))
        if read is None or read.reason is not None or not read.unchanged():
            return None
        return program

    def of(
        self,
        step: Step,
        *parts: Any,
        copies: int = 0,
        owners: tuple[Any, ...] = (),
        make: Callable[..., Step] | None = None,
    ) -> Program:
        """Return the program of a step.

        Args:
            step: of a program.
            parts: all that the step reads: modules, tensors, functions, settings. One that cannot be written
                down is known to be equal to nothing.
            copies: as in `Program`.
            owners: objects and settings that decide what the parts are, for `unchanged`.
            make: the step of ``parts``, all of which come to it by these arguments: floats of the library's
                objects among them are then numbers of the table, too.
        """
        read = Contents(copies, *parts, telling=make is not None, watched=False)
        if read.told and read.key not in self._models and not leads_by_copies(read, parts):
            read = Contents(copies, *parts, watched=False)
        if read.key is None:
            if not self._warned:
                self._warned = True
                told = (
                    "%s is traced again at every call, as it reads what cannot be compared between calls: %s"
                )
                _log.warning(told, self._name, read.reason)
            new = Program(step, name=self._name, copies=copies)
            new.described(None, ())
            return new
        tensors = read.tensors
        writes = Writes(tensors)
        floats = read.told

        def spelled() -> Step:
            """The step, in a trace of copies that have tensors in the place of floats."""
            if make is None or not floats:
                return step
            return traced_as(lambda *given: make(*told_copies(floats, parts))(*given))(step)

        with self._lock:
            return self._found(spelled, read, writes, copies, owners)

    def _found(
        self,
        step: Callable[[], Step],
        read: Contents,
        writes: Writes,
        copies: int,
        owners: tuple[Any, ...],
    ) -> Program:
        """Return the program of what a step reads: the kept one, one that follows from it, or a new one."""
        tensors, held = read.tensors, self._models.pop(read.key, None)
        if held is None or read.replaced(held.methods):
            new, signature = Program(step(), name=self._name, copies=copies), read.signature()
            new.described(signature, tensors)
            held = _KeptModel(new, tensors, new, tensors, writes, signature, read.methods())
        elif not held.writes.none() or not all(map(is_, held.tensors, tensors)):
            new = held.traced.with_others(step(), list(zip(held.found, tensors, strict=True)))
            new.described(held.signature, tensors)
            held = held._replace(last=new, tensors=tensors, writes=writes)
        self._models[read.key] = held
        _forget(self._models, self._most)
        if owners:
            latest = _identities(owners)
            again = (
                self._latest.pop(latest, None) is not None
            )  # a second reading is worth its time from then on
            self._latest[latest] = held.last, Contents(*owners) if again else None, owners  # kept: addresses
            _forget(self._latest, self._most)
        return held.last


def shared_program(
    name: str, step: Step, *parts: Any, copies: int = 0, make: Callable[..., Step] | None = None
) -> Program:
    """Return the program of a step, shared with steps of the name that differ in tensors alone.

    Example:
        >>> def doubled(scale):
        ...     return lanes.shared_program("doubled", lambda x, now, row: (x, scale * x), scale)
        >>> doubled(torch.tensor(2.0))(torch.ones(1), steps=1)[1]
        tensor([[2.]])

        Shown by `staf_torch/lanes/README.md`.

    Args:
        name: in the log.
        step, parts, copies, make: as in `SharedPrograms.of`.
    """
    return _kinds.setdefault(name, SharedPrograms(name)).of(step, *parts, copies=copies, make=make)


_kinds: dict[str, SharedPrograms] = {}


def _forget(held: dict[Hashable, Any], most: int) -> None:
    while len(held) > most:
        del held[next(iter(held))]


def _identities(owners: tuple[Any, ...]) -> Hashable:
    return tuple(each if isinstance(each, int | float | str) else id(each) for each in owners)


_KEPT = 64  # shapes of calls that are remembered


def is_state(x: Tensor) -> bool:
    return x.is_floating_point() and x.dim() > 0


def check_states(given: Sequence[Tensor]) -> None:
    """Refuse states that are integers, flags or single numbers, when their form is new."""
    for x in given:
        if not is_state(x):
            raise ValueError(f"states must be (..., n) of floating point; got {tuple(x.shape)} of {x.dtype}.")


class Rows:
    """y = function(a, b, ...), (B, ...) to (B, ...), where nobody traces or differentiates."""

    def __init__(
        self,
        function: Callable[..., Tree],
        name: str,
        *parts: Any,
        copies: int = 1,
        make: Callable[..., Callable[..., Tree]] | None = None,
    ) -> None:
        def step_of(function: Callable[..., Tree]) -> Step:
            return lambda carry, _, row: (carry, function(*row))

        if parts:
            told = None if make is None else (lambda *others: step_of(make(*others)))
            self.program = shared_program(name, step_of(function), *parts, copies=copies, make=told)
        else:
            self.program = Program(step_of(function), name=name, copies=copies)
        self._plans: dict[Any, Plan] = {}
        self.at_once: dict[Any, Callable[[Tensor], Tensor]] = {}

    @property
    def compiled(self) -> bool:
        """Return whether a compiled program has served a call."""
        return bool(self._plans)

    def __call__(self, *given: Tensor) -> Tensor:
        """Return y with a dimension of one time after the rows, (B, 1, ...); (n,) is one row."""
        # Shapes alone: the caller has looked at the rest.
        key = tuple(
            [(x.shape, x.stride(), x.dtype, inputs.processor if x.is_cpu else x.device) for x in given]
        )
        plan = self._plans.get(key)
        if plan is not None:
            return plan(given)[0]
        check_states(given)
        rows = [x.unsqueeze(0) if x.dim() == 1 else x for x in given]
        plan, found = self.planned(*rows)
        if plan is not None:
            if len(self._plans) >= _KEPT:
                self._plans.clear()
                self.at_once.clear()
            self._plans[key] = plan
            keep_at_once(self.at_once, plan, *given)
        return found

    def planned(self, *given: Tensor) -> tuple[Plan | None, Tensor]:
        """Return the plan of calls with such inputs, (B, ...), None where the definition runs; and y."""
        prepared = self.program.prepare((), (), tuple(given), steps=1)
        found: Tensor = prepared((), (), tuple(given))[1]
        return prepared.plan, found


def keep_at_once(known: dict[Any, Callable[[Tensor], Tensor]], plan: Plan, x: Tensor, *more: Tensor) -> None:
    """Note what finds y for states like x alone, (n,) or (B, n), where that is a call of machine code."""
    found = plan.of_states(*x.shape[:-1]) if isinstance(plan, PlannedCall) and not more else None
    if found is not None:
        known[x.shape, x.stride(), x.dtype] = found


class Trees:
    """The variant of `Rows` that maps trees (B, ...) to trees (B, ...)."""

    def __init__(self, rows: Rows) -> None:
        self.program, self.compiled = rows.program, False
        self.at_once: dict[Any, Callable[[Tensor], Tensor]] = {}

    def __call__(self, *given: Tree) -> Tree:
        self.compiled = self.compiled or self.program.compiles((), (), given, steps=1)
        return self.program.once(*given)

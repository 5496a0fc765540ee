"""Programs of which many differ in tensors alone: traced once, or never where the cache knows them.

What a step reads is written down as a key without floating-point tensors (`Contents`). A step of an equal key
takes over the text of the first, with a table of its own tensors' numbers. To look a program up by its class
and arguments would miss what a user's functions read beside.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Hashable
from operator import is_
from typing import Any, NamedTuple

from torch import Tensor

from .dependencies.contents import Contents
from .dependencies.tensor_writes import Writes
from .dependencies.told_numbers import leads_by_copies, told_copies
from .program import Program
from .threads import Mutex
from .trace.loops import traced_as
from .trace.step import Step

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

    Args:
        name: of the programs, in the log.
        most: programs that are kept.
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

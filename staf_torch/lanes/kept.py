"""Programs of which many differ in tensors alone: traced once, or never where the cache knows them."""

from __future__ import annotations

import functools
import logging
from collections.abc import Hashable
from operator import is_
from typing import Any, NamedTuple

import torch
from torch import Tensor

from .content import code, signature, skeleton, written
from .program import Program
from .trace.step import Step
from .watch import Watch

_log = logging.getLogger(__name__)


@functools.lru_cache(maxsize=4096)
def number(name: str, value: float) -> Tensor:
    """Return the tensor of a number that no text is to know, float64: of a name and a number always the same.

    Two names never share one: a text would then know that their numbers are equal.
    """
    return torch.tensor(value, dtype=torch.float64)


class _Model(NamedTuple):
    """A program that was traced, and the last one that followed from it."""

    traced: Program
    found: list[Tensor]  # by the traced one
    last: Program
    tensors: list[Tensor]  # of the last
    versions: list[int]
    signature: bytes | None
    code: list[Any]  # what is in the classes of the step's objects


class Kept:
    """The latest programs of one kind.

    A step that differs from another in floating-point tensors alone takes over its text, and nothing is
    traced or compiled. Where all code that it runs is of this library or of torch, the trace also comes from
    the user's cache, where earlier processes left it.

    Args:
        name: of the programs, in the log.
        most: programs that are kept.
    """

    def __init__(self, name: str, most: int = 64) -> None:
        self._name, self._most, self._told = name, most, False
        self._models: dict[Hashable, _Model] = {}
        self._latest: dict[Hashable, tuple[Program, Watch | None, tuple[Any, ...]]] = {}

    def unchanged(self, *owners: Any) -> Program | None:
        """Return the program that `of` last returned for these very objects, if they are as they were.

        A twentieth of the time of `of`, which reads all of them again.

        Args:
            owners: as given to `of`.
        """
        program, watch, _ = self._latest.get(_identities(owners), (None, None, None))
        if watch is None or not watch.unchanged():
            return None
        if torch.is_grad_enabled() and any(tensor.requires_grad for tensor in watch.tensors):
            return None
        return program

    def of(self, step: Step, *parts: Any, copies: int = 0, owners: tuple[Any, ...] = ()) -> Program | None:
        """Return the program of a step; None where a derivative with respect to its tensors may be wanted.

        Args:
            step: of a program.
            parts: all that the step reads: modules, tensors, functions, settings. One that cannot be written
                down is known to be equal to nothing.
            copies: as in `Program`.
            owners: objects and settings that decide what the parts are, for `unchanged`.
        """
        found = skeleton(copies, *parts)
        if found is None:
            self._say_why(parts)
            return Program(step, name=self._name, copies=copies)
        key, tensors = found
        inside = [value for part in code(key) for value in part.values()]
        if torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors):
            return None
        versions = [tensor._version for tensor in tensors]
        held = self._models.pop(key, None)
        if held is not None and not (len(held.code) == len(inside) and all(map(is_, held.code, inside))):
            held = None  # a method was replaced
        if held is None:
            new, told = Program(step, name=self._name, copies=copies), signature(key)
            new.described(told, tensors)
            held = _Model(new, tensors, new, tensors, versions, told, inside)
        elif held.versions != versions or any(a is not b for a, b in zip(held.tensors, tensors, strict=True)):
            new = held.traced.with_others(step, list(zip(held.found, tensors, strict=True)))
            new.described(held.signature, tensors)
            held = held._replace(last=new, tensors=tensors, versions=versions)
        self._models[key] = held
        while len(self._models) > self._most:
            del self._models[next(iter(self._models))]
        if owners:
            latest = _identities(owners)
            again = self._latest.pop(latest, None) is not None  # a watch is worth its time from then on
            watch = Watch(*owners) if again else None
            self._latest[latest] = held.last, watch, owners  # kept: an address is used once
            while len(self._latest) > self._most:
                del self._latest[next(iter(self._latest))]
        return held.last

    def _say_why(self, parts: tuple[Any, ...]) -> None:
        if not self._told:
            self._told = True
            reason = written(parts)
            _log.warning(
                "%s is traced again at every call: what it reads cannot be written down: %s",
                self._name,
                reason,
            )


def _identities(owners: tuple[Any, ...]) -> Hashable:
    return tuple(each if isinstance(each, int | str) else id(each) for each in owners)

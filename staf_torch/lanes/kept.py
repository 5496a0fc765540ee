"""Programs of which many differ in tensors alone: traced once, or never where the cache knows them."""

from __future__ import annotations

import functools
from collections.abc import Hashable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from .content import signature, skeleton
from .program import Program, Step


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
        self._name, self._most = name, most
        self._models: dict[Hashable, _Model] = {}

    def of(self, step: Step, *parts: Any, copies: int = 0) -> Program | None:
        """Return the program of a step; None where a derivative with respect to its tensors may be wanted.

        Args:
            step: of a program.
            parts: all that the step reads: modules, tensors, settings. One that holds a closure is known to
                be equal to nothing.
            copies: as in `Program`.
        """
        found = skeleton(copies, *parts)
        if found is None:
            return Program(step, name=self._name, copies=copies)
        key, tensors = found
        if torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors):
            return None
        versions = [tensor._version for tensor in tensors]
        held = self._models.pop(key, None)
        if held is None:
            new, told = Program(step, name=self._name, copies=copies), signature(key)
            new.described(told, tensors)
            held = _Model(new, tensors, new, tensors, versions, told)
        elif held.versions != versions or any(a is not b for a, b in zip(held.tensors, tensors, strict=True)):
            new = held.traced.with_others(step, list(zip(held.found, tensors, strict=True)))
            new.described(held.signature, tensors)
            held = held._replace(last=new, tensors=tensors, versions=versions)
        self._models[key] = held
        while len(self._models) > self._most:
            del self._models[next(iter(self._models))]
        return held.last

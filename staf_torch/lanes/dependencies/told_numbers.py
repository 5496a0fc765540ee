"""Numbers that are told: floats of the library's objects as numbers of a table, while a program is traced.

A mass, a discount or a step size is a Python float, with which plain torch is fastest. A trace would write
it into the text, and every mass would be traced and compiled anew. So a trace sees copies of the objects in
which these floats are tensors: captured numbers, of which the text knows nothing. Integers, flags and None
stay what they are, and so does what a user's classes hold: a tensor there is a number of the table already.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from types import MethodType
from typing import Any

from torch import Tensor

from .contents import BOUND, Contents, Derived
from .lookups import is_users

Told = dict[int, tuple[Any, dict[str, Tensor]]]
"""Objects by their addresses, and tensors by the names of the floats that they stand for."""


def told_copies(told: Told, parts: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return copies of parts with tensors in the place of told floats, wherever `leads_by_copies`."""
    return _Copies(told).all(parts)


def leads_by_copies(read: Contents, parts: tuple[Any, ...]) -> bool:
    """Return whether all that leads from a step's parts to told floats, of contents that tell, is copied.
    A closure or an object of a user's is not: a trace would read the float there."""
    copies = _Copies(read.told)
    copies.all(parts)
    beside = Contents(*copies.others, telling=True)
    known = read.key is not None and beside.key is not None
    return known and copies.replaced == read.told.keys() and not (beside.told.keys() & read.told.keys())


class _Copies:
    """Copies of objects that hold told floats, and of all that leads to them.

    Args:
        told: of `Contents`.

    Attributes:
        replaced: addresses of the objects that were copied with tensors.
        others: what was not looked into.
    """

    def __init__(self, told: Told) -> None:
        self._told, self.replaced, self.others = told, set[int](), list[Any]()
        self._made: dict[int, Any] = {}

    def all(self, parts: tuple[Any, ...]) -> tuple[Any, ...]:
        """Copy these."""
        return tuple(map(self._of, parts))

    def _of(self, value: Any) -> Any:
        if isinstance(value, Tensor | str | int | float | type | None):
            return value
        if id(value) not in self._made:
            self._made[id(value)] = value  # within itself
            self._made[id(value)] = self._copied(value)
        return self._made[id(value)]

    def _copied(self, value: Any) -> Any:
        kind = type(value)
        if kind in (list, tuple):
            return self._either(value, kind, value)
        if kind is dict:
            return self._either(value.values(), lambda new: dict(zip(value, new, strict=True)), value)
        if kind is MethodType:
            return self._either([value.__self__], lambda new: MethodType(value.__func__, *new), value)
        if kind is functools.partial:
            parts = [value.func, value.args, value.keywords]
            return self._either(parts, lambda new: functools.partial(new[0], *new[1], **new[2]), value)
        library = kind.__module__.startswith("staf_torch.") and not is_users(kind)
        if isinstance(value, Derived) or not hasattr(value, "__dict__") or not library:
            self.others.append(value)
            return value
        held = {name: part for name, part in vars(value).items() if name != BOUND}
        new = {name: self._of(part) for name, part in held.items()}
        if id(value) in self._told:
            self.replaced.add(id(value))
            new |= self._told[id(value)][1]
        elif all(new[name] is held[name] for name in held):
            return value
        other: Any = object.__new__(kind)
        vars(other).update(new)
        return other

    def _either(self, parts: Any, build: Callable[[list[Any]], Any], value: Any) -> Any:
        """Return the container of the copies, itself where there are none."""
        new = [self._of(part) for part in parts]
        return value if all(one is old for one, old in zip(new, parts, strict=True)) else build(new)

"""The contents of objects and functions, watched so that no program computes with a number that has changed.

The objects are pickled, which walks through all that they hold; the text, with classes and functions by
their identity and floating-point tensors by their order, is a key: equal keys compute the same. On the way
every container, tensor and class is noted, so that `Contents.unchanged` needs no second walk: it compares
identities, ten microseconds for a policy, where tracing a step anew takes .1 to .4 s and the policy thirty
microseconds. A function of a user also counts with what it reads beside its arguments: closure, defaults,
attributes, and every global that its code names, and so on through the functions and classes found there.
The library's own code, Python's and that of installed packages stands as it is.
"""

from __future__ import annotations

import copy
import ctypes
import functools
import io
import logging
import operator
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import chain, repeat
from operator import is_
from types import CodeType, MethodType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..row_numbers import all_rows
from .walk import BOUND, EMPTY, OF_PYTHON, READ, Derived, IdentityKey, Walk, content_of, is_users

_PACKAGE = __name__.partition(".")[0]
_VERSIONED = frozenset((_PACKAGE, "torch", "numpy", *OF_PYTHON))  # other processes have the same
_log = logging.getLogger(__name__)
_said: set[tuple[str, str]] = set()  # what has been logged
_REQUIRES = operator.attrgetter("requires_grad")
_CODE_OF, _CONTENT = operator.attrgetter("__code__", "__defaults__"), operator.attrgetter("cell_contents")
_BASE, _ARRAY = operator.itemgetter(*READ), operator.methodcaller("tobytes")


class Contents:
    """All that objects hold and lead to.

    Args:
        objects: modules, tensors, functions, anything that can be pickled.
        telling: whether floats of the library's objects count as tensors.
        watched: whether `unchanged` and `renewed` will be asked for.

    Attributes:
        key: of the settings inside; None where something cannot be written down (an open file, a lock).
        tensors: the floating-point tensors that the key leaves out, in an order that equal keys share.
        others: all other tensors.
        reason: why there is no key, or what cannot be watched; None where all can.
        of_users: whether code of a user is among what objects hold or lead to, or nobody can say.
        told: objects by their addresses, and tensors by the names of the floats that they stand for.
    """

    def __init__(self, *objects: Any, telling: bool = False, watched: bool = True) -> None:
        walk = self._walk = Walk(io.BytesIO(), telling)
        self.key: tuple[bytes, tuple[object, ...]] | None = None
        self._default = torch.get_default_dtype()  # of the numbers that code makes
        try:
            for each in objects:
                walk.dump(each)
            walk.finish()
            self.key = walk.file.getvalue() + str(self._default).encode(), tuple(walk.kept)
            self.reason = walk.unwatched
        except Exception as error:  # of any object that a function names: a lock, a deep list, a proxy
            self.reason = f"{type(error).__name__}: {error}"
        walk.clear_memo()  # in which the garbage collector of Python 3.11.2 finds no cycle
        self.tensors, self.others = walk.tensors, walk.others
        self.of_users = walk.of_users or self.key is None
        self.told = walk.told
        kinds = chain.from_iterable([each.__mro__ for each in walk.kept if isinstance(each, type)])
        classes = [(vars(kind), is_users(kind)) for kind in dict.fromkeys(kinds) if kind is not object]
        self._users = [space for space, users in classes if users]
        self._library = [space for space, users in classes if not users]
        if watched:
            self._watch(walk)

    def _watch(self, walk: Walk) -> None:
        """Note how all that was come upon is now."""
        self._writes, self._structural = Writes([*walk.tensors, *walk.others]), Writes(walk.others)
        self._rare: list[tuple[Callable[[Any], Any], Any, Any]] = [
            *((set, part, set(part)) for part in walk.sets),
            *((_ARRAY, array, array.tobytes()) for array in walk.arrays),
        ]
        # Live views of all containers: what they lead to is compared at once, in five microseconds a policy.
        self._modules = [attributes for attributes, _ in walk.modules]
        self._sized = [*walk.dicts, *self._users, *walk.lists, *self._modules]
        self._views = [*(part.values() for part in (*walk.dicts, *self._users)), *walk.lists]
        owners = [(attributes, own) for attributes, own in walk.modules if own]
        self._owners = [attributes for attributes, _ in owners]
        self._own = [operator.itemgetter("training", *own) for _, own in owners]
        lookups = walk.lookups
        self._looked_up = [lookup.space for lookup in lookups], [lookup.name for lookup in lookups]
        self._content = content_of if any(content_of(cell) is EMPTY for cell in walk.cells) else _CONTENT
        self._lengths, self._inside = [*map(len, self._sized)], [*self._look()]
        self._bases = [*map(_BASE, self._modules)]
        self._methods = self.methods()

    def wants_gradient(self) -> bool:
        """Return whether autograd is on, and one of the tensors requires a gradient."""
        return torch.is_grad_enabled() and any(map(_REQUIRES, self.tensors))

    def warn(self, name: str) -> None:
        """Log, once, what cannot be watched."""
        if self.reason is not None and (name, self.reason) not in _said:
            _said.add((name, self.reason))
            _log.warning("%s: later changes of what it reads here are not noticed: %s", name, self.reason)

    def unchanged(self, *, library: bool = True) -> bool:
        """Return whether nothing of what can be watched has changed since; with ``library`` also no method
        of a class that is not a user's."""
        try:
            return (
                torch.get_default_dtype() is self._default
                and (not self._sized or [*map(len, self._sized)] == self._lengths)
                and not any(self._walk.empty)
                # the same objects: nothing else is compared
                and (not self._modules or [*map(_BASE, self._modules)] == self._bases)
                and all(map(is_, self._look(), self._inside))
                and self._writes.none()
                and not (self._rare and any(now(part) != then for now, part, then in self._rare))
                and not (library and self.replaced(self._methods))
            )
        except (KeyError, RuntimeError, ValueError):  # what is gone, or comes from another thread meanwhile
            return False

    def renewed(self) -> bool:
        """Return whether floating-point numbers alone have changed; they count from now on."""
        then, self._writes = self._writes, self._writes.again()
        if self._writes.alike(then) and self.unchanged(library=False) and self._structural.none():
            return True
        self._writes = then
        return False

    def methods(self) -> list[Any]:
        """Return what is in the library's classes that were come upon, and in their bases."""
        return [*chain.from_iterable(part.values() for part in self._library)]

    def replaced(self, methods: list[Any]) -> bool:
        """Return whether a method of the library's is not what it was among ``methods``."""
        now = chain.from_iterable([part.values() for part in self._library])
        return sum(map(len, self._library)) != len(methods) or not all(map(is_, now, methods))

    def signature(self) -> bytes | None:
        """Return the key as bytes that mean the same in every process.

        None where it names a class or function of which another process may have another version: all but
        this library, torch and Python's own.
        """
        if self.key is None:
            return None
        text, kept = self.key
        names = [text]
        for value in kept:
            if isinstance(value, CodeType | IdentityKey):
                return None
            module, name = getattr(value, "__module__", None) or "", value.__qualname__  # type: ignore[attr-defined]
            found: Any = sys.modules.get(module)
            for part in name.split("."):
                found = getattr(found, part, None)
            if found is not value or module.partition(".")[0] not in _VERSIONED:
                return None
            names.append(f"{module}.{name}".encode())
        return b"\0".join(names)

    def _look(self) -> Iterator[Any]:
        """Look into all containers, and at what functions read beside."""
        walk = self._walk
        found: list[Iterable[Any]] = [*self._views, *map(operator.call, self._own, self._owners)]
        if walk.functions:
            found += map(_CODE_OF, walk.functions)  # an editor may reload them
        if walk.lookups:
            found.append(map(dict.get, *self._looked_up, repeat(EMPTY)))
        if walk.cells:
            found.append(map(self._content, walk.cells))
        return chain.from_iterable(found)


_VERSION, _SHAPE = operator.attrgetter("_version"), operator.attrgetter("shape")
_BYTES = operator.methodcaller("tobytes")
_SMALL = 1 << 16  # bytes of a tensor that are compared at every call
_FEW = 64  # numbers of a larger one


def version(tensor: Tensor) -> int:
    """Return a number that is another one once the tensor was written to.

    Torch counts writes, but not those to tensors made in inference mode: of these it is the content.
    """
    tensor = all_rows(tensor)
    return hash(tensor.numpy(force=True).tobytes()) if tensor.is_inference() else tensor._version


class Writes:
    """The state of tensors now, to be compared later.

    Torch counts writes to a tensor, but none to ``tensor.data`` (``target.data.copy_(...)``) or by NumPy,
    nor that ``tensor.data = other`` gives it other memory, as `torch.nn.utils.vector_to_parameters` does. So
    memory of the processor is compared, too: all of it up to 64 kB a tensor and where torch counts nothing,
    64 numbers of a larger one. On a device it is torch's count alone, as looking waits.

    Args:
        tensors: numbers of rows among them.
    """

    def __init__(self, tensors: Sequence[Tensor]) -> None:
        self._tensors = [*map(all_rows, tensors)]
        self._placed = [tensor for tensor in self._tensors if _has_memory(tensor)]
        # Kept, so that other memory cannot come to lie at the same address meanwhile.
        self._memory = [tensor.untyped_storage() for tensor in self._placed]
        self._addresses = [*map(Tensor.data_ptr, self._placed)]
        self._shapes = [*map(_SHAPE, self._tensors)]
        self._views = list[memoryview]()
        self._samples = list[np.ndarray[Any, Any]]()
        for tensor, address in zip(self._placed, self._addresses, strict=True):
            if not tensor.is_cpu:
                continue
            size = tensor.element_size() * (1 + sum(map(_reach, tensor.shape, tensor.stride())))
            begin = tensor.element_size() * tensor.storage_offset()
            there = tensor.untyped_storage().nbytes() - begin  # a storage may have been cut off
            size = int(max(0, min(size, there)))
            memory = memoryview((ctypes.c_char * size).from_address(address))
            if size <= _SMALL or tensor.is_inference():
                self._views.append(memory)
            else:
                width = min(tensor.element_size(), 8)
                self._samples.append(np.frombuffer(memory, f"u{width}")[:: size // (width * _FEW)])
        # Torch also counts what moves no number: `matrix.t_()`.
        self._counted = [tensor for tensor in self._tensors if not tensor.is_inference()]
        self._look()

    def _look(self) -> None:
        self._versions = [*map(_VERSION, self._counted)]
        self._contents = [*map(bytearray, self._views)]  # equal to memory of the same bytes, at once
        self._parts = [*map(_BYTES, self._samples)]

    def again(self) -> Writes:
        """Return how the same tensors are now."""
        same = [*map(Tensor.data_ptr, self._placed)] == self._addresses
        if not same or [*map(_SHAPE, self._tensors)] != self._shapes:
            return Writes(self._tensors)
        now = copy.copy(self)
        now._look()
        return now

    def alike(self, other: Writes) -> bool:
        """Return whether tensors had the shapes that they had at another time."""
        return self._shapes == other._shapes

    def none(self) -> bool:
        """Return whether nothing was written since."""
        return (
            [*map(Tensor.data_ptr, self._placed)] == self._addresses  # first: memory may have been given back
            and self._contents == self._views
            and [*map(_VERSION, self._counted)] == self._versions
            and (not self._samples or [*map(_BYTES, self._samples)] == self._parts)
        )


def _reach(size: int, stride: int) -> int:
    return (size - 1) * stride


def _has_memory(tensor: Tensor) -> bool:
    """Return whether a tensor lies somewhere: sparse ones, those of a transform or a fake mode do not."""
    if tensor.layout is not torch.strided or tensor.is_nested or tensor.is_meta:
        return False
    try:
        return tensor.data_ptr() != 0
    except RuntimeError:
        return False


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

    ``replaced`` are addresses of the objects that were copied with tensors, ``others`` what was not looked
    into.
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

"""What a program is made of, as a key: equal keys compute the same."""

from __future__ import annotations

import copyreg
import hashlib
import io
import pickle
import sys
from collections.abc import Hashable, Iterable, Mapping
from types import BuiltinFunctionType, CellType, CodeType, FunctionType, MethodType, ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from .surroundings import EMPTY, Lookup, Same, content_of, installed, is_users, lookups


def skeleton(*objects: Any) -> tuple[Hashable, list[Tensor]] | None:
    """Return a key of the settings inside of objects, and the floating-point tensors that it leaves out.

    They come in an order that equal keys share. A function of a user counts with all that it reads: what it
    closes over, its defaults, the globals that it names, and so on through the functions that it calls. None
    where something cannot be written down (an open file, a lock).

    Args:
        objects: modules, tensors, functions, anything that can be pickled.
    """
    writer = written(objects)
    return None if isinstance(writer, str) else ((writer.file.getvalue(), tuple(writer.kept)), writer.tensors)


def reads_users_code(*objects: Any) -> bool:
    """Return whether code of a user is among what objects hold or lead to, or nobody can say.

    Args:
        objects: as of `skeleton`.
    """
    writer = written(objects)
    return isinstance(writer, str) or writer.of_users


def signature(key: Any) -> bytes | None:
    """Return a key of `skeleton` as bytes that mean the same in every process.

    None where it names a class or function of which another process may have another version: all but this
    library, torch and Python's own.

    Args:
        key: of `skeleton`.
    """
    text, kept = key
    names = list[str]()
    for value in kept:
        if isinstance(value, CodeType | Same):
            return None
        module, name = getattr(value, "__module__", None) or "", value.__qualname__
        found: Any = sys.modules.get(module)
        for part in name.split("."):
            found = getattr(found, part, None)
        if found is not value or module.partition(".")[0] not in _VERSIONED:
            return None
        names.append(f"{module}.{name}")
    return b"\0".join((text, *(name.encode() for name in names)))


_VERSIONED = frozenset((__name__.partition(".")[0], "torch", "numpy", *sys.stdlib_module_names)) - {
    "__main__"
}


def code(key: Any) -> list[Mapping[str, Any]]:
    """Return what is in the classes that a key of `skeleton` names, and in their bases: methods above all."""
    _, kept = key
    return inside_classes(kept)


def inside_classes(kept: Iterable[object]) -> list[Mapping[str, Any]]:
    """Return what is in the classes among what was kept, and in their bases.

    Args:
        kept: of a `Writer`.
    """
    kinds = (kind for each in kept if isinstance(each, type) for kind in each.__mro__)
    return [vars(kind) for kind in dict.fromkeys(kinds) if kind is not object]


def written(objects: tuple[Any, ...]) -> Writer | str:
    """Return what has read all that objects hold, or why it could not.

    Args:
        objects: as of `skeleton`.
    """
    writer = Writer(io.BytesIO())
    try:
        for each in objects:
            writer.dump(each)
        writer.finish()
    except Exception as error:  # of any object that a function names: a lock, a deep list, a proxy
        return f"{type(error).__name__}: {error}"
    return writer


_ATOMS = frozenset((str, int, float, bool, bytes, tuple, type(None)))  # and what an address alone tells apart
_SMALL = 1 << 14  # bytes of an array that are compared at every call
_FIXED = (
    *(tuple, type, frozenset, complex, slice, range, np.generic, np.dtype, torch.dtype, torch.device),
    *(FunctionType, BuiltinFunctionType, MethodType),
)


class Writer(pickle.Pickler):
    """Writes everything but floating-point tensors, and notes what may change later."""

    def __init__(self, file: io.BytesIO) -> None:
        super().__init__(file)
        self.file = file
        self.kept: list[object] = []  # part of the key: an address is used once
        self.tensors: list[Tensor] = []
        self.others: list[Tensor] = []  # whose numbers are part of the key
        self.dicts: list[dict[Any, Any]] = []
        self.lists: list[list[Any]] = []
        self.sets: list[set[Any]] = []
        self.lookups: list[Lookup] = []
        self.cells: list[CellType] = []
        self.functions: list[FunctionType] = []
        self.of_users = False  # whether a function or class of a user was come upon
        self.arrays: list[np.ndarray[Any, Any]] = []
        self.inside: tuple[int, ...] = (0,) * 6  # how many of `held` lie inside of the objects
        self.blind, self.blind_around = False, False  # whether something cannot be watched, inside or around
        self._places: dict[int, int] = {}
        self._waiting: list[FunctionType | type] = []  # whose surroundings are to be written
        self._met: dict[int, int] = {}  # of a function or class of a user: its place among the kept

    def finish(self) -> None:
        """Write what the functions and classes of a user read that were come upon, and so on."""
        self.inside = tuple(map(len, self.held()))
        inside, self.blind = self.blind, False
        while self._waiting:
            met = self._waiting.pop()
            self.dump(self._class(met) if isinstance(met, type) else self._function(met))
        self.blind, self.blind_around = inside or self.blind, self.blind

    def held(self) -> tuple[list[Any], ...]:
        """All that may change later without being another object."""
        return self.dicts, self.lists, self.sets, self.arrays, self.tensors, self.others

    def _function(self, function: FunctionType) -> tuple[Any, ...]:
        """What a function reads beside its arguments."""
        parts: list[Any] = [function.__defaults__, function.__kwdefaults__, vars(function)]
        for cell in function.__closure__ or ():
            self.cells.append(cell)
            content = content_of(cell)
            if content is EMPTY or (isinstance(content, ModuleType) and is_users(function)):
                self.kept.append(Same(content))  # and what the function asks a module for, below
            else:
                parts.append(content)
        if not is_users(function):
            return tuple(parts)
        for lookup in lookups(function):
            self.lookups.append(lookup)
            value = lookup.value
            parts.append(lookup.name)
            if lookup.installed or isinstance(value, ModuleType):
                self.kept.append(Same(value))
            else:
                parts.append(value)
        return tuple(parts)

    def _class(self, kind: type) -> tuple[Any, ...]:
        """What the classes of a user hold from which one is derived: functions, numbers, containers."""
        users = [vars(each).items() for each in kind.__mro__ if is_users(each)]
        return tuple(part for items in users for name, value in items for part in _parts(name, value))

    def reducer_override(self, value: Any) -> Any:
        if not isinstance(value, nn.Module):
            return NotImplemented
        # The keys of hooks count all hooks of the process, and those of state_dicts change no result.
        state = {name: part for name, part in value.__getstate__().items() if "state_dict" not in name}
        hooks = {
            name: tuple(part.values()) for name, part in state.items() if name.endswith("_hooks") and part
        }
        return copyreg.__newobj__, (type(value),), state | hooks  # type: ignore[attr-defined]

    def persistent_id(self, value: Any) -> Any:
        if type(value) in _ATOMS:  # most of all: asked for every object
            return None
        if isinstance(value, Tensor):
            return self._tensor(value)
        if isinstance(value, type | FunctionType) and self._reads(value):
            return self._of_users(value)
        if isinstance(value, type | FunctionType | BuiltinFunctionType):
            self.kept.append(value)
            return len(self.kept)
        if isinstance(value, ModuleType):
            if not installed(value.__name__):
                raise pickle.PicklingError(f"the module {value.__name__}, which may change")
            self.kept.append(Same(value))
            return len(self.kept)
        if isinstance(value, np.ndarray) and not value.dtype.hasobject:
            return self._array(value)
        if type(value).__module__ == "itertools":  # Python 3.12 warns of it, 3.14 refuses
            raise pickle.PicklingError(f"an iterator, {type(value).__name__}")
        self._note(value)
        return None

    @staticmethod
    def _reads(value: type | FunctionType) -> bool:
        """Whether more than the address of a function or class decides what it does."""
        return is_users(value) or (isinstance(value, FunctionType) and value.__closure__ is not None)

    def _of_users(self, value: type | FunctionType) -> int:
        """Note a function or class once. Of a function the code counts: a lambda is often made anew."""
        if id(value) not in self._met:
            if isinstance(value, FunctionType):
                self.functions.append(value)
                self.kept.append(value.__code__)
            else:
                self.kept.append(value)
            self.of_users = self.of_users or is_users(value)
            self._met[id(value)] = len(self.kept)
            self._waiting.append(value)
        return self._met[id(value)]

    def _tensor(self, value: Tensor) -> Any:
        if not value.is_floating_point():
            self.others.append(value)
            plain = value.detach().cpu()
            return str(value.dtype), str(value.device), tuple(value.shape), plain.numpy().tobytes()
        if id(value) not in self._places:
            self._places[id(value)] = len(self.tensors)
            self.tensors.append(value)
        place = self._places[id(value)]
        return place, str(value.dtype), str(value.device), tuple(value.shape), value.stride()

    def _array(self, value: np.ndarray[Any, Any]) -> Any:
        """The numbers of an array by their digest: keys stay small."""
        if value.nbytes <= _SMALL:
            self.arrays.append(value)
        else:
            self.blind = True
        return str(value.dtype), value.shape, hashlib.blake2b(value.tobytes()).digest()

    def _note(self, value: Any) -> None:
        known = True
        if isinstance(value, dict):
            self.dicts.append(value)
        elif isinstance(value, list):
            self.lists.append(value)
        elif isinstance(value, set):
            self.sets.append(value)
        else:
            known = isinstance(value, _FIXED)
        if hasattr(value, "__dict__"):
            self.dicts.append(vars(value))
        elif not known:
            self.blind = True


_SIMPLE = (int, float, complex, str, bytes, tuple, list, dict, set, frozenset, Tensor)


def _parts(name: str, value: Any) -> Iterable[Any]:
    """What an attribute of a class holds that a step may read: functions, or itself."""
    if isinstance(value, property):
        return [part for part in (value.fget, value.fset, value.fdel) if part is not None]
    value = getattr(value, "__func__", value)  # of a static or class method
    known = (
        FunctionType if name.startswith("__") else (FunctionType, *_SIMPLE)
    )  # not annotations and the like
    return [value] if isinstance(value, known) else []

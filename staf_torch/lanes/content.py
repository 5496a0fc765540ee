"""What a program is made of, as a key: equal keys compute the same."""

from __future__ import annotations

import copyreg
import io
import pickle
import sys
from collections.abc import Hashable, Iterable, Mapping
from itertools import chain
from operator import is_
from types import BuiltinFunctionType, FunctionType, MethodType
from typing import Any

import torch
from torch import Tensor, nn


def skeleton(*objects: Any) -> tuple[Hashable, list[Tensor]] | None:
    """Return a key of the settings inside of objects, and the floating-point tensors that it leaves out.

    They come in an order that equal keys share. None where an object holds a closure.

    Args:
        objects: modules, tensors, anything that can be pickled.
    """
    writer = _written(objects)
    return None if writer is None else ((writer.file.getvalue(), tuple(writer.kept)), writer.tensors)


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


class Watch:
    """Says whether objects are as they were: nothing inside of them has been put in the place of another.

    Args:
        objects: as of `skeleton`.

    Attributes:
        tensors: inside of them.
        blind: whether something inside cannot be watched.
    """

    def __init__(self, *objects: Any) -> None:
        writer = _written(objects)
        self.blind = writer is None or writer.blind
        if writer is None:
            return
        self.tensors = [*writer.tensors, *writer.others]
        self._versions = [tensor._version for tensor in self.tensors]
        self._dicts, self._lists = writer.dicts, writer.lists
        self._sets = [(part, set(part)) for part in writer.sets]
        self._code = _inside(writer.kept)
        self._lengths, self._inside = self._look()

    def unchanged(self) -> bool:
        """Return whether nothing has changed since."""
        if self.blind:
            return False
        lengths, inside = self._look()  # all at once: a hundred containers in ten microseconds
        if lengths != self._lengths or not all(map(is_, inside, self._inside)):
            return False
        if any(now != then for now, then in self._sets):
            return False
        return [tensor._version for tensor in self.tensors] == self._versions

    def _look(self) -> tuple[list[int], list[Any]]:
        """The lengths of all containers, and what is in them."""
        parts: list[Iterable[Any]] = [part.values() for part in self._dicts]
        parts += [part.values() for part in self._code]  # a method may be replaced
        parts += self._lists
        return [*map(len, self._dicts), *map(len, self._code), *map(len, self._lists)], [
            *chain.from_iterable(parts)
        ]


def code(key: Any) -> list[Mapping[str, Any]]:
    """Return what is in the classes that a key of `skeleton` names, and in their bases: methods above all."""
    _, kept = key
    return _inside(kept)


def _inside(kept: Iterable[object]) -> list[Mapping[str, Any]]:
    kinds = (kind for each in kept if isinstance(each, type) for kind in each.__mro__)
    return [vars(kind) for kind in dict.fromkeys(kinds) if kind is not object]


def _written(objects: tuple[Any, ...]) -> _Writer | None:
    writer = _Writer(io.BytesIO())
    try:
        for each in objects:
            writer.dump(each)
    except (pickle.PicklingError, TypeError, AttributeError):
        return None
    return writer


_ATOMS = frozenset((str, int, float, bool, bytes, tuple, type(None)))  # and what an address alone tells apart
_FIXED = (tuple, type, FunctionType, BuiltinFunctionType, MethodType, torch.dtype, torch.device, frozenset)


class _Writer(pickle.Pickler):
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
        self.blind = False
        self._places: dict[int, int] = {}

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
        if isinstance(value, FunctionType) and value.__closure__:
            raise pickle.PicklingError("a closure")
        if isinstance(value, type | FunctionType | BuiltinFunctionType):
            self.kept.append(value)
            return len(self.kept)
        self._note(value)
        return None

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

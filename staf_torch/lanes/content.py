"""What a program is made of, as a key: equal keys compute the same."""

from __future__ import annotations

import copyreg
import io
import pickle
import sys
from collections.abc import Hashable
from types import BuiltinFunctionType, FunctionType
from typing import Any

from torch import Tensor, nn


def content(*objects: Any) -> Hashable | None:
    """Return a key of all numbers and settings inside of objects; None where one of them holds a closure.

    Classes and functions are told apart by identity, so that one that is defined anew is another. What a
    function closed over, nobody sees from here.

    Args:
        objects: modules, tensors, anything that can be pickled.
    """
    text = io.BytesIO()
    writer = _Writer(text)
    try:
        for each in objects:
            writer.dump(each)
    except (pickle.PicklingError, TypeError, AttributeError):
        return None
    return text.getvalue(), tuple(writer.kept)


def skeleton(*objects: Any) -> tuple[Hashable, list[Tensor]] | None:
    """Return a key of the settings inside of objects, and the floating-point tensors that it leaves out.

    They come in an order that equal keys share. None where an object holds a closure.

    Args:
        objects: modules, tensors, anything that can be pickled.
    """
    text = io.BytesIO()
    writer = _Skeleton(text)
    try:
        for each in objects:
            writer.dump(each)
    except (pickle.PicklingError, TypeError, AttributeError):
        return None
    return (text.getvalue(), tuple(writer.kept)), writer.tensors


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
_PLAIN = frozenset((str, int, float, bool, bytes, tuple, list, dict, set, type(None)))


class _Writer(pickle.Pickler):
    def __init__(self, file: io.BytesIO) -> None:
        super().__init__(file)
        self.kept: list[object] = []  # part of the key: an address is used once

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
        if type(value) in _PLAIN:  # most of all: asked for every object
            return None
        if isinstance(value, FunctionType) and value.__closure__:
            raise pickle.PicklingError("a closure")
        if isinstance(value, type | FunctionType | BuiltinFunctionType):
            self.kept.append(value)
            return len(self.kept)
        if isinstance(value, Tensor):
            plain = value.detach().cpu()
            return str(value.dtype), str(value.device), tuple(value.shape), plain.numpy().tobytes()
        return None


class _Skeleton(_Writer):
    def __init__(self, file: io.BytesIO) -> None:
        super().__init__(file)
        self.tensors: list[Tensor] = []
        self._places: dict[int, int] = {}

    def persistent_id(self, value: Any) -> Any:
        if type(value) in _PLAIN:
            return None
        if not isinstance(value, Tensor) or not value.is_floating_point():
            return super().persistent_id(value)
        if id(value) not in self._places:
            self._places[id(value)] = len(self.tensors)
            self.tensors.append(value)
        place = self._places[id(value)]
        return place, str(value.dtype), str(value.device), tuple(value.shape), value.stride()

"""What captured numbers are called: the attributes, entries and variables that lead to their tensors."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Mapping, Sequence
from types import FunctionType, MethodType, ModuleType
from typing import Any

import numpy as np
from torch import Tensor, nn

from ..dependencies.contents import BOUND, Derived
from ..dependencies.lookups import EMPTY, content_of
from ..trace.captured_tensors import Recipe, tensors
from ..trace.kept_numbers import sources

_LED = "; others here follow from it"
_ASKED = "; the text was written for this value"
_MOST = 3  # names of what a number follows from
_OF_MODULES = frozenset(vars(nn.Module()))
_FREE = re.compile(r"[^\w.\[\], ]")  # nothing that ends a comment


def named_tensors(roots: Mapping[str, Any]) -> dict[int, tuple[str, Tensor]]:
    """Return tensors that objects lead to by the addresses of their memory, with the shortest name of each.

    Args:
        roots: objects by their names; that of the only one may be "".
    """
    found: dict[int, tuple[str, Tensor]] = {}
    met, waiting = set[int](), [*roots.items()]
    while waiting:
        name, value = waiting.pop(0)
        if isinstance(value, Tensor):
            found.setdefault(_address(value), (_FREE.sub("?", name), value))
        elif id(value) not in met:
            met.add(id(value))
            waiting += _parts(name, value)
    return found


def said(recipe: Recipe, known: Mapping[int, tuple[str, Tensor]]) -> list[str]:
    """Return what every number of a table is called: its name, or those of what it follows from."""
    ends, found = sources(recipe), {id(tensor): tensor for tensor in recipe.found}
    made = {id(tensor) for *_, out in recipe.operations for tensor in tensors(out)}

    def origins(tensor: Tensor) -> set[int]:
        """The memory of the found tensors that one follows from."""
        return {_address(found[key]) for key in ends.get(id(tensor), ()) if key in found}

    def named(tensor: Tensor) -> bool:
        return _address(tensor) in known or id(tensor) not in made

    led = set[int]().union(*(origins(tensor) for tensor, _ in recipe.reads if not named(tensor)))
    asked = set[int]().union(*(origins(tensor) for tensor, _ in recipe.checks))
    told = list[str]()
    for tensor, at in recipe.reads:
        if not named(tensor):
            names = [known[address][0] for address in origins(tensor) if address in known]
            told += [f"follows from {_some(names)}"] * len(at)
            continue
        name, whole = known.get(_address(tensor), ("without a name", tensor))
        more = _LED * (_address(tensor) in led) + _ASKED * (_address(tensor) in asked)
        index = {place: k for k, place in enumerate(_places(whole).reshape(-1).tolist())}
        places = _places(tensor).reshape(-1)[at].tolist()
        told += [_entry(name, whole, index.get(place)) + more for place in places]
    return told


def _some(names: Sequence[str]) -> str:
    listed = sorted(names, key=lambda name: ("._" in name, name))
    more = f" and {len(listed) - _MOST} more" if len(listed) > _MOST else ""
    return ", ".join(listed[:_MOST]) + more or "numbers without a name"


def _entry(name: str, whole: Tensor, place: int | None) -> str:
    if whole.dim() == 0 or place is None:
        return name
    return f"{name}[{', '.join(map(str, np.unravel_index(place, tuple(whole.shape))))}]"


def _places(tensor: Tensor) -> np.ndarray[Any, Any]:
    """Return the places in memory of the entries."""
    at = np.full(tuple(tensor.shape), int(tensor.storage_offset()), dtype=np.int64)
    for axis, (size, stride) in enumerate(zip(tensor.shape, tensor.stride(), strict=True)):
        at += (np.arange(size) * stride).reshape([-1] + [1] * (tensor.dim() - axis - 1))
    return at


def _address(tensor: Tensor) -> int:
    return tensor.untyped_storage().data_ptr()


def _parts(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """What an object leads to, by names."""
    dot = f"{name}." if name else ""
    if isinstance(value, list | tuple):
        fields = getattr(value, "_fields", None)
        named = [f"{name}[{k}]" for k in range(len(value))] if fields is None else [dot + f for f in fields]
        yield from zip(named, value, strict=True)
    elif isinstance(value, dict):
        yield from ((f"{name}[{key}]", part) for key, part in value.items())
    elif isinstance(value, FunctionType):
        yield from _read_by(dot, value)
    elif isinstance(value, MethodType):
        yield name, value.__self__
    elif not isinstance(value, type | ModuleType | Derived | str | int | float | None):
        held = getattr(value, "__dict__", {})
        inside = [held.get(each) or {} for each in ("_parameters", "_buffers", "_modules")]
        own = [(k, v) for k, v in held.items() if k not in _OF_MODULES and k != BOUND]
        own.sort(key=lambda each: each[0].startswith("_"))  # the names that a user knows come first
        everything = itertools.chain(*(part.items() for part in inside), own)
        yield from ((dot + key, part) for key, part in everything)


def _read_by(dot: str, function: FunctionType) -> Iterator[tuple[str, Any]]:
    code = function.__code__
    for key, cell in zip(code.co_freevars, function.__closure__ or (), strict=True):
        if (content := content_of(cell)) is not EMPTY:
            yield dot + key, content
    for key in code.co_names:
        if isinstance(part := function.__globals__.get(key), Tensor | nn.Module):
            yield dot + key, part

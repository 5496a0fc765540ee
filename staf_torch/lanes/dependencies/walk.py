"""The walk through objects and functions: what they hold, names that code looks up, and whose code it is."""

from __future__ import annotations

import copyreg
import dis
import functools
import hashlib
import io
import math
import os
import pickle
import sys
import sysconfig
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import BuiltinFunctionType, CellType, CodeType, FunctionType, MethodType, ModuleType
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.utils import parametrize

from ..row_numbers import RowNumbers

_PACKAGE = __name__.partition(".")[0]
OF_PYTHON = frozenset(sys.stdlib_module_names) - {"__main__"}
_FOLDERS = (
    *(Path(sysconfig.get_path(name)) for name in ("stdlib", "platstdlib", "purelib", "platlib")),
    Path(os.__file__).parent,  # where links make that another path
)
_PACKAGES = frozenset(("site-packages", "dist-packages"))
_SIMPLE = (int, float, complex, str, bytes, tuple, list, dict, set, frozenset, Tensor)
_WRITTEN = 1 << 9  # Py_TPFLAGS_HEAPTYPE: made by a `class` statement
EMPTY = object()
"""In a cell whose name has no value yet, and in place of a global that is gone."""


class Lookup(NamedTuple):
    """A name that code looks up in the globals of its module, or in a module that it found there."""

    space: dict[str, Any]
    name: str

    @property
    def value(self) -> Any:
        return self.space.get(self.name, EMPTY)


def lookups(function: FunctionType) -> Iterator[Lookup]:
    """Yield what a function looks up by name: its globals, and attributes of modules there or in its closure.

    An attribute counts for every module that the function knows; too many do no harm.
    """
    names, attributes = _names(function.__code__)
    closed_over = map(content_of, function.__closure__ or ())
    spaces = [(function.__globals__, names)]
    spaces += [(vars(part), attributes) for part in closed_over if isinstance(part, ModuleType)]
    seen = {id(space) for space, _ in spaces}
    while spaces:
        space, names = spaces.pop()
        for name in names:
            if name in space:
                value = space[name]
                yield Lookup(space, name)
            else:
                value = sys.modules.get(name)  # an import inside of the function
            if isinstance(value, ModuleType) and id(vars(value)) not in seen:
                seen.add(id(vars(value)))
                spaces.append((vars(value), attributes))


@functools.lru_cache(maxsize=4096)
def _names(code: CodeType) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The names that code and the code inside of it look up, and the attributes that it asks for."""
    names, attributes = dict[str, None](), dict[str, None]()
    for instruction in dis.get_instructions(code):
        if instruction.opname in ("LOAD_GLOBAL", "LOAD_NAME", "IMPORT_NAME"):
            names[instruction.argval.partition(".")[0]] = None
        if instruction.opname in ("LOAD_ATTR", "LOAD_METHOD", "IMPORT_FROM", "IMPORT_NAME"):
            attributes.update(dict.fromkeys(instruction.argval.split(".")))
    for part in code.co_consts:
        if isinstance(part, CodeType):
            inner, asked = _names(part)
            names.update(dict.fromkeys(inner))
            attributes.update(dict.fromkeys(asked))
    return tuple(names), tuple(attributes)


def content_of(cell: CellType) -> Any:
    """Return the content of a closure's cell, or `EMPTY`."""
    try:
        return cell.cell_contents
    except ValueError:
        return EMPTY


def attribute_parts(name: str, value: Any) -> Iterable[Any]:
    """Return the parts of a class attribute that a step may read: functions, or itself."""
    if isinstance(value, property):
        return [part for part in (value.fget, value.fset, value.fdel) if part is not None]
    value = getattr(value, "__func__", value)  # of a static or class method
    known = FunctionType if name.startswith("__") else (FunctionType, *_SIMPLE)  # no annotations
    return [value] if isinstance(value, known) else []


@functools.lru_cache(maxsize=4096)
def installed(module: str) -> bool:
    """Return whether a module's code stands: this library's, Python's own, what lies in a folder of packages.

    What is left is a user's: a script, a notebook, files beside it. ``__main__`` is, whatever file it names:
    `python -m cProfile script.py` runs a script in a namespace of this name, and the module is the profiler.
    """
    root = module.partition(".")[0]
    if root == _PACKAGE or (root.startswith("namedtuple_") and root not in sys.modules):
        return True  # of a named tuple's own methods
    file = getattr(sys.modules.get(module), "__file__", None)
    if root == "__main__" or file is None:
        return root in OF_PYTHON
    path = Path(file)
    if any(path.is_relative_to(folder) for folder in _FOLDERS) or _PACKAGES & set(path.parts):
        return True
    return root in OF_PYTHON and any(part.endswith(".zip") for part in path.parts)  # not a user's `code.py`


def is_users(value: FunctionType | type) -> bool:
    """Return whether a function or a class is of a user, and may read what changes between two calls."""
    module = value.__globals__.get("__name__") if isinstance(value, FunctionType) else value.__module__
    if module == "builtins" and isinstance(value, type):  # of text that was run in a namespace without a name
        return bool(value.__flags__ & _WRITTEN)
    return not (isinstance(module, str) and installed(module))


ATOMS = frozenset((str, int, float, bool, bytes, tuple, type(None)))  # and what an address alone tells apart
_SMALL = 1 << 14  # bytes of an array that are compared at every call
_FIXED = (
    *(tuple, type, frozenset, complex, slice, range, np.generic, np.dtype, torch.dtype, torch.device),
    *(FunctionType, BuiltinFunctionType, MethodType),
)
_CODE = (type, FunctionType, BuiltinFunctionType)
_OF_EVERY_MODULE = frozenset(vars(nn.Module()))  # looked into by themselves
READ = ("training", "_parameters", "_buffers", "_modules", "_forward_hooks", "_forward_pre_hooks")
IDLE = _OF_EVERY_MODULE - {*READ}  # hooks of derivatives and of state_dicts, and what goes with other hooks
_TOLD = "a number of the table"
BOUND = "_compiled_methods"
"""Attribute in which an object holds its compiled methods: no part of what it is."""
_UNREAD, _HOOKS = IDLE | {BOUND}, ("_forward_hooks", "_forward_pre_hooks")


class Derived:
    """Base of what follows from its recipe in a pickle, as programs do: nothing inside of it is watched."""


@functools.lru_cache(maxsize=4096)
def _is_layer(kind: type) -> bool:
    """Return whether a class or one of its bases makes parameters, which require gradients by default."""
    return any(map(_makes_parameters, kind.__mro__))


def _makes_parameters(kind: type) -> bool:
    root, _, rest = kind.__module__.partition(".")
    return kind not in (nn.Module, parametrize.ParametrizationList) and (
        root == "torch" or (root == _PACKAGE and rest.startswith("approximation"))
    )


@functools.lru_cache(maxsize=4096)
def number(place: int, value: float) -> Tensor:
    """Return a float64 tensor of a number that no text is to know: of a place and a number always the same.

    Two places never share one: a text would then know that their numbers are equal.
    """
    return torch.tensor(value, dtype=torch.float64, device="cpu")


_name_of = functools.cache(str)  # of a dtype, which torch spells anew each time


class IdentityKey:
    """An object as a key: equal to itself alone, and kept, so that its address is used once."""

    __slots__ = ("value",)

    def __init__(self, value: object) -> None:
        self.value = value

    def __eq__(self, other: object) -> bool:
        return isinstance(other, IdentityKey) and self.value is other.value

    def __hash__(self) -> int:
        return id(self.value)


class Walk(pickle.Pickler):
    """Writes everything but floating-point tensors, and notes what may change later."""

    def __init__(self, file: io.BytesIO, telling: bool = False) -> None:
        super().__init__(file)
        self.file, self._telling = file, telling
        self.told: dict[int, tuple[Any, dict[str, Tensor]]] = {}
        self.kept: list[object] = []  # part of the key: an address is used once
        self.tensors: list[Tensor] = []
        self.others: list[Tensor] = []  # whose numbers are part of the key
        self.dicts: list[dict[Any, Any]] = []
        self.empty: list[dict[Any, Any]] = []  # most of them the hooks of a module
        self.modules: list[tuple[dict[str, Any], list[str]]] = []  # attributes, and names of its own ones
        self.lists: list[list[Any]] = []
        self.sets: list[set[Any]] = []
        self.arrays: list[np.ndarray[Any, Any]] = []
        self.lookups: list[Lookup] = []
        self.cells: list[CellType] = []
        self.functions: list[FunctionType] = []
        self.of_users = False
        self.unwatched: str | None = None
        self.layers: set[int] = set()  # parameters that a layer of torch's, or of this library's, made
        self._states: dict[int, Any] = {}  # containers that are noted, or made on the way
        self._places: dict[int, int] = {}
        self._waiting: list[FunctionType | type] = []  # whose surroundings are to be written
        self._met: dict[int, int] = {}  # of a function or class of a user: its place among the kept

    def finish(self) -> None:
        """Write what the functions and classes of a user read that were come upon, and so on."""
        while self._waiting:
            met = self._waiting.pop()
            self.dump(_class_parts(met) if isinstance(met, type) else self._function_parts(met))

    def _function_parts(self, function: FunctionType) -> tuple[Any, ...]:
        """Return what a function reads beside its arguments."""
        parts: list[Any] = [function.__defaults__, function.__kwdefaults__, vars(function)]
        for cell in function.__closure__ or ():
            self.cells.append(cell)
            content = content_of(cell)
            if content is EMPTY or (isinstance(content, ModuleType) and is_users(function)):
                self.kept.append(IdentityKey(content))  # and what the function asks a module for, below
            else:
                parts.append(content)
        for lookup in lookups(function) if is_users(function) else ():
            self.lookups.append(lookup)
            value = lookup.value
            parts.append(lookup.name)
            if isinstance(value, ModuleType) or installed(str(lookup.space.get("__name__", ""))):
                self.kept.append(IdentityKey(value))
            else:
                parts.append(value)
        return tuple(parts)

    def reducer_override(self, value: Any) -> Any:
        if isinstance(value, nn.Module):
            kind: Any = type(value)  # which has a hash
            attributes, owners = vars(value), [value]
            if "parametrizations" in value._modules and parametrize.is_parametrized(value):
                kind = parametrize.type_before_parametrizations(value)  # torch's of it refuses to be written
                owners += cast("nn.ModuleDict", value.parametrizations).values()
            if _is_layer(kind):
                self.layers.update(id(part) for owner in owners for part in owner._parameters.values())
            plain = kind.__getstate__ is object.__getstate__ and not kind.__dict__.get("__slotnames__", True)
            whole = attributes if plain else kind.__getstate__(value)
            state = {k: v for k, v in whole.items() if k not in _UNREAD}
            for hooks in _HOOKS:  # whose keys count all hooks of the process
                if state.get(hooks):
                    self.dicts.append(state[hooks])
                    state[hooks] = tuple(state[hooks].values())
            if self._telling:
                self._tell(value, state)
            self._states[id(state)] = state
            self.modules.append(
                (attributes, [k for k in attributes if k in state and k not in _OF_EVERY_MODULE])
            )
            return (copyreg.__newobj__, (kind,), state) if kind is type(value) else (kind, (), state)  # type: ignore[attr-defined]
        held = getattr(value, "__dict__", ())
        if BOUND in held or (held and self._telling and getattr(type(value), "told", ())):
            made = list(value.__reduce_ex__(2))
            made[2] = {k: v for k, v in made[2].items() if k != BOUND}
            if self._telling:
                self._tell(value, made[2])
            self._states[id(made[2])] = made[2]
            return tuple(made)
        return NotImplemented

    def _tell(self, value: Any, state: dict[str, Any]) -> None:
        """Put tensors in the place of the finite floats of an object of the library, in its state."""
        kind = type(value)
        names = getattr(kind, "told", ())
        if not names or is_users(kind):
            return
        told = {}
        for name in [*state] if names is True else names:
            real = state.get(name)
            if type(real) is float and math.isfinite(real):
                told[name] = number(len(self.tensors), real)
                self.tensors.append(told[name])
                state[name] = _TOLD
        if told:
            self.told[id(value)] = value, told

    def persistent_id(self, value: Any) -> Any:
        kind = type(value)
        if kind in ATOMS:  # most of all: asked for every object
            return None
        if kind is dict:
            self._note_dict(value)
            return None
        if isinstance(value, Tensor):
            return self._tensor(value)
        if isinstance(value, _CODE):
            return self._code(value)
        if isinstance(value, ModuleType):
            if not installed(value.__name__):
                raise pickle.PicklingError(f"the module {value.__name__}, which may change")
            self.kept.append(IdentityKey(value))
            return len(self.kept)
        if isinstance(value, np.ndarray) and not value.dtype.hasobject:
            if value.nbytes <= _SMALL:
                self.arrays.append(value)
            else:
                self.unwatched = f"an array of {value.nbytes} bytes"
            # By their digest: keys stay small.
            return str(value.dtype), value.shape, hashlib.blake2b(value.tobytes()).digest()
        if kind.__module__ == "itertools":  # Python 3.12 warns of it, 3.14 refuses
            raise pickle.PicklingError(f"an iterator, {type(value).__name__}")
        self._note(value)
        return None

    def _code(self, value: type | FunctionType | BuiltinFunctionType) -> int:
        """Note a class or function; once where more than its address decides what it does."""
        users = not isinstance(value, BuiltinFunctionType) and is_users(value)
        closes = isinstance(value, FunctionType) and value.__closure__ is not None
        if isinstance(value, BuiltinFunctionType) or not (users or closes):
            self.kept.append(value)
            return len(self.kept)
        if id(value) not in self._met:
            if isinstance(value, FunctionType):
                self.functions.append(value)
            # A lambda is often made anew, of the same code.
            self.kept.append(value.__code__ if isinstance(value, FunctionType) else value)
            self.of_users = self.of_users or users
            self._met[id(value)] = len(self.kept)
            self._waiting.append(value)
        return self._met[id(value)]

    def _tensor(self, value: Tensor) -> Any:
        if not value.is_floating_point():
            self.others.append(value)
            numbers = b"" if value.is_meta else value.detach().cpu().numpy().tobytes()
            return str(value.dtype), str(value.device), tuple(value.shape), numbers
        if id(value) not in self._places:
            self._places[id(value)] = len(self.tensors)
            self.tensors.append(value)
        place = self._places[id(value)]
        own = isinstance(value, RowNumbers)  # how many rows there are is no matter
        where = "cpu" if value.is_cpu else str(value.device)
        return place, own, _name_of(value.dtype), where, tuple(value.shape), value.stride()

    def _note(self, value: Any) -> None:
        """Note what may change inside of an object; a module is noted in `reducer_override`."""
        if isinstance(value, Derived):
            return
        if isinstance(value, list):
            self.lists.append(value)
        elif isinstance(value, set):
            self.sets.append(value)
        elif isinstance(value, dict):
            self._note_dict(value)
        if hasattr(value, "__dict__"):
            if not isinstance(value, nn.Module):
                self._note_dict(vars(value))
        elif not isinstance(value, (list, set, dict, *_FIXED)):
            self.unwatched = f"an object of {type(value).__qualname__}"

    def _note_dict(self, value: dict[Any, Any]) -> None:
        if id(value) not in self._states:
            self._states[id(value)] = value
            (self.dicts if value else self.empty).append(value)


def _class_parts(kind: type) -> tuple[Any, ...]:
    """Return what a user's base classes hold: functions, numbers, containers."""
    users = [vars(each).items() for each in kind.__mro__ if is_users(each)]
    return tuple(part for items in users for name, value in items for part in attribute_parts(name, value))

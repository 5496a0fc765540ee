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

import copyreg
import functools
import hashlib
import io
import logging
import math
import operator
import pickle
import sys
from collections.abc import Callable, Iterable, Iterator
from itertools import chain, repeat
from operator import is_
from types import BuiltinFunctionType, CellType, CodeType, FunctionType, MethodType, ModuleType
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.utils import parametrize

from ..row_numbers import RowNumbers
from .lookups import EMPTY, OF_PYTHON, Lookup, attribute_parts, content_of, installed, is_users, lookups
from .tensor_writes import Writes

_PACKAGE = __name__.partition(".")[0]
_VERSIONED = frozenset((_PACKAGE, "torch", "numpy", *OF_PYTHON))  # other processes have the same
ATOMS = frozenset((str, int, float, bool, bytes, tuple, type(None)))  # and what an address alone tells apart
_SMALL = 1 << 14  # bytes of an array that are compared at every call
_FIXED = (
    *(tuple, type, frozenset, complex, slice, range, np.generic, np.dtype, torch.dtype, torch.device),
    *(FunctionType, BuiltinFunctionType, MethodType),
)
_CODE = (type, FunctionType, BuiltinFunctionType)
_OF_EVERY_MODULE = frozenset(vars(nn.Module()))  # looked into by themselves
_READ = ("training", "_parameters", "_buffers", "_modules", "_forward_hooks", "_forward_pre_hooks")
IDLE = _OF_EVERY_MODULE - {*_READ}  # hooks of derivatives and of state_dicts, and what goes with other hooks
_log = logging.getLogger(__name__)
_said: set[tuple[str, str]] = set()  # what has been logged
_TOLD = "a number of the table"
_REQUIRES = operator.attrgetter("requires_grad")
_CODE_OF, _CONTENT = operator.attrgetter("__code__", "__defaults__"), operator.attrgetter("cell_contents")
_BASE, _ARRAY = operator.itemgetter(*_READ), operator.methodcaller("tobytes")
BOUND = "_compiled_methods"
"""Attribute in which an object holds its compiled methods: no part of what it is."""
_UNREAD, _HOOKS = IDLE | {BOUND}, ("_forward_hooks", "_forward_pre_hooks")


class Derived:
    """Base of what follows from its recipe in a pickle, as programs do: nothing inside of it is watched."""


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
            if isinstance(value, CodeType | _Same):
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


class _Same:
    """An object as a key: equal to itself alone, and kept, so that its address is used once."""

    __slots__ = ("value",)

    def __init__(self, value: object) -> None:
        self.value = value

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and self.value is other.value

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
                self.kept.append(_Same(content))  # and what the function asks a module for, below
            else:
                parts.append(content)
        for lookup in lookups(function) if is_users(function) else ():
            self.lookups.append(lookup)
            value = lookup.value
            parts.append(lookup.name)
            if isinstance(value, ModuleType) or installed(str(lookup.space.get("__name__", ""))):
                self.kept.append(_Same(value))
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
            self.kept.append(_Same(value))
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

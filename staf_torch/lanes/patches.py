"""Whether the code of this package is what its files say: no other process sees what was put in its place."""

from __future__ import annotations

import functools
import sys
import threading
from collections.abc import Iterator
from itertools import chain
from operator import is_
from types import FunctionType
from typing import Any

_PACKAGE = __name__.partition(".")[0]
_BESIDE = frozenset(
    ("cli", "figures", "plugins", "results", "settings", "sweeps", "tables")
)  # no step is there
_KEEPING = frozenset(f"lanes.{name}" for name in ("cache", "compiler", "program"))  # know no step
_OTHERS = frozenset(("torch", "numpy", "scipy", "gymnasium", "mujoco", "hydra", "omegaconf", "matplotlib"))
_OTHERS |= sys.stdlib_module_names - {"__main__", "unittest"}
_seen: dict[
    str, tuple[list[Any], bool]
] = {}  # what was in a module and its classes, and whether it was its own
_one_at_a_time = threading.Lock()


def unpatched() -> bool:
    """Return whether every function in the numerical modules of this package was written there.

    A function that a user, a test or another library put into a module or a class of this package
    (`kernels.GaussianKernel.core = mine`) tells itself by the module whose globals it reads. Constants of
    modules are not looked at.
    """
    with _one_at_a_time:
        return all(_own(name) for name in list(sys.modules) if _numerical(name))


def _numerical(name: str) -> bool:
    package, _, rest = name.partition(".")
    return package == _PACKAGE and rest.partition(".")[0] not in _BESIDE and rest not in _KEEPING


def _own(name: str) -> bool:
    """Whether a module is its own, looked at again only where something in it is another object."""
    values = list(vars(sys.modules[name]).values())
    classes = [value for value in values if isinstance(value, type) and value.__module__ == name]
    values.extend(chain.from_iterable(vars(each).values() for each in classes))
    before, own = _seen.get(name, ((), False))
    if len(before) != len(values) or not all(map(is_, before, values)):
        own = not any(
            _foreign(value, name, classes) for value in (*classes, *vars(sys.modules[name]).values())
        )
        _seen[name] = values, own
    return own


def _foreign(value: Any, name: str, classes: list[type]) -> bool:
    """Whether a value of a module, or a method of a class of it, is a function that somebody put there."""
    if isinstance(value, type):
        inside = vars(value).values() if value in classes else ()
        return any(_origin(f) not in (name, *_OTHERS) for each in inside for f in _functions(each))
    return any(_origin(f).partition(".")[0] not in (_PACKAGE, *_OTHERS) for f in _functions(value))


def _origin(function: FunctionType) -> str:
    """The module in which a function was written, the package alone for one of `_OTHERS`."""
    module: str = function.__globals__.get("__name__", "")
    package = module.partition(".")[0]
    if package.startswith("namedtuple_"):  # what `collections` writes for a named tuple
        return "collections"
    return package if package in _OTHERS else module


def _functions(value: Any) -> Iterator[FunctionType]:
    if isinstance(value, property):
        parts: tuple[Any, ...] = (value.fget, value.fset, value.fdel)
    else:
        parts = (getattr(value, "__func__", value),)  # of a static or class method
    for part in parts:
        while isinstance(part, functools.partial):
            part = part.func
        if isinstance(part, FunctionType):
            yield part
        elif not isinstance(part, type) and callable(part):
            called = type(part).__call__
            if isinstance(called, FunctionType):
                yield called  # an object in the place of a function, a mock say
        inner = (
            None if isinstance(part, type) else getattr(part, "__wrapped__", None)
        )  # of a cache, a decorator
        if isinstance(inner, FunctionType):
            yield inner

"""Names that code looks up, and whose it is: globals of its module, attributes of modules and of classes."""

from __future__ import annotations

import dis
import functools
import os
import sys
import sysconfig
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import CellType, CodeType, FunctionType, ModuleType
from typing import Any, NamedTuple

from torch import Tensor

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

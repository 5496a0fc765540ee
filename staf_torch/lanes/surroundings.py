"""What a function reads beside its arguments and the objects it is given: globals, and what they lead to."""

from __future__ import annotations

import dis
import functools
import sys
import sysconfig
from collections.abc import Iterator
from pathlib import Path
from types import CellType, CodeType, FunctionType, ModuleType
from typing import Any, NamedTuple

_PACKAGE = __name__.partition(".")[0]
_OF_PYTHON = frozenset(sys.stdlib_module_names) - {"__main__"}
_FOLDERS = tuple(
    Path(folder)
    for name, folder in sysconfig.get_paths().items()
    if name in ("stdlib", "platstdlib", "purelib", "platlib")
)
_PACKAGES = frozenset(("site-packages", "dist-packages"))


class Same:
    """An object as a key: equal to itself alone, and kept, so that its address is used once."""

    __slots__ = ("value",)

    def __init__(self, value: object) -> None:
        self.value = value

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Same) and self.value is other.value

    def __hash__(self) -> int:
        return id(self.value)


class Lookup(NamedTuple):
    """A name that code looks up in the globals of its module, or in a module that it found there."""

    space: dict[str, Any]
    name: str
    installed: bool  # whether the space is of code that nobody edits while it runs

    @property
    def value(self) -> Any:
        return self.space.get(self.name, _MISSING)


_MISSING = object()
EMPTY = object()  # in a cell whose name has no value yet


def content_of(cell: CellType) -> Any:
    """Return what a function closes over, or `EMPTY`.

    Args:
        cell: of its closure.
    """
    try:
        return cell.cell_contents
    except ValueError:
        return EMPTY


@functools.lru_cache(maxsize=4096)
def installed(module: str) -> bool:
    """Return whether a module's code stands: this library's, Python's own, what lies in a folder of packages.

    What is left is a user's: a script, a notebook, files beside it.

    Args:
        module: its name; one that is not loaded counts as a user's.
    """
    root = module.partition(".")[0]
    if root == _PACKAGE or root in _OF_PYTHON:
        return True
    file = getattr(sys.modules.get(module), "__file__", None)
    if file is None:
        return False
    path = Path(file)
    return bool(_PACKAGES & set(path.parts)) or any(path.is_relative_to(folder) for folder in _FOLDERS)


def is_users(value: FunctionType | type) -> bool:
    """Return whether a function or a class is of a user, and may read what changes between two calls."""
    module = value.__globals__.get("__name__") if isinstance(value, FunctionType) else value.__module__
    return not (isinstance(module, str) and installed(module))


def lookups(function: FunctionType) -> Iterator[Lookup]:
    """Yield what a function looks up by name: its globals, and attributes of modules there or in its closure.

    An attribute counts for every module that the function knows; too many do no harm.

    Args:
        function: and the functions that are written inside of it.
    """
    found, attributes = _names(function.__code__)
    spaces = [(function.__globals__, found)]
    closed_over = map(content_of, function.__closure__ or ())
    spaces += [(vars(part), attributes) for part in closed_over if isinstance(part, ModuleType)]
    seen = {id(space) for space, _ in spaces}
    while spaces:
        space, names = spaces.pop()
        stands = installed(str(space.get("__name__", "")))
        for name in names:
            if name not in space:
                value = sys.modules.get(name)  # an import inside of the function
            else:
                value = space[name]
                yield Lookup(space, name, stands)
            if isinstance(value, ModuleType) and id(vars(value)) not in seen:
                seen.add(id(vars(value)))
                spaces.append((vars(value), attributes))


@functools.lru_cache(maxsize=4096)
def _names(code: CodeType) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The names that code and the code inside of it look up, and the attributes that it asks for."""
    found, attributes = dict[str, None](), dict[str, None]()
    for instruction in dis.get_instructions(code):
        if instruction.opname in ("LOAD_GLOBAL", "LOAD_NAME", "IMPORT_NAME"):
            found[instruction.argval.partition(".")[0]] = None
        if instruction.opname in ("LOAD_ATTR", "LOAD_METHOD", "IMPORT_FROM", "IMPORT_NAME"):
            attributes.update(dict.fromkeys(instruction.argval.split(".")))
    for part in code.co_consts:
        if isinstance(part, CodeType):
            inner, asked = _names(part)
            found.update(dict.fromkeys(inner))
            attributes.update(dict.fromkeys(asked))
    return tuple(found), tuple(attributes)

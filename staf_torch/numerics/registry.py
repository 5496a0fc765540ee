"""The variants that the files of a folder define."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import sys
from typing import Any, TypeVar

_T = TypeVar("_T")


def variants(package: str, base: type[_T]) -> dict[str, type[_T]]:
    """Import every file of a package and return the public subclasses of a base, by class name.

    So a variant is a file: no list names it.

    Args:
        package: its ``__name__``.
        base: itself among them.
    """
    found: dict[str, type[_T]] = {}
    for file in pkgutil.iter_modules(sys.modules[package].__path__):
        module = importlib.import_module(f"{package}.{file.name}")
        for name, kind in vars(module).items():
            own = inspect.isclass(kind) and kind.__module__ == module.__name__
            if own and issubclass(kind, base) and not name.startswith("_"):
                found[name] = kind
    return found


def without_arguments(kinds: dict[str, type[_T]]) -> dict[str, type[_T]]:
    """Return the concrete ones of some classes that need no argument, by the name of their file."""

    def needs_none(kind: type[Any]) -> bool:
        given = inspect.signature(kind).parameters.values()
        return all(
            each.default is not each.empty or each.kind in (each.VAR_POSITIONAL, each.VAR_KEYWORD)
            for each in given
        )

    ready = (kind for kind in kinds.values() if not inspect.isabstract(kind) and needs_none(kind))
    return {
        kind.__module__.rpartition(".")[2]: kind for kind in sorted(ready, key=lambda kind: kind.__module__)
    }

"""The variants that the files of a folder define: no list names them."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import sys
from collections.abc import Mapping
from typing import Any

Kinds = dict[str, Any]
"""Classes by name; `type[Base]` would not take a base that is abstract."""


def variants(package: str, base: Any) -> Kinds:
    """Import every file of a package, by its ``__name__``, and return the public subclasses of a base,
    itself among them, by class name."""
    found: Kinds = {}
    for file in pkgutil.iter_modules(sys.modules[package].__path__):
        module = importlib.import_module(f"{package}.{file.name}")
        for name, kind in vars(module).items():
            own = inspect.isclass(kind) and kind.__module__ == module.__name__
            if own and issubclass(kind, base) and not name.startswith("_"):
                found[name] = kind
    return found


def unlisted(names: Mapping[str, Any], base: Any) -> Kinds:
    """Return the variants of files of which a package has no name yet, as lines for type checkers give it."""
    listed = {kind.__module__ for kind in names.values() if inspect.isclass(kind)}
    found = variants(names["__name__"], base)
    return {name: kind for name, kind in found.items() if kind.__module__ not in listed}


def without_arguments(kinds: Kinds) -> Kinds:
    """Return the concrete ones of some classes that need no argument, by the name of their file."""

    def needs_none(kind: Any) -> bool:
        given = inspect.signature(kind).parameters.values()
        packed = inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD
        return all(each.default is not each.empty or each.kind in packed for each in given)

    ready = (kind for kind in kinds.values() if not inspect.isabstract(kind) and needs_none(kind))
    return {
        kind.__module__.rpartition(".")[2]: kind for kind in sorted(ready, key=lambda kind: kind.__module__)
    }

"""The public names of the package, read from its source: nothing is imported, so that no torch is needed."""

from __future__ import annotations

import ast
from pathlib import Path
from typing import NamedTuple

PACKAGE = Path(__file__).resolve().parents[2]
ROOMS = {
    "approximation": "`StaF`, its basis, its accuracy",
    "kernels": "kernels k(y, c)",
    "centers": "layouts of centers and their radius",
    "targets": "functions V to approximate",
    "optim": "update laws of the weights",
    "engine": "the gradient chase",
    "systems": "plants, and trajectories of them",
    "adp": "optimal control: policies, plans, filters, learning",
    "online": "streams of samples",
    "theory": "the theorems, computable",
    "metrics": "metrics of your own",
    "sweeps": "runs and sweeps from Python",
    "tables": "tables of runs",
    "deploy": "exported controllers and approximations",
    "envs": "Gymnasium environments",
    "lanes": "programs of one row, compiled",
}
"""Rooms that have a reference page, in the order of a reader's questions."""
_TOP = {"sweeps": ("read_runs", "run", "sweep")}
"""Names that are imported from the package itself although their room has no list of them."""


class Name(NamedTuple):
    """A public name."""

    name: str
    source: str  # the module that users import it from
    home: str  # the module that defines it
    summary: str  # the first line of its docstring


def public_names(room: str) -> list[Name]:
    """Return the public classes and functions of a room, sorted."""
    if room in ("approximation", *_TOP):
        top = [name for name in _imports("staf_torch") if _is_of(room, name)]
        return [found for name in top if (found := _found("staf_torch", name))]
    module = f"staf_torch.{room}"
    names = sorted({*_imports(module), *_definitions(module)}, key=str.lower)
    return [found for name in names if (found := _found(module, name))]


def _is_of(room: str, name: str) -> bool:
    home = _imports("staf_torch")[name][0]
    return (home.startswith(f"staf_torch.{room}.") and not name.islower()) or name in _TOP.get(room, ())


def _found(module: str, name: str) -> Name | None:
    """Follow a name to the class or function that it is; None for a module."""
    home, inner = module, name
    while inner not in _definitions(home):
        if inner not in _imports(home):
            return None
        step = _imports(home)[inner]
        if step == (home, inner) or not _file(step[0]):
            return None  # a module, or a function of somebody else
        home, inner = step
    return Name(name, module, home, _definitions(home)[inner])


def _file(module: str) -> Path | None:
    place = PACKAGE.joinpath(*module.split(".")[1:])
    files = (place / "__init__.py", place.with_suffix(".py"))
    return next((file for file in files if file.is_file()), None)


_TREES: dict[str, ast.Module] = {}


def _tree(module: str) -> ast.Module:
    if module not in _TREES:
        file = _file(module)
        assert file is not None, module
        _TREES[module] = ast.parse(file.read_text(encoding="utf-8"))
    return _TREES[module]


def _imports(module: str) -> dict[str, tuple[str, str]]:
    """Return what a module hands on, `from .a import b as b`: name -> module and name there."""
    file = _file(module)
    assert file is not None
    inside = module.split(".") if file.name == "__init__.py" else module.split(".")[:-1]
    found: dict[str, tuple[str, str]] = {}
    for node in ast.walk(_tree(module)):
        if isinstance(node, ast.ImportFrom) and node.level:
            base = ".".join([*inside[: len(inside) - node.level + 1], *filter(None, [node.module])])
            listed = _listed(module)
            found |= {
                each.name: (base, each.name)
                for each in node.names
                if each.asname == each.name or each.name in listed
            }
    return found


def _listed(module: str) -> set[str]:
    """Return the names that a literal `__all__` of a module has."""
    lists = (node.value for node in _tree(module).body if isinstance(node, ast.Assign | ast.AugAssign))
    return {
        entry.value
        for each in lists
        if isinstance(each, ast.List)
        for entry in each.elts
        if isinstance(entry, ast.Constant) and isinstance(entry.value, str)
    }


def _definitions(module: str) -> dict[str, str]:
    """Return the public classes and functions that a module defines, and the first line of each docstring."""
    return {
        node.name: (ast.get_docstring(node) or "").partition("\n")[0]
        for node in _tree(module).body
        if isinstance(node, ast.ClassDef | ast.FunctionDef) and not node.name.startswith("_")
    }

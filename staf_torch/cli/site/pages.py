"""The pages of the site: manuals and guides as they lie in the repository, and a page for each public name.

A page keeps its place in the tree, so that its links stay as they are. What a wheel lacks (tests, benchmarks,
pictures of examples) is not shown there: a link to it becomes text. Names are read from the source: nothing
is imported, so that no torch is needed.
"""

from __future__ import annotations

import ast
import os
import re
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
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


_CHECKOUT = PACKAGE.parent
_FRONT = PACKAGE / "guides" / "front"
"""In a wheel: README.md, CHANGELOG.md and the pictures of both."""
_FENCE = re.compile(r"^(```.*?^```$)", re.DOTALL | re.MULTILINE)
_TABLE = re.compile(r"^(?:</?(?:table|tr|td)\b[^>]*>)+$", re.MULTILINE)
_LINK = re.compile(r"(!?)\[((?:[^][]|\[[^][]*\])*)\]\(([^()\s]+)\)")
_MANUALS = ("README.md", "CHANGELOG.md", "runs/README.md", "tests/README.md", "tests/benchmarks")


def source_file(place: str) -> Path | None:
    """Return the file of a place in the repository, also where the package is installed from a wheel."""
    inside = place.removeprefix("staf_torch/")
    tries = [_CHECKOUT / place] if (_CHECKOUT / "pyproject.toml").is_file() else [_FRONT / place]
    tries += [PACKAGE / inside]
    return next((file for file in tries if file.is_file()), None)


def manuals() -> list[str]:
    """Return the places of all manuals and guides that are installed."""
    found = [f"staf_torch/{path.relative_to(PACKAGE).as_posix()}" for path in PACKAGE.rglob("*.md")]
    found = [place.replace("staf_torch/conf/", "conf/") for place in found if "/front/" not in place]
    if (_CHECKOUT / "pyproject.toml").is_file():
        found += ["conf/README.md", *_of_checkout()]
    return sorted({*found, "README.md", "CHANGELOG.md"})


def _of_checkout() -> Iterator[str]:
    for place in ("runs/README.md", "tests"):
        files = [_CHECKOUT / place] if place.endswith(".md") else (_CHECKOUT / place).rglob("*.md")
        yield from (path.relative_to(_CHECKOUT).as_posix() for path in files)


def write_pages(folder: Path, rooms: tuple[str, ...]) -> None:
    """Write all pages as Markdown into a folder, with the pictures and files that they link to."""
    places = manuals()
    for place in places:
        file = source_file(place)
        assert file is not None, place
        text = _linked(file.read_text(encoding="utf-8"), place, places, folder)
        _write(folder / ("front.md" if place == "README.md" else place), text)
    _write(folder / "index.md", _beginning(places, folder))
    for room in rooms:
        _write_room(folder / "reference", room)
    _write(folder / "reference" / "index.md", _overview(rooms))


def _write(file: Path, text: str) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text, encoding="utf-8")


def _beginning(places: list[str], folder: Path) -> str:
    """Return the first page: the sentence and the moving picture, the tasks, then how to install and try."""
    front, tasks = source_file("README.md"), source_file("staf_torch/guides/README.md")
    assert front is not None
    assert tasks is not None
    head, _, rest = front.read_text(encoding="utf-8").partition("\n## ")
    install = "## " + rest.partition("\n## ")[0]
    list_of_tasks = tasks.read_text(encoding="utf-8").partition("\n")[2]
    parts = [
        _linked(head, "README.md", places, folder),
        "## What do you want to do?\n",
        _linked(list_of_tasks, "staf_torch/guides/README.md", places, folder, at=""),
        _linked(install, "README.md", places, folder),
    ]
    return "\n\n".join(parts)


def _linked(text: str, place: str, places: list[str], folder: Path, at: str | None = None) -> str:
    """Return a page that lies at a ``place`` of the repository with links as they are on the site; files that
    it links to are copied into the folder of the site's pages. ``at`` is the folder of the page there, where
    it is another one."""
    home = PurePosixPath(place).parent.as_posix()
    shown_at = home if at is None else at

    def link(found: re.Match[str]) -> str:
        picture, words, target = found.groups()
        if "://" in target or target.startswith(("#", "mailto:")):
            return found[0]
        path, _, anchor = target.partition("#")
        there = os.path.normpath(f"{home}/{path}").replace(os.sep, "/")
        if there not in places and not _copied(there, folder):
            return words
        there = "front.md" if there == "README.md" else _shown(there)
        shown = os.path.relpath(there, shown_at or ".").replace(os.sep, "/")
        return f"{picture}[{words}]({shown}{'#' + anchor if anchor else ''})"

    parts = _FENCE.split(text)
    return "".join(
        part if part.startswith("```") else _TABLE.sub(_beside, _LINK.sub(link, part)) for part in parts
    )


def _beside(found: re.Match[str]) -> str:
    """Return a line of an HTML table as blocks of Markdown, side by side where there is room."""
    line = re.sub(r"<td[^>]*>", '<div markdown="1">', found[0]).replace("</td>", "</div>")
    line = line.replace("<table>", '<div class="beside" markdown="1">').replace("</table>", "</div>")
    return re.sub(r"</?tr>", "", line).replace("><", ">\n<")


def _copied(place: str, folder: Path) -> bool:
    file = source_file(place)
    if file is None:
        return False
    copy = folder / _shown(place)
    copy.parent.mkdir(parents=True, exist_ok=True)
    copy.write_bytes(file.read_bytes())
    return True


def _shown(place: str) -> str:
    """Return where a file is on the site: folders that begin with a dot are not published."""
    return place.replace(".assets/", "assets/pictures/")


# --- reference ----------------------------------------------------------------------------------------------


def _overview(rooms: tuple[str, ...]) -> str:
    lines = [
        "# Reference",
        "",
        "Every public name has a page: formula, arguments, errors, an example, its source.",
        "",
    ]
    lines += ["| room | what is in it |", "|---|---|"]
    lines += [f"| [{room}]({room}/index.md) | {ROOMS[room]} |" for room in rooms]
    return "\n".join(lines) + "\n"


def _write_room(folder: Path, room: str) -> None:
    names = public_names(room)
    title = ROOMS[room]
    lines = [f"# {room}", "", f"{title[0].upper()}{title[1:]}."]
    if source_file(f"staf_torch/{room}/README.md"):
        lines[-1] += f" The manual: [{room}](../../staf_torch/{room}/README.md)."
    lines += ["", "| name | |", "|---|---|"]
    cells = [each.summary.replace("|", "\\|") for each in names]
    lines += [
        f"| [`{each.name}`]({each.name}.md) | {cell} |" for each, cell in zip(names, cells, strict=True)
    ]
    _write(folder / room / "index.md", "\n".join(lines) + "\n")
    for each in names:
        _write(folder / room / f"{each.name}.md", _page(room, each))


def _page(room: str, name: Name) -> str:
    return f"""---
title: {name.name}
search:
  boost: 2
---

[Reference](../index.md) / [{room}](index.md) / `from {name.source} import {name.name}`

::: {name.home}.{name.name}
"""

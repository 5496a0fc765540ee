"""How the package hangs together: no circle, Hydra's inside in one module, a short way to the engine."""

from __future__ import annotations

import ast
import functools
import importlib
import inspect
import re
import shlex
import sys
from collections.abc import Callable, Iterable
from pathlib import Path

import pytest
from command_line import ROOT, one
from public_names import PACKAGES, public
from source_rules import without_dtype, without_encoding

PACKAGE = ROOT / "staf_torch"
TOP = re.findall(r"^(\w+):", (ROOT / "conf" / "config.yaml").read_text(encoding="utf-8"), re.MULTILINE)
DOCUMENTED = {"hydra.core.hydra_config", "hydra.core.config_store"}  # of `hydra.core`, what Hydra documents
MODULES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
    for path in sorted(PACKAGE.rglob("*.py"))
    if "plugins" not in path.parts
}


@functools.cache
def nodes(path: Path) -> list[ast.AST]:
    """Of a file, read once: all of them, from the outside in."""
    return list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))


@functools.cache
def imports(name: str, path: Path) -> tuple[str, ...]:
    """Absolute names of all that a file imports, inside functions too, but for type checkers alone."""
    package = name if path.name == "__init__.py" else name.rpartition(".")[0]
    typing = {
        id(inner)
        for node in nodes(path)
        if isinstance(node, ast.If) and ast.unparse(node.test) in ("TYPE_CHECKING", "typing.TYPE_CHECKING")
        for inner in ast.walk(node)
    }
    found: list[str] = []
    for node in nodes(path):
        if id(node) in typing:
            continue
        if isinstance(node, ast.Import):
            found += (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            parts = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            module = ".".join([*parts, *([node.module] if node.module else [])])
            found += (f"{module}.{alias.name}" for alias in node.names)
    return tuple(found)


def imported_modules(name: str, path: Path) -> set[str]:
    """Modules of the package that a file imports; `from a import b` is of a.b where that is a module."""
    found = set()
    for target in imports(name, path):
        for candidate in (target, target.rpartition(".")[0]):
            if candidate in MODULES and candidate != name:
                found.add(candidate)
                break
    return found


def circle(graph: dict[str, set[str]]) -> list[str]:
    """Nodes that follow each other in a circle; empty where there is none."""
    done: set[str] = set()

    def visit(node: str, path: list[str]) -> list[str]:
        if node in path:
            return [*path[path.index(node) :], node]
        if node in done:
            return []
        for other in sorted(graph.get(node, ())):
            found = visit(other, [*path, node])
            if found:
                return found
        done.add(node)
        return []

    return next((found for node in sorted(graph) if (found := visit(node, []))), [])


def test_a_circle_is_found() -> None:
    assert circle({"a": {"b"}, "b": {"c"}, "c": {"b"}}) == ["b", "c", "b"]
    assert circle({"a": {"b", "c"}, "b": {"c"}, "c": set()}) == []


def test_no_file_imports_in_a_circle_not_even_inside_functions() -> None:
    graph = {
        name: imported_modules(name, path) for name, path in MODULES.items() if path.name != "__init__.py"
    }
    assert len(graph) > 100
    assert circle(graph) == []


def test_no_room_imports_in_a_circle_not_even_inside_functions() -> None:
    rooms: dict[str, set[str]] = {}
    for name, path in MODULES.items():
        room = name.split(".")[1] if "." in name else ""
        if room and not room.startswith("__"):
            targets = {target.split(".")[1] for target in imported_modules(name, path) if "." in target}
            rooms.setdefault(room, set()).update(targets - {room})
    assert len(rooms) > 15
    assert circle(rooms) == []


@pytest.mark.parametrize("name", MODULES)
def test_the_inside_of_hydra_is_used_in_one_folder(name: str) -> None:
    if name.startswith("staf_torch.sweeps.hydra_compat"):
        return
    for target in imports(name, MODULES[name]):
        assert not target.startswith("hydra._internal")
        assert not (target.startswith("hydra.") and "._" in target)
        if target.startswith("hydra.core"):
            assert target.rpartition(".")[0] in DOCUMENTED, target


def test_private_functions_have_seven_parameters_at_most() -> None:
    crowded = [
        f"{name}.{node.name}"
        for name, path in MODULES.items()
        for node in nodes(path)
        if isinstance(node, ast.FunctionDef) and node.name.startswith("_") and not node.name.startswith("__")
        if len([*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]) > 7
    ]
    assert [
        name for name in crowded if name.split(".")[1] in ("cli", "sweeps", "experiments", "results")
    ] == []


def test_the_engine_is_six_frames_from_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from staf_torch.experiments import chase_batch

    ways: list[list[str]] = []
    pieces = chase_batch.chase_pieces

    def counted(*args: object, **kwargs: object) -> object:
        files = [frame.filename for frame in inspect.stack(0)[1:]]
        own = [name for name in files if name.startswith(str(PACKAGE))]
        assert not any("engine" in name.removeprefix(str(PACKAGE)) for name in own)
        ways.append(own)
        return pieces(*args, **kwargs)  # type: ignore[arg-type]

    monkeypatch.setattr(chase_batch, "chase_pieces", counted)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", list(sys.argv))
    code, _, err = one(str(tmp_path), ["duration=0.05", "settle_time=0", "figures=false"])
    assert code == 0, err
    (way,) = ways
    assert len(way) <= 6
    assert len({Path(name).name for name in way}) <= 5


@pytest.mark.parametrize("package", [name for name in PACKAGES if name != "targets"])
def test_all_lists_what_a_package_hands_on(package: str) -> None:
    module = importlib.import_module(f"staf_torch.{package}")
    tree = ast.parse(Path(str(module.__file__)).read_text(encoding="utf-8"))
    handed = {
        alias.asname
        for node in tree.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
        if alias.asname == alias.name and not inspect.ismodule(getattr(module, alias.name))
    }
    defined = {
        node.name
        for node in tree.body
        if isinstance(node, ast.ClassDef | ast.FunctionDef) and not node.name.startswith("_")
    }
    assert handed | defined <= set(module.__all__)
    assert all(hasattr(module, name) for name in module.__all__)


def test_every_public_name_has_an_example_and_says_where_it_is_shown() -> None:
    for name, (thing, _) in public().items():
        text = thing.__doc__ or ""
        assert ">>> " in text, f"the docstring of {name} needs an example"
        check_shown(name, text)


def check_shown(name: str, text: str) -> None:
    """What "Shown by" names must exist: a configuration, a command, or a file."""
    shown = re.findall(r"Shown by `([^`]+)`", " ".join(text.split()))
    assert shown, f"the docstring of {name} needs a line: Shown by `staf experiment=...`."
    for place in shown:
        program, *words = shlex.split(place)
        if program == "staf":
            groups = [word.split("=") for word in words if (ROOT / "conf" / word.partition("=")[0]).is_dir()]
            assert groups or all("." in word or word.split("=")[0] in TOP for word in words), place
            for group, option in groups:
                assert (ROOT / "conf" / group / f"{option}.yaml").is_file(), place
        elif program not in ("staf-table", "staf-export"):
            assert (ROOT / place).is_file(), place


@pytest.mark.parametrize("rule", [without_dtype, without_encoding], ids=["dtype", "encoding"])
def test_no_number_depends_on_the_default_dtype_of_torch_and_no_text_on_a_locale(
    rule: Callable[[str], Iterable[str]],
) -> None:
    """These are the user's: every tensor that is made says of which dtype, or is cast at once."""
    found = [
        f"{path.relative_to(ROOT)}:{call}"
        for path in sorted(PACKAGE.rglob("*.py"))
        for call in rule(path.read_text(encoding="utf-8"))
    ]
    assert found == []

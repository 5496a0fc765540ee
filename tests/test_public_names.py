"""Every public name says what it is, has an example that runs, and says which experiment or manual shows it.

Examples begin where a reader does: with `import torch`, `from pathlib import Path`, `from staf_torch import
*` and the names of the package that the name itself is in.
"""

from __future__ import annotations

import ast
import doctest
import importlib
import inspect
import re
import shlex
from pathlib import Path
from typing import Any

import pytest
import torch
from command_line import ROOT

import staf_torch

PACKAGES = [
    *("adp", "centers", "deploy", "engine", "envs", "kernels", "lanes", "metrics", "online", "optim"),
    *("systems", "tables", "targets", "theory"),
]
API = ("read_runs", "run", "sweep")  # not in `__all__`: they import Hydra


def public() -> dict[str, tuple[object, dict[str, Any]]]:
    """Module and name -> the class or function, and the names that its example may use."""
    top = {name: getattr(staf_torch, name) for name in (*staf_torch.__all__, *API)}
    common = {"torch": torch, "Path": Path} | top
    common |= {name: getattr(staf_torch, name) for name in PACKAGES}
    found: dict[str, tuple[object, dict[str, Any]]] = {}
    for package in ("", *PACKAGES):
        module = importlib.import_module(f"staf_torch.{package}".rstrip("."))
        own = top if package == "" else {name: getattr(module, name) for name in module.__all__}
        for thing in own.values():
            if inspect.isclass(thing) or inspect.isfunction(thing):
                found.setdefault(f"{thing.__module__}.{thing.__name__}", (thing, common | own))
    return found


PUBLIC = public()


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


@pytest.mark.parametrize("name", PUBLIC)
def test_the_example_of_a_name_does_what_it_says(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    thing, names = PUBLIC[name]
    text = inspect.cleandoc(thing.__doc__ or "")
    test = doctest.DocTestParser().get_doctest(text, dict(names), name, None, None)
    assert test.examples, f"the docstring of {name} needs an example"
    said: list[str] = []
    doctest.DocTestRunner(verbose=False, optionflags=doctest.ELLIPSIS).run(test, out=said.append)
    assert said == [], "".join(said)


@pytest.mark.parametrize("name", PUBLIC)
def test_a_name_says_where_it_is_shown(name: str) -> None:
    shown = re.findall(r"Shown by `([^`]+)`", " ".join((PUBLIC[name][0].__doc__ or "").split()))
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


TOP = re.findall(r"^(\w+):", (ROOT / "conf" / "config.yaml").read_text(encoding="utf-8"), re.MULTILINE)

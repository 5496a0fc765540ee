"""How the package hangs together, and what no test may do, read from the text; circles: `lint-imports`."""

from __future__ import annotations

import ast
import dataclasses
import functools
import gc
import importlib
import inspect
import pkgutil
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import yaml
from command_line import ROOT
from source_rules import looks_inside, on_defaults, without_encoding

import staf_torch

PACKAGE, CONF, TESTS = ROOT / "staf_torch", ROOT / "conf", ROOT / "tests"
DOCUMENTED = {"hydra.core.hydra_config", "hydra.core.config_store"}  # of `hydra.core`, what Hydra documents
MODULES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
    for path in sorted(PACKAGE.rglob("*.py"))
    if "plugins" not in path.parts
}
INSIDE = {
    "lanes/test_traces.py": "a user who replaces a method of the library is what it is about",
    "pretend_device.py": "torch has no public name for a tensor of a device that there is not",
}
DOCUMENTABLE = ast.Module | ast.ClassDef | ast.FunctionDef
RIDDLE = re.compile(r"(What|Whether|Of|As|One|Where|How|The same)\b")
PERHAPS = re.compile(
    r"__new__|SimpleNamespace|patch|setattr|[ .\"']_[a-z]|^\s*(del )?(?!self|cls)\w+\.[\w.]+ .?=[^=]",
    re.M,
)
"""What a file holds that looks inside the package."""
Rule = Callable[[Sequence[ast.AST]], Iterable[str]]


@pytest.fixture(autouse=True)
def _no_search_for_garbage() -> Iterator[None]:
    """Half of the time of half a million nodes, none of which refers to an outer one."""
    gc.disable()
    yield
    gc.enable()


def nodes(path: Path) -> list[ast.AST]:
    """Of a file: all of them, from the outside in."""
    return list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))


class About(NamedTuple):
    """What the tree of a file of the package says, which is read once."""

    classes: tuple[str, ...]
    told: tuple[str, ...]
    docstrings: tuple[str, ...]  # their first lines


@functools.cache
def about(name: str) -> About:
    path = MODULES[name]
    tree = nodes(path)
    kinds = (node.name for node in tree if isinstance(node, ast.ClassDef))
    said = told(path, tree, on_defaults, without_encoding)
    documented = (ast.get_docstring(each) for each in tree if isinstance(each, DOCUMENTABLE))
    lines = (text.partition("\n")[0] for text in documented if text)
    return About(tuple(kinds), tuple(said), tuple(lines))


def test_the_inside_of_hydra_is_imported_in_one_module_at_four_places_at_most() -> None:
    for name, path in MODULES.items():
        text, inside = path.read_text(encoding="utf-8"), "staf_torch.sweeps.hydra_compat"
        assert text.count("hydra._internal") <= 4 * (name == f"{inside}.inside"), name
        core = set(re.findall(r"hydra\.core\.\w+", text))
        assert name.startswith(inside) or core <= DOCUMENTED, name


# --- classes and settings -----------------------------------------------------------------------------------


@functools.cache
def classes() -> list[type]:
    """Every class of the package."""
    skipped = ("plugins", "__main__", ".conf")
    names = [info.name for info in pkgutil.walk_packages(staf_torch.__path__, "staf_torch.")]
    modules = [importlib.import_module(n) for n in names if not any(each in n for each in skipped)]
    return [
        kind
        for m in modules
        for kind in vars(m).values()
        if inspect.isclass(kind) and kind.__module__ == m.__name__
    ]


def test_a_class_name_lives_in_one_module() -> None:
    homes: dict[str, set[str]] = {}
    for name in MODULES:
        for kind in about(name).classes:
            homes.setdefault(kind.lstrip("_"), set()).add(name)
    assert {name: found for name, found in homes.items() if len(found) > 1} == {}


CHANGING = {"Loop": "a loop while it is traced", "StreamState": "a filter's, written in place"}


def test_every_dataclass_is_frozen_but_for_two_that_say_why() -> None:
    kinds = [kind for kind in classes() if dataclasses.is_dataclass(kind)]
    assert len(kinds) > 30
    open_ = {kind.__name__ for kind in kinds if not kind.__dataclass_params__.frozen}  # type: ignore[attr-defined]
    assert open_ == set(CHANGING)


OTHERWISE = {
    ("experiment/adp_policy_iteration.yaml", "width"): "the experiment's own",
    ("optimizer/jacobi.yaml", "preconditioner"): "the option's name says so",
    ("system/two_state_as_printed.yaml", "as_printed"): "the option's name says so",
}


def objects(node: Any) -> Iterator[dict[str, Any]]:
    """Every node of settings that makes an object of the package."""
    for value in node.values() if isinstance(node, dict) else ():
        yield from objects(value)
    if isinstance(node, dict) and str(node.get("_target_", "")).startswith("staf_torch."):
        yield node


def parameters(target: str) -> dict[str, inspect.Parameter]:
    """Of what a target makes: of the class, also where a method of it makes one from settings."""
    classes()  # all packages are attributes then
    thing: Any = staf_torch
    found = [thing := getattr(thing, name) for name in target.split(".")[1:]]
    kind = next((each for each in found if inspect.isclass(each)), found[-1])
    return dict(inspect.signature(kind).parameters)


def test_an_option_of_the_command_line_is_the_default_of_the_constructor() -> None:
    differing, count = {}, 0
    for path in sorted(CONF.rglob("*.yaml")):
        for node in objects(yaml.safe_load(path.read_text(encoding="utf-8"))):
            known = parameters(node["_target_"])
            for key, value in node.items():
                default = known[key].default if key in known else None
                written = (
                    isinstance(value, bool | int | float | str) and "$" not in str(value) and value != "???"
                )
                if written and default not in (inspect.Parameter.empty, None):
                    count += 1
                    if value != default:
                        differing[str(path.relative_to(CONF)), key] = value, default
    assert count > 40
    assert set(differing) == set(OTHERWISE), differing


# --- lines --------------------------------------------------------------------------------------------------


def told(path: Path, tree: Sequence[ast.AST], *rules: Rule) -> list[str]:
    """What rules say of a file, each with its place."""
    return [f"{path.relative_to(ROOT)}:{line}" for rule in rules for line in rule(tree)]


def test_no_number_depends_on_torchs_default_dtype_or_device_and_no_text_on_a_locale() -> None:
    """These are the user's: every tensor that is made names its device, and its dtype or is cast at once."""
    assert [line for name in MODULES for line in about(name).told] == []


ON_THE_DEFAULT_DEVICE = """
torch.zeros(3)
torch.zeros(3, device=x.device)
torch.as_tensor([1.0], dtype=torch.float64)
torch.zeros(3, **more)
map(torch.tensor, numbers)
from torch import zeros
nn.Linear(2, 1)
""".strip().splitlines()


def test_what_makes_tensors_on_the_default_device_is_found_and_what_names_another_is_not() -> None:
    def found(lines: str) -> list[str]:
        return [*on_defaults([*ast.walk(ast.parse(lines))])]

    assert [line for line in ON_THE_DEFAULT_DEVICE if not found(line)] == []
    named = 'torch.zeros(3, device=x.device).double(); torch.zeros_like(x); nn.Linear(2, 1, device="cpu")'
    assert found(named) == []


def test_docstrings_begin_with_a_subject_and_an_action() -> None:
    lines = [line for name in MODULES for line in about(name).docstrings]
    riddles = [line for line in lines if RIDDLE.match(line)]
    assert len(riddles) <= 0.02 * len(lines), riddles


def test_no_test_looks_inside_the_package() -> None:
    """Public names only: what cannot be seen through them no user loses."""
    files = [path for path in TESTS.rglob("*.py") if str(path.relative_to(TESTS)) not in INSIDE]
    files = [path for path in sorted(files) if PERHAPS.search(path.read_text(encoding="utf-8"))]
    assert [line for path in files for line in told(path, nodes(path), looks_inside)] == []


FORBIDDEN = """
from staf_torch.lanes import _part
policy._cached
getattr(policy, "_cached")
importlib.import_module("staf_torch.lanes._part")
policy = SimpleNamespace(step=1)
adp.LQR.__new__(adp.LQR)
monkeypatch.setattr(adp.rollout, "horizon", 1)
monkeypatch.setattr("staf_torch.adp.policies.rollout.horizon", 1)
monkeypatch.setitem(adp.TABLE, "a", 1)
mock.patch.object(adp, "LQR")
adp.LQR = None
""".strip().splitlines()
ALLOWED = """
monkeypatch.setenv("CXX", "clang++")
monkeypatch.setitem(sys.modules, "scipy", None)
policy = adp.LQR(); policy.period = 0.1
self._own; cls._own; os._exit(0); pair._replace(x=1)
"""


def test_lines_that_look_inside_are_found_and_those_of_ones_own_are_not() -> None:
    def found(lines: str) -> list[str]:
        return [*looks_inside([*ast.walk(ast.parse(f"from staf_torch import adp\n{lines}"))])]

    assert [line for line in FORBIDDEN if not found(line) or not PERHAPS.search(line)] == []
    assert found(ALLOWED) == []

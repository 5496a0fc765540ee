"""What holds for every class and signature of the package, whatever it does.

`mutation.py` runs these for what happens at import, beside the tests that the map finds.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib
import inspect
import pkgutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from public_names import public
from recorded import Record

import staf_torch

ROOT = Path(staf_torch.__file__).parent
CONF = next(path for path in (ROOT / "conf", ROOT.parent / "conf") if path.is_dir())
CHANGING = {"Loop": "a loop while it is traced", "StreamState": "a filter's, written in place"}
OTHERWISE = {
    ("experiment/adp_policy_iteration.yaml", "width"): "the experiment's own",
    ("optimizer/jacobi.yaml", "preconditioner"): "the option's name says so",
    ("system/two_state_as_printed.yaml", "as_printed"): "the option's name says so",
}
"""Options of the command line that differ from the constructor's default on purpose."""


@functools.cache
def classes() -> dict[str, type]:
    """Every class by its place in the package."""
    found = {}
    for info in pkgutil.walk_packages(staf_torch.__path__, "staf_torch."):
        if "plugins" in info.name or "__main__" in info.name or ".conf" in info.name:
            continue
        for name, kind in vars(importlib.import_module(info.name)).items():
            if inspect.isclass(kind) and kind.__module__ == info.name:
                found[f"{info.name}.{name}"] = kind
    return found


def test_every_dataclass_is_frozen_and_says_which_are_not() -> None:
    kinds = [kind for kind in classes().values() if dataclasses.is_dataclass(kind)]
    open_ = {kind.__name__ for kind in kinds if not kind.__dataclass_params__.frozen}  # type: ignore[attr-defined]
    assert open_ == set(CHANGING)
    assert len(kinds) > 30


def targets() -> Iterator[tuple[str, str, Any, Any]]:
    """File, key, value and the constructor's default, of every option with a plain value."""
    for path in sorted(CONF.rglob("*.yaml")):
        for node in nodes(yaml.safe_load(path.read_text(encoding="utf-8"))):
            for key, value in node.items():
                parameter = signature(node["_target_"]).get(key)
                plain = (
                    isinstance(value, bool | int | float | str) and "$" not in str(value) and value != "???"
                )
                if plain and parameter is not None and parameter.default not in (parameter.empty, None):
                    yield str(path.relative_to(CONF)), key, value, parameter.default


def nodes(node: Any) -> Iterator[dict[str, Any]]:
    if isinstance(node, dict):
        if str(node.get("_target_", "")).startswith("staf_torch."):
            yield node
        for value in node.values():
            yield from nodes(value)


def signature(target: str) -> dict[str, inspect.Parameter]:
    """Parameters of what a target makes: of the class, also where a method of it makes one from settings."""
    thing: Any = staf_torch
    classes()  # all packages are attributes then
    found = [thing := getattr(thing, name) for name in target.split(".")[1:]]
    kind = next((each for each in found if inspect.isclass(each)), found[-1])
    return dict(inspect.signature(kind).parameters)


def test_an_option_of_the_command_line_is_the_default_of_the_constructor() -> None:
    found = list(targets())
    differing = {(file, key): (value, default) for file, key, value, default in found if value != default}
    assert set(differing) == set(OTHERWISE), differing
    assert len(found) > 40


def defaults(name: str, thing: object) -> Iterator[tuple[str, str]]:
    """Argument and default of a class or function, of a class's own public methods too, as text."""
    for key, parameter in inspect.signature(thing).parameters.items():  # type: ignore[arg-type]
        if parameter.default is not parameter.empty:
            yield f"{name}({key})", plain(parameter.default)
    for key, method in vars(thing).items() if inspect.isclass(thing) else ():
        method = getattr(method, "__func__", method)
        if inspect.isfunction(method) and method.__module__.startswith("staf_torch") and key[0] != "_":
            yield from defaults(f"{name}.{key}", method)


def plain(value: object) -> str:
    """A number, a text, several of them; of anything else its kind."""
    if isinstance(value, tuple):
        return f"({', '.join(map(plain, value))})"
    return repr(value) if isinstance(value, bool | int | float | str | None) else type(value).__name__


def test_defaults_of_public_arguments_are_the_recorded_ones(record: Record) -> None:
    found = dict(each for name, (thing, _) in sorted(public().items()) for each in defaults(name, thing))
    assert len(found) > 400
    record(found)


ROOMS = (
    "adp",
    "adp.adaptation",
    "adp.shooting",
    "approximation",
    "centers",
    "cli",
    "deploy",
    "engine",
    "envs",
    "experiments",
    "figures",
    "kernels",
    "lanes",
    "local_basis",
    "metrics",
    "numerics",
    "online",
    "optim",
    "results",
    "settings",
    "sweeps",
    "sweeps.executors",
    "sweeps.hydra_compat",
    "systems",
    "tables",
    "theory",
)
"""Rooms whose constants and defaults, of what is not public too, are recorded here."""
OF_VERSIONS = ("HAS_WHITELIST", "_OWN")  # what is so with one version of Hydra alone, or in one place


def chosen(module: Any) -> Iterator[tuple[str, str]]:
    """Constants of a module and of its classes, and defaults of all arguments and fields, as texts."""
    for name, thing in vars(module).items():
        if inspect.isfunction(thing) and thing.__module__ == module.__name__:
            yield from defaults(name, thing)
        elif inspect.isclass(thing) and thing.__module__ == module.__name__:
            for key, value in vars(thing).items():
                value = getattr(value, "__func__", value)
                if inspect.isfunction(value) and value.__module__ == module.__name__:
                    yield from defaults(f"{name}.{key}", value)
                elif isinstance(value, bool | int | float) and not key.startswith(("__", "_abc", "_is_p")):
                    yield f"{name}.{key}", repr(value)
            for key, value in getattr(thing, "_field_defaults", {}).items():
                yield f"{name}.{key}", plain(value)
        elif name in OF_VERSIONS:
            continue
        elif name.strip("_").isupper() and isinstance(thing, bool | int | float | tuple | dict | str):
            yield name, written(thing)


def called(thing: Any) -> str:
    return str(getattr(thing, "__name__", type(thing).__name__))


def written(value: Any) -> str:
    """As `plain`, of dictionaries too, and of what is in them."""
    if isinstance(value, dict):
        names = {
            key: key if isinstance(key, str | tuple | bool | int | float) else called(key) for key in value
        }
        return f"{{{', '.join(f'{names[key]!r}: {written(each)}' for key, each in value.items())}}}"
    if isinstance(value, tuple):
        return f"({', '.join(map(written, value))})"
    return plain(value)


@pytest.mark.parametrize("room", ROOMS)
def test_constants_and_defaults_of_a_room_are_the_recorded_ones(room: str, record: Record) -> None:
    if room == "envs":
        pytest.importorskip("gymnasium")
    package = importlib.import_module(f"staf_torch.{room}")
    found = {}
    for info in pkgutil.iter_modules(package.__path__, f"staf_torch.{room}."):
        module = importlib.import_module(info.name)
        found |= {f"{info.name.split('.', 2)[2]}.{name}": value for name, value in chosen(module)}
    record(found)

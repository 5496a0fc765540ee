"""Numbers that are chosen: constants of modules and classes, and defaults of arguments, as they are recorded.

A constant such as "eight passes at most" has no property: what a change of it does is seen in a run, late and
by chance. Here the change itself is seen, in the difference of `tests/recorded/chosen_numbers.json`.
"""

from __future__ import annotations

import importlib
import inspect
import pkgutil
from collections.abc import Iterator
from typing import Any

import pytest
from recorded import Record

PLAIN = (bool, int, float, str, type(None))
NOTHING = (None, (), "")  # defaults that choose no number


def plain(value: Any) -> bool:
    """Whether a value is numbers and words alone."""
    if isinstance(value, tuple | list | set | frozenset):
        return all(map(plain, value))
    if isinstance(value, dict):
        return all(plain(key) and plain(each) for key, each in value.items())
    return isinstance(value, PLAIN)


def written(value: Any) -> str:
    return repr(sorted(value, key=repr)) if isinstance(value, set | frozenset) else repr(value)


def named(names: dict[str, Any]) -> Iterator[tuple[str, str]]:
    for name, value in names.items():
        if not name.startswith("__") and not isinstance(value, str) and plain(value) and value not in NOTHING:
            yield name, written(value)


def defaults(function: Any) -> Iterator[tuple[str, str]]:
    for name, parameter in inspect.signature(function).parameters.items():
        if parameter.default not in (parameter.empty, *NOTHING) and plain(parameter.default):
            yield name, written(parameter.default)


def chosen(module: Any) -> Iterator[tuple[str, str]]:
    """Constants and defaults of a module, by name."""
    yield from named(vars(module))
    for name, thing in vars(module).items():
        if getattr(thing, "__module__", None) != module.__name__:
            continue
        if inspect.isfunction(thing):
            yield from ((f"{name}({key})", value) for key, value in defaults(thing))
        if not inspect.isclass(thing):
            continue
        skipped = "_fields", "_field_defaults", "_is_protocol"
        own = {key: value for key, value in vars(thing).items() if key not in skipped and key[:4] != "_abc"}
        yield from ((f"{name}.{key}", value) for key, value in named(own))
        for key, method in own.items():
            method = getattr(method, "__func__", method)
            if inspect.isfunction(method) and method.__module__ == module.__name__:
                yield from ((f"{name}.{key}({each})", value) for each, value in defaults(method))


@pytest.mark.parametrize("room", ["adp", "systems", "envs", "deploy"])
def test_constants_and_defaults_of_a_room_are_the_recorded_ones(room: str, record: Record) -> None:
    if room == "envs":
        pytest.importorskip("gymnasium")
    package = importlib.import_module(f"staf_torch.{room}")
    found = {}
    for info in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
        module = importlib.import_module(info.name)
        short = info.name.removeprefix("staf_torch.")
        found |= {f"{short}.{name}": value for name, value in chosen(module)}
    assert len(found) > 10
    record(found)

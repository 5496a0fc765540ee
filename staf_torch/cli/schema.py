"""`staf schema`: the settings as a JSON schema, with which an editor completes and checks YAML files.

All of it comes from what ships: names, values and comments from `conf/`, types from the constructors that the
options name and from the launcher's dataclass. The schema knows keys and types; rules of numbers
(`must be positive`) are left to the constructors.
"""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import json
import re
import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra.utils import get_object
from omegaconf import OmegaConf
from torch import Tensor

from .. import __version__
from ..experiments.registry import EXPERIMENTS
from ..numerics.checks import choice
from ..settings import config_directory
from ..settings.chase import DTYPES
from ..sweeps.hydra_compat import find_launcher

Node = dict[str, Any]

_DIALECT = "https://json-schema.org/draft/2020-12/schema"
_NO_GROUPS = ("hydra", "experiment", "__pycache__")
_LATER: Node = {"type": "string", "pattern": r"^\?\?\?$|\$\{"}  # ??? or an interpolation
_DEFAULTS: Node = {"type": "array", "description": "options of groups that the file starts from"}
_KINDS = {float: {"number"}, int: {"integer"}, bool: {"boolean"}, str: {"string"}, type(None): {"null"}}
_OWN: Node = {
    "description": "a class of your own takes what it takes",
    "type": "object",
    "properties": {"_target_": {"type": "string", "not": {"pattern": r"^staf_torch\."}}},
    "required": ["_target_"],
}
_FIGURES: Node = {
    "draw": {"enum": [True, False, "auto"]},
    "width": {"type": "number", "description": "inches; a column of a paper is 3.4"},
    "font": {
        "type": ["number", "string"],
        "description": "of all text: size in pt, family, or both (9 serif)",
    },
}
_SAID: Mapping[str, Node] = {  # what neither values nor signatures say
    "task": {"anyOf": [{"enum": list(EXPERIMENTS)}, {"type": "string", "pattern": r"\w\.\w"}]},
    "dtype": {"enum": list(DTYPES)},
    "animation": {"enum": [False, True, "gif", "html"]},
    "figures": {
        "anyOf": [
            {"type": "boolean"},
            {"type": "object", "properties": _FIGURES, "additionalProperties": False},
        ]
    },
    "adp.compile": {"enum": [True, False, "auto"]},
    **{f"adp.{name}": {"type": ["number", "array"]} for name in ("critic", "actor", "q", "r")},
}


def main(words: Sequence[str]) -> str:
    """Return what `staf schema [GROUP]` prints.

    Raises:
        ValueError: if there is no such group.
    """
    whole = schema()
    groups = [name.replace(".", "/") for name in whole["$defs"]]
    if words and choice("staf schema", "group", words[0], ("experiment", *groups)) != "experiment":
        title = {"$schema": _DIALECT, "title": f"Options of {words[0]}, staf_torch {__version__}"}
        whole = title | {"$ref": f"#/$defs/{words[0].replace('/', '.')}", "$defs": whole["$defs"]}
    return json.dumps(whole, indent=1)


def schema() -> Node:
    """Return the schema of `experiment` files, of `config.yaml` and a run's `.hydra/config.yaml`.

    `$defs` has one for the options of each group. Every key may be left out, as in a file that changes a few.
    """
    conf = Path(config_directory())
    files = [conf / "config.yaml", *sorted((conf / "experiment").glob("*.yaml"))]
    groups = [path.relative_to(conf) for path in sorted(conf.rglob("*")) if path.is_dir()]
    groups = [path for path in groups if path.parts[0] not in _NO_GROUPS and "__pycache__" not in path.parts]
    examples = sorted((conf / "adp").glob("*.yaml"))  # settings of a whole task, which no class takes
    groups = [group for group in groups if str(group) != "adp"]
    defs = {".".join(group.parts): _options(conf / group, str(group)) for group in groups}
    inner = {name.removeprefix("adp."): _ref(name) for name in defs if name.startswith("adp.")}
    experiments = [_read(path) for path in files]
    adp = [_read(path) for path in examples] + [each.pop("adp") for each in experiments if "adp" in each]
    said = _comments([*files, *examples])
    defs["adp"] = _closed(_merged([_without(each, inner) for each in adp], "adp.", said) | inner)
    keys = _merged([_without(each, defs) for each in experiments], "", said)
    keys |= {name: _ref(name) for name in defs if "." not in name}
    keys |= {"experiment": {"type": "string"}, "hydra": _hydra()}
    title = {"$schema": _DIALECT, "title": f"Settings of staf_torch {__version__}"}
    return title | _closed(keys) | {"$defs": defs}


def _ref(name: str) -> Node:
    return {"$ref": f"#/$defs/{name}"}


def _closed(properties: Node) -> Node:
    keys = {"defaults": _DEFAULTS} | properties
    return {"type": "object", "properties": keys, "additionalProperties": False}


def _read(path: Path) -> Node:
    return typing.cast(Node, OmegaConf.to_container(OmegaConf.load(path)))


def _without(node: Node, names: Mapping[str, object]) -> Node:
    return {key: value for key, value in node.items() if key not in {*names, "defaults", "hydra"}}


def _options(folder: Path, group: str) -> Node:
    """Return the schema of a group: one of its options, a class of one's own, or some keys of an option."""
    by_target: dict[str | None, list[tuple[Path, Node]]] = {}
    for path in sorted(folder.glob("*.yaml")):
        node = _read(path)
        by_target.setdefault(node.pop("_target_", None), []).append((path, node))
    options: list[Node] = []
    union: Node = {}
    for target, found in by_target.items():
        said = _comments([path for path, _ in found])
        keys = _merged([_without(node, {}) for _, node in found], "", said, target)
        union |= {name: node for name, node in keys.items() if name not in union}
        options.append(_closed({"_target_": {"const": target}} | keys) | {"required": ["_target_"]})
    return {"anyOf": [*options, _OWN, _closed(union) | {"description": f"some settings of {group}"}]}


def _merged(
    nodes: Sequence[Node], prefix: str, said: Mapping[str, str], target: str | None = None
) -> dict[str, Node]:
    """Return name -> schema of all keys of mappings of one kind, arguments of ``target``.

    Keys begin with ``prefix``, which ends with a dot; ``said`` has the comment of each dotted key.
    """
    hints = {} if target is None else _hints(target)
    found: dict[str, Node] = {}
    for key in dict.fromkeys([*(key for node in nodes for key in node), *hints]):
        values = [node[key] for node in nodes if key in node]
        name = prefix + key
        node = _SAID.get(name) or _value(values, name, said, hints.get(key))
        described = {"description": said[name]} if name in said else {}
        found[key] = ({"anyOf": [node, _LATER]} if node else {}) | described
    return found


def _value(values: Sequence[Any], name: str, said: Mapping[str, str], hint: set[str] | None) -> Node:
    """Return the schema of values of one kind; an empty one, which takes all, where nothing is known."""
    inner = [value for value in values if isinstance(value, dict)]
    if inner:
        targets = sorted({str(value["_target_"]) for value in inner if value.get("_target_")})
        target = next(iter(targets), None)
        keys = _merged([_without(each, {"_target_": 0}) for each in inner], f"{name}.", said, target)
        if target is None:
            return {"anyOf": [_closed(keys), {"type": "null"}]}
        return {"anyOf": [_closed(keys | {"_target_": {"enum": targets}}), _OWN]}
    kinds = set(hint or ())
    for value in values:
        if value is None and hint is None:
            return {}
        if not (isinstance(value, str) and re.search(_LATER["pattern"], value)):
            kinds |= {"array"} if isinstance(value, list) else _KINDS[type(value)]
    return {"type": sorted(kinds - ({"integer"} if "number" in kinds else set()))} if kinds else {}


def _hints(target: str) -> dict[str, set[str]]:
    """Return argument -> JSON types of a constructor or a function, of what a YAML file can say."""
    made = get_object(target)
    owner = getattr(made, "__self__", None)
    called = [made] if owner is None else [made, owner]  # a classmethod that hands its arguments on
    found: dict[str, set[str]] = {}
    for each in called:
        function: Any = each.__init__ if isinstance(each, type) else each  # type: ignore[misc]
        try:
            hints = typing.get_type_hints(function)
        except NameError:  # a name that type checkers alone know
            continue
        for name, hint in hints.items():
            kinds = _kinds(hint)
            if kinds is not None and name != "return":
                found[name] = kinds
    return found


def _kinds(hint: Any) -> set[str] | None:
    """Return the JSON types of an annotation; None where a YAML file cannot say such a value."""
    if hint in _KINDS:
        return set(_KINDS[hint])
    if hint is Tensor:
        return {"number", "array"}
    origin = typing.get_origin(hint)
    if origin in (types.UnionType, typing.Union):
        parts = [_kinds(part) for part in typing.get_args(hint)]
        return set().union(*(part for part in parts if part)) or None
    if origin in (list, tuple, Sequence):
        return {"array"}
    return {"object"} if origin in (dict, Mapping) else None


def _hydra() -> Node:
    """Return the schema of Hydra's node, of which our launcher is described."""
    find_launcher()
    settings = importlib.import_module("hydra_plugins.staf_batched").BatchedLauncherConf
    said = dict(re.findall(r"^ +(\w+): .*?# (.*)$", inspect.getsource(settings), re.MULTILINE))
    names = [field.name for field in dataclasses.fields(settings) if field.name != "_target_"]
    launcher = {"type": "object", "properties": {name: {"description": said[name]} for name in names}}
    return {"type": "object", "properties": {"launcher": launcher}}


def _comments(files: Sequence[Path]) -> dict[str, str]:
    """Return dotted key -> the comment behind it; the first file that says something counts."""
    found: dict[str, str] = {}
    for path in files:
        for key, comment in _commented(path.read_text(encoding="utf-8").splitlines()):
            name = f"adp.{key}" if path.parent.name == "adp" else key
            found.setdefault(name, comment)
    return found


def _commented(lines: Sequence[str]) -> Iterator[tuple[str, str]]:
    above: list[tuple[int, str]] = []  # indentation and name of the keys around a line
    for line in lines:
        found = re.match(r"( *)(\w+):[^#]*(?:# (.*))?$", line)
        if found is None:
            continue
        depth = len(found[1])
        above = [*(each for each in above if each[0] < depth), (depth, found[2])]
        if found[3]:
            yield ".".join(name for _, name in above), found[3]

"""The YAML files that Hydra leaves in a run directory, read as plain values; they may be anybody's."""

from __future__ import annotations

import functools
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from .untrusted import UnreadableError, read_text, visible

_MOST_BYTES, _MOST_NODES, _DEEPEST = 2**18, 20_000, 30
_EXPONENT = re.compile(r"^[-+]?[0-9]+(\.[0-9]*)?[eE][-+]?[0-9]+$")  # a text for YAML 1.1, a number for Hydra
_TAG = "tag:yaml.org,2002:"
_PLAIN = {f"{_TAG}{kind}" for kind in ("null", "bool", "int", "float", "str")}


class SettingsFile(NamedTuple):
    """What such a file holds."""

    tree: Any  # of dictionaries, lists, texts, numbers, booleans and None; interpolations as they are written
    lines: Mapping[str, int]  # dotted key -> number of its line, from 1
    text: list[str]

    def line(self, key: str) -> str:
        """Return `17: kernel: gaussian`, the line of a dotted key, or of the nearest key above it."""
        while key and key not in self.lines:
            key = key.rpartition(".")[0]
        number = self.lines.get(key, 1)
        return f"{number}: {visible(self.text[number - 1].strip())}"


def read_settings(path: Path, root: Path) -> SettingsFile:
    """Read such a file: without aliases, tags and merges, which Hydra never writes.

    Args:
        path: of the file.
        root: the run directory; no folder between the two may be a link.

    Raises:
        UnreadableError: if it cannot be read, is no such YAML, or is larger than what Hydra writes.
    """
    import yaml  # Hydra brings it; only runs without `run.json` and exports need it

    text = read_text(path, _MOST_BYTES, root=root)
    kind = _loader()
    try:
        _check(text, path.name)
        loader = kind(text)
        try:
            node = loader.get_single_node()
            lines: dict[str, int] = {}
            tree = None if node is None else _value(loader, node, "", lines)
        finally:
            loader.dispose()
    except (yaml.YAMLError, ValueError) as error:
        raise UnreadableError(f"{path.name} is not YAML: {' '.join(str(error).split())}") from error
    return SettingsFile(tree, lines, text.splitlines() or [""])


@functools.cache
def _loader() -> Any:
    """Return YAML's loader of plain values, with numbers like 1e-3 besides."""
    import yaml

    kind = type("_Loader", (getattr(yaml, "CSafeLoader", yaml.SafeLoader),), {})
    kind.add_implicit_resolver(f"{_TAG}float", _EXPONENT, list("-+0123456789"))  # type: ignore[attr-defined]
    return kind


def _check(text: str, name: str) -> None:
    """Look at the events alone, before anything is built."""
    import yaml

    depth = 0
    events = yaml.parse(text, getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    for nodes, event in enumerate(events):
        if getattr(event, "anchor", None) is not None:
            raise UnreadableError(f"{name}:{event.start_mark.line + 1} has an anchor or an alias")
        if isinstance(event, yaml.events.CollectionStartEvent):
            depth += 1
        elif isinstance(event, yaml.events.CollectionEndEvent):
            depth -= 1
        if depth > _DEEPEST or nodes > _MOST_NODES:
            raise UnreadableError(f"{name}:{event.start_mark.line + 1} is nested too deep, or too long")


def _value(loader: Any, node: Any, key: str, lines: dict[str, int]) -> Any:
    lines.setdefault(key, node.start_mark.line + 1)
    prefix = f"{key}." if key else ""
    if node.tag == f"{_TAG}map":
        made = {}
        for name, inner in node.value:
            at = f"{prefix}{name.value}"
            if name.tag not in _PLAIN or name.value in made:
                raise UnreadableError(
                    f"line {name.start_mark.line + 1} has a key twice, or one that is no text"
                )
            lines[at] = name.start_mark.line + 1
            made[visible(name.value)] = _value(loader, inner, at, lines)
        return made
    if node.tag == f"{_TAG}seq":
        return [_value(loader, inner, f"{prefix}{number}", lines) for number, inner in enumerate(node.value)]
    if node.tag == f"{_TAG}timestamp":
        return node.value
    if node.tag not in _PLAIN:
        raise UnreadableError(f"line {node.start_mark.line + 1} has the tag {node.tag}")
    found = loader.construct_object(node)
    if isinstance(found, int) and not isinstance(found, bool) and abs(found) >= 2**63:
        return float(found) if abs(found) < 10**300 else float("inf")
    return visible(found) if isinstance(found, str) else found

"""Messages about a setting that does not exist: which choice has it, or which name is near."""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml

from . import config_directory

_FULL_NAMES = ("experiment",)  # groups whose files hold settings by their full names


def without_setting(name: str) -> str:
    """Return a sentence about a setting that the chosen options do not have."""
    known = _settings()
    if choices := known.get(name):
        shown = ", ".join(choices[:4]) + (", ..." if len(choices) > 4 else "")
        return f"there is no setting `{name}` with what is chosen; {shown} has it."
    if name in known:
        whole = name.partition(".")[0]
        return f"`{name}` cannot be set where `{whole}` is one value: leave `{whole}=...` away."
    near = difflib.get_close_matches(name, known, n=1)
    return f"there is no setting `{name}`; " + (
        f"did you mean `{near[0]}`?" if near else "`staf --help` lists them."
    )


def _settings() -> dict[str, list[str]]:
    """Return every group and setting of `conf/` by its full name, with the choices that have a setting."""
    folder = Path(config_directory())
    found: dict[str, list[str]] = {}
    for path in sorted(folder.rglob("*.yaml")):
        group = path.parent.relative_to(folder).as_posix()
        if group.partition("/")[0] == "hydra":
            continue
        found.setdefault(group, [])
        whole = group in (".", *_FULL_NAMES)
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
        for key in _keys(content if isinstance(content, dict) else {}):
            name = key if whole else f"{group.replace('/', '.')}.{key}"
            found.setdefault(name, []).extend([] if group == "." else [f"{group}={path.stem}"])
    return found


def _keys(tree: Mapping[str, Any], before: str = "") -> Iterator[str]:
    for key, value in tree.items():
        if key not in ("defaults", "_target_", "hydra"):
            yield f"{before}{key}"
            yield from _keys(value, f"{before}{key}.") if isinstance(value, dict) else ()

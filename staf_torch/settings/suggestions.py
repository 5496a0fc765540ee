"""Messages about a setting that does not exist: which choice has it, or which name is near."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from . import config_directory

_CLOSE = 0.55  # of difflib: what is told as near
_ELSEWHERE = dict.fromkeys(("iterations", "iters", "max_iter", "n_iter"), "inner_steps")  # in other libraries
_FULL_NAMES = ("experiment",)  # groups whose files hold settings by their full names


def without_setting(name: str) -> str:
    """Return a sentence about a setting that the chosen options do not have."""
    known = _settings()
    if choices := known.get(name):
        shown = ", ".join(choices[:4]) + (", ..." if len(choices) > 4 else "")
        have = "has" if len(choices) == 1 else "have"
        return f"there is no setting `{name}` with these choices; {shown} {have} it."
    if name in known:
        whole = name.partition(".")[0]
        return f"`{name}` cannot be set where `{whole}` is one value: omit `{whole}=...`."
    near = _near(name, known)
    return f"there is no setting `{name}`; " + (
        f"did you mean `{near}`?" if near else "`staf --help` lists them."
    )


def without_option(name: str, options: Sequence[str]) -> str:
    """Return a sentence about an option, `kernel/nope`, that its group does not have."""
    group, _, last = name.rpartition("/")
    said = f"there is no `{name}`; there are {', '.join(options)}"
    if group.startswith("hydra"):
        return f"{said}; others come with the extras joblib, slurm, ray and optuna."
    near = difflib.get_close_matches(last, options, n=1, cutoff=_CLOSE)
    meant = f" Did you mean `{near[0]}`?" if near else ""
    return f"{said}.{meant} One of your own needs `--config-dir FOLDER`."


def _near(name: str, known: Collection[str]) -> str | None:
    """Return the setting that was meant: of the same group by its last word, where there is such a group."""
    group, dot, last = name.rpartition(".")
    inside = [key for key in known if dot and key.rpartition(".")[0] == group]
    words = {key.rpartition(".")[2]: key for key in inside}
    near = difflib.get_close_matches(last, words, n=1, cutoff=_CLOSE)
    if near or (last in _ELSEWHERE and _ELSEWHERE[last] in words):
        return words[near[0] if near else _ELSEWHERE[last]]
    found = difflib.get_close_matches(name, [key for key in known if key not in (group, *inside)], n=1)
    return found[0] if found else None


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

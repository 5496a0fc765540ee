"""The files of run and sweep directories: their names, and how they are written: complete or not at all.

They are read by `untrusted`.
"""

from __future__ import annotations

import functools
import json
import math
import os
import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, TypeGuard, TypeVar

RUN, METRICS, HISTORY, ROWS = "run.json", "metrics.json", "history.npz", "rows.json"
SWEEP, PAGE, TABLE = "sweep.json", "report.html", "table"
FIGURES, HYDRA = "figures", ".hydra"
COMPLETED, FAILED, RUNNING, UNFINISHED = "completed", "failed", "running", "unfinished"
"""Status of a run: it ended, it raised, it has not said that it ended, or there is no word of its end."""

FREE = ("figures", "animation", "tracker")
"""Settings that change no number: a sweep that is resumed may have others."""

Value = str | float | int | bool | list[Any] | None
"""What a setting holds; a list may hold lists."""
_WORDS: Mapping[str, Value] = {"null": None, "none": None, "true": True, "false": False}
Item = TypeVar("Item")
Key = TypeVar("Key")


def grouped(items: Iterable[Item], key: Callable[[Item], Key]) -> dict[Key, list[Item]]:
    """Return the items by a key, groups and items in the order in which they came."""
    groups: dict[Key, list[Item]] = {}
    for item in items:
        groups.setdefault(key(item), []).append(item)
    return groups


@functools.lru_cache(4096)  # a table of a thousand rows asks for the same keys a thousand times
def is_free(line: str) -> bool:
    """Return whether an override, or a dotted key, is about one of `FREE`."""
    return re.split(r"[.=@/]", line.lstrip("+~"), maxsplit=1)[0] in FREE


def is_number(value: object) -> TypeGuard[int | float]:
    """Return whether a value is a number, which a truth value is not."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def write_text(path: Path, text: str) -> None:
    """Write a file under another name, flush it to disk, then rename it into place."""
    write_bytes(path, text.encode())


def write_bytes(path: Path, content: bytes) -> None:
    """Write bytes as `write_text` writes a text."""
    partial = path.with_name(partial_name(path.name))
    try:
        partial.unlink(missing_ok=True)  # of a run that was killed; and a link there would be written through
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW
        with os.fdopen(os.open(partial, flags, 0o666), "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def open_after(path: Path, keep: int) -> int:
    """Return the descriptor of a file to write to after its first ``keep`` bytes; the rest of it is cut off.

    With none to keep it is a new file. A link is not followed.
    """
    if keep:
        file = os.open(path, os.O_WRONLY | os.O_NOFOLLOW)
        os.ftruncate(file, keep)
        os.lseek(file, keep, os.SEEK_SET)
        return file
    path.unlink(missing_ok=True)
    return os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o666)


def partial_name(name: str) -> str:
    """Return the name of a file until it is complete."""
    return f".{name}.partial"


def write_metrics(path: Path, metrics: Mapping[str, float | int | None]) -> None:
    """Write a flat JSON object, name to number or null.

    Raises:
        ValueError: for a number that is not finite, which JSON does not have.
    """
    write_text(path, json.dumps(metrics, indent=2, allow_nan=False) + "\n")


def flatten(settings: Mapping[Any, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested settings with dotted keys: ``{"centers": {"count": 3}}`` -> ``{"centers.count": 3}``."""
    flat: dict[str, Any] = {}
    for key, value in settings.items():
        if isinstance(value, Mapping) and value:
            flat |= flatten(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat


def plain(value: Any) -> Any:
    """Return what JSON can hold of a value; a number that is not finite becomes its name."""
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    return value if value is None or isinstance(value, bool | int | float | str) else str(value)


def parse_overrides(lines: Iterable[str]) -> dict[str, Value]:
    """Return overrides as typed: ``["kernel=gaussian", "+seed=3"]`` -> ``{"kernel": "gaussian", "seed": 3}``.

    Hydra's own are left out. Hydra itself is not asked: it takes a second to import.
    """
    typed: dict[str, Value] = {}
    for line in lines:
        key, given, text = line.lstrip("+~").partition("=")
        if given and not key.startswith(("hydra.", "hydra/")):
            typed[key] = _parsed(text.strip())
    return typed


def _parsed(word: str) -> Value:
    """A number, word, list or text; what is none of the first three stays as it was typed."""
    if word.lower() in _WORDS:
        return _WORDS[word.lower()]
    if len(word) > 1 and word[0] == word[-1] and word[0] in "'\"":
        return word[1:-1]
    for kind in (int, float):
        try:
            number: float = kind(word)
        except ValueError:
            continue
        return number if abs(number) < float("inf") else word  # neither nan nor inf is a JSON number
    if word.startswith("["):
        try:
            listed = json.loads(word)
        except ValueError:
            return word
        return plain(listed) if isinstance(listed, list) else word
    return word

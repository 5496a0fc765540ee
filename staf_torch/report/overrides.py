"""Command-line overrides as they were typed, read back without Hydra."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from typing import Any

Value = str | float | int | bool | list[Any] | None
"""What a setting holds; a list may hold lists."""

_WORDS: Mapping[str, Value] = {"null": None, "none": None, "true": True, "false": False}


def parse_overrides(lines: Iterable[str]) -> dict[str, Value]:
    """``["kernel=gaussian", "+seed=3"]`` -> ``{"kernel": "gaussian", "seed": 3}``, without Hydra's own."""
    found: dict[str, Value] = {}
    for line in lines:
        key, given, text = line.lstrip("+~").partition("=")
        if given and not key.startswith(("hydra.", "hydra/")):
            found[key] = parse_value(text)
    return found


def parse_value(text: str) -> Value:
    """A number, word, list or text; what is none of the first three stays as it was typed."""
    word = text.strip()
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
        return listed if isinstance(listed, list) else word
    return word


def flatten(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Value]:
    """Nested settings with dotted keys: ``{"centers": {"count": 3}}`` -> ``{"centers.count": 3}``."""
    found: dict[str, Value] = {}
    for key, value in settings.items():
        if isinstance(value, Mapping) and value:
            found |= flatten(value, f"{prefix}{key}.")
        else:
            found[f"{prefix}{key}"] = None if isinstance(value, Mapping) else value
    return found

"""Plain settings of many members: one composition by Hydra for all that differ in values alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from hydra.core.override_parser.types import Override, OverrideType
from omegaconf import OmegaConf

from ...results import run_record as records
from ...results.files import plain as as_json
from ...settings.plain import ManySettings, PlainSettings
from .composing import MOST_LINES, Composer, independent


class PlainComposer:
    """Composes members as `Composer` does, and without OmegaConf wherever the result is known to be the same.

    That is where no setting refers to another one and the members set the same keys, each a number, a text or
    a list at a place of its own.

    Args:
        composer: asked for everything else.
    """

    def __init__(self, composer: Composer) -> None:
        self._composer = composer
        self._lines: dict[str, _Line] = {}
        self._bases: dict[tuple[tuple[str, ...], ...], _Base | None] = {}

    def __call__(self, members: Sequence[Sequence[str]]) -> ManySettings:
        """Return the settings of members, by their overrides.

        Raises:
            hydra.errors.HydraException, ValueError: what Hydra itself raises.
        """
        plain: list[PlainSettings | None] = []
        flat: list[Mapping[str, Any]] = []
        for overrides in members:
            one, by_key = self._one(overrides)
            plain.append(one)
            flat.append(by_key)
        return ManySettings(plain, flat, lambda i: self._composer(members[i]))

    def _one(self, overrides: Sequence[str]) -> tuple[PlainSettings | None, Mapping[str, Any]]:
        lines = [self._line(text) for text in overrides]
        values = {line.key: line for line in lines if not line.chooses}
        base = None
        if all(line.simple for line in lines if not line.chooses):
            key = tuple(line.text for line in lines if line.chooses), tuple(values)
            if key not in self._bases:
                self._bases[key] = self._base(overrides, values)
            base = self._bases[key]
        if base is None:
            return None, records.flat(self._composer(overrides))
        return base.with_values(values)

    def _line(self, text: str) -> _Line:
        if text not in self._lines:
            if len(self._lines) >= MOST_LINES:
                self._lines.clear()
            override = self._composer.parsed(text)
            key, value = override.key_or_group, override.value()
            changes = override.type == OverrideType.CHANGE
            simple = changes and not isinstance(value, dict) and not _refers(value)
            self._lines[text] = _Line(text, key, value, self._composer.chooses(override), simple, override)
        return self._lines[text]

    def _base(self, overrides: Sequence[str], values: Mapping[str, _Line]) -> _Base | None:
        """Compose one member for all of its kind; None where their settings are not plain."""
        if self._composer.choices(overrides) is None:
            return None
        if not independent({key: line.override for key, line in values.items()}):
            return None
        composed = self._composer(overrides)
        tree = OmegaConf.to_container(composed)
        assert isinstance(tree, dict)
        if _refers(tree):
            return None
        settings = PlainSettings.of(tree)
        if any(_at(settings, key) != line.value for key, line in values.items()):
            return None  # an entry of a list, or a key that is written in another way
        return _Base(settings, records.flat(composed), dict(values))


class _Line(NamedTuple):
    """One override."""

    text: str
    key: str
    value: Any
    chooses: bool  # what is composed, beyond the value of one key
    simple: bool  # a value that is known without the other settings
    override: Override


class _Base(NamedTuple):
    """The settings of one member, from which those of others follow."""

    tree: PlainSettings
    flat: Mapping[str, Any]
    values: Mapping[str, _Line]

    def with_values(self, values: Mapping[str, _Line]) -> tuple[PlainSettings, Mapping[str, Any]]:
        """Return the settings, nested and by dotted keys, with other values of the same keys."""
        tree, flat = PlainSettings(self.tree), dict(self.flat)
        for key, line in values.items():
            if line.text == self.values[key].text:
                continue
            *path, last = key.split(".")
            node = tree
            for part in path:
                node[part] = PlainSettings(node[part])
                node = node[part]
            node[last] = line.value
            if key in flat:
                flat[key] = as_json(line.value)
        return tree, flat


def _at(tree: Any, key: str) -> Any:
    """Return the value at a dotted key; the tree itself where there is none."""
    node = tree
    for part in key.split("."):
        if not isinstance(node, dict) or part not in node:
            return tree
        node = node[part]
    return node


def _refers(value: Any) -> bool:
    """Return whether something in a value refers to other settings, or is missing."""
    return "${" in str(value) or "???" in str(value)

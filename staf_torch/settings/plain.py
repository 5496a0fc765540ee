"""Resolved settings as plain Python objects, for jobs by the thousand: OmegaConf's take milliseconds each."""

from __future__ import annotations

import pickle
from collections.abc import Mapping, Sequence
from typing import Any, overload

from omegaconf import DictConfig, OmegaConf


class PlainSettings(dict[str, Any]):
    """Settings by name, nested, that are read as a `DictConfig` is: ``cfg.kernel``, ``cfg.get("dt")``.

    Jobs share what is equal in their settings, so that nobody may change them.
    """

    def __getattr__(self, name: str) -> Any:
        try:
            return self[name]
        except KeyError as error:
            raise AttributeError(name) from error

    @classmethod
    def of(cls, tree: Mapping[Any, Any]) -> PlainSettings:
        """Return a tree of dictionaries as settings."""
        return cls({str(k): cls.of(v) if isinstance(v, dict) else v for k, v in tree.items()})

    def hydras(self) -> DictConfig:
        """Return the same settings as OmegaConf has them."""
        found: DictConfig = OmegaConf.create(plain(self))
        OmegaConf.set_struct(found, True)
        return found


def plain(value: Any) -> Any:
    """Return a setting as Python has it: a list or dictionary, resolved, in place of OmegaConf's."""
    if isinstance(value, PlainSettings):
        return {key: plain(inner) for key, inner in value.items()}
    return OmegaConf.to_container(value, resolve=True) if OmegaConf.is_config(value) else value


class ManySettings(Sequence[DictConfig]):
    """The settings of many jobs: plain where that is possible, and OmegaConf's where one asks for them."""

    def __init__(self, settings: Sequence[DictConfig | PlainSettings]) -> None:
        self._settings = list(settings)
        self._made: dict[int, DictConfig] = {}
        self._first: tuple[PlainSettings, bytes] | None = None  # of which the others are changed copies

    def __len__(self) -> int:
        return len(self._settings)

    @overload
    def __getitem__(self, index: int) -> DictConfig: ...

    @overload
    def __getitem__(self, index: slice) -> ManySettings: ...

    def __getitem__(self, index: int | slice) -> DictConfig | ManySettings:
        if isinstance(index, slice):
            return self.of(range(*index.indices(len(self))))
        index = range(len(self))[index]
        found = self._settings[index]
        if isinstance(found, PlainSettings):
            found = self._made[index] = self._made.get(index) or self._hydras(found)
        return found

    def plain(self, index: int) -> PlainSettings | None:
        """Return those of a job where they are plain."""
        found = self._settings[index]
        return found if isinstance(found, PlainSettings) else None

    def made(self, index: int) -> DictConfig:
        """Return those of a job, which are plain, as OmegaConf has them: new ones at every call."""
        found = self.plain(index)
        assert found is not None
        return self._hydras(found)

    def _hydras(self, settings: PlainSettings) -> DictConfig:
        """Return settings as OmegaConf has them, in a fifth of the time where they are like the first."""
        if self._first is None:
            self._first = settings, pickle.dumps(settings.hydras())
        first, content = self._first
        found: DictConfig = pickle.loads(content)
        return found if _changed(found, settings, first) else settings.hydras()

    def of(self, indices: Sequence[int]) -> ManySettings:
        """Return those of some jobs."""
        return ManySettings([self._settings[i] for i in indices])

    def read(self) -> Sequence[DictConfig | PlainSettings]:
        """Return the settings of every job, plain where that is possible."""
        return self._settings


def _changed(node: DictConfig, now: PlainSettings, then: PlainSettings) -> bool:
    """Set what is otherwise in a node of the settings `then`; return whether both have the same names."""
    if list(now) != list(then):
        return False
    for name, value in now.items():
        if isinstance(value, PlainSettings) and isinstance(then[name], PlainSettings):
            if value is not then[name] and not _changed(node[name], value, then[name]):
                return False
        elif value is not then[name]:
            node[name] = plain(value)
    return True


def to_read(cfgs: Sequence[DictConfig]) -> Sequence[DictConfig | PlainSettings]:
    """Return settings that are only read: plain ones where somebody has them."""
    return cfgs.read() if isinstance(cfgs, ManySettings) else cfgs

"""Hydra's composition, many times in one process: what it read and merged once it need not do again.

Hydra composes for the commands and sweeps of many tests, and nearly all of that time goes to parsing the same
files of `conf/` and merging them in the same order. `pieces` keeps both, by the files' times and sizes.
"""

from __future__ import annotations

import contextlib
import os
import pickle
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from hydra._internal import defaults_list
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.config_repository import ConfigRepository
from hydra.core.config_store import ConfigStore
from hydra.core.object_type import ObjectType
from hydra.version import VersionBase
from omegaconf import DictConfig

_LOAD: Callable[..., Any] = ConfigRepository.load_config
_MERGE: Callable[..., DictConfig] = ConfigLoaderImpl._compose_config_from_defaults_list
_CHOICES: Callable[..., Any] | None = getattr(defaults_list, "_create_interpolation_map", None)  # not in 1.4

_read: dict[Any, bytes] = {}
_merged: dict[Any, bytes] = {}


@contextlib.contextmanager
def pieces(kept: bool = True) -> Iterator[None]:
    """Let Hydra read each file once, and merge what a defaults list names once; False: as by itself."""
    hydra: tuple[Any, ...] = (ConfigRepository, ConfigLoaderImpl, defaults_list)
    names = "load_config", "_compose_config_from_defaults_list", "_create_interpolation_map"
    functions = (_load_once, _merge_once, _choices_where_asked) if kept else (_LOAD, _MERGE, _CHOICES)
    places = [one for one in zip(hydra, names, functions, strict=True) if hasattr(one[0], one[1])]
    before = [getattr(place, name) for place, name, _ in places]
    for place, name, function in places:
        setattr(place, name, function)
    try:
        yield
    finally:
        for (place, name, _), function in zip(places, before, strict=True):
            setattr(place, name, function)


def _load_once(self: ConfigRepository, config_path: str) -> Any:
    key = _version(self, config_path)
    if key is None:
        return _LOAD(self, config_path)
    if key not in _read:
        _read[key] = pickle.dumps(_LOAD(self, config_path))
    return pickle.loads(_read[key])


def _merge_once(self: ConfigLoaderImpl, defaults: Sequence[Any], repo: Any) -> DictConfig:
    versions = [_version(repo.delegate, default.config_path) for default in defaults]
    if None in versions:
        return _MERGE(self, defaults, repo)
    key = (*versions, *(tuple(sorted(vars(default).items())) for default in defaults))
    if key not in _merged:
        _merged[key] = pickle.dumps(_MERGE(self, defaults, repo))
    composed: DictConfig = pickle.loads(_merged[key])
    return composed


def _choices_where_asked(overrides: Any, defaults: Sequence[Any], self_added: bool) -> Any:
    """A fifth of Hydra's time goes to a map of all choices that only a default with `${...}` looks at."""
    asked = any(default.is_interpolation() for default in defaults if not default.is_self())
    assert _CHOICES is not None
    return _CHOICES(overrides, defaults, self_added) if asked else None


def _version(repository: ConfigRepository, config_path: str) -> tuple[Any, ...] | None:
    """Return what tells a configuration from all that its path led to before; None where nothing does."""
    source = repository._find_object_source(config_path, ObjectType.CONFIG)
    if source is None:
        return None
    name = source._normalize_file_name(config_path)
    stored = _Same(ConfigStore.instance()._open(name))  # also what a file's schema would be
    told = (
        config_path,
        source.scheme(),
        source.provider,
        source.path,
        VersionBase.instance().getbase(),
        stored,
    )
    if source.scheme() == "file":
        status = os.stat(os.path.join(source.path, name))
        return *told, status.st_ino, status.st_mtime_ns, status.st_ctime_ns, status.st_size
    return told if source.scheme() == "structured" or source.path == "hydra.conf" else None


class _Same:
    """Something that is equal to itself alone, and stays as long as it is part of a key."""

    def __init__(self, one: Any) -> None:
        self.one = one

    def __hash__(self) -> int:
        return id(self.one)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and other.one is self.one

"""Where Hydra looks for settings: as the running program does, also in a worker where none is running."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from contextvars import ContextVar

from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.config_search_path_impl import ConfigSearchPathImpl
from hydra._internal.utils import create_config_search_path
from hydra.core.config_loader import ConfigLoader
from hydra.core.global_hydra import GlobalHydra
from hydra.core.plugins import Plugins

from ...settings import config_directory

SearchPaths = tuple[tuple[str, str], ...]
"""Provider and place of every folder in which Hydra looks for settings."""
_PATHS: ContextVar[SearchPaths | None] = ContextVar("_PATHS", default=None)


def config_loader() -> ConfigLoader:
    """Return Hydra's loader: of the running program, else one for the paths of `searching` or `conf/`."""
    if GlobalHydra.instance().is_initialized():
        return GlobalHydra.instance().config_loader()
    Plugins.instance()  # the sources of configurations are plugins
    given = _PATHS.get()
    if given is None:
        return ConfigLoaderImpl(create_config_search_path(config_directory()))
    found = ConfigSearchPathImpl()
    for provider, place in given:
        found.append(provider, place)
    return ConfigLoaderImpl(found)


def search_paths() -> SearchPaths:
    """Return where the running program looks for settings."""
    return tuple((each.provider, each.path) for each in config_loader().get_search_path().get_path())


@contextlib.contextmanager
def searching(paths: SearchPaths) -> Iterator[None]:
    """Let `config_loader` look in those places where no program of Hydra's is running."""
    token = _PATHS.set(paths)
    try:
        yield
    finally:
        _PATHS.reset(token)

"""Hydra called from Python: an application in a process that may be a notebook or another application."""

from __future__ import annotations

import contextlib
import importlib
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, cast

from hydra import version
from hydra._internal.hydra import Hydra
from hydra._internal.utils import create_config_search_path
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.plugins import Plugins
from hydra.core.singleton import Singleton
from hydra.core.utils import JobRuntime
from hydra.types import RunMode
from hydra.version import VersionBase
from omegaconf import DictConfig
from omegaconf.basecontainer import BaseContainer

from ...settings import config_directory
from .log_handlers import handlers_aside
from .mode import mode_read_from_its_file
from .program import HAS_WHITELIST, find_launcher, named_packages, trusted, with_mode

_OF_AN_APPLICATION: tuple[type, ...] = (GlobalHydra, HydraConfig, JobRuntime, VersionBase)
"""Hydra's singletons that belong to the application that runs; plugins and the store are everyone's."""


class Application(NamedTuple):
    """The library's own Hydra application, alive within `application`."""

    hydra: Hydra
    seen: list[DictConfig]  # settings that Hydra composed, the latest last

    def is_sweep(self, overrides: Sequence[str]) -> bool:
        """Return whether the settings themselves ask for a sweep, as those of `experiment=ablation` do."""
        lines, hydra = with_mode(overrides), cast(Any, self.hydra)
        with mode_read_from_its_file():
            if HAS_WHITELIST:
                read = hydra.get_mode("config", lines, OverridesParser.create().parse_overrides(lines))
            else:
                read = hydra.get_mode("config", lines)
        return bool(read == RunMode.MULTIRUN)

    def run(self, task: Callable[[DictConfig], Any], overrides: Sequence[str]) -> Path:
        """Run one job and return its directory.

        Raises:
            BaseException: that of Hydra or of the task.
        """
        with trusted(named_packages(overrides)):
            ended = self.hydra.run("config", task, [*overrides, "hydra.mode=RUN"])
        config: Any = ended.hydra_cfg
        return Path(config.hydra.runtime.output_dir)

    def sweep(self, task: Callable[[DictConfig], Any], overrides: Sequence[str]) -> Path:
        """Run a sweep and return its directory.

        Raises:
            BaseException: that of Hydra, or of the first job that failed, after all jobs have ended.
        """
        with trusted(named_packages(overrides)):
            self.hydra.multirun("config", task, [*overrides, "hydra.mode=MULTIRUN"])
        return Path(self.seen[-1].hydra.sweep.dir).absolute()


@contextlib.contextmanager
def application() -> Iterator[Application]:
    """Yield the application; what the process had of Hydra, logging and import path comes back in the end."""
    with contextlib.ExitStack() as stack:
        for guard in (_import_path, _environment, _singletons, handlers_aside):
            stack.enter_context(guard())
        find_launcher()
        _register_launcher()
        if hasattr(version, "setbase") and not HAS_WHITELIST:  # 1.4 warns of it
            version.setbase("1.3")
        stack.enter_context(trusted())
        hydra = Hydra.create_main_hydra2("staf", create_config_search_path(config_directory()))
        seen: list[DictConfig] = []
        compose = hydra.compose_config

        def remembered(*arguments: Any, **keywords: Any) -> DictConfig:
            seen.append(compose(*arguments, **keywords))
            return seen[-1]

        hydra.compose_config = remembered  # type: ignore[method-assign]
        yield Application(hydra, seen)


def _register_launcher() -> None:
    """Name the batched launcher to Hydra, which may have looked for plugins before."""
    plugin = importlib.import_module("hydra_plugins.staf_batched")  # on the path since `find_launcher`
    Plugins.instance().register(plugin.BatchedLauncher)


@contextlib.contextmanager
def _import_path() -> Iterator[None]:
    """Let settings name modules of the working directory, as the command does."""
    before = sys.path[:]
    sys.path.insert(0, os.getcwd())
    try:
        yield
    finally:
        sys.path[:] = before


@contextlib.contextmanager
def _environment() -> Iterator[None]:
    """Restore the variables of the environment that jobs or the launcher set."""
    before = dict(os.environ)
    try:
        yield
    finally:
        for name in set(os.environ) - set(before):
            del os.environ[name]
        os.environ.update(before)


@contextlib.contextmanager
def _singletons() -> Iterator[None]:
    """Set the singletons and the resolvers of another application aside."""
    instances: dict[type, Any] = Singleton._instances
    aside: dict[type, Any] = {kind: instances.pop(kind) for kind in _OF_AN_APPLICATION if kind in instances}
    resolvers = dict(BaseContainer._resolvers)
    try:
        yield
    finally:
        for kind in _OF_AN_APPLICATION:
            instances.pop(kind, None)
        instances.update(aside)
        BaseContainer._resolvers.clear()
        BaseContainer._resolvers.update(resolvers)

"""Hydra called from Python: an application in a process that may be a notebook or another application."""

from __future__ import annotations

import contextlib
import importlib
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from hydra import initialize_config_dir, version
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.plugins import Plugins
from hydra.core.utils import JobRuntime
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from ...settings import config_directory
from .inside import HAS_WHITELIST, trusted
from .log_handlers import handlers_aside
from .program import find_launcher, named_packages, with_mode

_RESOLVERS = ("now", "hydra", "python_version", "hydra_override_dirname", "hydra_deprecated_override_dirname")
"""Hydra's own, which it registers where it begins."""


class Application(NamedTuple):
    """The library's own Hydra application, alive within `application`."""

    hydra: Any
    seen: list[DictConfig]  # settings that Hydra composed, the latest last

    def is_sweep(self, overrides: Sequence[str]) -> bool:
        """Return whether the settings themselves ask for a sweep, as those of `experiment=ablation` do."""
        loader = self.hydra.config_loader
        try:
            found = loader.load_configuration(
                "config", with_mode(overrides), RunMode.MULTIRUN, validate_sweep_overrides=False
            )
        except Exception:  # the run itself raises it
            return False
        return bool(found.hydra.mode == RunMode.MULTIRUN)

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
        for guard in (_import_path, _environment, _other_application, handlers_aside):
            stack.enter_context(guard())
        find_launcher()
        _register_launcher()
        base = {} if HAS_WHITELIST else {"version_base": "1.3"}  # 1.4 warns of it
        stack.enter_context(initialize_config_dir(config_directory(), "staf", **base))
        stack.enter_context(trusted())
        hydra: Any = GlobalHydra.instance().hydra
        seen: list[DictConfig] = []
        compose = hydra.compose_config

        def remembered(*arguments: Any, **keywords: Any) -> DictConfig:
            seen.append(compose(*arguments, **keywords))
            return seen[-1]

        hydra.compose_config = remembered
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
def _other_application() -> Iterator[None]:
    """Set aside what another application of the process has of Hydra."""
    theirs, config, job = GlobalHydra.instance(), HydraConfig.instance(), JobRuntime.instance()
    kept = theirs.hydra, config.cfg, job.conf, version.getbase()
    resolvers = [name for name in _RESOLVERS if OmegaConf.has_resolver(name)]
    theirs.clear()
    config.cfg, job.conf = None, OmegaConf.create()
    try:
        yield
    finally:
        GlobalHydra.set_instance(theirs)
        theirs.hydra, config.cfg, job.conf, version.VersionBase.instance().version_base = kept
        for name in _RESOLVERS:
            if name not in resolvers and OmegaConf.has_resolver(name):
                OmegaConf.clear_resolver(name)

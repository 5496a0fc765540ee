"""`staf` as a Hydra application: of its command line, and of Python, where a process may have another one."""

from __future__ import annotations

import argparse
import contextlib
import functools
import importlib
import importlib.util
import os
import re
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import hydra
from hydra import initialize_config_dir, version
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.plugins import Plugins
from hydra.core.utils import JobRuntime
from hydra.types import RunMode
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from ...settings import config_directory
from .. import lock
from .composing import Composer
from .inside import HAS_WHITELIST, TRUSTED, arguments, config_loader, trusted
from .jobs import handlers_aside

_PACKAGE = Path(__file__).resolve().parents[2]
_NAMES = re.compile(r"(?:_target_|\bpath)['\"]?\s*[=:]\s*['\"]?([A-Za-z_]\w*\.[\w.]*\w)")
_OUTSIDE = re.compile(r"hydra.(searchpath|job)")  # files and variables that may be others at the next call
_SHOWING = (
    "help",
    "hydra_help",
    "cfg",
    "info",
    "shell_completion",
    "resolve",
    "config_path",
    "experimental_rerun",
)
VERSION: dict[str, str] = {} if HAS_WHITELIST else {"version_base": "1.3"}  # 1.4 warns of it
_RESOLVERS = ("now", "hydra", "python_version", "hydra_override_dirname", "hydra_deprecated_override_dirname")
"""Hydra's own, which it registers where it begins."""


class Application:
    """The library's own Hydra application, alive within `application`.

    ``run`` runs one job by a task, and ``sweep`` all of them: Hydra's own methods, which raise what the task
    raises, of a sweep the error of the first job that failed, when all have ended.
    """

    def __init__(self, hydra: Any, name: str, overrides: Sequence[str], multirun: bool) -> None:
        self._loader, self._name = hydra.config_loader, name
        self._overrides, self._multirun = list(overrides), multirun
        self.run = functools.partial(hydra.run, name, overrides=[*overrides, "hydra.mode=RUN"])
        self.sweep = functools.partial(hydra.multirun, name, overrides=[*overrides, "hydra.mode=MULTIRUN"])
        self._loader.latest_sweep = None

    def is_sweep(self) -> bool:
        """Return whether the command line or the settings, as those of `experiment=ablation`, ask for one."""
        if self._multirun:
            return True
        try:
            found = self._loader.load_configuration(
                self._name, self._overrides, RunMode.MULTIRUN, validate_sweep_overrides=False
            )
        except Exception:  # the run itself raises it
            return False
        self._loader.latest_sweep = None  # but the question whether this is one
        return bool(found.hydra.mode == RunMode.MULTIRUN)

    @property
    def begun(self) -> DictConfig | None:
        """The settings of the sweep that has begun, None where it has not come so far."""
        found: DictConfig | None = self._loader.latest_sweep
        return found


@contextlib.contextmanager
def application(argv: Sequence[str]) -> Iterator[Application]:
    """Yield the application of a command line.

    What the process had of Hydra, logging, environment and import path comes back in the end.
    """
    words = arguments(argv)
    name = words.config_name or "config"
    with contextlib.ExitStack() as stack:
        for guard in (
            working_directory_imports,
            _environment,
            _other_application,
            handlers_aside,
            lock.returned,
        ):
            stack.enter_context(guard())
        find_launcher()
        plugin = importlib.import_module(
            "hydra_plugins.staf_batched"
        )  # Hydra may have looked for plugins before
        Plugins.instance().register(plugin.BatchedLauncher)
        stack.enter_context(initialize_config_dir(config_directory(), "staf", **VERSION))
        stack.enter_context(trusted(named_packages(argv)))
        running: Any = GlobalHydra.instance().hydra
        changes = words.config_dir is not None or any(re.search(_OUTSIDE, line) for line in words.overrides)
        running.config_loader = (
            Composer(config_loader(words.config_dir), name) if changes else _composer(name)
        )
        yield Application(running, name, words.overrides, words.multirun)


@functools.cache
def _composer(name: str) -> Composer:
    """Return the settings of the package alone, composed once a process: its files do not change."""
    return Composer(config_loader(), name)


def is_about_settings(argv: Sequence[str]) -> bool:
    """Return whether a command line only shows something (`--help`, `--cfg job`, ...), or is a wrong one."""
    words = arguments(argv)
    return (
        any(vars(words)[name] for name in _SHOWING) or (words.run and words.multirun) or bool(words.unknown)
    )


def program(task: Callable[[DictConfig], Any]) -> Callable[[], None]:
    """Return ``task`` as Hydra's own program over `conf/`, which reads `sys.argv`."""
    options = {"execution_whitelist": TRUSTED} if HAS_WHITELIST else VERSION
    decorate: Any = hydra.main
    decorated: Callable[[], None] = decorate(config_path=config_directory(), config_name="config", **options)(
        task
    )
    return decorated


def find_launcher() -> None:
    """Make Hydra find `hydra/launcher=batched` in a bare checkout, in this process and in those it starts.

    The package's own `hydra_plugins` goes before any other: an editable install has a copy, which may be of
    another day. A wheel has one at the top level, for programs that do not import this module.
    """
    folder = _PACKAGE / "plugins"
    if str(folder) in sys.path or not folder.is_dir():
        return
    try:
        installed = importlib.util.find_spec("hydra_plugins.staf_batched") is not None
    except ModuleNotFoundError:  # no package `hydra_plugins` at all
        installed = False
    sys.path.insert(0, str(folder))
    if not installed:  # workers of other launchers unpickle names of `hydra_plugins` before they import us
        path = [os.environ.get("PYTHONPATH", ""), str(folder), str(_PACKAGE.parent)]
        os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, path))


def overrides_in(argv: Sequence[str]) -> list[str]:
    """Return the overrides among the words of a command line."""
    return list(arguments(argv).overrides)


def named_packages(argv: Sequence[str]) -> list[str]:
    """Return the packages of the objects that a command line names: who types a name trusts what is there.

    Objects are named by keys `_target_` and `path`, in overrides and in the files below `--config-dir`.
    """
    if not HAS_WHITELIST:
        return []
    words: argparse.Namespace = arguments(argv)
    named = re.findall(_NAMES, "\n".join(words.overrides))
    for file in Path(words.config_dir).rglob("*.yaml") if words.config_dir else ():
        named += re.findall(_NAMES, file.read_text(encoding="utf-8", errors="replace"))
    return sorted({name.partition(".")[0] for name in named})


@contextlib.contextmanager
def full_errors() -> Iterator[bool]:
    """Let exceptions leave Hydra as they are; yield whether the user asked for traces (HYDRA_FULL_ERROR)."""
    before = os.environ.get("HYDRA_FULL_ERROR")
    os.environ["HYDRA_FULL_ERROR"] = "1"
    try:
        yield before not in (None, "", "0")
    finally:
        if before is None:
            os.environ.pop("HYDRA_FULL_ERROR", None)
        else:
            os.environ["HYDRA_FULL_ERROR"] = before


def end_sweep(config: DictConfig) -> None:
    """Tell the callbacks that a sweep is over which an exception ended: Hydra 1.3 forgets it."""
    for settings in () if HAS_WHITELIST else reversed(list(config.hydra.callbacks.values())):
        try:
            instantiate(settings).on_multirun_end(config=config, config_name=config.hydra.job.config_name)
        except Exception as error:  # as Hydra does it
            warnings.warn(f"{settings._target_} raised {type(error).__name__}: {error}", stacklevel=2)


@contextlib.contextmanager
def working_directory_imports() -> Iterator[None]:
    """Context: settings may name modules of the working directory."""
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

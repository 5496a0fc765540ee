"""A job of a sweep, as Hydra's launchers run it."""

from __future__ import annotations

import contextlib
import functools
import logging
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import yaml
from hydra.core.config_loader import ConfigLoader
from hydra.core.hydra_config import HydraConfig
from hydra.core.utils import (
    JobReturn,
    JobRuntime,
    JobStatus,
    _flush_loggers,
    configure_log,
    env_override,
    filter_overrides,
    run_job,
    setup_globals,
)
from hydra.types import HydraContext
from omegaconf import DictConfig, OmegaConf, open_dict, read_write
from omegaconf._utils import OmegaConfDumper

from ...settings.plain import ManySettings
from .composing import Composer, as_typed, directory_of, parse_override, take_directory
from .inside import HAS_WHITELIST


class SweepJobs:
    """The jobs of a sweep whose launcher is ours, composed by a `Composer`; for the rest, Hydra's own loader.

    Args:
        context: of the sweep, as Hydra hands it to a launcher; from now on it has this loader.
        master: settings of the sweep.
    """

    def __init__(self, context: HydraContext, master: DictConfig) -> None:
        node = master.hydra
        self.master, self._context, self._loader = master, context, context.config_loader
        self._always = as_typed(node.overrides.hydra)
        self._composer = (
            self._loader
            if isinstance(self._loader, Composer)
            else Composer(self._loader, node.job.config_name, as_typed(node.searchpath))
        )
        context.config_loader = cast(ConfigLoader, self)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._loader, name)

    def load_sweep_config(self, master_config: DictConfig, sweep_overrides: Sequence[str]) -> DictConfig:
        """Return the settings of the sweep: sweepers compose every job as a test, which the launcher does."""
        return master_config

    def settings(self, overrides: Sequence[str]) -> DictConfig:
        """Return the settings of a job as its task sees them; the caller may change them."""
        return self._at_the_same_time(self._composer([*self._always, *overrides]))

    def many(self, jobs: Sequence[Sequence[str]]) -> tuple[ManySettings, list[Mapping[str, Any]]]:
        """Return what `Composer.many` returns for jobs of the sweep."""
        return self._composer.many([[*self._always, *job] for job in jobs], self._at_the_same_time)

    @property
    def base(self) -> DictConfig:
        """The settings of the sweep itself, without what is swept and without Hydra's node."""
        names = [str(name) for name in self.master if name != "hydra"]
        return self._at_the_same_time(OmegaConf.masked_copy(self.master, names))

    @property
    def typed(self) -> list[str]:
        """The overrides that the sweep began with, but Hydra's own."""
        return as_typed(self.master.hydra.overrides.task)

    @property
    def fixed(self) -> set[str]:
        """Keys of those that are the same in all jobs, as the jobs' own overrides have them."""
        parsed = [parse_override(line) for line in self.typed]
        return {str(one.get_key_element()) for one in parsed if not one.is_sweep_override()}

    @property
    def choices(self) -> dict[str, str | None]:
        """The option chosen of each group of settings."""
        return {str(group): choice for group, choice in self.master.hydra.runtime.choices.items()}

    def whole(self, num: int, overrides: Sequence[str]) -> DictConfig:
        """Return the configuration of job ``num`` with Hydra's node; the caller may change it."""
        config = self._at_the_same_time(self._composer.whole([*self._always, *overrides]))
        with read_write(config.hydra), open_dict(config.hydra):
            config.hydra.job.id = str(num)
            config.hydra.job.num = num
        return config

    def _at_the_same_time(self, config: DictConfig) -> DictConfig:
        """Let times and the like be those at which the sweep began."""
        OmegaConf.copy_cache(from_config=self.master, to_config=config)
        return config

    @property
    def at_once(self) -> bool:
        """Return whether the sweeper hands over all jobs at once."""
        sweeper = self.master.hydra.sweeper
        return self.choices.get("hydra/sweeper") == "basic" and sweeper.get("max_batch_size") is None

    def directory(self, num: int, overrides: Sequence[str]) -> Path:
        """Return the run directory of job ``num``: its number, where nobody says otherwise."""
        if self._numbered([overrides]):
            return Path(str(self.master.hydra.sweep.dir), str(num))
        return directory_of(self.whole(num, overrides))

    def refuse_shared(self, numbered: Mapping[int, Sequence[str]]) -> None:
        """Raise ValueError if two jobs have one directory."""
        taken: dict[str, str] = {}
        for num, job in () if self._numbered(numbered.values()) else numbered.items():
            name = " ".join(without_hydra_overrides(job))
            take_directory(taken, self.directory(num, job), f"job {num} ({name})")

    def _numbered(self, jobs: Iterable[Sequence[str]]) -> bool:
        """Return whether the directories of these jobs are their numbers."""
        sweep: Any = OmegaConf.to_container(self.master.hydra.sweep)
        own = any(line.lstrip("+~").startswith("hydra") for job in jobs for line in job)
        return not own and sweep["subdir"] == "${hydra.job.num}"

    def start(self) -> None:
        """Register Hydra's resolvers and send the log to the sweep's own handlers."""
        setup_globals()
        trust: dict[str, Any] = {}
        if HAS_WHITELIST:
            trust = {"execution_whitelist": cast(Any, self._context).execution_whitelist}
        configure_log(self.master.hydra.hydra_logging, self.master.hydra.verbose, **trust)

    def run(self, task: Callable[[DictConfig], Any], config: DictConfig, settings: DictConfig) -> JobReturn:
        """Run one job as every launcher does: directory, `.hydra/`, log, callbacks and status.

        Args:
            task: is called with ``settings``.
            config: of the job, with Hydra's node.
            settings: of the job, without.
        """
        with handlers_aside():  # what comes after belongs to no job's log
            if not HAS_WHITELIST and not config.hydra.job.chdir:
                return _run_job(self._context.callbacks, task, config, settings)
            return run_job(task, config, "hydra.sweep.dir", "hydra.sweep.subdir", self._context)


def _run_job(
    callbacks: Any, task: Callable[[DictConfig], Any], config: DictConfig, settings: DictConfig
) -> JobReturn:
    """Run one job as `run_job` of Hydra 1.3 does, without its five copies of the settings.

    Args:
        callbacks: of the sweep.
        task: is called with ``settings``.
        config: of the job, with Hydra's node.
        settings: of the job, without.
    """
    active, before = HydraConfig.instance(), HydraConfig.instance().cfg
    OmegaConf.set_readonly(config.hydra, True)
    active.cfg = cast(Any, config)
    try:
        directory = directory_of(config).absolute()
        with read_write(config.hydra.runtime), open_dict(config.hydra.runtime):
            config.hydra.runtime.output_dir = os.path.normpath(directory)
        ret = JobReturn(
            overrides=as_typed(config.hydra.overrides.task),
            cfg=settings,
            hydra_cfg=config,
            working_dir=os.getcwd(),
            task_name=JobRuntime.instance().get("name"),
        )
        directory.mkdir(parents=True, exist_ok=True)
        configure_log(config.hydra.job_logging, config.hydra.verbose)
        if config.hydra.output_subdir is not None:
            folder = directory / config.hydra.output_subdir
            folder.mkdir(exist_ok=True)
            node = OmegaConf.to_container(config.hydra, enum_to_str=True)
            files = {"config": OmegaConf.to_container(settings, enum_to_str=True), "hydra": {"hydra": node}}
            for name, content in (files | {"overrides": ret.overrides}).items():
                (folder / f"{name}.yaml").write_text(_yaml(content), encoding="utf-8")
        with env_override(config.hydra.job.env_set):
            callbacks.on_job_start(config=config, task_function=task)
            try:
                ret.return_value = task(settings)
                ret.status = JobStatus.COMPLETED
            except Exception as error:
                ret.return_value, ret.status = error, JobStatus.FAILED
        _flush_loggers()
        callbacks.on_job_end(config=config, job_return=ret)
        return ret
    finally:
        active.cfg = before


def _yaml(content: Any) -> str:
    """Return plain values as OmegaConf writes them, emitted in C where that is built: a tenth of the time."""
    base: Any = getattr(yaml, "CDumper", yaml.Dumper)
    return cast(str, yaml.dump(content, Dumper=_dumper(base), allow_unicode=True, sort_keys=False))


@functools.cache
def _dumper(base: Any) -> Any:
    kind: Any = type("_Dumper", (base,), {})
    kind.add_representer(str, OmegaConfDumper.str_representer)
    return kind


def without_hydra_overrides(overrides: Sequence[str]) -> list[str]:
    """Return the overrides that are not about Hydra's own node."""
    return list(filter_overrides(overrides))


@contextlib.contextmanager
def handlers_aside() -> Iterator[None]:
    """Hide the handlers of the process from `logging.config`, which closes all that it knows of.

    In the end they come back, the level with them, and those made meanwhile are closed.
    """
    root = logging.getLogger()
    handlers, level, known = root.handlers[:], root.level, logging._handlerList[:]  # type: ignore[attr-defined]
    named = dict(logging._handlers)  # type: ignore[attr-defined]
    disabled = {name for name, each in _loggers() if each.disabled}
    logging._handlerList.clear()  # type: ignore[attr-defined]
    logging._handlers.clear()  # type: ignore[attr-defined]
    root.handlers[:] = []
    try:
        yield
    finally:
        for handler in root.handlers:
            handler.close()
        root.handlers[:] = handlers
        if root.level != level:
            root.setLevel(level)
        for name, each in _loggers():
            each.disabled = name in disabled
        logging._handlerList[:0] = known  # type: ignore[attr-defined]
        logging._handlers.update(named)  # type: ignore[attr-defined]


def _loggers() -> list[tuple[str, logging.Logger]]:
    """The loggers of the process but the root, by their names."""
    known = logging.Logger.manager.loggerDict
    return [(name, each) for name, each in known.items() if isinstance(each, logging.Logger)]

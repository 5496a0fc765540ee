"""One job of a sweep, as Hydra's launchers run it."""

from __future__ import annotations

import functools
import json
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, cast

import yaml
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
from omegaconf._utils import OmegaConfDumper, get_omega_conf_dumper

from .composing import JobLoader, as_typed
from .log_handlers import handlers_aside
from .program import HAS_WHITELIST


class SweepContext(NamedTuple):
    """What Hydra hands to a launcher."""

    hydra: HydraContext
    master: DictConfig  # settings of the sweep

    def start(self) -> None:
        """Register Hydra's resolvers and send the log to the sweep's own handlers."""
        setup_globals()
        trust: dict[str, Any] = {}
        if HAS_WHITELIST:
            trust = {"execution_whitelist": cast(Any, self.hydra).execution_whitelist}
        configure_log(self.master.hydra.hydra_logging, self.master.hydra.verbose, **trust)

    def settings(self, overrides: Sequence[str], *, reuse: bool = False) -> DictConfig:
        """Return the settings of a job as its task sees them.

        Args:
            overrides: of the job.
            reuse: whether the next call may change the object, which is faster; else it is the caller's own.
        """
        if reuse:
            return self._loader.load_sweep_config(self.master, overrides)
        return self._loader.settings(self.master, overrides)

    def job_config(self, num: int, overrides: Sequence[str], *, reuse: bool = False) -> DictConfig:
        """Return the configuration of job ``num`` with Hydra's node; ``reuse`` as of `settings`."""
        config = self._loader.whole(self.master, overrides, reuse=reuse)
        with read_write(config.hydra), open_dict(config.hydra):
            config.hydra.job.id = str(num)
            config.hydra.job.num = num
        return config

    @property
    def own_callbacks(self) -> bool:
        """Whether all callbacks of the sweep are this package's, which keep no configuration."""
        listed = getattr(self.hydra.callbacks, "callbacks", None)
        package = f"{__name__.partition('.')[0]}."
        return listed is not None and all(type(each).__module__.startswith(package) for each in listed)

    @property
    def numbered(self) -> bool:
        """Whether the directories of jobs are their numbers, as they are where nobody says otherwise."""
        node: Any = OmegaConf.to_container(self.master.hydra.sweep)
        return bool(node["subdir"] == "${hydra.job.num}")

    @property
    def _loader(self) -> JobLoader:
        loader = self.hydra.config_loader
        assert isinstance(loader, JobLoader)
        return loader

    def run_job(
        self,
        task: Callable[[DictConfig], Any],
        config: DictConfig,
        settings: DictConfig,
        overrides: Sequence[str],
    ) -> JobReturn:
        """Run one job as every launcher does: directory, `.hydra/`, log, callbacks and status.

        Args:
            task: is called with ``settings``.
            config: of the job, with Hydra's node.
            settings: of the job, without.
            overrides: of the job.
        """
        with handlers_aside():  # what comes after belongs to no job's log
            if not HAS_WHITELIST and not config.hydra.job.chdir:
                chosen = self._loader.choices(self.master, overrides)
                kept = {} if chosen is None else self._loader.hydra_yaml.setdefault(chosen, {})
                return _run_job(self.hydra.callbacks, task, config, settings, kept)
            return run_job(
                hydra_context=self.hydra,
                task_function=task,
                config=config,
                job_dir_key="hydra.sweep.dir",
                job_subdir_key="hydra.sweep.subdir",
            )


def directory_of(config: DictConfig) -> Path:
    """Return the run directory of a job whose configuration has Hydra's node."""
    return Path(str(config.hydra.sweep.dir), str(config.hydra.sweep.subdir))


def _run_job(
    callbacks: Any,
    task: Callable[[DictConfig], Any],
    config: DictConfig,
    settings: DictConfig,
    kept: dict[str, str],
) -> JobReturn:
    """Run one job as `run_job` of Hydra 1.3 does, without its five copies of the settings.

    Args:
        callbacks: of the sweep.
        task: is called with ``settings``.
        config: of the job, with Hydra's node.
        settings: of the job, without.
        kept: parts of `hydra.yaml` that all jobs of the same choices share; filled where it is empty.
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
            as_written: Any = OmegaConf.to_container(settings, enum_to_str=True)
            (folder / "config.yaml").write_text(_yaml(as_written), encoding="utf-8")
            (folder / "hydra.yaml").write_text(_hydra_yaml(config.hydra, kept), encoding="utf-8")
            (folder / "overrides.yaml").write_text(_dumped(ret.overrides), encoding="utf-8")
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


_OF_THE_JOB = ("job", "overrides", "runtime")
"""The parts of Hydra's node that are not the same for all jobs of the same choices."""


def _hydra_yaml(node: DictConfig, kept: dict[str, str]) -> str:
    """Return `hydra.yaml` of a job; the parts in ``kept`` are taken from there, and it gets them all."""
    if kept:
        parts: Any = {key: OmegaConf.to_container(node[key]) for key in _OF_THE_JOB}
    else:
        parts = OmegaConf.to_container(node, enum_to_str=True)
    for key, part in parts.items():
        if key in _OF_THE_JOB:
            kept[key] = f"  {key}:\n" + _yaml(part, ("hydra", key))
        else:
            kept[key] = _yaml({key: part}, ("hydra",))
    return "".join(["hydra:\n", *kept.values()])


def _yaml(parts: Mapping[str, Any], above: tuple[str, ...] = ()) -> str:
    """Return the entries of a mapping as OmegaConf writes them; equal entries of many are made once.

    Args:
        parts: plain values.
        above: keys that lead to the mapping; their own lines are left out.
    """
    return "".join(_yaml_entry(key, json.dumps(part), above) for key, part in parts.items())


@functools.lru_cache(1000)
def _yaml_entry(key: str, part: str, above: tuple[str, ...]) -> str:
    node = {key: json.loads(part)}
    for name in reversed(above):
        node = {name: node}
    lines = _dumped(node).splitlines(keepends=True)
    return "".join(lines[len(above) :])


def _dumped(value: Any) -> str:
    text: str = yaml.dump(
        value, Dumper=_dumper(), default_flow_style=False, allow_unicode=True, sort_keys=False
    )
    return text


@functools.cache
def _dumper() -> Any:
    """Return OmegaConf's dumper of texts, over the emitter in C where there is one: a tenth of the time."""
    base = getattr(yaml, "CDumper", None)
    if base is None:
        return get_omega_conf_dumper()
    kind = type("_Dumper", (base,), {})
    kind.add_representer(str, OmegaConfDumper.str_representer)  # type: ignore[attr-defined]
    return kind


def without_hydra_overrides(overrides: Sequence[str]) -> list[str]:
    """Return the overrides that are not about Hydra's own node."""
    return list(filter_overrides(overrides))

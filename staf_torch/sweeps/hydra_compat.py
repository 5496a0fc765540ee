"""What depends on the inside of Hydra 1.3 and 1.4; beside `hydra_in_process` no module does."""

from __future__ import annotations

import contextlib
import functools
import importlib.util
import inspect
import json
import os
import pickle
import re
import sys
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, cast

import hydra
import yaml
from hydra._internal import config_loader_impl
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra._internal.utils import create_config_search_path, get_args_parser
from hydra.core.config_loader import ConfigLoader as ConfigLoader
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn as JobReturn
from hydra.core.utils import (
    JobRuntime,
    _flush_loggers,
    configure_log,
    filter_overrides,
    run_job,
    setup_globals,
)
from hydra.core.utils import JobStatus as JobStatus
from hydra.core.utils import env_override as env_override
from hydra.errors import ConfigCompositionException
from hydra.types import HydraContext, RunMode
from omegaconf import DictConfig, OmegaConf, open_dict, read_write
from omegaconf._utils import get_omega_conf_dumper
from omegaconf.errors import OmegaConfBaseException

from ..settings import config_directory as config_directory

_PACKAGE = Path(__file__).resolve().parent.parent
_KEPT_JOBS = 64
_TRUSTED = ("staf_torch.*",)
_NAMES = re.compile(r"(?:_target_|\bpath)['\"]?\s*[=:]\s*['\"]?([A-Za-z_]\w*\.[\w.]*\w)")
_HAS_WHITELIST = "execution_whitelist" in inspect.signature(hydra.main).parameters
"""Hydra 1.4: only trusted targets are instantiated. That version also ends sweeps that failed by itself."""


# The program


def program(task: Callable[[DictConfig], Any]) -> Callable[[], None]:
    """Return ``task`` as a Hydra application over `conf/`, which reads `sys.argv`."""
    options = {"execution_whitelist": _TRUSTED} if _HAS_WHITELIST else {"version_base": "1.3"}
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
    return list(get_args_parser().parse_known_args(list(argv))[0].overrides)


@contextlib.contextmanager
def trusted(packages: Iterable[str] = ()) -> Iterator[None]:
    """Let settings name objects of this package and of ``packages``: Hydra 1.4 trusts nothing by itself."""
    with contextlib.ExitStack() as stack:
        if _HAS_WHITELIST:
            from hydra._internal.execution_policy import execution_whitelist

            stack.enter_context(execution_whitelist((*_TRUSTED, *(f"{name}.*" for name in packages))))
        yield


def trusted_packages() -> list[str]:
    """Return the packages that settings may name at present, beside this one; workers get them."""
    if not _HAS_WHITELIST:
        return []
    from hydra._internal.execution_policy import _get_active_execution_whitelist as active

    return [pattern.removesuffix(".*") for pattern in active() or () if pattern not in _TRUSTED]


def named_packages(argv: Sequence[str]) -> list[str]:
    """Return the packages of the objects that a command line names: who types a name trusts what is there.

    Objects are named by keys `_target_` and `path`, in overrides and in the files below `--config-dir`.
    """
    if not _HAS_WHITELIST:
        return []
    named = re.findall(_NAMES, "\n".join(overrides_in(argv)))
    for folder in _config_folders(argv):
        for file in Path(folder).rglob("*.yaml"):
            named += re.findall(_NAMES, file.read_text(encoding="utf-8", errors="replace"))
    return sorted({name.partition(".")[0] for name in named})


def with_mode(argv: Sequence[str]) -> list[str]:
    """Return the arguments, and the `hydra.mode` that the file of `experiment=...` sets, for Hydra 1.4.

    That version takes the mode from the command line or from the primary file alone.
    """
    given = overrides_in(argv)
    chosen = [line.partition("=")[2] for line in given if line.startswith("experiment=")]
    stated = any(line.startswith("hydra.mode=") for line in given) or {"-m", "--multirun"} & set(argv)
    if not _HAS_WHITELIST or stated or not chosen:
        return list(argv)
    for folder in (*_config_folders(argv), config_directory()):
        file = Path(folder, "experiment", f"{chosen[-1]}.yaml")
        if file.is_file():
            mode = OmegaConf.select(OmegaConf.load(file), "hydra.mode")
            return [*argv, f"hydra.mode={mode}"] if mode is not None else list(argv)
    return list(argv)


def _config_folders(argv: Sequence[str]) -> list[str]:
    """Return the directory of `--config-dir`, as a list of one or none."""
    return list(filter(None, [get_args_parser().parse_known_args(list(argv))[0].config_dir]))


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


class BrokenSweep(NamedTuple):
    """A sweep that an exception ended."""

    config: DictConfig
    callbacks: Any

    def end(self) -> None:
        """Tell the callbacks that the sweep is over, where Hydra does not: version 1.3 forgets it."""
        if not _HAS_WHITELIST:
            self.callbacks.on_multirun_end(config=self.config, config_name=self.config.hydra.job.config_name)


def broken_sweep(error: BaseException) -> BrokenSweep | None:
    """Return the sweep that ``error`` ended, None where no sweep had begun.

    Hydra keeps both in local variables of `Hydra.multirun`, which the traceback leads to.
    """
    for frame, _ in traceback.walk_tb(error.__traceback__):
        if frame.f_code.co_name == "multirun" and "callbacks" in frame.f_locals:
            return BrokenSweep(frame.f_locals["cfg"], frame.f_locals["callbacks"])
    return None


# One job of a sweep


class SweepContext(NamedTuple):
    """What Hydra hands to a launcher."""

    hydra: HydraContext
    master: DictConfig  # settings of the sweep

    def start(self) -> None:
        """Register Hydra's resolvers and send the log to the sweep's own handlers."""
        setup_globals()
        self.sweep_logging()

    def sweep_logging(self) -> None:
        """Send the log to the sweep's own handlers: what follows belongs to no job's log."""
        trust: dict[str, Any] = {}
        if _HAS_WHITELIST:
            trust = {"execution_whitelist": cast(Any, self.hydra).execution_whitelist}
        configure_log(self.master.hydra.hydra_logging, self.master.hydra.verbose, **trust)

    def job_config(self, num: int, overrides: Sequence[str]) -> DictConfig:
        """Return the settings of job ``num``; they are the caller's own."""
        loader = self.hydra.config_loader
        assert isinstance(loader, ComposeOnce)
        config = loader.take(self.master, overrides)
        with open_dict(config):
            config.hydra.job.id = str(num)
            config.hydra.job.num = num
        return config

    def run_job(
        self, task: Callable[[DictConfig], Any], config: DictConfig, settings: DictConfig
    ) -> JobReturn:
        """Run one job as every launcher does: directory, `.hydra/`, log, callbacks and status.

        Args:
            task: is called with ``settings``.
            config: of the job, with Hydra's node.
            settings: of the job, without.
        """
        if not _HAS_WHITELIST and not config.hydra.job.chdir:
            return _run_job(self.hydra.callbacks, task, config, settings)
        return run_job(
            hydra_context=self.hydra,
            task_function=task,
            config=config,
            job_dir_key="hydra.sweep.dir",
            job_subdir_key="hydra.sweep.subdir",
        )


def _run_job(
    callbacks: Any, task: Callable[[DictConfig], Any], config: DictConfig, settings: DictConfig
) -> JobReturn:
    """Run one job as `run_job` of Hydra 1.3 does, without its five copies of the settings."""
    active, before = HydraConfig.instance(), HydraConfig.instance().cfg
    OmegaConf.set_readonly(config.hydra, True)
    active.cfg = cast(Any, config)
    try:
        directory = Path(str(config.hydra.sweep.dir), str(config.hydra.sweep.subdir)).absolute()
        with read_write(config.hydra.runtime), open_dict(config.hydra.runtime):
            config.hydra.runtime.output_dir = os.path.normpath(directory)
        ret = JobReturn(
            overrides=[str(line) for line in config.hydra.overrides.task],
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
            (folder / "config.yaml").write_text(_yaml(settings), encoding="utf-8")
            (folder / "hydra.yaml").write_text(_yaml(config.hydra, "hydra"), encoding="utf-8")
            overrides = OmegaConf.to_yaml(config.hydra.overrides.task)
            (folder / "overrides.yaml").write_text(overrides, encoding="utf-8")
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


def _yaml(node: DictConfig, parent: str | None = None) -> str:
    """Return `OmegaConf.to_yaml(node)`, or of ``{parent: node}``; equal parts of many nodes are made once."""
    parts: Any = OmegaConf.to_container(node, enum_to_str=True)
    text = [] if parent is None else [f"{parent}:\n"]
    return "".join(text + [_yaml_part(key, json.dumps(part), parent) for key, part in parts.items()])


@functools.lru_cache(1000)
def _yaml_part(key: str, part: str, parent: str | None) -> str:
    node = {key: json.loads(part)} if parent is None else {parent: {key: json.loads(part)}}
    dumper, as_hydra = get_omega_conf_dumper(), {"allow_unicode": True, "sort_keys": False}
    text: str = yaml.dump(node, Dumper=dumper, default_flow_style=False, **as_hydra)
    return text if parent is None else text.partition("\n")[2]


def without_hydra_overrides(overrides: Sequence[str]) -> list[str]:
    """Return the overrides that are not about Hydra's own node."""
    return list(filter_overrides(overrides))


# Composing settings


def config_loader() -> ConfigLoader:
    """Return Hydra's loader: of the running program, else one of `conf/`."""
    if GlobalHydra.instance().is_initialized():
        return GlobalHydra.instance().config_loader()
    Plugins.instance()  # the sources of configurations are plugins
    return ConfigLoaderImpl(create_config_search_path(config_directory()))


def parse_override(line: str, loader: ConfigLoader | None = None) -> Override:
    """Return one override, parsed by Hydra's grammar.

    Raises:
        hydra.errors.HydraException: if the grammar has no such line.
    """
    (parsed,) = OverridesParser.create(config_loader=loader).parse_overrides([line])
    return parsed


def product(overrides: Sequence[Override]) -> list[list[str]]:
    """Return the overrides of every job of a sweep, in the order of Hydra's own sweeper."""
    (jobs,) = BasicSweeper.split_arguments(list(overrides), None)
    return [list(job) for job in jobs]


class Composer:
    """``loader.load_configuration(config_name, overrides, RunMode.RUN)``, fast where it is called often.

    Hydra takes some 40 ms a configuration, nearly all of it for the defaults list and for merging files. Here
    each choice of config groups is composed once, and the values are then applied. A test holds the result to
    Hydra's own, to the last flag.

    Args:
        loader: Hydra's, of the program.
        config_name: of the primary configuration.
        hydra_node: False for the configuration as a task sees it, which is the larger part of the time.
    """

    def __init__(
        self, loader: ConfigLoader, config_name: str | None = "config", *, hydra_node: bool = True
    ) -> None:
        self._loader, self._name, self._hydra_node = loader, config_name, hydra_node
        self._parser = OverridesParser.create()
        self._parsed: dict[str, Override] = {}
        self._chosen: dict[tuple[str, ...], bytes] = {}  # pickled: copied a fifth as fast otherwise
        self._groups: dict[str, bool] = {}
        self._apply = getattr(ConfigLoaderImpl, "_apply_overrides_to_config", None)
        self._repository = getattr(loader, "repository", None)

    def __call__(self, overrides: Sequence[str]) -> DictConfig:
        """Return the configuration of these overrides; the caller may change it.

        Raises:
            hydra.errors.HydraException, ValueError: what Hydra itself raises.
        """
        parsed = [self._parse(line) for line in overrides]
        chosen = tuple(line for line, one in zip(overrides, parsed, strict=True) if self._chooses(one))
        if self._apply is None or any("searchpath" in line for line in chosen):
            return self._load(overrides)
        if chosen not in self._chosen:
            self._chosen[chosen] = pickle.dumps(self._load(chosen))
        composed: DictConfig = pickle.loads(self._chosen[chosen])
        try:
            self._apply([one for one in parsed if not self._chooses(one)], composed)
        except OmegaConfBaseException as error:
            raise ConfigCompositionException() from error
        if self._hydra_node:
            _note_overrides(composed, parsed)
        return composed

    def _load(self, overrides: Sequence[str]) -> DictConfig:
        composed = self._loader.load_configuration(self._name, list(overrides), RunMode.RUN)
        if not self._hydra_node:
            with read_write(composed), open_dict(composed):
                del composed["hydra"]
        return composed

    def _parse(self, line: str) -> Override:
        if line not in self._parsed:
            (parsed,) = self._parser.parse_overrides([line])
            if parsed.is_sweep_override():
                self._load([line])  # refused there, in Hydra's words
            self._parsed[line] = parsed
        return self._parsed[line]

    def _chooses(self, override: Override) -> bool:
        """Return whether the override decides what is composed, beyond the value of one key."""
        key = override.key_or_group
        if override.is_hydra_override() or self._repository is None:
            return True
        if key not in self._groups:
            self._groups[key] = bool(self._repository.group_exists(key))
        return self._groups[key] and not isinstance(override.value(), dict)


def _note_overrides(composed: DictConfig, parsed: Sequence[Override]) -> None:
    """Write into Hydra's node what Hydra notes there of the overrides."""
    app = [one for one in parsed if not one.is_hydra_override()]
    node: Any = composed.hydra
    node.overrides.task = [one.input_line for one in app]
    directory_name = getattr(config_loader_impl, "get_overrides_dirname", None)  # Hydra 1.3; then a resolver
    if directory_name is not None:
        style = node.job.config.override_dirname
        node.job.override_dirname = directory_name(
            overrides=app, kv_sep=style.kv_sep, item_sep=style.item_sep, exclude_keys=style.exclude_keys
        )


class ComposeOnce:
    """Hydra's loader, with `load_sweep_config` cached: sweepers compose each job as a test, launchers again.

    Args:
        loader: Hydra's own, asked for all else.
        master: the settings of the sweep.
    """

    def __init__(self, loader: ConfigLoader, master: DictConfig) -> None:
        self._loader = loader
        composer = Composer(loader, master.hydra.job.config_name)
        self._compose = composer._load if master.hydra.searchpath else composer  # whose groups it cannot see
        self._kept: dict[tuple[str, ...], DictConfig] = {}

    @classmethod
    def install(cls, context: HydraContext, master: DictConfig) -> None:
        """Replace the loader in the context that the sweeper and its launcher share."""
        if not isinstance(context.config_loader, cls):
            context.config_loader = cast(ConfigLoader, cls(context.config_loader, master))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._loader, name)

    def load_sweep_config(self, master_config: DictConfig, sweep_overrides: Sequence[str]) -> DictConfig:
        """Return the configuration of a job; it is shared, so nobody may change it."""
        key = tuple(sweep_overrides)
        if key not in self._kept:
            composed = self._compose([*master_config.hydra.overrides.hydra, *key])
            # Times and the like are those at which the sweep began.
            OmegaConf.copy_cache(from_config=master_config, to_config=composed)
            if len(self._kept) >= _KEPT_JOBS:  # half a megabyte each
                self._kept.clear()
            self._kept[key] = composed
        return self._kept[key]

    def take(self, master_config: DictConfig, sweep_overrides: Sequence[str]) -> DictConfig:
        """Return the configuration of a job and forget it: the caller may change it."""
        self.load_sweep_config(master_config, sweep_overrides)
        return self._kept.pop(tuple(sweep_overrides))

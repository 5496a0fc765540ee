"""A job of a sweep, as Hydra's launchers run it.

OmegaConf takes ten milliseconds a job for Hydra's node, its log and the texts of `.hydra/`. Jobs of a sweep
differ in a few lines there, so that the first job of a kind is asked, and the others are changed copies.
"""

from __future__ import annotations

import contextlib
import copy
import functools
import logging
import os
import re
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, cast

import yaml
from hydra.core.config_loader import ConfigLoader
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.types import Override
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
from hydra.experimental.callback import Callback
from hydra.types import HydraContext, RunMode
from omegaconf import DictConfig, OmegaConf, open_dict, read_write
from omegaconf._utils import OmegaConfDumper

from ...settings.plain import ManySettings
from .composing import Composer, as_typed, directory_name, directory_of, parse_override, take_directory
from .inside import HAS_WHITELIST, configure_logging

Plan = tuple[ManySettings, Sequence[Mapping[str, Any]]]
"""The settings of many jobs, and the same by dotted keys."""


class SweepJobs:
    """The jobs of a sweep whose launcher is ours, composed by a `Composer`; for the rest, Hydra's own loader.

    The context of the sweep, as Hydra hands it to a launcher, has this loader from now on.
    """

    def __init__(self, context: HydraContext, master: DictConfig) -> None:
        node = master.hydra
        self.master, self._context, self._loader = master, context, context.config_loader
        self._always = as_typed(node.overrides.hydra)
        self._leaders: dict[Hashable, NodeOfJob] = {}  # of each kind of job
        self._texts = Texts()
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
            config.hydra.runtime.output_dir = os.path.abspath(directory_of(config))
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
            return self._folder / str(num)
        return directory_of(self.whole(num, overrides))

    def prepared(self, num: int, overrides: Sequence[str]) -> NodeOfJob:
        """Return what Hydra's node of job ``num`` says, from another job of its kind where there is one."""
        kind, parsed = self._composer.kind([*self._always, *overrides])
        leader = self._leaders.get(kind) if self._numbered([overrides]) else None
        if leader is None:
            leader = NodeOfJob.of(self.whole(num, overrides))
            if leader.leads:
                self._leaders[kind] = leader
            return leader
        return leader.followed(num, parsed, os.path.abspath(self._folder / str(num)))

    def refuse_shared(self, numbered: Mapping[int, Sequence[str]]) -> None:
        """Raise ValueError if two jobs have one directory."""
        taken: dict[str, str] = {}
        for num, job in () if self._numbered(numbered.values()) else numbered.items():
            name = " ".join(filter_overrides(job))
            take_directory(taken, self.directory(num, job), f"job {num} ({name})")

    def _numbered(self, jobs: Iterable[Sequence[str]]) -> bool:
        """Return whether the directories of these jobs are their numbers."""
        own = any(line.lstrip("+~").startswith("hydra") for job in jobs for line in job)
        return not own and self._by_number

    @functools.cached_property
    def _by_number(self) -> bool:
        sweep: Any = OmegaConf.to_container(self.master.hydra.sweep)
        return bool(sweep["subdir"] == "${hydra.job.num}")

    @functools.cached_property
    def _folder(self) -> Path:
        """The directory of the sweep."""
        return Path(str(self.master.hydra.sweep.dir))

    def start(self) -> None:
        """Register Hydra's resolvers and send the log to the sweep's own handlers."""
        setup_globals()
        trust: dict[str, Any] = {}
        if HAS_WHITELIST:
            trust = {"execution_whitelist": cast(Any, self._context).execution_whitelist}
        configure_log(self.master.hydra.hydra_logging, self.master.hydra.verbose, **trust)

    def run(self, task: Callable[[DictConfig], Any], job: Job) -> JobReturn:
        """Run one job as every launcher does: directory, `.hydra/`, log, callbacks and status."""
        with handlers_aside():  # what comes after belongs to no job's log
            if HAS_WHITELIST or job.prepared.node["job"]["chdir"]:
                return run_job(task, job.config, "hydra.sweep.dir", "hydra.sweep.subdir", self._context)
            active, before = HydraConfig.instance(), HydraConfig.instance().cfg
            active.cfg = cast(Any, job)
            try:
                return self._run(task, job)
            finally:
                active.cfg = before

    def _run(self, task: Callable[[DictConfig], Any], job: Job) -> JobReturn:
        """Run one job as `run_job` of Hydra 1.3 does, without its five copies of the settings."""
        about, callbacks = job.prepared, self._context.callbacks
        heard = _listen(callbacks, job.settings)
        ret = JobReturn(
            overrides=about.overrides,
            cfg=job.settings,
            hydra_cfg=job.config if heard else None,
            working_dir=os.getcwd(),
            task_name=JobRuntime.instance().get("name"),
        )
        os.makedirs(about.directory, exist_ok=True)
        configure_logging(copy.deepcopy(about.log), about.verbose)
        if about.folder is not None:
            folder = Path(about.directory, about.folder)
            folder.mkdir(exist_ok=True)
            for name, text in job.texts(self._texts).items():
                (folder / f"{name}.yaml").write_text(text, encoding="utf-8")
        with env_override(dict(about.env)):
            if heard:
                callbacks.on_job_start(config=job.config, task_function=task)
            try:
                ret.return_value = task(job.settings)
                ret.status = JobStatus.COMPLETED
            except Exception as error:
                ret.return_value, ret.status = error, JobStatus.FAILED
        _flush_loggers()
        if heard:
            callbacks.on_job_end(config=job.config, job_return=ret)
        return ret


class Job:
    """A job of a sweep, of that index in a plan; its configuration with Hydra's node is composed where
    somebody asks for it. While it runs `HydraConfig.get()` returns its node."""

    def __init__(self, jobs: SweepJobs, num: int, overrides: Sequence[str], plan: Plan, index: int) -> None:
        self._jobs, self.num, self.overrides = jobs, num, overrides
        self._planned, self._index, self.flat = plan[0], index, plan[1][index]

    @functools.cached_property
    def prepared(self) -> NodeOfJob:
        """Facts that Hydra's node of a job says."""
        return self._jobs.prepared(self.num, self.overrides)

    @functools.cached_property
    def directory(self) -> Path:
        """The run directory."""
        return self._jobs.directory(self.num, self.overrides)

    @functools.cached_property
    def settings(self) -> DictConfig:
        """The settings as the task sees them, its own to change."""
        if self._planned.plain(self._index) is None:
            return self._jobs.settings(self.overrides)
        return self._planned.made(self._index)

    @functools.cached_property
    def config(self) -> DictConfig:
        """The configuration with Hydra's node, which is read alone."""
        config = self._jobs.whole(self.num, self.overrides)
        OmegaConf.set_readonly(config.hydra, True)
        return config

    @property
    def hydra(self) -> Any:
        """Hydra's node."""
        return self.config.hydra

    def texts(self, texts: Texts) -> dict[str, str]:
        """Return the files of `.hydra/`, by name, as Hydra writes them."""
        written: Mapping[Any, Any] | None = self._planned.plain(self._index)
        if written is None:
            written = cast(dict[str, Any], OmegaConf.to_container(self.settings, enum_to_str=True))
        return {
            "config": texts.mapping(written),
            "hydra": texts.mapping({"hydra": self.prepared.node}),
            "overrides": texts.lines(self.prepared.overrides),
        }


class About(NamedTuple):
    """The job that runs, in the words of Hydra."""

    directory: Path
    choices: Mapping[str, str | None]  # the option of each group
    overrides: list[str]  # as typed
    alone: bool  # whether it is no job of a sweep
    flat: Mapping[str, Any] | None = None  # its settings by dotted keys, where they are known

    @classmethod
    def now(cls) -> About:
        """Return the job that Hydra runs now."""
        active: Any = HydraConfig.instance().cfg
        if isinstance(active, Job):
            known = active.prepared
            return cls(Path(known.directory), known.choices, known.overrides, False, active.flat)
        node: Any = HydraConfig.get()
        choices = {str(group): choice for group, choice in node.runtime.choices.items()}
        overrides = as_typed(node.overrides.task)
        return cls(Path(node.runtime.output_dir), choices, overrides, node.mode == RunMode.RUN)


def _listen(callbacks: Any, settings: DictConfig) -> bool:
    """Return whether a callback wants to know of a job: those of Hydra's base class do nothing."""
    for each in callbacks.callbacks:
        kind, idle = type(each), getattr(each, "idle", None)
        if idle is not None and idle(settings):
            continue
        if (kind.on_job_start, kind.on_job_end) != (Callback.on_job_start, Callback.on_job_end):
            return True
    return False


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


_KNOWN = ("hydra.runtime.output_dir", "hydra.job.name")  # what a log may refer to in a job that follows
_MOST = 1000  # entries of YAML that are kept


class NodeOfJob(NamedTuple):
    """Facts that Hydra's node of a job says."""

    directory: str  # absolute
    node: Mapping[str, Any]  # as it is written: interpolations are not looked up
    log: Any  # `hydra.job_logging`, resolved; None: Hydra's own
    verbose: Any
    env: Mapping[str, str]  # variables of the job's own
    folder: str | None  # for the settings
    choices: Mapping[str, str | None]  # of each group
    overrides: list[str]

    @classmethod
    def of(cls, config: DictConfig) -> NodeOfJob:
        """Read it in a configuration with Hydra's node."""
        node: Any = config.hydra
        log = node.job_logging
        return cls(
            str(node.runtime.output_dir),
            cast(dict[str, Any], OmegaConf.to_container(node, enum_to_str=True)),
            None if log is None else OmegaConf.to_container(log, resolve=True),
            node.verbose,
            {str(name): str(value) for name, value in node.job.env_set.items()},
            node.output_subdir,
            {str(group): choice for group, choice in node.runtime.choices.items()},
            as_typed(node.overrides.task),
        )

    @property
    def leads(self) -> bool:
        """Return whether that of other jobs follows from this one."""
        refers = re.findall(r"\$\{([^}]*)\}", str(self.node["job_logging"]))
        own = str((self.node["job"]["name"], self.node["job"]["env_set"], self.node["output_subdir"]))
        return set(refers) <= set(_KNOWN) and "${" not in own

    def followed(self, num: int, parsed: Sequence[Override], directory: str) -> NodeOfJob:
        """Return that of job ``num``, which differs in these overrides and in its directory alone."""
        node, job = dict(self.node), dict(self.node["job"])
        lines = [str(one.input_line) for one in parsed]
        job |= {"id": str(num), "num": num}
        if "${" not in str(job["override_dirname"]):  # it is one in Hydra 1.4
            job["override_dirname"] = directory_name(job["config"]["override_dirname"], parsed)
        node["overrides"] = {**node["overrides"], "task": lines}
        node["runtime"] = {**node["runtime"], "output_dir": directory}
        node["job"] = job
        log = _moved(self.log, self.node["job_logging"], self.directory, directory)
        return self._replace(directory=directory, node=node, log=log, overrides=lines)


def _moved(value: Any, written: Any, before: str, now: str) -> Any:
    """Return resolved settings with another directory, where ``written`` names it."""
    if isinstance(value, dict):
        return {key: _moved(inner, written[key], before, now) for key, inner in value.items()}
    if isinstance(value, list):
        return [_moved(inner, own, before, now) for inner, own in zip(value, written, strict=True)]
    return value.replace(before, now) if isinstance(value, str) and _KNOWN[0] in str(written) else value


class Texts:
    """YAML as OmegaConf writes it; an entry is emitted once, however many files have it."""

    def __init__(self) -> None:
        self._known: dict[tuple[str, str, int], str] = {}

    def mapping(self, content: Mapping[Any, Any], depth: int = 0) -> str:
        """Return the lines of a mapping that is in so many others."""
        return "".join(self._entry(key, value, depth) for key, value in content.items()) or "{}\n"

    def lines(self, content: Sequence[str]) -> str:
        """Return a list of texts."""
        return "".join(self._kept("", one, 0, functools.partial(_yaml, [one])) for one in content) or "[]\n"

    def _entry(self, key: Any, value: Any, depth: int) -> str:
        nested = isinstance(value, Mapping) and bool(value)

        def emitted() -> str:
            if nested:
                return _line(key, 0, depth).removesuffix(" 0\n") + "\n" + self.mapping(value, depth + 1)
            return _line(key, dict(value) if isinstance(value, Mapping) else value, depth)

        # The whole node of Hydra is another one in every job.
        return emitted() if nested and not depth else self._kept(repr(key), value, depth, emitted)

    def _kept(self, key: str, value: Any, depth: int, emitted: Callable[[], str]) -> str:
        known = key, repr(value), depth
        if known not in self._known:
            if len(self._known) >= _MOST:
                self._known.clear()
            self._known[known] = emitted()
        return self._known[known]


def _line(key: Any, value: Any, depth: int) -> str:
    """Return the lines of a key whose value is no mapping."""
    nested = {key: value}
    for _ in range(depth):
        nested = {"x": nested}
    return _yaml(nested).split("\n", depth)[-1]


def _yaml(content: Any) -> str:
    text: str = yaml.dump(content, Dumper=_DUMPER, allow_unicode=True, sort_keys=False)
    return text


_BASE: Any = getattr(yaml, "CDumper", yaml.Dumper)  # emitted in C where that is built: a tenth of the time
_DUMPER: Any = type("_Dumper", (_BASE,), {})
_DUMPER.add_representer(str, OmegaConfDumper.str_representer)

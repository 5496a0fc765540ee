"""A job from its settings to the end of its run directory: alone, or solved beside others in a tensor batch.

`execute` is the function that Hydra calls. `batches` says which jobs may share a tensor batch, `solve`
computes one, and `completion` is what is then left to do for each of them.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import logging
import math
import os
import re
import shutil
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextvars import ContextVar
from pathlib import Path
from typing import Any, NamedTuple

from hydra.errors import HydraException, MissingConfigException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from ..experiments.registry import (
    BatchedExperiment,
    Experiment,
    Metrics,
    Solution,
    check_animation,
)
from ..experiments.study import experiment_of
from ..figures.style import FigurePaper, in_a_sweep, printed_on
from ..lanes.compilation.compiler import compiler
from ..numerics.checks import COMMAND_LINE, choice
from ..results import run_record as records
from ..results.files import FIGURES, METRICS
from ..settings.chase import make_metrics, units_of
from ..settings.plain import to_read
from ..settings.suggestions import without_option, without_setting
from ..signs import SHOWN, Progress, Sign
from . import lock
from .hydra_compat import About

_log = logging.getLogger(__name__)
_KEPT_BYTES = 2**28
"""What the jobs of a chunk may keep until they are written."""
_CHUNK = 128
"""Jobs of a chunk where nobody says otherwise: what is done is written that much later."""
_LIGHT, _MANY = 2**24, 1024
"""Bytes that many jobs may keep together to be of one chunk all the same, and how many."""
_UNREADABLE = (ValueError, TypeError, KeyError, AttributeError, OmegaConfBaseException)
"""What broken settings raise while they are grouped. The job itself says later what is wrong with it."""


class LostError(Exception):
    """A worker that ended without a result; the message says how."""


USER_ERRORS = (ValueError, HydraException, OmegaConfBaseException, OSError, LostError)
"""What a setting, the disk or the machine can bring about; anything else is a defect and keeps its trace."""


@dataclasses.dataclass(frozen=True)
class Computed:
    """The outcome of a job that was solved in a tensor batch; its files are not written yet."""

    solution: Solution

    @property
    def metrics(self) -> Metrics:
        """Contents of `metrics.json`."""
        return self.solution.metrics


@dataclasses.dataclass(frozen=True)
class Written:
    """The outcome of a job that ran as a whole in a worker, and has its files."""

    metrics: Metrics
    log: Sequence[tuple[int, str]]  # level and message, for the log of the run

    def replay(self, cfg: DictConfig, directory: Path, progress: Progress = SHOWN) -> Metrics:
        """Say in the log of the run what the worker was told, and return the metrics."""
        for level, line in self.log:
            _log.log(level, "%s", line)
        return self.metrics


@dataclasses.dataclass(frozen=True)
class Deferred:
    """In place of an outcome: the experiment takes no part in batches and runs when it is finished."""


@dataclasses.dataclass(frozen=True)
class Failed:
    """The outcome of a job that raised."""

    error: Exception


Flat = Mapping[str, Any]
"""Settings by dotted keys."""
Outcome = Computed | Written | Deferred | Failed
DEFERRED = Deferred()


class Batch(NamedTuple):
    """The jobs of a tensor batch."""

    settings: Sequence[DictConfig]
    directories: list[str]  # of the runs
    measured: bool = False  # whether metrics are all that is wanted of those that a batch solves


class Done(NamedTuple):
    """A tensor batch that was computed."""

    outcomes: list[Outcome]  # one a job
    seconds: float


def groups(settings: Sequence[Flat]) -> list[list[int]]:
    """Return the indices of the jobs that may share one tensor batch, in order of appearance."""
    found, _ = _grouped(settings)
    return found


def batches(
    settings: Sequence[Flat], *, least: int = 1, most: int | None = None, measured: bool = False
) -> list[list[int]]:
    """Return the indices of every tensor batch, in order; what a batch keeps fits into memory together.

    Args:
        settings: of all jobs.
        least: so many batches at least, where that can be, to keep that many workers busy.
        most: jobs of a batch at most; None for as many as memory allows, 128 at most.
        measured: whether metrics are all that is wanted: light jobs are then up to a thousand a batch.
    """
    grouped, sizes = _grouped(settings)
    light = _LIGHT if measured and most is None else 0
    found = []
    for group in grouped:
        length = min(most or len(group), -(-len(group) * len(grouped) // least))
        for chunk in _chunks(sizes, group, most or _CHUNK, light):
            found += [chunk[i : i + length] for i in range(0, len(chunk), length)]
    return sorted(found)


def _grouped(settings: Sequence[Flat]) -> tuple[list[list[int]], list[int]]:
    """The groups, and how many bytes each job keeps until it is written."""
    found: dict[str, list[int]] = {}
    sizes = []
    for index, one in enumerate(settings):
        key, size = _group_and_size(one, index)
        found.setdefault(key, []).append(index)
        sizes.append(size)
    return list(found.values()), sizes


def are_light(settings: Sequence[Flat]) -> bool:
    """Return whether so many jobs keep little, as they all say: they are computed in no time."""
    _, sizes = _grouped(settings)
    return all(sizes) and sum(sizes) <= _LIGHT


def _chunks(sizes: Sequence[int], indices: Sequence[int], most: int, light: int) -> list[list[int]]:
    """The indices of a group in pieces that fit into memory together.

    Each has ``most`` jobs at most, or up to `_MANY` that keep no more than ``light`` bytes together.
    """
    parts: list[list[int]] = []
    total = 0
    for index in indices:
        size, count = sizes[index], len(parts[-1]) if parts else 0
        full = count >= most and not (count < _MANY and 0 < size <= light - total)
        if not parts or full or total + size > _KEPT_BYTES:
            parts.append([])
            total = 0
        parts[-1].append(index)
        total += sizes[index]
    return parts


def solve(cfgs: Sequence[DictConfig], progress: Progress) -> list[Outcome]:
    """Compute one tensor batch; return an outcome a configuration, in order.

    Where the batch as a whole raises, its members are tried one by one, so that only the culprit fails.
    """
    try:
        study = experiment_of(to_read(cfgs)[0])
        if not isinstance(study, BatchedExperiment):
            return [DEFERRED for _ in cfgs]
        with in_a_sweep():
            solutions = study.solve(cfgs, progress)
        return [Failed(each) if isinstance(each, Exception) else Computed(each) for each in solutions]
    except Exception as error:
        if len(cfgs) == 1:
            return [Failed(error)]
        _log.warning(
            "a batch of %d jobs cannot run as one tensor program (%s); they run one by one",
            len(cfgs),
            reason(error),
        )
        return [outcome for cfg in cfgs for outcome in solve([cfg], progress)]


def completion(cfg: DictConfig, outcome: Outcome) -> Experiment:
    """Return what is left to do for a job with that outcome, as a function like an experiment.

    Raises:
        Exception: that of a job that failed, or ValueError for an animation that the experiment has not.
    """
    check_animation(cfg)
    study = experiment_of(cfg)
    match outcome:
        case Failed(error):
            raise error
        case Computed(solution):
            assert isinstance(study, BatchedExperiment)
            return lambda cfg, directory, progress=SHOWN: study.write(cfg, directory, solution)
        case Written():
            return outcome.replay
    return study


def _group_and_size(settings: Flat, index: int) -> tuple[str, int]:
    """A text that is equal for the members of a group, and the bytes that the solution keeps."""
    key, size = json.dumps(index), 0
    try:
        study = experiment_of(settings)
        if isinstance(study, BatchedExperiment):
            static = [[name, study.shared(name, value)] for name, value in settings.items()]
            key = json.dumps([study.shape(settings), *static])
            size = study.size(settings)
    except _UNREADABLE:
        pass
    return key, size


def chain(error: BaseException | None, *, contexts: bool = True) -> Iterator[BaseException]:
    """Yield an error, its cause, or what it arose from where ``contexts`` count, and so on.

    Each comes once: OmegaConf makes rings of them under a debugger, and so does ``raise error from error``.
    """
    seen = set[int]()
    while error is not None and id(error) not in seen:
        seen.add(id(error))
        yield error
        error = error.__cause__ or (error.__context__ if contexts else None)


def sentence(error: BaseException) -> str:
    """The library's own words where Hydra wrapped them, else the error's."""
    for cause in chain(error, contexts=False):
        if isinstance(cause, ValueError) and not isinstance(cause, OmegaConfBaseException):
            return str(cause).partition("\nfull_key: ")[0]  # a line that Hydra 1.4 adds
    if isinstance(error, OSError) and not isinstance(error, HydraException) and error.filename:
        return f"cannot write {error.filename}: {error.strerror}"
    unknown = re.match(r"Could not override '(.+?)'", str(error))
    if unknown:
        return without_setting(unknown[1])
    if isinstance(error, MissingConfigException) and error.options:
        name = (error.missing_cfg_file or "").removesuffix(".yaml")
        return without_option(name, error.options)
    missing = re.match(r"Missing mandatory value: (\S+)", str(error))
    if missing:
        return f"`{missing[1]}` has no default here: give `{missing[1]}=...`."
    several = re.match(r"Ambiguous value for argument '([^=]+)=(.*)'", str(error))
    if several:
        line = f"{several[1]}={several[2]}"
        return (
            f"`{line}` is a list, and a list is a sweep: `staf -m {line}`; "
            f"one setting that is a list is written `{several[1]}=[{several[2]}]`."
        )
    return str(error)


def reason(error: BaseException) -> str:
    """Return one line for the records: the sentence, and the type of an error that is a defect."""
    if isinstance(error, KeyboardInterrupt):
        return "interrupted"
    said = " ".join(sentence(error).split())
    return said if isinstance(error, USER_ERRORS) and said else f"{type(error).__name__}: {said}"


_BATCHED = "a sweep (staf -m) whose launcher is hydra/launcher=batched"

PRINTS: ContextVar[bool] = ContextVar("PRINTS", default=True)
"""Whether the table and the count of a sweep go to stdout: for a command they do, for Python they do not."""


class Refused(SystemExit):
    """A run that ended by a user's error: Hydra lets it pass without a word of its own."""

    def __init__(self, error: BaseException) -> None:
        super().__init__(f"staf: {sentence(error)}")


def execute(
    cfg: DictConfig, outcome: Outcome = DEFERRED, seconds: float = 0.0, progress: Progress = SHOWN
) -> Metrics | float | tuple[float, ...]:
    """Run the job that Hydra has prepared, fill its directory, and return what the sweeper is told.

    ``outcome`` is what was computed for it already, in so many ``seconds``. `run.json` says how the job ends;
    an exception is that of the experiment, and the record has its reason.
    """
    about = About.now()
    directory, choices = about.directory, about.choices
    record = records.RunRecord(cfg, choices, about.overrides, compiler(), about.flat)
    try:
        if records.in_table(cfg):
            raise ValueError(f"`sweep.records=table` needs {_BATCHED}.")
        metrics = record.finished_before(directory)
        if metrics is not None:
            _log.info("completed before: %s", os.path.relpath(directory))
        else:
            if about.alone and records.completed(directory) is not None:
                _log.info("replaces the run of the same command line in %s", os.path.relpath(directory))
            sign = Sign(f"experiment {choices.get('experiment') or cfg.task}")
            with sign, recorded(record, directory, seconds), in_a_sweep(not about.alone):
                record.declare([metric.info for metric in make_metrics(cfg.get("metric"))])
                record.measured_in(units_of(cfg))
                with printed_on(FigurePaper.of(cfg.get("figures", True))):
                    metrics = completion(cfg, outcome)(cfg, directory, progress)
            _log.info("  run directory: %s", os.path.relpath(directory))
            if pictures := sorted(path.name for path in (directory / FIGURES).glob("*.png")):
                _log.info("  pictures: %s (%s)", os.path.relpath(directory / FIGURES), ", ".join(pictures))
    except BaseException as error:
        refused = isinstance(error, USER_ERRORS)
        if not about.alone:  # a job of a sweep keeps its log, and the sweep goes on
            _log.error("%s", reason(error), exc_info=None if refused else error)
        elif refused:
            _take_back(directory)
            raise Refused(error) from error
        raise
    return objective(cfg, metrics)


@contextlib.contextmanager
def recorded(record: records.RunRecord, directory: Path, seconds: float) -> Iterator[None]:
    """Write `run.json` at the beginning and at the end, and send warnings to the log in between."""
    record.add_seconds(seconds)
    try:
        record.write(directory, "running")
        with warnings.catch_warnings():
            warnings.showwarning = _log_warning
            yield
        record.write(directory, "completed")
    except BaseException as error:
        with contextlib.suppress(OSError):
            record.write(directory, "failed", reason(error))
        raise


def _log_warning(message: Warning | str, *_: Any, **__: Any) -> None:
    _log.warning("%s", message)


def _take_back(directory: Path) -> None:
    """Remove what this run has written, and nothing else: the directory may be the user's own."""
    if (directory / METRICS).exists() or lock.held(directory) is None:  # of others: they stay
        return
    lock.give_back(directory)
    shutil.rmtree(directory / ".hydra", ignore_errors=True)
    for name in (records.RUN, "staf.log"):
        (directory / name).unlink(missing_ok=True)
    with contextlib.suppress(OSError):  # not empty: it was there before
        directory.rmdir()


def silence_terminal() -> None:
    """Let the log go to files alone, until it is configured anew."""
    for handler in logging.getLogger().handlers:
        if isinstance(handler, logging.StreamHandler) and not isinstance(handler, logging.FileHandler):
            handler.setLevel(logging.CRITICAL + 1)


def objective(cfg: DictConfig, metrics: Metrics) -> Metrics | float | tuple[float, ...]:
    """Return all metrics, or those named in `sweep.objective` alone, for sweepers that optimise.

    Raises:
        ValueError: if there is no metric of that name.
    """
    named = OmegaConf.select(cfg, "sweep.objective")
    names = [named] if isinstance(named, str) else list(named or ())
    for name in names:
        choice(COMMAND_LINE, "sweep.objective", name, tuple(metrics))
    values = [metrics[name] for name in names]
    numbers = tuple(math.inf if value is None else float(value) for value in values)  # null: it is not finite
    return metrics if named is None else numbers[0] if isinstance(named, str) else numbers

"""A job, from its settings to the end of its run directory: the function that Hydra calls."""

from __future__ import annotations

import contextlib
import logging
import math
import os
import shutil
import warnings
from collections.abc import Iterator
from contextvars import ContextVar
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from ..experiments.registry import Metrics
from ..figures.style import FigurePaper, in_a_sweep, printed_on
from ..lanes.compilation.compiler import compiler
from ..numerics.checks import COMMAND_LINE, choice
from ..results import run_record as records
from ..results.files import FIGURES, METRICS
from ..settings.chase import make_metrics, units_of
from ..signs import SHOWN, Progress, Sign
from . import lock
from .batching import DEFERRED, USER_ERRORS, Outcome, completion, reason, sentence
from .hydra_compat import About

_log = logging.getLogger(__name__)
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

"""The command `staf`: a Hydra application. It wires; the experiments are plain functions beside it."""

from __future__ import annotations

import contextlib
import inspect
import logging
import os
import shutil
import sys
import warnings
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from .._checks import choice
from .composition import config_directory as config_directory
from .plugin import find_launcher
from .sweep import handoff, records
from .sweep.executors.work import Written
from .sweep.objective import Metrics, objective
from .sweep.resume import command_line
from .sweep.session import session
from .wording import USER_ERRORS, reason, sentence

_log = logging.getLogger(__name__)
_FULL_ERROR = "HYDRA_FULL_ERROR"
EXPERIMENTS = (
    "gradient_chase",
    "laws",
    "flat_limit",
    "exponential_bound",
    "feasibility",
    "layouts",
    "memory",
    "adp",
    "adp_comparison",
    "adp_initial_weights",
    "adp_tracking",
)
"""Modules of this package with a function ``run(cfg, directory)``, by the name in ``task``."""


def _hydra_options() -> dict[str, Any]:
    options: dict[str, Any] = {"config_path": config_directory(), "config_name": "config"}
    if "execution_whitelist" in inspect.signature(hydra.main).parameters:  # Hydra 1.4
        options["execution_whitelist"] = ("staf_torch.*",)
    else:
        options["version_base"] = "1.3"  # which 1.4 deprecates
    return options


find_launcher()


@hydra.main(**_hydra_options())
@handoff.takes_solved
def _task(cfg: DictConfig) -> Metrics | float | tuple[float, ...]:
    settings = HydraConfig.get()
    directory, overrides = Path(settings.runtime.output_dir), list(settings.overrides.task)
    if records.resumed(cfg):
        finished = records.metrics_of(directory, overrides)
        if finished is not None:
            _log.info("completed before: %s", os.path.relpath(directory))
            return objective(cfg, finished)
    metrics = _recorded(cfg, directory, records.RunRecord(cfg, settings.runtime.choices, overrides))
    _log.info("  run directory: %s", os.path.relpath(directory))
    return objective(cfg, metrics)


def _recorded(cfg: DictConfig, directory: Path, record: records.RunRecord) -> Metrics:
    """The experiment, and in `run.json` how it ends."""
    solved = handoff.current()
    record.add_seconds(0.0 if solved is None else solved.seconds)
    try:
        record.write(directory, "running")
        with warnings.catch_warnings():
            warnings.showwarning = _log_warning
            metrics = _experiment(cfg, directory, solved)
        record.write(directory, "completed")
    except BaseException as error:
        with contextlib.suppress(OSError):
            record.write(directory, "failed", reason(error))
        refused = isinstance(error, USER_ERRORS)
        if HydraConfig.get().mode != RunMode.RUN:  # a member of a sweep keeps its log, and the sweep goes on
            _log.error("%s", reason(error), exc_info=None if refused else error)
        elif refused:
            _withdraw(directory)
            raise Refused(error) from error
        raise
    return metrics


def _experiment(cfg: DictConfig, directory: Path, solved: handoff.Solved | None) -> Metrics:
    choice("staf", "task", cfg.task, EXPERIMENTS)
    from . import members  # which imports this module

    metrics: Metrics
    if solved is None:
        metrics = members.run(cfg, directory)
    elif isinstance(solved.outcome, BaseException):
        raise solved.outcome
    elif isinstance(solved.outcome, Written):
        for level, line in solved.outcome.log:
            _log.log(level, "%s", line)
        metrics = solved.outcome.metrics
    else:
        metrics = members.write(cfg, directory, solved.outcome)
    return metrics


class Refused(SystemExit):
    """A run that ended by a user's error: Hydra lets it pass without a word of its own."""

    def __init__(self, error: BaseException) -> None:
        super().__init__(f"staf: {sentence(error)}")


def _withdraw(directory: Path) -> None:
    """Take back what this run has written, and nothing else: the directory may be the user's own."""
    if (directory / "metrics.json").exists():
        return
    shutil.rmtree(directory / ".hydra", ignore_errors=True)
    for name in (records.RUN, "staf.log"):
        (directory / name).unlink(missing_ok=True)
    with contextlib.suppress(OSError):  # not empty: it was there before
        directory.rmdir()


def _log_warning(message: Warning | str, *_: Any, **__: Any) -> None:
    _log.warning("%s", message)


def main() -> None:
    """Run the command line. What a user got wrong ends as one sentence and the exit code 1."""
    before = os.environ.get(_FULL_ERROR)
    wants_trace = before not in (None, "", "0")
    # Hydra then hands every exception on, and this function words it, once, for run and sweep alike.
    os.environ[_FULL_ERROR] = "1"
    sys.path.insert(0, os.getcwd())  # so that `target.path=my_module.my_function` finds the user's file
    typed = sys.argv
    with session() as running:
        try:
            sys.argv = [typed[0], *command_line(typed[1:])]
            try:
                _task()
            except (Exception, KeyboardInterrupt):
                running.close()
                raise
        except Refused as refused:
            if wants_trace and refused.__cause__ is not None:
                raise refused.__cause__ from None
            raise
        except USER_ERRORS as error:
            if wants_trace:
                raise
            sys.exit(f"staf: {sentence(error)}")
        except KeyboardInterrupt:
            sys.stderr.write(running.farewell + "\n")
            sys.exit(130)  # as shells have it
        finally:
            sys.argv = typed
            if before is None:
                del os.environ[_FULL_ERROR]

"""The command `staf`: a Hydra application. It wires; the experiments are plain functions beside it."""

from __future__ import annotations

import contextlib
import importlib
import inspect
import logging
import os
import re
import shutil
import sys
import warnings
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from .._checks import choice

USER_ERRORS = (ValueError, HydraException, OmegaConfBaseException, OSError)
"""What a setting or the disk can bring about; anything else is a defect and keeps its trace."""

_log = logging.getLogger(__name__)
_FULL_ERROR = "HYDRA_FULL_ERROR"
EXPERIMENTS = (
    "gradient_chase",
    "laws",
    "flat_limit",
    "exponential_bound",
    "feasibility",
    "layouts",
    "adp",
    "adp_comparison",
    "adp_initial_weights",
    "adp_tracking",
)
"""Modules of this package with a function ``run(cfg, directory)``, by the name in ``task``."""


def config_directory() -> str:
    """`conf/`: inside the package when it is installed from a wheel, beside it in a checkout."""
    package = Path(__file__).resolve().parent.parent
    inside = package / "conf"
    return str(inside if inside.is_dir() else package.parent / "conf")


def _hydra_options() -> dict[str, Any]:
    options: dict[str, Any] = {"config_path": config_directory(), "config_name": "config"}
    options["version_base"] = "1.3"
    if "execution_whitelist" in inspect.signature(hydra.main).parameters:  # Hydra 1.4
        options["execution_whitelist"] = ("staf_torch.*",)
    return options


@hydra.main(**_hydra_options())
def _task(cfg: DictConfig) -> dict[str, float | None]:
    settings = HydraConfig.get()
    directory = Path(settings.runtime.output_dir)
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _log_warning
            metrics = _experiment(cfg, directory)
    except USER_ERRORS as error:
        if settings.mode != RunMode.RUN:  # a member of a sweep keeps its log, and the sweep goes on
            _log.error("%s", sentence(error))
            raise
        _withdraw(directory)
        raise Refused(error) from error
    _log.info("  run directory: %s", os.path.relpath(directory))
    return metrics


def _experiment(cfg: DictConfig, directory: Path) -> dict[str, float | None]:
    choice("staf", "task", cfg.task, EXPERIMENTS)
    experiment = importlib.import_module(f"{__package__}.{cfg.task}")
    metrics: dict[str, float | None] = experiment.run(cfg, directory)
    return metrics


class Refused(SystemExit):
    """A run that ended by a user's error: Hydra lets it pass without a word of its own."""

    def __init__(self, error: Exception) -> None:
        super().__init__(f"staf: {sentence(error)}")


def _withdraw(directory: Path) -> None:
    """Take back what this run has written, and nothing else: the directory may be the user's own."""
    if (directory / "metrics.json").exists():
        return
    shutil.rmtree(directory / ".hydra", ignore_errors=True)
    (directory / "staf.log").unlink(missing_ok=True)
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
    try:
        _task()
    except Refused as refused:
        if wants_trace and refused.__cause__ is not None:
            raise refused.__cause__ from None
        raise
    except USER_ERRORS as error:
        if wants_trace:
            raise
        sys.exit(f"staf: {sentence(error)}")
    except KeyboardInterrupt:
        sys.exit("staf: interrupted")
    finally:
        if before is None:
            del os.environ[_FULL_ERROR]


def sentence(error: BaseException) -> str:
    """The library's own words where Hydra wrapped them, else the error's."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, ValueError) and not isinstance(cause, OmegaConfBaseException):
            return str(cause)
        cause = cause.__cause__
    if isinstance(error, OSError) and not isinstance(error, HydraException) and error.filename:
        return f"cannot write {error.filename}: {error.strerror}"
    unknown = re.match(r"Could not override '(.+?)'", str(error))
    if unknown:
        return f"there is no setting `{unknown[1]}`; `staf --help` lists them."
    return str(error)

"""The Hydra callback that hands finished runs to the tracker of the settings, whatever launched them."""

from __future__ import annotations

import logging
from typing import Any

from hydra.core.utils import JobReturn
from hydra.experimental.callback import Callback
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from .._wording import COMMAND_LINE, fail
from ..report import collect
from ..report.run import COMPLETED
from ..report.trackers import Tracker

_log = logging.getLogger(__name__)


class TrackRuns(Callback):
    """`tracker=`: made before the first run, so that it can refuse; given each completed run."""

    def on_run_start(self, config: DictConfig, **_: Any) -> None:
        """A run begins."""
        _require(config)

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        """A sweep begins."""
        _require(config)

    def on_job_end(self, config: DictConfig, job_return: JobReturn, **_: Any) -> None:
        """A run, or a job of a sweep, has ended."""
        try:
            found = tracker(config)
            if found is None:
                return
            for run in collect(config.hydra.runtime.output_dir).rows:
                if run.status == COMPLETED:
                    found.record(run)
        except Exception as error:  # the results are on the disk
            _log.warning("not tracked: %s: %s", type(error).__name__, error)


def tracker(config: DictConfig) -> Tracker | None:
    """The tracker that the settings name; None for `tracker=none`.

    Raises:
        ValueError: if it is none, or something that it needs is not installed.
    """
    settings = OmegaConf.select(config, "tracker")
    if settings is None or settings.get("_target_") is None:
        return None
    try:
        found = instantiate(settings, _convert_="all")
    except Exception as error:
        if isinstance(error.__cause__, ValueError):  # Hydra wraps what a constructor raises
            raise error.__cause__ from error
        raise
    if not isinstance(found, Tracker):
        raise fail(COMMAND_LINE, "tracker", "must be a staf_torch.report.trackers.Tracker", found)
    return found


def _require(config: DictConfig) -> None:
    """Hydra turns exceptions of callbacks into warnings; this one has to end the program."""
    try:
        tracker(config)
    except Exception as error:
        raise SystemExit(f"staf: {error}") from error

"""The Hydra callback that ends a sweep with its table, its figures and its page, whatever launched it."""

from __future__ import annotations

import logging
import sys
from pathlib import Path
from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf

_log = logging.getLogger(__name__)


class SweepReport(Callback):
    """Prints and saves the table of a sweep, draws its figures, and writes `report.html`, when it ends.

    Hydra says so only of sweeps in which no job failed; `Session.close` does it for the others.

    Args:
        figures: whether to draw; None: as the runs do, by `figures` of the settings.
    """

    def __init__(self, figures: bool | None = None) -> None:
        self._figures = figures

    def on_multirun_end(self, config: DictConfig, **_: Any) -> None:
        """Write the report; nothing that goes wrong here may look like a sweep gone wrong."""
        directory = Path(str(config.hydra.sweep.dir))
        figures = OmegaConf.select(config, "figures") if self._figures is None else self._figures
        if not directory.is_dir():
            return
        from ..report.sweep_report import PAGE, write_report  # the jobs of a sweep import this module too

        try:
            text = write_report(directory, figures=figures is not False)
        except Exception as error:
            _log.warning("no report of the sweep: %s", error)
            return
        sys.stdout.write(f"\n{text}\n  report: {directory / PAGE}\n")
        sys.stdout.flush()

"""The Hydra callback that ends a sweep with its table, its figures and its page, whatever launched it."""

from __future__ import annotations

import logging
import sys
from pathlib import Path
from typing import Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig

_log = logging.getLogger(__name__)
_open: list[SweepReport] = []  # sweeps that began and have not been reported: those that end by an error


class SweepReport(Callback):
    """Prints and saves the table of a sweep, draws its figures, and writes `report.html`, when it ends.

    Hydra says so only of sweeps in which no job failed; `finish` does it for the others.

    Args:
        figures: whether to draw.
    """

    def __init__(self, figures: bool = True) -> None:
        self._figures = bool(figures)
        self._directory: Path | None = None

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        """Remember where the sweep writes."""
        self._directory = Path(config.hydra.sweep.dir)
        _open.append(self)

    def on_multirun_end(self, config: DictConfig, **_: Any) -> None:
        """Every job completed."""
        self.report()

    def report(self) -> None:
        """Write the report once; nothing that goes wrong here may look like a sweep gone wrong."""
        if self in _open:
            _open.remove(self)
        if self._directory is None or not self._directory.is_dir():
            return
        from ..report.sweep_report import PAGE, write_report  # the jobs of a sweep import this module too

        try:
            text = write_report(self._directory, figures=self._figures)
        except Exception as error:
            _log.warning("no report of the sweep: %s", error)
            return
        sys.stdout.write(f"\n{text}\n  report: {self._directory / PAGE}\n")
        sys.stdout.flush()


def finish() -> None:
    """Report the sweeps that ended without Hydra's word of it: a job failed, or someone interrupted."""
    while _open:
        _open[-1].report()

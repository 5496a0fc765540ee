"""A run on the meta device: settings become objects and shapes, nothing is computed, and the log says what a
run would hold.

Gains, designs and initial states, which are small and which numbers decide, are made on the CPU as
everywhere. An experiment takes part by an attribute ``held``: a function of the settings that makes the
histories of the rows, by the calls with which a run begins, and reads nothing of them.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from torch import Tensor

from ..lanes.trace.tracer import explained
from ..numerics.checks import COMMAND_LINE, fail
from ..results.run_directory import RunDirectory
from ..signs import SHOWN, Progress
from ..tables import Table
from .registry import BatchedExperiment, Experiment, Metrics, Solution, experiment
from .study import report

_log = logging.getLogger(__name__)
_COLUMNS = {"history": "history", "shape": "shape", "dtype": "dtype", "bytes": "bytes"}
_UNITS = ("B", "kB", "MB", "GB", "TB")


def experiment_of(settings: Mapping[str, Any] | DictConfig) -> Experiment | BatchedExperiment[Solution]:
    """Return the experiment of a run: that of the setting `task`, or on the meta device its dry run.

    Args:
        settings: all of them, nested or with dotted keys.

    Raises:
        ValueError: as `experiment`, and for a dry run of an experiment that makes no histories.
    """
    study, device = experiment(settings["task"]), str(settings.get("device"))
    if device.partition(":")[0] != "meta":
        return study
    held = getattr(study, "held", None)
    if held is None:
        rule = "in which numbers decide: it has no function `held` that makes its histories without them"
        raise fail(
            COMMAND_LINE, "device", f"must not be meta for the task {settings['task']}, {rule}", device
        )
    return DryRun(held)


class DryRun:
    """In place of an experiment on the meta device: log and write what its run would hold.

    Args:
        held: makes the histories of a run from its settings: name -> (B, T, ...).
    """

    def __init__(self, held: Callable[[DictConfig], Mapping[str, Tensor]]) -> None:
        self._held = held

    def __call__(self, cfg: DictConfig, directory: Path, progress: Progress = SHOWN) -> Metrics:
        """Write shape, dtype and bytes of every history; the only metric is their sum, `history_bytes`.

        Raises:
            ValueError: if numbers decide on the way, with the line of code.
        """
        try:
            with torch.no_grad():
                held = self._held(cfg)
        except RuntimeError as error:
            if (instead := explained(error, f"staf device={cfg.device} task={cfg.task}")) is error:
                raise
            raise instead from error
        rows: list[dict[str, Any]] = [
            {"history": name, "shape": _shape(x), "dtype": str(x.dtype)[len("torch.") :], "bytes": x.nbytes}
            for name, x in held.items()
        ]
        total, out = sum(x.nbytes for x in held.values()), RunDirectory(directory)
        told = f"the histories of a run take {_size(total)}" if rows else "a run keeps no histories"
        heading = f"Dry run, nothing was computed: {told}"
        report(out, _log, "dry_run", Table.of(rows, _COLUMNS), None, heading=heading)
        return out.metrics({"history_bytes": float(total)})


def _shape(x: Tensor) -> str:
    return " x ".join(map(str, x.shape))


def _size(count: int) -> str:
    """Return a number of bytes in a unit in which it has up to three digits before the point."""
    power = min(len(_UNITS) - 1, max(0, len(str(count)) - 1) // 3)
    return f"{count / 1000**power:.4g} {_UNITS[power]}"

"""The frame of a study: methods beside each other, of each a row, metrics and a log line; and dry runs.

A dry run is a run on the meta device: settings become objects and shapes, nothing is computed, and the log
says what a run would hold. Gains, designs and initial states, which are small and which numbers decide, are
made on the CPU as everywhere. An experiment takes part by an attribute ``held``: a function of the settings
that makes the histories of the rows, by the calls with which a run begins, and reads nothing of them.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from omegaconf import DictConfig
from torch import Tensor

from ..figures.style import draws, images
from ..lanes.trace.tracer import explained
from ..numerics.checks import COMMAND_LINE, fail
from ..results.run_directory import Printable, RunDirectory
from ..settings.chase import placement
from ..signs import SHOWN, Progress
from ..systems import Plant
from ..tables import Style, Table
from ..tables.model import significant
from .registry import BatchedExperiment, Experiment, Metrics, Solution, experiment, finite

if TYPE_CHECKING:  # `adp` is .1 s, which chases do not need
    from matplotlib.figure import Figure

    from ..adp import Controller, Cost, LoopResult

_log = logging.getLogger(__name__)
Drawing = Callable[[], "Figure"]
_NAMED = 20  # diverged trajectories that the log lists by number


class Method(NamedTuple):
    """A method that a study compares: a controller, the plant that it steers, and the cost there."""

    controller: Controller
    plant: Plant
    cost: Cost
    options: Mapping[str, Any] = {}  # of `simulate`, beside those that all methods share

    def run(self, x0: Tensor, **shared: Any) -> LoopResult:
        """Run the closed loop from the states of the plant, (B, n)."""
        from ..adp import simulate

        return simulate(self.controller, self.plant, self.cost, x0, **shared, **self.options)


class Study:
    """Collect what methods have reached, in the order of the table, and write it.

    ``columns`` has the heading of each number or label of the table, ``logged`` the numbers that the log
    shows of a method, none for no line.
    """

    def __init__(
        self,
        name: str,
        columns: Mapping[str, str],
        logged: Sequence[str],
        log: logging.Logger,
        digits: int = 3,
    ) -> None:
        self._name, self._columns, self._logged, self._log = name, dict(columns), tuple(logged), log
        self._style = Style(digits=digits)
        self.rows: list[dict[str, Any]] = []
        self.metrics: Metrics = {}

    def add(
        self,
        prefix: str,
        measured: Mapping[str, float | None],
        more: Mapping[str, float | str | None] | None = None,
        **labels: str,
    ) -> None:
        """Add a method with its numbers, None where there is none, and what the table calls it, by column.

        Its names in `metrics.json` begin with ``prefix``; ``more`` is what the table alone has of it, as
        times.
        """
        self.rows.append(labels | dict(measured) | dict(more or {}))
        self.metrics |= {prefix + name: finite(value) for name, value in measured.items()}
        if self._logged:
            shown = [f"{name.replace('_', ' ')} {significant(measured[name], 5)}" for name in self._logged]
            self._log.info("%s: %s", ", ".join(labels.values()), ", ".join(shown))

    def write_table(self, out: RunDirectory) -> None:
        """Write the table of the methods so far."""
        table = Table.of(self.rows, self._columns)
        out.table(self._name, dataclasses.replace(table, style=self._style))

    def write(
        self, cfg: DictConfig, out: RunDirectory, drawing: Drawing, figure: str | None = None
    ) -> Metrics:
        """Write the table, the figure (of the table's name by default) where the settings want one, and
        `metrics.json` at last."""
        self.write_table(out)
        if draws(cfg.figures):
            out.figure(figure or self._name, images(drawing()))
        return out.metrics(self.metrics)


def report(
    cfg: DictConfig,
    out: RunDirectory,
    log: logging.Logger,
    name: str,
    table: Table,
    drawing: Drawing | None,
    *,
    shown: Printable | Sequence[Printable] = (),
    heading: str = "",
) -> None:
    """Write a table and the figure of the same name, where the settings want one, and log the table below a
    heading."""
    text = out.table(name, table, shown=shown)
    for line in [*filter(None, [heading]), *text.splitlines()]:
        log.info("%s", line)
    if drawing is not None and draws(cfg.figures):
        out.figure(name, images(drawing()))


def recorded_times(duration: float, dt: float, between: float) -> dict[str, int]:
    """Return `steps` and `every` of `simulate` for records about ``between`` seconds apart."""
    every = max(1, round(between / dt))
    return {"steps": every * max(1, round(duration / dt / every)), "every": every}


def tell_of_cpu(cfg: DictConfig, log: logging.Logger, why: str) -> None:
    """Log that an experiment computes on the CPU, and why, where the settings name another device."""
    device, _ = placement(cfg.device, cfg.dtype)
    if device.type != "cpu":
        log.warning("the task %s computes on the CPU and not on %s: %s", cfg.task, device, why)


def trajectories(count: int) -> str:
    """Return a number of trajectories in words, for the log."""
    return f"{count} {'trajectory' if count == 1 else 'trajectories'}"


def label_key(label: str) -> str:
    """Return a method's label as it stands in the names of metrics: lower case, words joined by _."""
    return "_".join(label.lower().replace(",", "").replace("-", "_").split())


def write_history(out: RunDirectory, time: Tensor, arrays: Mapping[str, Tensor]) -> None:
    """Write `history.npz`: time (T,), and (B, T, ...) arrays by their names."""
    with out.history(*next(iter(arrays.values())).shape[:2]) as writer:
        writer.add({name: array.cpu().numpy() for name, array in arrays.items()})
        writer.close(time=time.numpy())


def histories(results: Mapping[str, LoopResult]) -> dict[str, Tensor]:
    """Return what closed loops keep of all rows and times: (B, T, ...) by method and name."""
    return {
        f"{method}: {name}" if method else name: array
        for method, result in results.items()
        for name, array in {
            "state": result.state,
            "control": result.control,
            "running_cost": result.running_cost,
            **result.recorded,
        }.items()
    }


def log_diverged(log: logging.Logger, starts: Tensor | np.ndarray, at: Tensor, also: str = "") -> None:
    """Warn of each diverged trajectory, up to twenty of them by number, and of what ``also`` happens to it.

    Starts are (B, n), ``at`` the times of divergence in s, inf where a row did not, (B,).
    """
    rows = at.isfinite().nonzero().flatten().tolist()
    for row in rows[:_NAMED]:
        start = [round(value, 6) for value in starts[row].tolist()]
        log.warning("trajectory %d from %s diverged at t = %.6g s%s", row, start, float(at[row]), also)
    if len(rows) > _NAMED:
        log.warning("and %d more trajectories diverged", len(rows) - _NAMED)


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
        columns = ("history", "shape", "dtype", "bytes")
        rows: list[dict[str, Any]] = []
        for name, x in held.items():
            cells = name, " x ".join(map(str, x.shape)), str(x.dtype).removeprefix("torch."), x.nbytes
            rows.append(dict(zip(columns, cells, strict=True)))
        total, out = sum(x.nbytes for x in held.values()), RunDirectory(directory)
        power = min(4, max(0, len(str(total)) - 1) // 3)
        size = f"{total / 1000**power:.4g} {('B', 'kB', 'MB', 'GB', 'TB')[power]}"
        told = f"the histories of a run take {size}" if rows else "a run keeps no histories"
        heading = f"Dry run, nothing was computed: {told}"
        report(cfg, out, _log, "dry_run", Table.of(rows, dict.fromkeys(columns, "")), None, heading=heading)
        return out.metrics({"history_bytes": float(total)})

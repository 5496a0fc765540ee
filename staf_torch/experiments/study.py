"""The frame of a study: methods beside each other, of each a row, metrics and a line of the log."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from omegaconf import DictConfig
from torch import Tensor

from ..figures.style import images
from ..results.run_directory import Printable, RunDirectory
from ..settings.chase import placement
from ..systems import Plant
from ..tables import Style, Table
from ..tables.model import significant
from .registry import Metrics, finite

if TYPE_CHECKING:  # `adp` is .1 s, which chases do not need
    from matplotlib.figure import Figure

    from ..adp import Controller, Cost, LoopResult

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

    def write(self, out: RunDirectory, drawing: Drawing | None, figure: str | None = None) -> Metrics:
        """Write the table, the figure (of the table's name by default) where one is wanted, and
        `metrics.json` at last."""
        self.write_table(out)
        if drawing is not None:
            out.figure(figure or self._name, images(drawing()))
        return out.metrics(self.metrics)


def report(
    out: RunDirectory,
    log: logging.Logger,
    name: str,
    table: Table,
    drawing: Drawing | None,
    *,
    shown: Printable | Sequence[Printable] = (),
    heading: str = "",
) -> None:
    """Write a table and the figure of the same name, and log the table below a heading."""
    text = out.table(name, table, shown=shown)
    for line in [*filter(None, [heading]), *text.splitlines()]:
        log.info("%s", line)
    if drawing is not None:
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

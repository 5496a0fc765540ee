"""The paper's simulation: chase the ideal weights along uncontrolled trajectories."""

from __future__ import annotations

import contextlib
import logging
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from omegaconf import DictConfig
from torch import Tensor

from .._checks import COMMAND_LINE, flag
from ..chase import ChaseResult, chase_pieces, chunk_length
from ..metrics import ChaseMetrics
from ..report import HistoryWriter, write_metrics
from ..systems import trajectory
from .build import ChaseProblem, chase_problem
from .progress import Progress

_log = logging.getLogger(__name__)
_HISTORY = ("state", "value", "estimate", "weights", "ideal_weights", "excess")
_DRAWN = (*_HISTORY, "ideal_estimate")
_DRAWN_TIMES = 4000  # more could not be told apart in print
_NAMED = 20  # diverged trajectories that the log lists by number


class Outcome(NamedTuple):
    """What a gradient chase leaves behind in memory."""

    metrics: dict[str, float | None]
    drawn: dict[str, np.ndarray]  # the first trajectory, thinned: name -> (T', ...)
    diverged_at: Tensor  # (B,) index of time, -1 if none


def run(cfg: DictConfig, directory: Path) -> dict[str, float | None]:
    """Run what the settings describe and fill the run directory; `metrics.json` comes last."""
    problem = chase_problem(cfg)
    figures = flag(COMMAND_LINE, "figures", cfg.figures)
    history = flag(COMMAND_LINE, "history", cfg.history)
    batch, times = problem.initial_states.shape[0], problem.steps + 1
    with contextlib.ExitStack() as stack:
        writer = None
        if history:
            writer = stack.enter_context(HistoryWriter(directory / "history.npz", batch, times))
        outcome = solve(problem, writer)
        if writer is not None:
            writer.close(time=_times(problem))
    _name_the_diverged(problem, outcome.diverged_at)
    if figures:
        _draw(outcome, directory)
    _summarise(problem, outcome.metrics)
    write_metrics(directory / "metrics.json", outcome.metrics)
    return outcome.metrics


def solve(
    problem: ChaseProblem, writer: HistoryWriter | None = None, progress: Progress | None = None
) -> Outcome:
    """The simulation itself, in pieces of time."""
    metrics = ChaseMetrics(
        problem.basis,
        problem.target,
        problem.law,
        inner_steps=problem.inner_steps,
        dt=problem.dt,
        settle_time=problem.settle_time,
    )
    x0 = problem.initial_states
    times = problem.steps + 1
    chunk = chunk_length(x0.shape[0], problem.basis, x0.element_size())
    # Some twenty pieces of a long run, so that progress is seen; the results do not depend on it.
    chunk = max(1, min(chunk, max(64, -(-times // 20))))
    thinned = _Thinned(times)
    progress = Progress(times, "times") if progress is None else progress
    diverged_at = torch.full(x0.shape[:1], -1)
    states = trajectory(problem.system, x0, dt=problem.dt, steps=problem.steps, chunk=chunk)
    chased = chase_pieces(
        states,
        problem.basis,
        problem.target,
        problem.law,
        inner_steps=problem.inner_steps,
        predictor=problem.predictor,
        certificate=problem.certificate,
    )
    with torch.no_grad():
        for result in chased:
            metrics.add(result)
            thinned.add(result)
            if writer is not None:
                writer.add({name: getattr(result, name).cpu().numpy() for name in _HISTORY})
            diverged_at = result.diverged_at
            progress.advance(result.state.shape[1])
    progress.close()
    drawn = thinned.arrays() | {"time": _times(problem)[:: thinned.stride]}
    return Outcome(metrics.summary(), drawn, diverged_at.cpu())


class _Thinned:
    """The first trajectory at every so manieth time, for the figure."""

    def __init__(self, times: int) -> None:
        self.stride = -(-times // _DRAWN_TIMES)
        self._time = 0
        self._parts: dict[str, list[np.ndarray]] = {name: [] for name in _DRAWN}

    def add(self, result: ChaseResult) -> None:
        first = -self._time % self.stride
        for name, parts in self._parts.items():
            # A copy: a view would keep the whole piece in memory.
            parts.append(getattr(result, name)[0, first :: self.stride].cpu().numpy().copy())
        self._time += result.state.shape[1]

    def arrays(self) -> dict[str, np.ndarray]:
        return {name: np.concatenate(parts) for name, parts in self._parts.items()}


def _times(problem: ChaseProblem) -> np.ndarray:
    return np.arange(problem.steps + 1) * problem.dt


def _name_the_diverged(problem: ChaseProblem, diverged_at: Tensor) -> None:
    rows = (diverged_at >= 0).nonzero().flatten().tolist()
    for row in rows[:_NAMED]:
        _log.warning(
            "trajectory %d from %s diverged at t = %.6g s; its weights are frozen from there on",
            row,
            problem.initial_states[row].tolist(),
            float(diverged_at[row]) * problem.dt,
        )
    if len(rows) > _NAMED:
        _log.warning("and %d more trajectories diverged", len(rows) - _NAMED)


def _summarise(problem: ChaseProblem, metrics: dict[str, float | None]) -> None:
    def show(name: str) -> str:
        number = metrics[name]
        return "-" if number is None else f"{number:.4g}"

    batch, count = problem.initial_states.shape[0], problem.basis.count
    _log.info(
        "Gradient chase: %d %s, %d times, dt = %g s, %d centers, %s, %s x %d%s",
        batch,
        "trajectory" if batch == 1 else "trajectories",
        problem.steps + 1,
        problem.dt,
        count,
        type(problem.basis.kernel).__name__,
        type(problem.law).__name__,
        problem.inner_steps,
        "" if problem.predictor is None else f", {type(problem.predictor).__name__.lower()} predictor",
    )
    if metrics["ultimate_error"] is None:
        _log.warning(
            "nothing to report: no trajectory is finite at a time t >= settle_time = %g s",
            problem.settle_time,
        )
    row = "  %-22s %12s %12s %12s"
    _log.info(row, f"worst, t >= {problem.settle_time:g} s", "corrected", "before", "ideal weights")
    names = ("ultimate_error", "ultimate_error_before", "floor_error")
    _log.info(row, "error at the state", *map(show, names))
    _log.info(row, "excess F(a) - F(w)", *map(show, ("ultimate_excess", "ultimate_excess_before")), "0")
    _log.info("  error on the ball %s, gradient error %s", show("ball_error"), show("gradient_error"))
    _log.info(
        "  condition number %s, settled after %s s, contraction violations %s, diverged %s",
        *map(show, ("condition_number", "settling_time")),
        *map(show, ("contraction_violations", "diverged_fraction")),
    )


def _draw(outcome: Outcome, directory: Path) -> None:
    # Imported here: matplotlib takes a second, which figures=false need not pay.
    from ..report import plots

    folder = directory / "figures"
    folder.mkdir(exist_ok=True)
    plots.save(plots.draw_chase(plots.ChaseHistory(**outcome.drawn)), folder / "gradient_chase")

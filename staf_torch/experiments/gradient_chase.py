"""The paper's simulation: chase the ideal weights along uncontrolled trajectories."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from omegaconf import DictConfig
from torch import Tensor

from ..figures.chase import ChaseHistory, draw_chase
from ..figures.style import draws, images
from ..numerics.checks import COMMAND_LINE, flag
from ..results.run_directory import RunDirectory
from ..settings.chase import ChaseProblem, Parts, chase_problem, warnings_to
from ..settings.plain import PlainSettings, to_read
from ..signs import SHOWN, Progress
from ..systems import Units
from ..tables.model import significant
from .chase_batch import HISTORY, Outcome, histories, simulate
from .registry import BatchedExperiment, Metrics
from .scenes import animation_kind, chase_scene, write_animation
from .study import log_diverged, trajectories

_log = logging.getLogger(__name__)


class Title(NamedTuple):
    """A problem in a few words, for the log."""

    rows: int
    times: int
    dt: float
    settle_time: float
    method: str
    work: float  # products of an M x M matrix with a vector, a second of trajectory

    @classmethod
    def of(cls, problem: ChaseProblem) -> Title:
        predictor, count = problem.predictor, problem.basis.count
        method = f"{count} centers, {type(problem.basis.kernel).__name__}, "
        method += f"{type(problem.law).__name__} x {problem.inner_steps}"
        work = problem.law.products(count, problem.inner_steps)
        if predictor is not None:
            method += f", {type(predictor).__name__.lower()} predictor"
            work += predictor.products(count)
        batch, times = len(problem.initial_states), problem.steps + 1
        return cls(batch, times, problem.dt, problem.settle_time, method, work / problem.dt)


@dataclasses.dataclass(frozen=True)
class ChaseSolution:
    """A problem that has been solved and has left nothing on disk yet. It can be pickled."""

    title: Title
    outcome: Outcome
    starts: np.ndarray  # initial states, (B, n)
    history: dict[str, np.ndarray] | None = None  # name -> (B, T, ...)
    warnings: tuple[str, ...] = ()
    units: tuple[str, ...] = ()  # of the states

    @property
    def metrics(self) -> Metrics:
        """Return the content of `metrics.json`."""
        return {**self.outcome.metrics, "products_per_second": self.title.work}


class GradientChase(BatchedExperiment[ChaseSolution]):
    """The chase of the ideal weights; initial states and scalar hyperparameters share a tensor batch."""

    animates = True
    batchable = frozenset(
        {
            *("seed", "initial_state", "spread", "trajectories", "dt", "duration", "settle_time"),
            *("centers.radius", "centers.directions", "centers.shrink.*"),
            *("kernel.*", "target.*", "optimizer.*", "system.*", "predictor.*"),
        }
    )

    def __call__(self, cfg: DictConfig, directory: Path, progress: Progress = SHOWN) -> Metrics:
        """Run what the settings describe and fill the run directory; `metrics.json` comes last.

        The history goes to disk as it arises, where `solve` keeps it in memory for `write`.
        """
        problem = chase_problem(cfg)
        figures, history = _wanted(cfg, problem)
        out, title = RunDirectory(directory), Title.of(problem)
        kept = out.history(title.rows, title.times) if history else contextlib.nullcontext()
        with kept as writer, progress.over(title.times, "times") as advance:
            sink = None if writer is None else lambda pieces, row, _: writer.add(pieces, row)
            (outcome,) = simulate([problem], [sink], [figures], advance)
            if writer is not None:
                writer.close(time=_times(title))
        return _finish(out, _solved(problem, outcome), cfg)

    def held(self, cfg: DictConfig) -> dict[str, Tensor]:
        """Return the history of a run; nothing where none is kept."""
        problem = chase_problem(cfg)
        _, history = _wanted(cfg, problem)
        found = histories(problem) if history else {}
        return {name: found[name] for name in HISTORY if history}

    def solve(self, cfgs: Sequence[DictConfig], progress: Progress) -> list[ChaseSolution | Exception]:
        """Solve several configurations of one group as one tensor batch."""
        parts = Parts()
        prepared = [_prepared(cfg, parts) for cfg in to_read(cfgs)]
        ready = [member for member in prepared if isinstance(member, _Ready)]
        common: list[str] = []
        left: Iterator[Outcome] = iter(())
        if ready:
            problems, drawn = [member.problem for member in ready], [member.figures for member in ready]
            sinks = [None if member.memory is None else member.memory.add for member in ready]
            times = sum(problem.steps + 1 for problem in problems)
            with warnings_to(common), progress.over(times, "times") as advance:
                left = iter(simulate(problems, sinks, drawn, advance))
        return [
            _solved(each.problem, next(left), each, common) if isinstance(each, _Ready) else each
            for each in prepared
        ]

    def write(self, cfg: DictConfig, directory: Path, solution: ChaseSolution) -> Metrics:
        """Fill the run directory with what was solved; `metrics.json` comes last."""
        for message in solution.warnings:
            warnings.warn(message, stacklevel=2)
        out, title = RunDirectory(directory), solution.title
        if solution.history is not None:
            with out.history(title.rows, title.times) as writer:
                writer.add(solution.history)
                writer.close(time=_times(title))
        return _finish(out, solution, cfg)

    def shape(self, settings: Mapping[str, object]) -> object:
        """Return the numbers of steps and of iterations a step."""
        return [self._steps(settings), settings.get("optimizer.inner_steps")]

    def _steps(self, settings: Mapping[str, object]) -> int | str:
        dt, duration = settings["dt"], settings["duration"]
        if not isinstance(dt, int | float) or not isinstance(duration, int | float) or dt <= 0:
            return "none"
        ratio = duration / dt
        return math.floor(ratio + 1e-9) if math.isfinite(ratio) else "none"

    def size(self, settings: Mapping[str, object]) -> int:
        """Return about how many bytes the history and the drawn trajectory take."""
        rows, times = settings.get("trajectories"), self._steps(settings)
        count = settings.get("centers.count")
        start = settings.get("initial_state")
        if not isinstance(rows, int) or not isinstance(times, int):
            return 0  # it will be refused
        n, m = len(start) if isinstance(start, list) else 2, count if isinstance(count, int) else 12
        kept = n + 4 + 2 * m if settings.get("history") else 1
        return 8 * times * (rows * kept + (n + 5 + 2 * m))


class _Ready(NamedTuple):
    """A member of a batch before it is solved."""

    problem: ChaseProblem
    figures: bool  # whether the first trajectory is drawn, at rest or in motion
    memory: _Memory | None  # takes the history; None where nobody wants it
    warnings: list[str]


def _prepared(cfg: DictConfig | PlainSettings, parts: Parts) -> _Ready | Exception:
    said: list[str] = []
    try:
        with warnings_to(said):
            problem = chase_problem(cfg, parts)
            figures, history = _wanted(cfg, problem)
    except Exception as error:  # of this member alone
        return error
    memory = _Memory(len(problem.initial_states), problem.steps + 1) if history else None
    return _Ready(problem, figures, memory, said)


def _solved(
    problem: ChaseProblem, outcome: Outcome, member: _Ready | None = None, common: Sequence[str] = ()
) -> ChaseSolution:
    """Return a solution; that of a member has its history and what the whole batch was warned of as well."""
    starts = problem.initial_states
    units: Units = getattr(problem.system, "units", Units())  # of any module with the methods of a plant
    history, said = None, list[str]()
    if member is not None:
        history = None if member.memory is None else member.memory.arrays
        said = list(dict.fromkeys([*member.warnings, *common, *outcome.warnings]))
    about = Title.of(problem), outcome, starts.cpu().numpy(), history
    return ChaseSolution(*about, tuple(said), units.of_states(starts.shape[-1]))


class _Memory:
    """A history kept in memory."""

    def __init__(self, batch: int, times: int) -> None:
        self._shape = batch, times
        self.arrays: dict[str, np.ndarray] = {}

    def add(self, pieces: Mapping[str, np.ndarray], row: int, time: int) -> None:
        for name, piece in pieces.items():
            if name not in self.arrays:
                self.arrays[name] = np.empty((*self._shape, *piece.shape[2:]), piece.dtype)
            rows, length = piece.shape[:2]
            self.arrays[name][row : row + rows, time : time + length] = piece


def _wanted(cfg: DictConfig | PlainSettings, problem: ChaseProblem) -> tuple[bool, bool]:
    """Return whether the first trajectory is drawn, at rest or in motion, and whether there is a history."""
    drawn = draws(cfg.figures)
    moving = animation_kind(cfg, problem.basis.dim) is not None
    return drawn or moving, flag(COMMAND_LINE, "history", cfg.history)


def _finish(out: RunDirectory, solved: ChaseSolution, cfg: DictConfig) -> Metrics:
    """Write what follows the history: the log, the figure, the animation, the metrics."""
    outcome = solved.outcome
    diverged = torch.where(outcome.diverged_at < 0, torch.inf, outcome.diverged_at * solved.title.dt)
    log_diverged(_log, solved.starts, diverged, "; its weights are frozen from there on")
    write_animation(cfg, out, "chase", lambda: chase_scene(chase_problem(cfg), outcome.drawn))
    if draws(cfg.figures):
        out.figure("gradient_chase", images(draw_chase(ChaseHistory(**outcome.drawn, units=solved.units))))
    _summarise(solved.title, outcome.metrics)
    return out.metrics(solved.metrics)


def _times(title: Title) -> np.ndarray:
    return np.arange(title.times) * title.dt


def _summarise(title: Title, metrics: dict[str, float | None]) -> None:
    def show(name: str) -> str:
        return significant(metrics[name], 4)

    about = trajectories(title.rows), title.times, title.dt, title.method
    _log.info("Gradient chase: %s, %d times, dt = %g s, %s", *about)
    if metrics["ultimate_error"] is None:
        end, first = (title.times - 1) * title.dt, f"settle_time = {title.settle_time:g} s"
        ends = f"the run ends at {end:g} s, and metrics begin at {first}: give `settle_time=...`"
        why = ends if end < title.settle_time else f"no trajectory is finite at a time t >= {first}"
        _log.warning("nothing to report: %s", why)
    row = "  %-22s %12s %12s %12s"
    _log.info(row, f"worst, t >= {title.settle_time:g} s", "corrected", "before", "ideal weights")
    names = ("ultimate_error", "ultimate_error_before", "floor_error")
    _log.info(row, "error at the state", *map(show, names))
    ideal = "-" if metrics["ultimate_excess"] is None else "0"
    _log.info(row, "excess F(a) - F(w)", *map(show, ("ultimate_excess", "ultimate_excess_before")), ideal)
    _log.info("  error on the ball %s, gradient error %s", show("ball_error"), show("gradient_error"))
    time = metrics["settling_time"]
    since = "at all times" if time == 0 else f"from {show('settling_time')} s on"
    excess = f"excess {since} at most {show('ultimate_excess')}"
    _log.info(
        "  condition number %s, %s, contraction violations %s, diverged %s",
        *(show("condition_number"), "excess not known" if time is None else excess),
        *map(show, ("contraction_violations", "diverged_fraction")),
    )

"""The paper's simulation: chase the ideal weights along uncontrolled trajectories."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from omegaconf import DictConfig

from .._checks import COMMAND_LINE, flag
from ..report import HistoryWriter, write_metrics
from .build import ChaseProblem, Parts, chase_problem
from .chase_batch import Outcome, simulate
from .progress import Progress

_log = logging.getLogger(__name__)
_NAMED = 20  # diverged trajectories that the log lists by number

BATCHABLE = frozenset(
    {
        *("seed", "initial_state", "spread", "trajectories", "dt", "duration", "settle_time"),
        *("centers.radius", "centers.shrink.offset", "centers.shrink.gain"),
        *("kernel.width", "kernel.length_scale", "kernel.alpha", "kernel.bias"),
        *("target.matrix", "target.frequency", "target.phase"),
        *("optimizer.step", "optimizer.momentum"),
    }
)
"""Settings whose numbers may differ within a tensor batch; see `shape` for dt and duration."""


def shape(settings: Mapping[str, object]) -> object:
    """What follows from batchable settings and must be equal all the same: the number of steps."""
    dt, duration = settings["dt"], settings["duration"]
    if not isinstance(dt, int | float) or not isinstance(duration, int | float) or dt <= 0:
        return "none"
    ratio = duration / dt
    return math.floor(ratio + 1e-9) if math.isfinite(ratio) else "none"


@dataclasses.dataclass(frozen=True)
class Title:
    """A problem in a few words, for the log."""

    rows: int
    times: int
    dt: float
    settle_time: float
    method: str

    @classmethod
    def of(cls, problem: ChaseProblem) -> Title:
        predictor = problem.predictor
        method = (
            f"{problem.basis.count} centers, {type(problem.basis.kernel).__name__}, "
            f"{type(problem.law).__name__} x {problem.inner_steps}"
            + ("" if predictor is None else f", {type(predictor).__name__.lower()} predictor")
        )
        batch = len(problem.initial_states)
        return cls(batch, problem.steps + 1, problem.dt, problem.settle_time, method)


@dataclasses.dataclass(frozen=True)
class Solved:
    """A problem that has been solved and has left nothing on disk yet. It can be pickled."""

    title: Title
    outcome: Outcome
    starts: list[list[float]]  # initial states, (B, n)
    history: dict[str, np.ndarray] | None = None  # name -> (B, T, ...)
    warnings: tuple[str, ...] = ()

    @property
    def metrics(self) -> dict[str, float | None]:
        """What `metrics.json` will hold."""
        return self.outcome.metrics


def run(cfg: DictConfig, directory: Path) -> dict[str, float | None]:
    """Run what the settings describe and fill the run directory; `metrics.json` comes last.

    `write` of what `solve_members` gives, but that the history goes to disk as it arises.
    """
    problem = chase_problem(cfg)
    figures, history = _wanted(cfg)
    batch, times = problem.initial_states.shape[0], problem.steps + 1
    with contextlib.ExitStack() as stack:
        writer = None
        if history:
            writer = stack.enter_context(HistoryWriter(directory / "history.npz", batch, times))
        outcome = solve(problem, writer, drawn=figures)
        if writer is not None:
            writer.close(time=_times(Title.of(problem)))
    return _finish(directory, Solved(Title.of(problem), outcome, problem.initial_states.tolist()))


def solve(
    problem: ChaseProblem,
    writer: HistoryWriter | None = None,
    progress: Progress | None = None,
    *,
    drawn: bool = True,
) -> Outcome:
    """The simulation itself, in pieces of time."""
    progress = Progress(problem.steps + 1, "times") if progress is None else progress
    (outcome,) = simulate([problem], [None if writer is None else writer.add], [drawn], progress)
    progress.close()
    return outcome


def solve_members(cfgs: Sequence[DictConfig]) -> list[Solved | Exception]:
    """Several configurations of one group as one tensor batch.

    Returns:
        In their order; an exception in the place of one whose settings break a rule.

    Raises:
        Exception: what stops the batch as a whole.
    """
    parts = Parts()
    prepared = [_prepared(cfg, parts) for cfg in cfgs]
    ready = [member for member in prepared if isinstance(member, _Ready)]
    common: list[str] = []
    outcomes: list[Outcome] = []
    if ready:
        with _recorded(common):
            outcomes = simulate(
                [member.problem for member in ready],
                [None if member.memory is None else member.memory.add for member in ready],
                [member.figures for member in ready],
            )
    left = iter(outcomes)
    return [
        member.solved(next(left), common) if isinstance(member, _Ready) else member for member in prepared
    ]


def write(cfg: DictConfig, directory: Path, solved: Solved) -> dict[str, float | None]:
    """Fill the run directory with what was solved; `metrics.json` comes last."""
    for message in solved.warnings:
        warnings.warn(message, stacklevel=2)
    if solved.history is not None:
        title = solved.title
        with HistoryWriter(directory / "history.npz", title.rows, title.times) as writer:
            writer.add(solved.history)
            writer.close(time=_times(title))
    return _finish(directory, solved)


def size(settings: Mapping[str, object]) -> int:
    """About how many bytes a member keeps until it is written."""
    rows, times = settings.get("trajectories"), shape(settings)
    count = settings.get("centers.count")
    start = settings.get("initial_state")
    if not isinstance(rows, int) or not isinstance(times, int):
        return 0  # it will be refused
    n, m = len(start) if isinstance(start, list) else 2, count if isinstance(count, int) else 12
    kept = n + 4 + 2 * m if settings.get("history") else 1
    return 8 * times * (rows * kept + (n + 5 + 2 * m))


@dataclasses.dataclass(frozen=True)
class _Ready:
    """A member of a batch before it is solved."""

    problem: ChaseProblem
    figures: bool
    memory: _Memory | None  # takes the history; None where nobody wants it
    warnings: list[str]

    def solved(self, outcome: Outcome, common: Sequence[str]) -> Solved:
        """With what the whole batch was warned of."""
        told = dict.fromkeys([*self.warnings, *common, *outcome.warnings])
        history = None if self.memory is None else self.memory.arrays
        starts = self.problem.initial_states.tolist()
        return Solved(Title.of(self.problem), outcome, starts, history, tuple(told))


def _prepared(cfg: DictConfig, parts: Parts) -> _Ready | Exception:
    said: list[str] = []
    try:
        with _recorded(said):
            problem = chase_problem(cfg, parts)
            figures, history = _wanted(cfg)
    except Exception as error:  # of this member alone
        return error
    memory = _Memory(len(problem.initial_states), problem.steps + 1) if history else None
    return _Ready(problem, figures, memory, said)


@contextlib.contextmanager
def _recorded(messages: list[str]) -> Iterator[None]:
    """Warnings go to the list."""
    with warnings.catch_warnings(record=True) as given:
        warnings.simplefilter("always")
        yield
    messages += [str(warning.message) for warning in given]


class _Memory:
    """A history kept in memory."""

    def __init__(self, batch: int, times: int) -> None:
        self._shape, self._done = (batch, times), 0
        self.arrays: dict[str, np.ndarray] = {}

    def add(self, pieces: Mapping[str, np.ndarray]) -> None:
        length = 0
        for name, piece in pieces.items():
            length = piece.shape[1]
            if name not in self.arrays:
                self.arrays[name] = np.empty((*self._shape, *piece.shape[2:]), piece.dtype)
            self.arrays[name][:, self._done : self._done + length] = piece
        self._done += length


def _wanted(cfg: DictConfig) -> tuple[bool, bool]:
    return flag(COMMAND_LINE, "figures", cfg.figures), flag(COMMAND_LINE, "history", cfg.history)


def _finish(directory: Path, solved: Solved) -> dict[str, float | None]:
    """What follows the history: the log, the figure, the metrics."""
    outcome = solved.outcome
    _name_the_diverged(solved)
    if outcome.drawn:
        _draw(outcome, directory)
    _summarise(solved.title, outcome.metrics)
    write_metrics(directory / "metrics.json", outcome.metrics)
    return outcome.metrics


def _times(title: Title) -> np.ndarray:
    return np.arange(title.times) * title.dt


def _name_the_diverged(solved: Solved) -> None:
    rows = (solved.outcome.diverged_at >= 0).nonzero().flatten().tolist()
    for row in rows[:_NAMED]:
        _log.warning(
            "trajectory %d from %s diverged at t = %.6g s; its weights are frozen from there on",
            row,
            solved.starts[row],
            float(solved.outcome.diverged_at[row]) * solved.title.dt,
        )
    if len(rows) > _NAMED:
        _log.warning("and %d more trajectories diverged", len(rows) - _NAMED)


def _summarise(title: Title, metrics: dict[str, float | None]) -> None:
    def show(name: str) -> str:
        number = metrics[name]
        return "-" if number is None else f"{number:.4g}"

    _log.info(
        "Gradient chase: %d %s, %d times, dt = %g s, %s",
        title.rows,
        "trajectory" if title.rows == 1 else "trajectories",
        title.times,
        title.dt,
        title.method,
    )
    if metrics["ultimate_error"] is None:
        _log.warning("nothing to report: %s", _why_nothing(title))
    row = "  %-22s %12s %12s %12s"
    _log.info(row, f"worst, t >= {title.settle_time:g} s", "corrected", "before", "ideal weights")
    names = ("ultimate_error", "ultimate_error_before", "floor_error")
    _log.info(row, "error at the state", *map(show, names))
    ideal = "-" if metrics["ultimate_excess"] is None else "0"
    _log.info(row, "excess F(a) - F(w)", *map(show, ("ultimate_excess", "ultimate_excess_before")), ideal)
    _log.info("  error on the ball %s, gradient error %s", show("ball_error"), show("gradient_error"))
    _log.info(
        "  condition number %s, settled after %s s, contraction violations %s, diverged %s",
        *map(show, ("condition_number", "settling_time")),
        *map(show, ("contraction_violations", "diverged_fraction")),
    )


def _why_nothing(title: Title) -> str:
    end = (title.times - 1) * title.dt
    if end < title.settle_time:
        return f"the run ends at {end:g} s, and metrics begin at settle_time = {title.settle_time:g} s"
    return f"no trajectory is finite at a time t >= settle_time = {title.settle_time:g} s"


def _draw(outcome: Outcome, directory: Path) -> None:
    # Imported here: matplotlib takes a second, which figures=false need not pay.
    from ..report import plots

    folder = directory / "figures"
    folder.mkdir(exist_ok=True)
    plots.save(plots.draw_chase(plots.ChaseHistory(**outcome.drawn)), folder / "gradient_chase")

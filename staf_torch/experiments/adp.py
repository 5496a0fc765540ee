"""Optimal regulation: the paper's actor-critic, or a policy to compare it with, in closed loop."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from omegaconf import DictConfig
from torch import Tensor

from ..adp import LoopResult
from ..adp_metrics import adp_metrics
from ..report import HistoryWriter, write_metrics
from .adp_batch import simulate_together
from .build_adp import AdpProblem, adp_problem
from .optimum import Reference, compare
from .progress import Progress

_log = logging.getLogger(__name__)
_NAMED = 20  # diverged trajectories that the log lists by number


_GAINS = (
    *("critic", "critic_extrapolated", "actor", "actor_decay", "forgetting", "normalisation"),
    *("information", "information_extrapolated"),
)
BATCHABLE = frozenset(
    {"seed", "initial_state", "spread", "adp.critic", "adp.actor", "adp.gain"}
    | {f"adp.gains.{name}" for name in _GAINS}
)
"""Settings whose numbers may differ within a tensor batch."""


def shape(settings: Mapping[str, object]) -> object:
    """Nothing more follows from batchable settings."""
    return None


def size(settings: Mapping[str, object]) -> int:
    """About how many bytes a member keeps until it is written: no more than 200 000 states are recorded."""
    rows, dt, duration = (settings.get(name) for name in ("trajectories", "dt", "duration"))
    if not all(isinstance(number, int | float) and number > 0 for number in (rows, dt, duration)):
        return 0  # it will be refused
    return int(8 * 40 * min(rows * duration / dt, 2e5))  # type: ignore[operator]


@dataclasses.dataclass(frozen=True)
class Solved:
    """A closed loop that has been run and has left nothing on disk yet. It can be pickled."""

    result: LoopResult
    optimum: Reference
    method: str  # plant and policy, for the log
    dt: float  # s
    steps: int
    metrics: dict[str, float | None]  # what `metrics.json` will hold


def run(cfg: DictConfig, directory: Path) -> dict[str, float | None]:
    """Run what the settings describe and fill the run directory; `metrics.json` comes last."""
    problem = adp_problem(cfg)
    return write(cfg, directory, _solved(cfg, problem, solve(problem)))


def solve_members(cfgs: Sequence[DictConfig]) -> list[Solved | Exception]:
    """Several configurations of one group as one tensor batch.

    Returns:
        In their order; an exception in the place of one whose settings break a rule.

    Raises:
        Exception: what stops the batch as a whole.
    """
    prepared = [_prepared(cfg) for cfg in cfgs]
    problems = [problem for problem in prepared if isinstance(problem, AdpProblem)]
    results = iter(simulate_together(problems) if problems else ())
    return [
        _solved(cfg, problem, next(results)) if isinstance(problem, AdpProblem) else problem
        for cfg, problem in zip(cfgs, prepared, strict=True)
    ]


def _prepared(cfg: DictConfig) -> AdpProblem | Exception:
    try:
        return adp_problem(cfg)
    except Exception as error:  # of this member alone
        return error


def _solved(cfg: DictConfig, problem: AdpProblem, result: LoopResult) -> Solved:
    optimum = compare(problem, result)
    metrics = adp_metrics(
        result,
        optimal_cost=optimum.cost,
        control_error=optimum.control_error,
        value_error=optimum.value_error,
    )
    policy = f"{cfg.adp.law} actor-critic" if cfg.adp.policy == "actor_critic" else cfg.adp.policy
    method = f"{type(problem.system).__name__} with {policy}"
    return Solved(result, optimum, method, problem.dt, problem.steps, metrics)


def write(cfg: DictConfig, directory: Path, solved: Solved) -> dict[str, float | None]:
    """Fill the run directory with what was solved; `metrics.json` comes last."""
    if cfg.history:
        write_history(directory / "history.npz", solved.result)
    name_the_diverged(solved.result)
    if cfg.figures:
        _draw(solved.result, solved.optimum, directory / "figures", cfg.task)
    _summarise(solved)
    write_metrics(directory / "metrics.json", solved.metrics)
    return solved.metrics


def solve(problem: AdpProblem) -> LoopResult:
    """The closed loop."""
    progress = Progress(problem.steps, "steps")
    (result,) = simulate_together([problem], progress.advance)
    progress.close()
    return result


def write_history(path: Path, result: LoopResult) -> None:
    """`history.npz`: time (T,), and (B, T, ...) arrays of everything recorded."""
    batch, times = result.state.shape[:2]
    with HistoryWriter(path, batch, times) as writer:
        names = ("state", "control", "actor_weights", "critic_weights", "running_cost")
        writer.add({name: getattr(result, name).cpu().numpy() for name in names})
        writer.close(time=result.time.numpy())


def name_the_diverged(result: LoopResult) -> None:
    """One warning a diverged trajectory, up to a number of them."""
    rows = result.diverged.nonzero().flatten().tolist()
    for row in rows[:_NAMED]:
        start = [round(v, 6) for v in result.state[row, 0].tolist()]
        _log.warning("trajectory %d from %s diverged at t = %.6g s", row, start, float(result.frozen_at[row]))
    if len(rows) > _NAMED:
        _log.warning("and %d more trajectories diverged", len(rows) - _NAMED)


def _summarise(solved: Solved) -> None:
    def show(name: str) -> str:
        number = solved.metrics[name]
        return "-" if number is None else f"{number:.5g}"

    batch = len(solved.result.state)
    _log.info(
        "Closed loop: %s, %d %s, %g s in steps of %g s",
        solved.method,
        batch,
        "trajectory" if batch == 1 else "trajectories",
        solved.steps * solved.dt,
        solved.dt,
    )
    _log.info("  cost %s, optimal %s, ratio %s", *map(show, ("cost", "optimal_cost", "cost_ratio")))
    _log.info("  second half: |u - u*| <= %s, |V - V^| <= %s", *map(show, ("control_error", "value_error")))
    names = ("final_state_norm", "regulated_fraction", "diverged_fraction")
    _log.info("  final |x| %s, regulated %s, diverged %s", *map(show, names))


def _draw(result: LoopResult, optimum: Reference, folder: Path, name: str) -> None:
    # Imported here: matplotlib takes a second, which figures=false need not pay.
    from ..report import plots, plots_adp

    def first(rows: Tensor | None) -> np.ndarray | None:
        return None if rows is None else rows[0].cpu().numpy()

    history = plots_adp.AdpHistory(
        time=result.time.numpy(),
        state=result.state[0].cpu().numpy(),
        control=result.control[0].cpu().numpy(),
        actor_weights=result.actor_weights[0].cpu().numpy(),
        critic_weights=result.critic_weights[0].cpu().numpy(),
        running_cost=result.running_cost[0].cpu().numpy(),
        control_error=first(optimum.control_error),
        value_error=first(optimum.value_error),
        optimal_cost=None if optimum.cost is None else float(optimum.cost[0]),
    )
    folder.mkdir(exist_ok=True)
    plots.save(plots_adp.draw_adp(history), folder / name)

"""Optimal regulation: the paper's actor-critic, or a policy to compare it with, in closed loop."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
from omegaconf import DictConfig
from torch import Tensor

from ..adp import LoopResult, simulate
from ..adp_metrics import adp_metrics
from ..report import HistoryWriter, write_metrics
from .build_adp import AdpProblem, adp_problem
from .optimum import Reference, compare
from .progress import Progress

_log = logging.getLogger(__name__)
_NAMED = 20  # diverged trajectories that the log lists by number


def run(cfg: DictConfig, directory: Path) -> dict[str, float | None]:
    """Run what the settings describe and fill the run directory; `metrics.json` comes last."""
    problem = adp_problem(cfg)
    result = solve(problem)
    optimum = compare(problem, result)
    metrics = adp_metrics(
        result,
        optimal_cost=optimum.cost,
        control_error=optimum.control_error,
        value_error=optimum.value_error,
    )
    if cfg.history:
        write_history(directory / "history.npz", result)
    name_the_diverged(problem, result)
    if cfg.figures:
        _draw(result, optimum, directory / "figures", cfg.task)
    _summarise(cfg, problem, metrics)
    write_metrics(directory / "metrics.json", metrics)
    return metrics


def solve(problem: AdpProblem) -> LoopResult:
    """The closed loop."""
    progress = Progress(problem.steps, "steps")
    result = simulate(
        problem.controller,
        problem.system,
        problem.cost,
        problem.initial_states,
        dt=problem.dt,
        steps=problem.steps,
        every=problem.every,
        seed=problem.seed,
        integrator=problem.integrator,
        compile=problem.compile,
        progress=progress.advance,
    )
    progress.close()
    return result


def write_history(path: Path, result: LoopResult) -> None:
    """`history.npz`: time (T,), and (B, T, ...) arrays of everything recorded."""
    batch, times = result.state.shape[:2]
    with HistoryWriter(path, batch, times) as writer:
        names = ("state", "control", "actor_weights", "critic_weights", "running_cost")
        writer.add({name: getattr(result, name).cpu().numpy() for name in names})
        writer.close(time=result.time.numpy())


def name_the_diverged(problem: AdpProblem, result: LoopResult) -> None:
    """One warning a diverged trajectory, up to a number of them."""
    rows = result.diverged.nonzero().flatten().tolist()
    for row in rows[:_NAMED]:
        start = [round(v, 6) for v in problem.initial_states[row].tolist()]
        _log.warning("trajectory %d from %s diverged at t = %.6g s", row, start, float(result.frozen_at[row]))
    if len(rows) > _NAMED:
        _log.warning("and %d more trajectories diverged", len(rows) - _NAMED)


def _summarise(cfg: DictConfig, problem: AdpProblem, metrics: dict[str, float | None]) -> None:
    def show(name: str) -> str:
        number = metrics[name]
        return "-" if number is None else f"{number:.5g}"

    policy = f"{cfg.adp.law} actor-critic" if cfg.adp.policy == "actor_critic" else cfg.adp.policy
    batch = len(problem.initial_states)
    _log.info(
        "Closed loop: %s with %s, %d %s, %g s in steps of %g s",
        type(problem.system).__name__,
        policy,
        batch,
        "trajectory" if batch == 1 else "trajectories",
        problem.steps * problem.dt,
        problem.dt,
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

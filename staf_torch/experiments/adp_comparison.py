"""Every method on the same initial states, a row a method, and every law from the same initial weights."""

from __future__ import annotations

import logging
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig, open_dict
from torch import Tensor

from ..adp import Controller, Feedback, LoopResult, RolloutPolicy
from ..adp.loop.simulation import AdpProblem
from ..adp.planning.shooting.reference_optimum import optimal_cost
from ..figures.closed_loop import draw_comparison, draw_initial_weights
from ..figures.style import draws, images
from ..metrics.closed_loop import comparison_row, regulated
from ..numerics.checks import COMMAND_LINE, fail, positive_real, vector
from ..results.run_directory import RunDirectory
from ..settings.adp import adp_problem, changed
from ..settings.chase import plain
from ..signs import SHOWN, Progress
from ..tables import Table
from .adp import learner, solve
from .registry import Metrics
from .study import Study, histories, label_key

_log = logging.getLogger(__name__)
_FIXED = {"extrapolated_around": "origin", "half_width": {"radius": 1.0, "offset": None}, "trust": None}
_ROWS: dict[str, dict[str, Any]] = {
    "StaF, as published, 1 ms": {"law": "published", "integrator": "euler", "trust": None},
    "StaF, information form": {"trust": None},
    "StaF, information, quadrature": {"trust": None, "extrapolation": "quadrature"},
    "StaF, information, supervised": {},
    "StaF, points in a fixed box": _FIXED,
    "global quadratic, points around x": {"basis": "quadratic", "trust": None},
    "global quadratic, fixed box": {"basis": "quadratic"} | _FIXED,
    "RBF grid, points around x": {"basis": "rbf_grid", "trust": None},
    "RBF grid, fixed box": {"basis": "rbf_grid"} | _FIXED,
    "StaF, no learning": {"policy": "none", "trust": None},
    "LQR": {"policy": "lqr"},
    "rollout policy": {"policy": "rollout"},
}
_LAWS: dict[str, dict[str, Any]] = {
    "published": {"law": "published", "integrator": "euler", "trust": None},
    "information": {"law": "information", "trust": None},
    "supervised": {"law": "information"},
}
_PUBLISHED_STEP = 0.001  # s
_COLUMNS = {
    "method": "method",
    "functions": "basis functions",
    "points": "points a step",
    "ratio_median": "J/J* median",
    "ratio_mean": "mean",
    "ratio_max": "max",
    "regulated": "regulated",
    "diverged": "diverged",
    "final_state_norm": "median final norm",
    "microseconds": "us a step and row",
}


def run(cfg: DictConfig, directory: Path, progress: Progress = SHOWN) -> Metrics:
    """Run every method and fill the run directory; `metrics.json` comes last."""
    study = Study("comparison", _COLUMNS, ("ratio_median", "ratio_max", "regulated"), _log, digits=4)
    ratios: dict[str, np.ndarray] = {}
    best: Tensor | None = None
    for name, changes in _ROWS.items():
        problem = variant(cfg, changes)
        best = _optimum(problem) if best is None else best  # the initial states are the same for all
        start = time.perf_counter()
        result = solve(problem, progress)
        seconds = (time.perf_counter() - start) / (problem.steps * len(problem.initial_states))
        ratio = torch.where(result.diverged, torch.inf, result.cost / best)
        functions, points = _size(problem.controller)
        final = _final(problem, result)
        row = {"functions": functions, "points": points} | comparison_row(result, ratio, final)
        study.add(f"{label_key(name)}_", row, {"microseconds": 1e6 * seconds}, method=name)
        ratios[name] = torch.where(regulated(result, final), ratio, torch.inf).cpu().numpy()
    return study.write(cfg, RunDirectory(directory), lambda: draw_comparison(ratios), "adp_comparison")


def held(cfg: DictConfig) -> dict[str, Tensor]:
    """Return what a run keeps of the rows of every method."""
    return histories({name: solve(variant(cfg, changes)) for name, changes in _ROWS.items()})


run.held = held  # type: ignore[attr-defined]


def variant(cfg: DictConfig, changes: dict[str, Any]) -> AdpProblem:
    """The closed loop of the settings with other ones under `adp`, recorded at its ends."""
    chosen = changed(cfg, changes)
    with open_dict(chosen):
        if changes.get("law") == "published":
            chosen.dt = min(cfg.dt, _PUBLISHED_STEP)  # its own step: Euler fails sooner at a longer one
        if chosen.adp.record_every is None:
            chosen.adp.record_every = round(cfg.duration / chosen.dt)  # the ends are enough for a table
        if changes.get("policy") == "rollout":
            chosen.adp.record_every = 1
        chosen.trajectories = cfg.trajectories + 1
    problem = adp_problem(chosen)
    # The first state is the middle of the box, the equilibrium: nothing can be compared there.
    return problem.with_states(problem.initial_states[1:])


def _final(problem: AdpProblem, result: LoopResult) -> Tensor:
    """The states at the end, measured from the set-point, (B, n)."""
    return problem.cost.around(problem.system).deviation(result.state[:, -1])


def _optimum(problem: AdpProblem) -> Tensor:
    best = optimal_cost(problem)
    if best is None:
        raise ValueError(
            "`experiment=adp_comparison` needs a plant whose optimum is known, or can be found by direct "
            f"shooting (adp.optimum.shooting); got {type(problem.system).__name__}."
        )
    return best


def _size(controller: Controller) -> tuple[int, int]:
    """Basis functions, and states of the model asked a step."""
    learning = learner(controller)
    if learning is not None:
        return learning.basis.count, learning.extrapolation.count
    if isinstance(controller, Feedback) and isinstance(controller.policy, RolloutPolicy):
        policy = controller.policy
        return policy.basis.count, policy.basis.count * policy.steps
    return 0, 0


def initial_weights(cfg: DictConfig, directory: Path, progress: Progress = SHOWN) -> Metrics:
    """Run every law from every pair of weights and state: a row a law; `metrics.json` comes last."""
    weights = _weights(cfg)
    headings = [*(f"W0 = {w:g}" for w in weights), "all"]
    metrics: Metrics = {}
    table: list[dict[str, str]] = []
    found: dict[str, list[float]] = {}
    for name, changes in _LAWS.items():
        problem = _from_weights(cfg, changes, weights)
        result = solve(problem, progress)
        shares = (
            regulated(result, _final(problem, result)).double().reshape(len(weights), -1).mean(-1).tolist()
        )
        found[name] = shares
        overall, diverged = sum(shares) / len(shares), float(result.diverged.double().mean())
        metrics |= {f"{name}_regulated_W{w:g}": share for w, share in zip(weights, shares, strict=True)}
        metrics |= {f"{name}_regulated_fraction": overall, f"{name}_diverged_fraction": diverged}
        shown = zip(headings, [*shares, overall], strict=True)
        table.append({"law": name} | {heading: f"{share:.4g}" for heading, share in shown})
        _log.info(
            "%-12s regulated %.4g of all, %.4g at the worst W0, diverged %.4g",
            *(name, overall, min(shares), diverged),
        )
    out = RunDirectory(directory)
    out.table(cfg.task, Table.of(table))
    if draws(cfg.figures):
        out.figure(cfg.task, images(draw_initial_weights(weights, found)))
    return out.metrics(metrics)


def held_of_weights(cfg: DictConfig) -> dict[str, Tensor]:
    """Return what a run keeps of the rows of every law."""
    weights = _weights(cfg)
    return histories({name: solve(_from_weights(cfg, each, weights)) for name, each in _LAWS.items()})


initial_weights.held = held_of_weights  # type: ignore[attr-defined]


def _weights(cfg: DictConfig) -> list[float]:
    weights = vector(COMMAND_LINE, "initial_weights", plain(cfg.initial_weights))
    if not weights:
        raise fail(COMMAND_LINE, "initial_weights", "must have at least one entry", weights)
    for name in ("critic", "actor"):
        positive_real(COMMAND_LINE, f"adp.{name}", cfg.adp[name])
    return weights


def _from_weights(cfg: DictConfig, changes: dict[str, Any], weights: list[float]) -> AdpProblem:
    """Every initial state once with every weight, one batch."""
    problem, actor = variant(cfg, changes), cfg.adp.actor / cfg.adp.critic
    x0, learning = problem.initial_states, learner(problem.controller)
    assert learning is not None
    critic: Tensor = torch.tensor(weights, device="cpu").to(x0).repeat_interleave(len(x0)).unsqueeze(-1)
    learning.critic = critic.expand(-1, learning.basis.count)
    learning.actor = actor * learning.critic
    return problem.with_states(x0.repeat(len(weights), 1))

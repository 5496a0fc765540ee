"""Every method on the same initial states: one table, a row a method, and one figure."""

from __future__ import annotations

import csv
import io
import logging
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf, open_dict
from torch import Tensor

from ..adp import ActorCritic, Feedback, LoopResult, RolloutPolicy, Supervised
from ..adp_metrics import comparison_row, regulated
from ..report import write_metrics, write_text
from .adp import solve
from .build_adp import AdpProblem, adp_problem
from .optimum import optimal_cost

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


def run(cfg: DictConfig, directory: Path) -> dict[str, float | None]:
    """Run every method and fill the run directory; `metrics.json` comes last."""
    rows: list[dict[str, Any]] = []
    ratios: dict[str, Tensor] = {}
    best: Tensor | None = None
    for name, problem in methods(cfg):
        best = _optimum(problem) if best is None else best  # the initial states are the same for all
        start = time.perf_counter()
        result = solve(problem)
        seconds = (time.perf_counter() - start) / (problem.steps * len(problem.initial_states))
        row, ratio = _row(problem, result, best)
        row |= {"method": name, "microseconds": 1e6 * seconds}
        rows.append(row)
        ratios[name] = ratio
        shown = ("ratio_median", "ratio_max", "regulated")
        numbers = ["-" if row[key] is None else f"{row[key]:.4g}" for key in shown]
        _log.info("%-34s J/J* median %s, max %s, regulated %s", name, *numbers)
    _write_table(directory, rows)
    if cfg.figures:
        _draw(ratios, directory / "figures")
    metrics = {
        f"{_slug(row['method'])}_{key}": value
        for row in rows
        for key, value in row.items()
        if key not in ("method", "microseconds")
    }
    write_metrics(directory / "metrics.json", metrics)
    return metrics


def methods(cfg: DictConfig) -> Iterator[tuple[str, AdpProblem]]:
    """Name and closed loop of every row of the table."""
    for name, changes in _ROWS.items():
        yield name, variant(cfg, changes)


def variant(cfg: DictConfig, changes: dict[str, Any]) -> AdpProblem:
    """The closed loop of the settings with other ones under `adp`, recorded at its ends."""
    changed = cfg.copy()
    with open_dict(changed):
        changed.adp = OmegaConf.merge(cfg.adp, changes)
        if changes.get("law") == "published":
            changed.dt = min(cfg.dt, _PUBLISHED_STEP)  # its own step: Euler fails sooner at a longer one
        if changed.adp.record_every is None:
            changed.adp.record_every = round(cfg.duration / changed.dt)  # the ends are enough for a table
        if changes.get("policy") == "rollout":
            changed.adp.record_every = 1
        changed.trajectories = cfg.trajectories + 1
    problem = adp_problem(changed)
    # The first state is the middle of the box, the equilibrium: nothing can be compared there.
    return problem.with_states(problem.initial_states[1:])


def _optimum(problem: AdpProblem) -> Tensor:
    best = optimal_cost(problem)
    if best is None:
        raise ValueError(
            "`experiment=adp_comparison` needs a plant whose optimum is known, or can be found by direct "
            f"shooting (adp.optimum.shooting); got {type(problem.system).__name__}."
        )
    return best


def _row(problem: AdpProblem, result: LoopResult, best: Tensor) -> tuple[dict[str, Any], Tensor]:
    ratio = torch.where(result.diverged, torch.inf, result.cost / best)
    functions, points = _size(problem.controller)
    row = {"functions": functions, "points": points} | comparison_row(result, ratio)
    return row, torch.where(regulated(result), ratio, torch.inf)


def _size(controller: object) -> tuple[int, int]:
    """Basis functions, and states of the model asked a step."""
    if isinstance(controller, Supervised):
        return _size(controller.controller)
    if isinstance(controller, ActorCritic):
        return controller.basis.count, controller.extrapolation.count
    if isinstance(controller, Feedback) and isinstance(controller.policy, RolloutPolicy):
        policy = controller.policy
        return policy.basis.count, policy.basis.count * policy.steps
    return 0, 0


def _write_table(directory: Path, rows: list[dict[str, Any]]) -> None:
    """`comparison.csv` with every digit, `comparison.md` to read."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(_COLUMNS), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_text(directory / "comparison.csv", text.getvalue())
    lines = ["| " + " | ".join(_COLUMNS.values()) + " |", "|---" * len(_COLUMNS) + "|"]
    lines += ["| " + " | ".join(_cell(row[key]) for key in _COLUMNS) + " |" for row in rows]
    write_text(directory / "comparison.md", "\n".join(lines) + "\n")


def _cell(value: object) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _slug(name: str) -> str:
    return "_".join(name.lower().replace(",", "").replace("-", "_").split())


def _draw(ratios: dict[str, Tensor], folder: Path) -> None:
    # Imported here: matplotlib takes a second, which figures=false need not pay.
    from ..report import plots, plots_adp

    folder.mkdir(exist_ok=True)
    values = {name: ratio.cpu().numpy() for name, ratio in ratios.items()}
    plots.save(plots_adp.draw_comparison(values), folder / "adp_comparison")

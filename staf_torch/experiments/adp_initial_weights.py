"""The share of initial states that is regulated, against the initial weights: a row a method."""

from __future__ import annotations

import csv
import io
import logging
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from .._checks import fail, positive_real, vector
from ..adp import ActorCritic, Supervised
from ..adp_metrics import regulated
from ..report import write_metrics, write_text
from .adp import solve
from .adp_comparison import variant
from .build_adp import AdpProblem

_log = logging.getLogger(__name__)
_ROWS: dict[str, dict[str, Any]] = {
    "published": {"law": "published", "integrator": "euler", "trust": None},
    "information": {"law": "information", "trust": None},
    "supervised": {"law": "information"},
}


def run(cfg: DictConfig, directory: Path) -> dict[str, float | None]:
    """Run every method from every pair of weights and state; `metrics.json` comes last."""
    weights = _weights(cfg)
    metrics: dict[str, float | None] = {}
    table: list[list[str]] = []
    for name, changes in _ROWS.items():
        problem = variant(cfg, changes)
        problem = _from_weights(problem, weights, cfg.adp.actor / cfg.adp.critic)
        result = solve(problem)
        shares = regulated(result).double().reshape(len(weights), -1).mean(-1).tolist()
        metrics |= {f"{name}_regulated_W{w:g}": share for w, share in zip(weights, shares, strict=True)}
        metrics[f"{name}_regulated_fraction"] = sum(shares) / len(shares)
        metrics[f"{name}_diverged_fraction"] = float(result.diverged.double().mean())
        table.append([name, *(f"{share:.4g}" for share in (*shares, sum(shares) / len(shares)))])
        _log.info(
            "%-12s regulated %.4g of all, %.4g at the worst W0, diverged %.4g",
            name,
            metrics[f"{name}_regulated_fraction"],
            min(shares),
            metrics[f"{name}_diverged_fraction"],
        )
    _write_table(directory / cfg.task, ["law", *(f"W0 = {w:g}" for w in weights), "all"], table)
    write_metrics(directory / "metrics.json", metrics)
    return metrics


def _weights(cfg: DictConfig) -> list[float]:
    listed: Any = (
        OmegaConf.to_container(cfg.initial_weights) if OmegaConf.is_list(cfg.initial_weights) else None
    )
    weights = vector("staf", "initial_weights", listed)
    if not weights:
        raise fail("staf", "initial_weights", "must have at least one entry", weights)
    for name in ("critic", "actor"):
        positive_real("adp", name, cfg.adp[name])
    return weights


def _from_weights(problem: AdpProblem, weights: list[float], actor: float) -> AdpProblem:
    """Every initial state once with every weight, one batch."""
    x0 = problem.initial_states
    inner = problem.controller
    learner = inner.controller if isinstance(inner, Supervised) else inner
    assert isinstance(learner, ActorCritic)
    critic: Tensor = torch.tensor(weights).to(x0).repeat_interleave(len(x0)).unsqueeze(-1)
    learner.critic = critic.expand(-1, learner.basis.count)
    learner.actor = actor * learner.critic
    return problem.with_states(x0.repeat(len(weights), 1))


def _write_table(stem: Path, head: list[str], rows: list[list[str]]) -> None:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([head, *rows])
    write_text(stem.with_suffix(".csv"), text.getvalue())
    lines = [head, ["---"] * len(head), *rows]
    write_text(stem.with_suffix(".md"), "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n")

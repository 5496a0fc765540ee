"""Memory beyond the ball: the error over the visited region, and the start at a revisit, with and without."""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from torch import Tensor

from ..centers import probe_points
from ..engine import ChaseResult
from ..figures.chase import draw_memory
from ..numerics.checks import COMMAND_LINE, fail, integer, positive_real
from ..online.experience_memory import ExperienceMemory
from ..results.run_directory import RunDirectory
from ..settings.chase import ChaseProblem, chase_problem
from ..signs import SHOWN, Progress
from ..systems import simulate
from ..tables import Table
from .chase_batch import histories
from .registry import Metrics, finite
from .study import report

_log = logging.getLogger(__name__)
_PROBES = 13  # points of the ball around each state
APPROXIMANTS = {"memory": "memory", "passing": "chase, in passing", "last": "last local model"}
STARTS = {"memory": "memory", "carried": "carried weights", "zero": "zero"}


def run(cfg: DictConfig, directory: Path, progress: Progress = SHOWN) -> Metrics:
    """Run what the settings describe and fill the run directory; `metrics.json` comes last."""
    problem, settings = chase_problem(cfg), settings_of(cfg)
    first = round(problem.settle_time / problem.dt)
    if not 0 <= first < problem.steps:
        raise fail(COMMAND_LINE, "settle_time", "must lie within the duration", problem.settle_time)
    states = simulate(problem.system, problem.initial_states, dt=problem.dt, steps=problem.steps)
    found = problem.chase(states)
    models = problem.basis.local(states).coefficients(found.weights)
    memory = ExperienceMemory(
        *(problem.basis, settings["capacity"], (len(states),)),
        reach=settings["reach"],
        spacing=settings["spacing"],
    ).to(states)
    for k in progress.each(range(first, states.shape[1]), "times"):
        memory.add(states[:, k], models[:, k])
    count = settings["states"]
    index = first + (torch.arange(count, device="cpu") * (problem.steps - first)) // count
    index = index.unique()
    over = errors(problem, memory, states, models, index)
    settled = found.excess[:, first:].amax(-1)  # (B,)
    excess = revisits(problem, settings, memory, found, first)
    metrics = summary(memory, over, excess, settled)
    stored = memory.states[0][memory.stored[0]]
    drawing = partial(  # of the first trajectory
        draw_memory,
        path=states[0, first:].cpu().numpy(),
        stored=stored.cpu().numpy(),
        radius=memory.basis.centers.radius(stored).expand(len(stored)).cpu().numpy(),
        time=(index.to(states) * problem.dt).cpu().numpy(),
        errors={APPROXIMANTS[k]: v[0].amax(-1).cpu().numpy() for k, v in over.items()},
        excess={STARTS[k]: v[0].amax(0).cpu().numpy() for k, v in excess.items()},
        settled=float(settled[0]),
    )
    shown, out = _shown(metrics), RunDirectory(directory)
    report(cfg, out, _log, "memory", Table.of([metrics]), drawing, shown=shown)
    return out.metrics(metrics)


def held(cfg: DictConfig) -> dict[str, Tensor]:
    """Return what a run keeps of its rows beside the memory, in which numbers decide."""
    settings_of(cfg)
    return histories(chase_problem(cfg))


run.held = held  # type: ignore[attr-defined]


def settings_of(cfg: DictConfig) -> dict[str, Any]:
    """The group `memory`.

    Raises:
        ValueError: if a setting breaks its rule; the message names it.
    """
    checks: dict[str, Callable[..., float]] = dict.fromkeys(
        ("capacity", "states", "revisits", "steps"), partial(integer, least=1)
    )
    checks |= dict.fromkeys(("reach", "spacing"), positive_real)
    return {name: check(COMMAND_LINE, f"memory.{name}", cfg.memory[name]) for name, check in checks.items()}


def errors(
    problem: ChaseProblem, memory: ExperienceMemory, states: Tensor, models: Tensor, index: Tensor
) -> dict[str, Tensor]:
    """Return |V - V^| of the memory (NaN where it does not reach), of passing models and of the last one over
    balls at some times: (B, K, P)."""
    x = states[:, index]
    radius = problem.basis.centers.radius(x)[..., None, None].to(x)
    z = radius * probe_points(_PROBES, x.shape[-1]).to(x)
    y = x.unsqueeze(-2) + z  # (B, K, P, n)
    truth, local = problem.target(y), problem.basis.local
    flat = y.flatten(1, 2)
    last = local(states[:, -1]).evaluate(flat - states[:, -1:], models[:, -1])
    estimates = {
        "memory": memory.query(flat).unflatten(1, y.shape[1:3]),
        "passing": local(x).evaluate(z.expand(y.shape), models[:, index]),
        "last": last.unflatten(1, y.shape[1:3]),
    }
    return {k: (v - truth).abs() for k, v in estimates.items()}


def revisits(
    problem: ChaseProblem, settings: dict[str, Any], memory: ExperienceMemory, found: ChaseResult, first: int
) -> dict[str, Tensor]:
    """The state returns to earlier ones: the excess after each step of a chase from the memory's weights,
    from the last ones, from none, (B, R, S)."""
    times, count = found.state.shape[1], settings["revisits"]
    steps = min(settings["steps"], times - first)
    at = first + (torch.arange(count, device="cpu") * (times - first - steps)) // count
    pieces = torch.stack([found.state[:, k : k + steps] for k in at.tolist()], dim=1)  # (B, R, S, n)
    x = pieces[:, :, 0]
    weights = problem.basis.local(x).weights(memory.start(x))
    chosen = {
        "memory": weights,
        "carried": found.weights[:, -1:].expand(weights.shape),
        "zero": torch.zeros_like(weights),
    }
    excess = {}
    for name, start in chosen.items():
        again = problem.chase(pieces.flatten(0, 1), start.flatten(0, 1))
        excess[name] = again.excess.unflatten(0, pieces.shape[:2])
    return excess


def summary(
    memory: ExperienceMemory, errors: dict[str, Tensor], again: dict[str, Tensor], settled: Tensor
) -> Metrics:
    """The worst over trajectories."""
    found: Metrics = {"models": float(memory.count.max())}
    found["covered_fraction"] = float((~errors["memory"].isnan()).double().mean())
    for name, error in errors.items():
        # where the memory does not reach is NaN; of the others that is an error
        covered = ~error.isnan() if name == "memory" else torch.ones_like(error, dtype=torch.bool)
        total = torch.where(covered, error.square(), 0.0).sum((1, 2)) / covered.sum((1, 2))
        found[f"{name}_rms_error"] = finite(total.sqrt().max())
        found[f"{name}_max_error"] = finite(torch.where(covered, error, 0.0).max())
    found["settled_excess"] = finite(settled.max())
    for name, excess in again.items():
        found[f"revisit_excess_{name}"] = finite(excess[..., 0].max())
        done = excess <= settled[:, None, None]
        taken = torch.where(done.any(-1), done.to(torch.int8).argmax(-1) + 1.0, torch.nan).max()
        found[f"revisit_steps_{name}"] = finite(taken)
    return found


def _shown(metrics: dict[str, float | None]) -> list[Table]:
    """Return a table of the errors over the region, and one of the revisits."""
    region = [
        {"by": label, "rms": metrics[f"{key}_rms_error"], "max": metrics[f"{key}_max_error"]}
        for key, label in APPROXIMANTS.items()
    ]
    again = [
        {"by": label, "excess": metrics[f"revisit_excess_{key}"], "steps": metrics[f"revisit_steps_{key}"]}
        for key, label in STARTS.items()
    ]
    return [
        Table.of(region, {"by": "error over the visited balls", "rms": "rms", "max": "max"}),
        Table.of(again, {"by": "start at a revisit", "excess": "excess after a step", "steps": "steps"}),
    ]

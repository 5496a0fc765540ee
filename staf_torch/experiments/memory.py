"""Memory beyond the ball: the error over the visited region, and the start at a revisit, with and without."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import NamedTuple

import torch
from omegaconf import DictConfig
from torch import Tensor

from ..centers import probe_points
from ..engine import ChaseResult
from ..figures.chase import MemoryPicture, draw_memory
from ..figures.style import draws
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


class Settings(NamedTuple):
    """The group `memory`, checked."""

    capacity: int
    reach: float
    spacing: float
    states: int
    revisits: int
    steps: int


class Region(NamedTuple):
    """Errors over the region that the settled chase visited."""

    time: Tensor  # (K,) s
    errors: dict[str, Tensor]  # approximant -> |V - V^|, (B, K, P); NaN where the memory does not reach


class Revisits(NamedTuple):
    """The chase after the state has come back."""

    excess: dict[str, Tensor]  # start -> after each step, (B, R, S)
    settled: Tensor  # the largest excess of the settled chase, (B,)


def run(cfg: DictConfig, directory: Path, progress: Progress = SHOWN) -> Metrics:
    """Run what the settings describe and fill the run directory; `metrics.json` comes last."""
    problem, settings = chase_problem(cfg), settings_of(cfg)
    figures = draws(cfg.figures)
    first = round(problem.settle_time / problem.dt)
    if not 0 <= first < problem.steps:
        raise fail(COMMAND_LINE, "settle_time", "must lie within the duration", problem.settle_time)
    states = simulate(problem.system, problem.initial_states, dt=problem.dt, steps=problem.steps)
    found = problem.chase(states)
    coefficients = problem.basis.local(states).coefficients(found.weights)
    memory = remember(problem, settings, states[:, first:], coefficients[:, first:], progress)
    index = first + (torch.arange(settings.states, device="cpu") * (problem.steps - first)) // settings.states
    region = errors(problem, memory, states, coefficients, index.unique())
    again = revisits(problem, settings, memory, found, first)
    metrics = summary(memory, region, again)
    out = RunDirectory(directory)
    picture = _picture(states[0, first:], memory, region, again)
    drawing = (lambda: draw_memory(picture)) if figures else None
    report(out, _log, "memory", Table.of([metrics]), drawing, shown=_shown(metrics))
    return out.metrics(metrics)


def held(cfg: DictConfig) -> dict[str, Tensor]:
    """Return what a run keeps of its rows beside the memory, in which numbers decide."""
    settings_of(cfg)
    return histories(chase_problem(cfg))


run.held = held  # type: ignore[attr-defined]


def settings_of(cfg: DictConfig) -> Settings:
    """The group `memory`.

    Raises:
        ValueError: if a setting breaks its rule; the message names it.
    """
    counts = ("capacity", "states", "revisits", "steps")
    checked = {name: integer(COMMAND_LINE, f"memory.{name}", cfg.memory[name], least=1) for name in counts}
    reach, spacing = (
        positive_real(COMMAND_LINE, f"memory.{name}", cfg.memory[name]) for name in ("reach", "spacing")
    )
    return Settings(reach=reach, spacing=spacing, **checked)


def remember(
    problem: ChaseProblem, settings: Settings, states: Tensor, kept: Tensor, progress: Progress = SHOWN
) -> ExperienceMemory:
    """A memory a trajectory, fed with the models (B, T, M) at the states (B, T, n) as they come."""
    memory = ExperienceMemory(
        problem.basis, settings.capacity, (len(states),), reach=settings.reach, spacing=settings.spacing
    ).to(states)
    for k in progress.each(range(states.shape[1]), "times"):
        memory.add(states[:, k], kept[:, k])
    return memory


def errors(
    problem: ChaseProblem, memory: ExperienceMemory, states: Tensor, models: Tensor, index: Tensor
) -> Region:
    """Return the errors of the memory, of passing models and of the last one over balls at some times."""
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
    return Region(index.to(x) * problem.dt, {k: (v - truth).abs() for k, v in estimates.items()})


def revisits(
    problem: ChaseProblem, settings: Settings, memory: ExperienceMemory, found: ChaseResult, first: int
) -> Revisits:
    """The state returns to earlier ones: a chase from the memory's weights, from the last ones, from none."""
    times = found.state.shape[1]
    steps = min(settings.steps, times - first)
    at = (
        first + (torch.arange(settings.revisits, device="cpu") * (times - first - steps)) // settings.revisits
    )
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
    return Revisits(excess, found.excess[:, first:].amax(-1))


def summary(memory: ExperienceMemory, region: Region, again: Revisits) -> Metrics:
    """The worst over trajectories."""
    found: Metrics = {"models": float(memory.count.max())}
    found["covered_fraction"] = float((~region.errors["memory"].isnan()).double().mean())
    for name, error in region.errors.items():
        # where the memory does not reach is NaN; of the others that is an error
        covered = ~error.isnan() if name == "memory" else torch.ones_like(error, dtype=torch.bool)
        total = torch.where(covered, error.square(), 0.0).sum((1, 2)) / covered.sum((1, 2))
        found[f"{name}_rms_error"] = finite(total.sqrt().max())
        found[f"{name}_max_error"] = finite(torch.where(covered, error, 0.0).max())
    found["settled_excess"] = finite(again.settled.max())
    for name, excess in again.excess.items():
        found[f"revisit_excess_{name}"] = finite(excess[..., 0].max())
        done = excess <= again.settled[:, None, None]
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


def _picture(path: Tensor, memory: ExperienceMemory, region: Region, again: Revisits) -> MemoryPicture:
    """The first trajectory and its memory."""
    stored = memory.states[0][memory.stored[0]]
    return MemoryPicture(
        path=path.cpu().numpy(),
        stored=stored.cpu().numpy(),
        radius=memory.basis.centers.radius(stored).expand(len(stored)).cpu().numpy(),
        time=region.time.cpu().numpy(),
        errors={APPROXIMANTS[k]: v[0].amax(-1).cpu().numpy() for k, v in region.errors.items()},
        excess={STARTS[k]: v[0].amax(0).cpu().numpy() for k, v in again.excess.items()},
        settled=float(again.settled[0]),
    )

"""A mass in the plane among moving discs: the LQR, and the LQR behind a safety filter."""

from __future__ import annotations

import logging
import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig
from torch import Tensor

from ..adp import LQR, Controller, Feedback, LoopResult, QuadraticCost, SafetyFilter, simulate
from ..adp.safety_filter import Constraint
from ..figures.animation import FRAMES, Curves, Scene, animate
from ..figures.safety import AvoidanceHistory, draw_avoidance
from ..figures.style import images
from ..metrics.safety import constraint_metrics
from ..numerics.checks import COMMAND_LINE, integer, positive_real
from ..results.progress import SHOWN, Progress
from ..results.run_directory import RunDirectory
from ..settings.adp import updated
from ..settings.chase import placement
from ..systems import ControlAffineSystem, Linear
from ..tables import Table
from ..tables.columns import significant
from .registry import Metrics, finite
from .scenes import animation_kind

_log = logging.getLogger(__name__)
_HALF_WIDTH = 2.0  # m, of the square that discs are drawn from
_CLEAR = 0.6  # m between the start and the edge of a disc at the beginning
_DRAWS = 1000  # of one scenario, until it is refused
_COLUMNS = {
    "method": "method",
    "cost": "cost, median",
    "cost_mean": "mean",
    "minimum_margin": "least distance (m)",
    "constraint_violations": "scenarios with a collision",
    "infeasible": "infeasible at a time",
}


class AmongDiscs(ControlAffineSystem):
    """A mass and discs in the plane, (p, p', c_1, c_1', ..., c_K, c_K'): p'' = u, c_k'' = 0.

    Args:
        discs: K.
    """

    inputs = 2

    def __init__(self, discs: int) -> None:
        super().__init__()
        self.dim = 4 * (1 + discs)

    def drift(self, x: Tensor) -> Tensor:
        parts = x.unflatten(-1, (-1, 2))  # p, p', c_1, c_1', ...
        moves = [
            parts[..., k + 1, :] if k % 2 == 0 else torch.zeros_like(parts[..., k, :])
            for k in range(parts.shape[-2])
        ]
        return torch.cat(moves, dim=-1)

    def effectiveness(self, x: Tensor) -> Tensor:
        g = torch.zeros(x.shape[-1], 2, dtype=x.dtype, device=x.device)
        g[2, 0] = g[3, 1] = 1.0
        return g.expand(*x.shape, 2)


def run(cfg: DictConfig, directory: Path, progress: Progress = SHOWN) -> Metrics:
    """Run both methods in every scenario and fill the run directory; `metrics.json` comes last."""
    device, dtype = placement(cfg.device, cfg.dtype)
    cfg = updated(cfg)
    chosen = cfg.avoidance
    kind = animation_kind(cfg)
    x0 = scenarios(cfg).to(device=device, dtype=dtype)
    discs, radius = (x0.shape[-1] - 4) // 4, positive_real("avoidance", "radius", chosen.radius)
    system = AmongDiscs(discs).to(device)
    dt = positive_real(COMMAND_LINE, "dt", cfg.dt)
    steps = max(1, round(positive_real(COMMAND_LINE, "duration", cfg.duration) / dt))
    bound = positive_real("avoidance", "bound", chosen.bound)
    lqr, cost = _lqr(cfg, dt, bound), _cost(cfg, system.dim or 0, bound)

    def wanted(x: Tensor) -> Tensor:
        u: Tensor = lqr(x[..., :4])
        return u

    guard = SafetyFilter(
        wanted,
        system,
        [_apart(k, radius) for k in range(discs)],
        dt=dt,
        low=-bound,
        high=bound,
        decay=positive_real("avoidance", "decay", chosen.decay),
        margin=float(chosen.margin),
    )
    methods: dict[str, Controller] = {"LQR, filtered": guard.to(device), "LQR": Feedback(wanted)}
    results: dict[str, LoopResult] = {}
    distances: dict[str, Tensor] = {}
    rows: list[dict[str, Any]] = []
    metrics: Metrics = {}
    for name, controller in methods.items():
        result = simulate(
            controller, system, cost.to(device), x0, dt=dt, steps=steps, compile=cfg.adp.compile
        )
        results[name], distances[name] = result, distance(result.state, radius)
        measured = constraint_metrics(result, distances[name])
        measured["cost"], measured["cost_mean"] = finite(result.cost.median()), finite(result.cost.mean())
        final = result.state[:, -1, :4].norm(dim=-1)
        measured["final_state_norm"] = finite(final.median())
        if controller is guard:
            report = guard.report(result)
            measured |= {"infeasible": float(len(report["infeasible"])), "acted": report["acted"]}
            for row in report["infeasible"][:20]:
                _log.info("scenario %d: at a time no admissible control met the condition", row)
        rows.append({"method": name} | measured)
        metrics |= (
            measured if controller is guard else {f"lqr_{key}": value for key, value in measured.items()}
        )
        shown = [
            significant(measured[key], 5) for key in ("cost_mean", "minimum_margin", "constraint_violations")
        ]
        _log.info("%-14s mean cost %s, least distance %s m, collisions in %s", name, *shown)
    out = RunDirectory(directory)
    told = _telling(distances)
    if cfg.history:
        arrays = {"state": results["LQR, filtered"].state, "control": results["LQR, filtered"].control}
        arrays |= {"distance": distances["LQR, filtered"], "lqr_distance": distances["LQR"]}
        arrays["running_cost"] = results["LQR, filtered"].running_cost
        with out.history(len(x0), steps + 1) as writer:
            writer.add({name: array.cpu().numpy() for name, array in arrays.items()})
            writer.close(time=results["LQR"].time.numpy())
    out.table("avoidance", Table.of(rows, _COLUMNS))
    if kind is not None:
        out.figure("avoidance", animate(_scene(results, distances, told, radius), kind))
    if cfg.figures:
        out.figure("avoidance", images(draw_avoidance(_drawn(results, distances, told, radius))))
    return out.metrics(metrics)


run.animates = True  # type: ignore[attr-defined]


def scenarios(cfg: DictConfig) -> Tensor:
    """Starts at rest on a circle and discs of constant velocities, a scenario a row: (B, 4 + 4 K).

    Raises:
        ValueError: if a setting breaks its rule, or no discs leave room for a start.
    """
    chosen = cfg.avoidance
    count, discs = (
        integer(COMMAND_LINE, "trajectories", cfg.trajectories, 1),
        integer("avoidance", "discs", chosen.discs, 1),
    )
    clear = positive_real("avoidance", "radius", chosen.radius) + _CLEAR
    away = positive_real("avoidance", "distance", chosen.distance)
    speed = positive_real("avoidance", "speed", chosen.speed)
    generator = torch.Generator().manual_seed(integer(COMMAND_LINE, "seed", cfg.seed, least=0))
    found: list[Tensor] = []
    for _ in range(_DRAWS * count):
        angle, numbers = (torch.rand(n, dtype=torch.float64, generator=generator) for n in (1, 4 * discs))
        start = away * torch.cat(((2 * math.pi * angle).cos(), (2 * math.pi * angle).sin()))
        moving = (2 * numbers - 1).reshape(discs, 4) * torch.tensor([_HALF_WIDTH] * 2 + [speed] * 2)
        if float((moving[:, :2] - start).norm(dim=-1).min()) > clear:
            found.append(torch.cat((start, torch.zeros(2, dtype=torch.float64), moving.flatten())))
        if len(found) == count:
            return torch.stack(found)
    raise ValueError(
        f"`avoidance(discs=...)` must leave room for a start; got {discs} of radius {chosen.radius}."
    )


def distance(state: Tensor, radius: float) -> Tensor:
    """From the mass to the nearest edge of a disc, m: (..., 4 + 4 K) -> (...)."""
    discs = state[..., 4:].unflatten(-1, (-1, 4))
    apart: Tensor = (state[..., None, :2] - discs[..., :2]).norm(dim=-1)
    return apart.amin(-1) - radius


def _apart(k: int, radius: float) -> Constraint:
    """|p - c_k|^2 - radius^2."""
    at = 4 + 4 * k
    return lambda x, t: (x[:, :2] - x[:, at : at + 2]).square().sum(-1) - radius**2


def _lqr(cfg: DictConfig, dt: float, bound: float) -> LQR:
    matrix, push = torch.zeros(4, 4), torch.zeros(4, 2)
    matrix[0, 2] = matrix[1, 3] = push[2, 0] = push[3, 1] = 1.0
    cost = QuadraticCost(cfg.adp.q, cfg.adp.r, 4, 2, low=-bound, high=bound)
    return LQR(Linear(matrix.tolist(), push.tolist()), cost, period=dt)


def _cost(cfg: DictConfig, dim: int, bound: float) -> QuadraticCost:
    """p'Qp and u'Ru of the mass; the discs cost nothing."""
    weights = QuadraticCost(cfg.adp.q, cfg.adp.r, 4, 2)
    state = torch.zeros(dim, dim, dtype=torch.float64)
    state[:4, :4] = weights.q
    return QuadraticCost(state, weights.r, dim, 2, low=-bound, high=bound)


def _telling(distances: dict[str, Tensor]) -> int:
    """The scenario to be shown: among those in which the LQR collides, where the filter comes nearest."""
    nearest = distances["LQR, filtered"].amin(-1)
    collides = distances["LQR"].amin(-1) < 0
    return int(torch.where(collides, nearest, nearest + 100).argmin())


def _drawn(
    results: dict[str, LoopResult], distances: dict[str, Tensor], row: int, radius: float
) -> AvoidanceHistory:
    filtered = results["LQR, filtered"]
    return AvoidanceHistory(
        time=filtered.time.numpy(),
        paths={name: result.state[row, :, :2].cpu().numpy() for name, result in results.items()},
        discs=filtered.state[row, :, 4:].unflatten(-1, (-1, 4))[..., :2].cpu().numpy(),
        radius=radius,
        distances={name: one[row].cpu().numpy() for name, one in distances.items()},
        costs={name: result.running_cost[row].cpu().numpy() for name, result in results.items()},
        nearest={name: one.amin(-1).cpu().numpy() for name, one in distances.items()},
    )


def _scene(results: dict[str, LoopResult], distances: dict[str, Tensor], row: int, radius: float) -> Scene:
    """The scenario in motion: the mass under the filter, the discs, and the distance to the nearest."""
    drawn = _drawn(results, distances, row, radius)
    # Nothing moves to look at once the mass is home: two thirds of the time are shown.
    at = np.unique(np.linspace(0, 2 * (len(drawn.time) - 1) // 3, FRAMES).round().astype(int))
    both = np.stack([drawn.distances[name][at] for name in ("LQR, filtered", "LQR")], axis=1)
    edges = np.full((*drawn.discs[at].shape[:2], 1), radius)
    return Scene(
        title="the filtered mass, and the LQR's way (dotted)",
        time=drawn.time[at],
        state=drawn.paths["LQR, filtered"][at],
        centers=np.zeros((len(at), 0, 2)),
        radius=np.zeros(len(at)),
        curves=Curves("distance to the nearest disc: filtered, LQR", both, None),
        along=np.linspace(-1, 1, 2),
        value=None,
        estimate=None,
        grid=None,
        followed=drawn.paths["LQR"][at],
        discs=np.concatenate((drawn.discs[at], edges), axis=-1),
    )

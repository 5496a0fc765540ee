"""A mass or a unicycle in the plane among moving discs: a policy, and the policy behind a safety filter."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from omegaconf import DictConfig
from torch import Tensor

from ..adp import LQR, Feedback, LoopResult, QuadraticCost, SafetyFilter
from ..adp.loop.controller import Policy
from ..adp.safety.conditions import Constraint
from ..figures.animation import Curves, Scene
from ..figures.closed_loop import AvoidanceHistory, draw_avoidance
from ..metrics.closed_loop import constraint_metrics
from ..numerics.checks import COMMAND_LINE, choice, integer, positive_real
from ..results.run_directory import RunDirectory
from ..settings.chase import generator_of, horizon, placement
from ..signs import SHOWN, Progress
from ..systems import ControlAffineSystem, Linear
from .registry import Metrics, finite
from .scenes import animation_kind, frames, write_animation
from .study import Method, Study, histories, write_history


class Vehicle(NamedTuple):
    """A mass or a unicycle among the discs."""

    label: str  # of the policy
    size: int  # states, of which the first two are the place
    rate: Callable[[Tensor, Tensor], Tensor]  # x' of these: (..., size), (..., 2) -> (..., size)
    policy: Policy  # (..., size) -> (..., 2)
    bounds: tuple[float, float]  # of the two inputs
    point: Callable[[Tensor], Tensor]  # that is kept away from the discs: (..., size) -> (..., 2)
    reach: float  # m, of the vehicle from that point
    paid: Callable[[Tensor], Tensor]  # that is to come to the origin: (..., size) -> (..., k)


def _mass(cfg: DictConfig, dt: float, bound: float) -> Vehicle:
    """p'' = u under its LQR."""
    matrix, push = [[0, 0, 1, 0], [0, 0, 0, 1], [0] * 4, [0] * 4], [[0, 0], [0, 0], [1, 0], [0, 1]]
    cost = QuadraticCost(cfg.adp.q, cfg.adp.r, 4, 2, low=-bound, high=bound)
    lqr = LQR(Linear(matrix, push), cost, period=dt)

    def rate(x: Tensor, u: Tensor) -> Tensor:
        return torch.cat((x[..., 2:], u), dim=-1)

    return Vehicle("LQR", 4, rate, lqr, (bound, bound), lambda x: x[..., :2], 0.0, lambda x: x)


def _unicycle(cfg: DictConfig, dt: float, bound: float) -> Vehicle:
    """p' = v (cos, sin), heading' = w: the point ahead of it goes straight to the origin.

    Speed and turning both move that point, the turning alone not the place: only there has a disc a relative
    degree of one. The bound of w lets the point move sideways as fast as ahead.
    """
    ahead = positive_real(COMMAND_LINE, "avoidance.ahead", cfg.avoidance.ahead)

    def direction(x: Tensor) -> Tensor:
        return torch.stack((x[..., 2].cos(), x[..., 2].sin()), dim=-1)

    def rate(x: Tensor, u: Tensor) -> Tensor:
        return torch.cat((u[..., :1] * direction(x), u[..., 1:]), dim=-1)

    def point(x: Tensor) -> Tensor:
        return x[..., :2] + ahead * direction(x)

    def policy(x: Tensor) -> Tensor:
        along = direction(x)
        wanted = -point(x)
        forward = (along * wanted).sum(-1)
        aside = along[..., 0] * wanted[..., 1] - along[..., 1] * wanted[..., 0]
        return torch.stack((forward, aside / ahead), dim=-1)

    return Vehicle("lookahead", 3, rate, policy, (bound, bound / ahead), point, ahead, point)


VEHICLES = {"mass": _mass, "unicycle": _unicycle}


def chosen_vehicle(cfg: DictConfig, dt: float) -> Vehicle:
    """Build what `avoidance.vehicle` names, whose control is held for dt."""
    name = str(choice(COMMAND_LINE, "avoidance.vehicle", cfg.avoidance.vehicle, tuple(VEHICLES)))
    return VEHICLES[name](cfg, dt, positive_real(COMMAND_LINE, "avoidance.bound", cfg.avoidance.bound))


_log = logging.getLogger(__name__)
_HALF_WIDTH = 2.0  # m, of the square that discs are drawn from
_CLEAR = 0.6  # m between the start and the edge of a disc at the beginning
_DRAWS = 1000  # of one scenario, until it is refused
FILTERED, BARE = "filtered", "bare"
_COLUMNS = {
    "method": "method",
    "cost": "cost, median",
    "cost_mean": "mean",
    "minimum_margin": "least distance (m)",
    "constraint_violations": "scenarios with a collision",
    "infeasible": "infeasible at a time",
}


class AmongDiscs(ControlAffineSystem):
    """A vehicle with states x and K discs in the plane, (x, c_1, c_1', ..., c_K, c_K') with c_k'' = 0."""

    inputs = 2

    def __init__(self, vehicle: Vehicle, discs: int) -> None:
        super().__init__()
        self.vehicle, self.dim = vehicle, vehicle.size + 4 * discs

    def rate(self, x: Tensor, u: Tensor) -> Tensor:
        own, discs = x.split((self.vehicle.size, x.shape[-1] - self.vehicle.size), dim=-1)
        moving = discs.unflatten(-1, (-1, 2, 2))[..., 1, :]  # (..., K, 2)
        still = torch.zeros_like(moving)
        return torch.cat((self.vehicle.rate(own, u), torch.cat((moving, still), dim=-1).flatten(-2)), dim=-1)

    def motion(self, x: Tensor, u: Tensor) -> Tensor:
        return self.rate(x, u)  # the sum f + g u would compute it three times

    def drift(self, x: Tensor) -> Tensor:
        return self.rate(x, x.new_zeros(*x.shape[:-1], 2))

    def effectiveness(self, x: Tensor) -> Tensor:
        idle = self.drift(x)
        units = torch.eye(2, dtype=x.dtype, device=x.device)
        return torch.stack([self.rate(x, unit.expand(*x.shape[:-1], 2)) - idle for unit in units], dim=-1)


def drives(cfg: DictConfig) -> tuple[Vehicle, float, SafetyFilter, dict[str, LoopResult]]:
    """Run both methods in every scenario: vehicle, radius of the discs (m), filter, and closed loops."""
    device, dtype = placement(cfg.device, cfg.dtype)
    chosen = cfg.avoidance
    animation_kind(cfg)  # refuses other values before anything takes time
    x0 = scenarios(cfg).to(device=device, dtype=dtype)
    radius = positive_real(COMMAND_LINE, "avoidance.radius", chosen.radius)
    dt, steps = horizon(cfg)
    vehicle = chosen_vehicle(cfg, dt)
    discs = (x0.shape[-1] - vehicle.size) // 4
    system, cost = AmongDiscs(vehicle, discs), vehicle_cost(cfg, vehicle, x0.shape[-1])

    def wanted(x: Tensor) -> Tensor:
        u: Tensor = vehicle.policy(x[..., : vehicle.size])
        return u

    guard = SafetyFilter(
        wanted,
        system,
        [apart(vehicle, k, radius) for k in range(discs)],
        dt=dt,
        low=[-bound for bound in vehicle.bounds],
        high=list(vehicle.bounds),
        decay=positive_real(COMMAND_LINE, "avoidance.decay", chosen.decay),
        margin=float(chosen.margin),
    ).to(device)
    results = {
        name: Method(each, system, cost).run(x0, dt=dt, steps=steps, compile=cfg.adp.compile)
        for name, each in ((FILTERED, guard), (BARE, Feedback(wanted)))
    }
    return vehicle, radius, guard, results


def run(cfg: DictConfig, directory: Path, progress: Progress = SHOWN) -> Metrics:
    """Run both methods in every scenario and fill the run directory; `metrics.json` comes last."""
    vehicle, radius, guard, results = drives(cfg)
    distances = {name: distance(result.state, radius, vehicle.size) for name, result in results.items()}
    study = Study("avoidance", _COLUMNS, ("cost_mean", "minimum_margin", "constraint_violations"), _log)
    for name, result in results.items():
        measured = constraint_metrics(result, distances[name])
        measured |= {"cost": finite(result.cost.median()), "cost_mean": finite(result.cost.mean())}
        far = vehicle.paid(result.state[:, -1, : vehicle.size]).norm(dim=-1)
        measured["final_state_norm"] = finite(far.median())
        if name == BARE:
            study.add(f"{vehicle.label.lower()}_", measured, method=vehicle.label)
            continue
        report = guard.report(result)
        measured |= {"infeasible": float(len(report["infeasible"])), "acted": report["acted"]}
        for row in report["infeasible"][:20]:
            _log.info("scenario %d: at a time no admissible control met the condition", row)
        study.add("", measured, method=f"{vehicle.label}, filtered")
    out, filtered = RunDirectory(directory), results[FILTERED]
    shown = _drawn(vehicle, results, distances, radius)
    if cfg.history:
        arrays = {"state": filtered.state, "control": filtered.control, "distance": distances[FILTERED]}
        arrays[f"{vehicle.label.lower()}_distance"] = distances[BARE]
        write_history(out, filtered.time, arrays | {"running_cost": filtered.running_cost})
    write_animation(cfg, out, "avoidance", lambda: _scene(vehicle, shown))
    return study.write(cfg, out, lambda: draw_avoidance(shown))


run.animates = True  # type: ignore[attr-defined]
run.held = lambda cfg: histories(drives(cfg)[-1])  # type: ignore[attr-defined]


def scenarios(cfg: DictConfig) -> Tensor:
    """Starts at rest on a circle and discs of constant velocities, a scenario a row: (B, n + 4 K). A unicycle
    begins with any heading.

    Raises:
        ValueError: if a setting breaks its rule, or no discs leave room for a start.
    """
    chosen = cfg.avoidance
    count = integer(COMMAND_LINE, "trajectories", cfg.trajectories, least=1)
    discs = integer(COMMAND_LINE, "avoidance.discs", chosen.discs, least=1)
    clear = positive_real(COMMAND_LINE, "avoidance.radius", chosen.radius) + _CLEAR
    away = positive_real(COMMAND_LINE, "avoidance.distance", chosen.distance)
    speed = positive_real(COMMAND_LINE, "avoidance.speed", chosen.speed)
    generator = generator_of(cfg)
    turns = choice(COMMAND_LINE, "avoidance.vehicle", chosen.vehicle, tuple(VEHICLES)) == "unicycle"

    def at_rest() -> Tensor:
        if not turns:
            return torch.zeros(2, dtype=torch.float64, device="cpu")
        return 2 * math.pi * torch.rand(1, dtype=torch.float64, generator=generator, device="cpu")

    reach = torch.tensor([_HALF_WIDTH] * 2 + [speed] * 2, dtype=torch.float64, device="cpu")
    found: list[Tensor] = []
    for _ in range(_DRAWS * count):
        angle, numbers = (
            torch.rand(n, dtype=torch.float64, generator=generator, device="cpu") for n in (1, 4 * discs)
        )
        start = away * torch.cat(((2 * math.pi * angle).cos(), (2 * math.pi * angle).sin()))
        moving = (2 * numbers - 1).reshape(discs, 4) * reach
        if float((moving[:, :2] - start).norm(dim=-1).min()) > clear:
            found.append(torch.cat((start, at_rest(), moving.flatten())))
        if len(found) == count:
            return torch.stack(found)
    raise ValueError(
        f"`staf avoidance.discs=...` must leave room for a start; got {discs} of radius {chosen.radius}."
    )


def distance(state: Tensor, radius: float, size: int = 4) -> Tensor:
    """From the vehicle to the nearest edge of a disc, m: (..., size + 4 K) -> (...)."""
    discs = state[..., size:].unflatten(-1, (-1, 4))
    apart: Tensor = (state[..., None, :2] - discs[..., :2]).norm(dim=-1)
    return apart.amin(-1) - radius


def apart(vehicle: Vehicle, k: int, radius: float) -> Constraint:
    """|point - c_k|^2 - (radius + reach)^2: where it holds the vehicle is outside."""
    at, far = vehicle.size + 4 * k, radius + vehicle.reach
    return lambda x, t: (vehicle.point(x[:, : vehicle.size]) - x[:, at : at + 2]).square().sum(-1) - far**2


def vehicle_cost(cfg: DictConfig, vehicle: Vehicle, dim: int) -> QuadraticCost:
    """x'Qx and u'Ru of the vehicle, of a unicycle of its point; the discs cost nothing."""
    low, high = [-bound for bound in vehicle.bounds], list(vehicle.bounds)
    home = [-vehicle.reach, *[0.0] * (dim - 1)] if vehicle.reach else None  # where the point is at the origin

    def output(x: Tensor) -> Tensor:
        return vehicle.paid(x[..., : vehicle.size])

    return QuadraticCost(cfg.adp.q, cfg.adp.r, dim, 2, low=low, high=high, target=home, output=output)


def _drawn(
    vehicle: Vehicle, results: dict[str, LoopResult], distances: dict[str, Tensor], radius: float
) -> AvoidanceHistory:
    """The scenario to be shown: among those in which the LQR collides, where the filter comes nearest."""
    filtered, nearest = results[FILTERED], distances[FILTERED].amin(-1)
    row = int(torch.where(distances[BARE].amin(-1) < 0, nearest, nearest + 100).argmin())
    labels = {FILTERED: f"{vehicle.label}, filtered", BARE: vehicle.label}
    return AvoidanceHistory(
        time=filtered.time.numpy(),
        paths={labels[name]: result.state[row, :, :2].cpu().numpy() for name, result in results.items()},
        discs=filtered.state[row, :, vehicle.size :].unflatten(-1, (-1, 4))[..., :2].cpu().numpy(),
        radius=radius,
        distances={labels[name]: one[row].cpu().numpy() for name, one in distances.items()},
        costs={labels[name]: result.running_cost[row].cpu().numpy() for name, result in results.items()},
        nearest={labels[name]: one.amin(-1).cpu().numpy() for name, one in distances.items()},
    )


def _scene(vehicle: Vehicle, drawn: AvoidanceHistory) -> Scene:
    """The scenario in motion: the vehicle under the filter, the discs, and the distance to the nearest."""
    names = f"{vehicle.label}, filtered", vehicle.label
    # Nothing moves to look at once the mass is home: two thirds of the time are shown.
    at = frames(2 * (len(drawn.time) - 1) // 3)
    both = np.stack([drawn.distances[name][at] for name in names], axis=1)
    edges = np.full((*drawn.discs[at].shape[:2], 1), drawn.radius)
    return Scene(
        title=f"the filtered {vehicle.label}, and its way alone (dotted)",
        time=drawn.time[at],
        state=drawn.paths[names[0]][at],
        centers=np.zeros((len(at), 0, 2)),
        radius=np.zeros(len(at)),
        curves=Curves(f"distance to the nearest disc: filtered, {vehicle.label}", both, None),
        along=np.linspace(-1, 1, 2),
        value=None,
        estimate=None,
        grid=None,
        followed=drawn.paths[names[1]][at],
        discs=np.concatenate((drawn.discs[at], edges), axis=-1),
    )

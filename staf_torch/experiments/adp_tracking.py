"""The four-state tracking problem: true drift, identified drift, and the first estimate kept."""

from __future__ import annotations

import copy
import logging
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from omegaconf import DictConfig
from torch import Tensor

from .. import adp
from ..adp import ConcurrentLearning, Controller, IdentifyingTracker, LoopResult, QuadraticCost
from ..figures.closed_loop import draw_tracking
from ..figures.style import draws, images
from ..metrics.closed_loop import tracking_metrics
from ..results.run_directory import RunDirectory
from ..settings.adp import build, value_basis
from ..settings.chase import horizon, initial_states, placement, plain, seed_of
from ..signs import SHOWN, Progress
from ..systems import TwoState, TwoStateTracking
from ..tables.model import significant
from .adp import recorded
from .registry import Metrics
from .scenes import tracking_scene, write_animation
from .study import Method, histories, write_history

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_log = logging.getLogger(__name__)
_HORIZON, _INTERVALS = 8.0, 160  # of direct shooting: the error has fallen to 1e-5 of itself


class Variants(NamedTuple):
    """Closed loops of the tracking problem by variant, and what they share."""

    plant: TwoStateTracking
    cost: QuadraticCost
    controllers: dict[str, Controller]
    results: dict[str, LoopResult]


def variants(cfg: DictConfig) -> Variants:
    """Run the three variants."""
    device, dtype = placement(cfg.device, cfg.dtype)
    plant = TwoStateTracking()
    weights = plain(cfg.adp.cost)
    cost = adp.tracking_cost(weights["state"], weights["control"])
    x0 = initial_states(cfg, plant.dim).to(device=device, dtype=dtype)
    dt, steps = horizon(cfg)
    controllers = _controllers(cfg, plant, cost)
    for part in (plant, cost, *controllers.values()):
        part.to(device)
    shared = {"dt": dt, "steps": steps, "seed": seed_of(cfg)}
    shared |= {"integrator": cfg.adp.integrator, "compile": cfg.adp.compile}
    results = {
        name: Method(controller, plant, cost).run(x0, **shared) for name, controller in controllers.items()
    }
    return Variants(plant, cost, controllers, results)


def run(cfg: DictConfig, directory: Path, progress: Progress = SHOWN) -> Metrics:
    """Run the three variants and fill the run directory; `metrics.json` comes last."""
    plant, cost, controllers, results = variants(cfg)
    best = _optimal_cost(plant, cost, results["known"].state[:, 0])
    metrics: Metrics = {"optimal_cost": None if best is None else float(best.nanmedian())}
    for name, result in results.items():
        measured = tracking_metrics(result, result.recorded.get("theta"), plant.theta, best)
        metrics |= {f"{name}_{key}": value for key, value in measured.items()}
        _log.info(
            "%-11s cost %s, over the optimum %s, final |e| %s, final |theta error| %s, diverged %s",
            *(name, *(significant(value, 4) for value in measured.values())),
        )
    out, identified = RunDirectory(directory), results["identified"]
    parameters = identified["theta"]  # (B, T, 3, 2)
    if cfg.history:
        write_history(out, identified.time, recorded(identified) | {"parameters": parameters})
    write_animation(cfg, out, "tracking", lambda: tracking_scene(controllers["identified"], identified))
    if draws(cfg.figures):
        out.figure("adp_tracking", images(_drawn(results, parameters, plant.theta)))
    return out.metrics(metrics)


run.animates = True  # type: ignore[attr-defined]
run.held = lambda cfg: histories(variants(cfg).results)  # type: ignore[attr-defined]


def _optimal_cost(plant: TwoStateTracking, cost: QuadraticCost, x0: Tensor) -> Tensor | None:
    """V*(x(0)) of the known plant by direct shooting, (B,); None without SciPy."""
    error_cost = QuadraticCost(cost.q[:2, :2], cost.r, 2, 1)
    try:
        lqr = adp.LQR(TwoState(), error_cost).to(x0.device)
    except ValueError as error:
        _log.warning("the optimum is not known: %s", error)
        return None
    shooting = adp.DirectShooting(
        TwoStateTracking().to(x0.device),
        copy.deepcopy(cost).double(),
        base=lambda x: lqr(x[..., :2]),
        terminal=lambda x: lqr.value(x[..., :2]),
        horizon=_HORIZON,
        intervals=_INTERVALS,
    )
    return shooting.solve(x0.double()).value


def _controllers(cfg: DictConfig, plant: TwoStateTracking, cost: QuadraticCost) -> dict[str, Controller]:
    chosen = cfg.adp.identification
    theta = torch.tensor(plain(chosen.theta), dtype=torch.float64, device="cpu")
    # 1e-300 keeps the first estimate: the same code without learning.
    learning = ConcurrentLearning(3, 2, chosen.size, chosen.gain)
    frozen = ConcurrentLearning(3, 2, chosen.size, 1e-300)
    learner = adp.ActorCritic(
        adp.LeadingCoordinates(value_basis(cfg, 2), plant.dim),
        plant,
        cost,
        build(cfg, "extrapolation", adp.Extrapolation, dim=lambda: plant.dim),
        build(cfg, "law", adp.ActorCriticLaw),
        critic=cfg.adp.critic,
        actor=cfg.adp.actor,
        gain=cfg.adp.gain,
    )
    return {
        "known": learner,
        "identified": IdentifyingTracker(learner, plant, learning, theta),
        "unidentified": IdentifyingTracker(learner, plant, frozen, theta),
    }


def _drawn(results: dict[str, LoopResult], parameters: Tensor, theta: Tensor) -> Figure:
    """Draw the first trajectory; |e| is NaN from where it diverged on."""

    def first(rows: Tensor) -> np.ndarray:
        return rows[0].cpu().numpy()

    shown = results["identified"]
    errors = {}
    for name, one in results.items():
        diverged = one.time.to(one.frozen_at) > one.frozen_at[0]
        errors[name] = torch.where(diverged, torch.nan, one.state[0, :, :2].norm(dim=-1))
    return draw_tracking(
        time=shown.time.numpy(),
        state=first(shown.state),
        errors={name: error.cpu().numpy() for name, error in errors.items()},
        parameters=first(parameters.flatten(-2)),
        truth=theta.flatten().cpu().numpy(),
        critic_weights=first(shown.critic_weights),
    )

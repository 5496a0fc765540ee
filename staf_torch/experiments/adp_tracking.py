"""The four-state tracking problem: true drift, identified drift, and the first estimate kept."""

from __future__ import annotations

import copy
import logging
from pathlib import Path

import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from .._checks import integer, positive_real
from ..adp import (
    LQR,
    ActorCritic,
    ConcurrentLearning,
    Controller,
    DirectShooting,
    IdentifyingTracker,
    LeadingCoordinates,
    LoopResult,
    QuadraticCost,
    TwoStateTracking,
    simulate,
    tracking_cost,
)
from ..adp_metrics import tracking_metrics
from ..report import HistoryWriter, write_metrics
from ..systems import TwoState
from .build import initial_states, placement
from .build_adp import actor_critic_law, extrapolation, staf_value_basis

_log = logging.getLogger(__name__)
_PARAMETERS = 6
_HORIZON, _INTERVALS = 8.0, 160  # of direct shooting: the error has fallen to 1e-5 of itself


def run(cfg: DictConfig, directory: Path) -> dict[str, float | None]:
    """Run the three variants and fill the run directory; `metrics.json` comes last."""
    device, dtype = placement(cfg.device, cfg.dtype)
    plant = TwoStateTracking().to(device)
    settings = OmegaConf.to_container(cfg.adp.cost, resolve=True)
    assert isinstance(settings, dict)
    cost = tracking_cost(settings["state"], settings["control"]).to(device)
    x0 = initial_states(cfg, plant.dim).to(device=device, dtype=dtype)
    dt = positive_real("staf", "dt", cfg.dt)
    steps = max(1, round(positive_real("staf", "duration", cfg.duration) / dt))
    results = {}
    for name, controller in _controllers(cfg, plant, cost).items():
        results[name] = simulate(
            controller.to(device),
            plant,
            cost,
            x0,
            dt=dt,
            steps=steps,
            seed=integer("staf", "seed", cfg.seed, least=0),
            integrator=cfg.adp.integrator,
            compile=cfg.adp.compile,
        )
    best = _optimal_cost(plant, cost, x0)
    metrics: dict[str, float | None] = {"optimal_cost": None if best is None else float(best.nanmedian())}
    for name, result in results.items():
        found = tracking_metrics(result, _parameters(result), plant.theta, best)
        metrics |= {f"{name}_{key}": value for key, value in found.items()}
        shown = ["-" if value is None else f"{value:.4g}" for value in found.values()]
        _log.info(
            "%-11s cost %s, over the optimum %s, final |e| %s, final |theta error| %s, diverged %s",
            name,
            *shown,
        )
    if cfg.history:
        _write_history(directory / "history.npz", results["identified"])
    if cfg.figures:
        _draw(results, plant.theta, directory / "figures")
    write_metrics(directory / "metrics.json", metrics)
    return metrics


def _optimal_cost(plant: TwoStateTracking, cost: QuadraticCost, x0: Tensor) -> Tensor | None:
    """V*(x(0)) of the known plant by direct shooting, (B,); None without SciPy."""
    error_cost = QuadraticCost(cost.q[:2, :2], cost.r, 2, 1)
    try:
        lqr = LQR(TwoState(), error_cost).to(x0.device)
    except ValueError as error:
        _log.warning("the optimum is not known: %s", error)
        return None
    shooting = DirectShooting(
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
    theta = torch.tensor(OmegaConf.to_container(chosen.theta), dtype=torch.float64)
    # 1e-300 keeps the first estimate: the same code without learning.
    learning = ConcurrentLearning(3, 2, chosen.size, chosen.gain)
    frozen = ConcurrentLearning(3, 2, chosen.size, 1e-300)
    learner = ActorCritic(
        LeadingCoordinates(staf_value_basis(cfg, 2), plant.dim),
        plant,
        cost,
        extrapolation(cfg.adp, plant),
        actor_critic_law(cfg),
        critic=cfg.adp.critic,
        actor=cfg.adp.actor,
        gain=cfg.adp.gain,
    )
    return {
        "known": learner,
        "identified": IdentifyingTracker(learner, plant, learning, theta),
        "unidentified": IdentifyingTracker(learner, plant, frozen, theta),
    }


def _parameters(result: LoopResult) -> Tensor | None:
    """theta^ at the recorded times, (B, T, 3, 2); None where nothing is identified."""
    if result.identifier.shape[-1] == 0:
        return None
    return result.identifier[..., :_PARAMETERS].reshape(*result.identifier.shape[:2], 3, 2)


def _errors(result: LoopResult) -> Tensor:
    """|e|, (B, T); NaN from where a row diverged on."""
    time = result.time.to(result.frozen_at)
    return torch.where(time > result.frozen_at.unsqueeze(-1), torch.nan, result.state[..., :2].norm(dim=-1))


def _write_history(path: Path, result: LoopResult) -> None:
    batch, times = result.state.shape[:2]
    parameters = _parameters(result)
    assert parameters is not None
    with HistoryWriter(path, batch, times) as writer:
        names = ("state", "control", "actor_weights", "critic_weights", "running_cost")
        arrays = {name: getattr(result, name).cpu().numpy() for name in names}
        writer.add(arrays | {"parameters": parameters.cpu().numpy()})
        writer.close(time=result.time.numpy())


def _draw(results: dict[str, LoopResult], theta: Tensor, folder: Path) -> None:
    # Imported here: matplotlib takes a second, which figures=false need not pay.
    from ..report import plots, plots_tracking

    parameters = _parameters(results["identified"])
    assert parameters is not None

    def first(rows: Tensor) -> np.ndarray:
        return rows[0].cpu().numpy()

    history = plots_tracking.TrackingHistory(
        time=results["identified"].time.numpy(),
        state=first(results["identified"].state),
        errors={name: first(_errors(result)) for name, result in results.items()},
        parameters=first(parameters.flatten(-2)),
        truth=theta.flatten().cpu().numpy(),
        critic_weights=first(results["identified"].critic_weights),
    )
    folder.mkdir(exist_ok=True)
    plots.save(plots_tracking.draw_tracking(history), folder / "adp_tracking")

"""States that must stay in a box: the LQR in barrier coordinates, a filter, the LQR alone, the optimum."""

from __future__ import annotations

import logging
import math
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from torch import Tensor

from ..adp import (
    LQR,
    Controller,
    Cost,
    DirectShooting,
    Feedback,
    LoopResult,
    QuadraticCost,
    SafetyFilter,
    simulate,
)
from ..adp.safety_filter import Constraint
from ..figures.safety import BoxHistory, draw_box
from ..figures.style import images
from ..metrics.safety import constraint_metrics
from ..numerics.checks import COMMAND_LINE, fail, flag, integer, positive_real
from ..results.progress import SHOWN, Progress
from ..results.run_directory import RunDirectory
from ..settings.adp import make_cost, plant, updated
from ..settings.chase import initial_states, placement, plain
from ..systems import Barrier, ControlAffineSystem, Plant
from ..tables import Table
from ..tables.columns import significant
from .registry import Metrics, finite

_log = logging.getLogger(__name__)
_COLUMNS = {
    "method": "method",
    "cost": "cost of s",
    "cost_ratio": "over the optimum",
    "minimum_margin": "least margin",
    "constraint_violations": "rows that left",
    "left_fraction": "left, of all starts in the box",
    "largest_control": "largest |u|",
}


def run(cfg: DictConfig, directory: Path, progress: Progress = SHOWN) -> Metrics:
    """Run every method from the same states and fill the run directory; `metrics.json` comes last."""
    device, dtype = placement(cfg.device, cfg.dtype)
    cfg = updated(cfg)
    system = plant(cfg).to(device)
    if not isinstance(system, ControlAffineSystem) or system.dim is None:
        raise fail(COMMAND_LINE, "system", "must be a ControlAffineSystem", system)
    cost = make_cost(cfg, system).to(device)
    chosen = cfg.safe_box
    box = Barrier(system, plain(chosen.low), plain(chosen.high)).to(device)
    x0 = initial_states(cfg, system.dim).to(device=device, dtype=dtype)
    s0 = box.transform(x0)
    dt = positive_real(COMMAND_LINE, "dt", cfg.dt)
    steps = max(1, round(positive_real(COMMAND_LINE, "duration", cfg.duration) / dt))
    every = next(k for k in range(max(1, steps // 2000), steps + 1) if steps % k == 0)
    filtered = flag("safe_box", "filter", chosen.filter)
    methods: dict[str, tuple[Controller, Plant, Cost]] = {"LQR of s": (Feedback(LQR(box, cost)), box, cost)}
    of_s = QuadraticCost(cost.q, cost.r, system.dim, cost.inputs, output=lambda x: box.coordinates(x)).to(
        device
    )
    lqr = LQR(system, QuadraticCost(cost.q, cost.r, system.dim, cost.inputs)).to(device)
    if filtered:
        walls = [k for k in range(system.dim) if bool(box.walled[:, k].any())]
        guard = SafetyFilter(lqr, system, [_within(box, k) for k in walls], dt=dt, decay=float(chosen.decay))
        methods["LQR of x, filtered"] = guard, system, of_s
    methods["LQR of x"] = Feedback(lqr), system, of_s
    anywhere = _anywhere(cfg, box).to(x0)
    results: dict[str, LoopResult] = {}
    left: dict[str, float] = {}
    for name, method in methods.items():
        moved = method[1]
        starts, others = (box.transform(x) if moved is box else x for x in (x0, anywhere))
        results[name] = _simulated(cfg, method, starts, steps, every)
        tried = _simulated(cfg, method, others, steps, every)
        left[name] = constraint_metrics(tried, _margin(box, moved, tried))["constraint_violations"] or 0.0
    wanted = flag("adp", "optimum.shooting", cfg.adp.optimum.shooting)
    best = _optimum(box, cost, s0[:1]) if wanted else None
    rows: list[dict[str, Any]] = []
    margins: dict[str, Tensor] = {}
    metrics: Metrics = {"optimal_cost": best}
    for name, result in results.items():
        inside = name == "LQR of s"
        margins[name] = _margin(box, methods[name][1], result)
        measured = constraint_metrics(result, margins[name])
        paid = None if bool(result.diverged[0]) else finite(result.cost[0])
        measured["cost"] = paid
        measured["cost_ratio"] = None if best is None or paid is None else paid / best
        measured["left_fraction"] = left[name] / len(anywhere)
        measured["largest_control"] = finite(result.control[0, :-1].abs().max())
        rows.append({"method": name} | measured)
        prefix = "_".join(name.lower().replace(",", "").split())
        metrics |= measured if inside else {f"{prefix}_{key}": value for key, value in measured.items()}
        shown = [significant(measured[key], 5) for key in ("cost", "minimum_margin", "constraint_violations")]
        _log.info("%-20s cost of s %s, least margin %s, rows that left %s", name, *shown)
    out = RunDirectory(directory)
    if cfg.history:
        first = results["LQR of s"]
        arrays = {"state": box.inverse(first.state), "barrier_state": first.state, "control": first.control}
        arrays |= {"running_cost": first.running_cost, "margin": margins["LQR of s"]}
        with out.history(*first.state.shape[:2]) as writer:
            writer.add({name: array.cpu().numpy() for name, array in arrays.items()})
            writer.close(time=first.time.numpy())
    out.table("safe_box", Table.of(rows, _COLUMNS))
    if cfg.figures:
        out.figure("safe_box", images(draw_box(_drawn(box, results, margins))))
    return out.metrics(metrics)


def _simulated(
    cfg: DictConfig, method: tuple[Controller, Plant, Cost], x0: Tensor, steps: int, every: int
) -> LoopResult:
    """Run one method; every ``every``-th step is recorded."""
    controller, system, cost = method
    seed = integer(COMMAND_LINE, "seed", cfg.seed, least=0)
    return simulate(
        *(controller, system, cost, x0),
        dt=float(cfg.dt),
        steps=steps,
        every=every,
        seed=seed,
        compile=cfg.adp.compile,
    )


def _anywhere(cfg: DictConfig, box: Barrier) -> Tensor:
    """States drawn uniformly from the box, from [-1, 1] around its middle where a wall is missing: (B, n)."""
    count = integer("safe_box", "states", cfg.safe_box.states, least=1)
    generator = torch.Generator().manual_seed(integer(COMMAND_LINE, "seed", cfg.seed, least=0))
    share = torch.rand(count, box.dim or 0, dtype=torch.float64, generator=generator)
    return (box.floor + (box.ceiling - box.floor) * share).clamp(box.low + 1e-9, box.high - 1e-9)


def _margin(box: Barrier, system: Plant, result: LoopResult) -> Tensor:
    """The distance to the nearest wall at the recorded times, NaN outside the box: (B, T)."""
    return box.margin(result.state if system is box else box.coordinates(result.state))


def _within(box: Barrier, k: int) -> Constraint:
    """h of a coordinate, in its units: (x - low)(high - x)/(high - low), or the distance to its one wall."""
    low, high = float(box.low[k]), float(box.high[k])
    if math.isinf(low) or math.isinf(high):
        return lambda x, t: high - x[:, k] if math.isinf(low) else x[:, k] - low
    return lambda x, t: (x[:, k] - low) * (high - x[:, k]) / (high - low)


def _optimum(box: Barrier, cost: Cost, s0: Tensor) -> float | None:
    """The least cost of s from the first state, by direct shooting; None where none was found."""
    found = DirectShooting(box, cost).solve(s0.double())
    if not bool(found.converged[0]):
        _log.warning("the optimum is not known: %s", found.reason[0])
    return finite(found.value[0])


def _drawn(box: Barrier, results: dict[str, LoopResult], margins: dict[str, Tensor]) -> BoxHistory:
    """The first trajectory of every method."""
    of_s = results["LQR of s"]
    paths = {
        name: (box.inverse(result.state[0]) if result is of_s else result.state[0]).cpu().numpy()
        for name, result in results.items()
    }
    return BoxHistory(
        time=of_s.time.numpy(),
        paths=paths,
        margins={name: margin[0].cpu().numpy() for name, margin in margins.items()},
        costs={name: result.running_cost[0].cpu().numpy() for name, result in results.items()},
        barrier_state=of_s.state[0].cpu().numpy(),
        low=box.low.cpu().numpy(),
        high=box.high.cpu().numpy(),
    )

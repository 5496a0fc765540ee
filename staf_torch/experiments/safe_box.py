"""States that must stay in a box: the LQR in barrier coordinates, a filter, the LQR alone, the optimum."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import NamedTuple

import torch
from omegaconf import DictConfig
from torch import Tensor

from ..adp import LQR, BoxFilter, Cost, DirectShooting, Feedback, LoopResult, QuadraticCost, SafetyFilter
from ..adp.loop.simulation import OptimumSettings
from ..adp.safety.box_filter import walls
from ..figures.closed_loop import BoxHistory, draw_box
from ..metrics.closed_loop import constraint_metrics
from ..numerics.checks import COMMAND_LINE, fail, flag, integer, positive_real
from ..results.run_directory import RunDirectory
from ..settings.adp import make_cost, optimum_settings, plant
from ..settings.chase import generator_of, horizon, initial_states, placement, plain, seed_of
from ..signs import SHOWN, Progress
from ..systems import Barrier, ControlAffineSystem, Plant
from .registry import Metrics, finite
from .study import Method, Study, histories, label_key, write_history

_log = logging.getLogger(__name__)
_COLUMNS = {
    "method": "method",
    "cost": "cost of s",
    "cost_ratio": "over the optimum",
    "minimum_margin": "least margin",
    "constraint_violations": "rows that left",
    "left_fraction": "left, of all starts in the box",
    "left_near_fraction": "left, of starts beside a wall",
    "largest_control": "largest |u|",
}
_NAMED = 20  # starts that the log lists


class BoxProblem(NamedTuple):
    """The box and what is compared in it, on the device and in the dtype of the settings."""

    box: Barrier
    cost: Cost
    methods: dict[str, Method]
    starts: dict[str, Tensor]  # (B, n) float64: "" as set, "left" anywhere, "left_near" beside a wall
    dtype: torch.dtype  # of the loops
    times: dict[str, tuple[int, int]]  # steps from these starts, and steps between records

    def loops(self, cfg: DictConfig, method: Method) -> dict[str, LoopResult]:
        """Run one method from all starts."""
        found = {}
        for what, x in self.starts.items():
            steps, every = self.times[what]
            every = 1 if what and method.plant is not self.box else every
            x = x.to(self.dtype)
            start = self.box.transform(x.double()).to(x) if method.plant is self.box else x
            shared = {"dt": float(cfg.dt), "steps": steps, "every": every, "compile": cfg.adp.compile}
            found[what] = method.run(start, **shared, seed=seed_of(cfg))
        return found


def box_problem(cfg: DictConfig) -> BoxProblem:
    """Build what the settings describe; designs and starts are made on the CPU.

    Raises:
        ValueError: if a setting breaks its rule.
    """
    device, dtype = placement(cfg.device, cfg.dtype)
    system = plant(cfg)
    if not isinstance(system, ControlAffineSystem) or system.dim is None:
        raise fail(COMMAND_LINE, "system", "must be a ControlAffineSystem", system)
    cost = make_cost(cfg, system)
    box = Barrier(system, plain(cfg.safe_box.low), plain(cfg.safe_box.high))
    starts = {"": initial_states(cfg, system.dim)}
    starts |= {"left": _anywhere(cfg, box), "left_near": _beside_walls(cfg, box)}
    dt, steps = horizon(cfg)
    followed = max(1, round(positive_real(COMMAND_LINE, "safe_box.followed", cfg.safe_box.followed) / dt))
    every = next(k for k in range(max(1, steps // 2000), steps + 1) if steps % k == 0)
    compared = methods(cfg, box, cost)  # asks for the settings' rules before anything takes time
    for part in (box, *(p for method in compared.values() for p in (method.controller, method.cost))):
        part.to(device)
    return BoxProblem(
        *(box, cost, compared, {what: x.to(device) for what, x in starts.items()}, dtype),
        {"": (steps, every), **dict.fromkeys(("left", "left_near"), (followed, followed))},
    )


def held(cfg: DictConfig) -> dict[str, Tensor]:
    """Return what a run keeps of the rows of every method."""
    problem = box_problem(cfg)
    return histories(
        {
            f"{name}, {what.replace('_', ' ')}" if what else name: result
            for name, method in problem.methods.items()
            for what, result in problem.loops(cfg, method).items()
        }
    )


def run(cfg: DictConfig, directory: Path, progress: Progress = SHOWN) -> Metrics:
    """Run every method from the same states and fill the run directory; `metrics.json` comes last."""
    shooting, problem = optimum_settings(cfg.adp.optimum), box_problem(cfg)
    box, cost, compared, starts = problem[:4]
    study = Study("safe_box", _COLUMNS, ("cost", "minimum_margin", "constraint_violations"), _log)
    best = _optimum(box, cost, box.transform(starts[""][:1]), shooting) if shooting.shooting else None
    study.metrics["optimal_cost"] = best
    results: dict[str, LoopResult] = {}
    margins: dict[str, Tensor] = {}
    for name, method in compared.items():
        tried = problem.loops(cfg, method)
        results[name] = tried.pop("")
        margins[name] = _margin(box, method.plant, results[name])
        measured = _measured(results[name], margins[name], best)
        for what, other in tried.items():
            left = constraint_metrics(other, _margin(box, method.plant, other))["constraint_violations"]
            measured[f"{what}_fraction"] = (left or 0.0) / len(starts[what])
        study.add("" if name == "LQR of s" else f"{label_key(name)}_", measured, method=name)
    study.metrics |= _unavoidable(cfg, box, cost, starts)
    out, first = RunDirectory(directory), results["LQR of s"]
    if cfg.history:
        arrays = {"state": box.inverse(first.state), "barrier_state": first.state, "control": first.control}
        arrays |= {"running_cost": first.running_cost, "margin": margins["LQR of s"]}
        write_history(out, first.time, arrays)
    drawn = _drawn(box, compared, results, margins)
    return study.write(cfg, out, lambda: draw_box(drawn))


run.held = held  # type: ignore[attr-defined]


def methods(cfg: DictConfig, box: Barrier, cost: Cost) -> dict[str, Method]:
    """The LQR in both coordinates, by itself and behind the filters."""
    system, size, dt = box.plant, len(box.low), float(cfg.dt)
    substeps = {"substeps": (1, integer(COMMAND_LINE, "safe_box.substeps", cfg.safe_box.substeps, least=1))}
    of_s = LQR(box, cost)
    paid = QuadraticCost(cost.q, cost.r, size, cost.inputs, output=lambda x: box.coordinates(x))
    lqr = LQR(system, QuadraticCost(cost.q, cost.r, size, cost.inputs))
    found = {"LQR of s": Method(Feedback(of_s), box, cost)}
    if flag(COMMAND_LINE, "safe_box.filter", cfg.safe_box.filter):
        for renewed, name in ((False, "LQR of s, filtered"), (True, "LQR of s, filtered, renewed")):
            steps = substeps | ({"renew": True} if renewed else {})
            found[name] = Method(Feedback(BoxFilter(of_s, box, dt=dt, renewed=renewed)), box, cost, steps)
        kept = walls(box.low.tolist(), box.high.tolist())
        guard = SafetyFilter(lqr, system, kept, dt=dt, decay=float(cfg.safe_box.decay))
        found["LQR of x, filtered"] = Method(guard, system, paid)
    found["LQR of x"] = Method(Feedback(lqr), system, paid)
    return found


def _measured(result: LoopResult, margin: Tensor, best: float | None) -> Metrics:
    paid = None if bool(result.diverged[0]) else finite(result.cost[0])
    return constraint_metrics(result, margin) | {
        "cost": paid,
        "cost_ratio": None if best is None or paid is None else paid / best,
        "largest_control": finite(result.control[0, :-1].abs().max()),
    }


def _unavoidable(cfg: DictConfig, box: Barrier, cost: Cost, starts: dict[str, Tensor]) -> Metrics:
    """The starts that no control held for dt keeps inside: their shares, and their numbers in the log."""
    guard = BoxFilter(LQR(box, cost), box, dt=float(cfg.dt))
    found: Metrics = {}
    for what in ("left", "left_near"):
        x = starts[what]
        rows = (guard.share(box.transform(x)) >= 1).nonzero().flatten().tolist()
        found[f"{what}_unavoidable_fraction"] = len(rows) / len(x)
        if rows:
            named = ", ".join(map(str, rows[:_NAMED])) + (" and more" if len(rows) > _NAMED else "")
            where = "beside a wall" if what == "left_near" else "in the box"
            _log.info(
                "%d of %d starts %s cannot be kept inside by any control held for %g s: number %s",
                *(len(rows), len(x), where, float(cfg.dt), named),
            )
    return found


def _anywhere(cfg: DictConfig, box: Barrier) -> Tensor:
    """States drawn uniformly from the box, from [-1, 1] around its middle where a wall is missing: (B, n)."""
    count = integer(COMMAND_LINE, "safe_box.states", cfg.safe_box.states, least=1)
    share = torch.rand(count, len(box.low), dtype=torch.float64, generator=generator_of(cfg), device="cpu")
    return (box.floor + (box.ceiling - box.floor) * share.to(box.low)).clamp(box.low + 1e-9, box.high - 1e-9)


def _beside_walls(cfg: DictConfig, box: Barrier) -> Tensor:
    """States of `_anywhere`, each moved to ``safe_box.near`` from one of the walls: (B, n)."""
    near = positive_real(COMMAND_LINE, "safe_box.near", cfg.safe_box.near)
    x = _anywhere(cfg, box)
    walls = [(k, side) for k in range(len(box.low)) for side in (0, 1) if bool(box.walled[side, k])]
    chosen = torch.randint(len(walls), (len(x),), generator=generator_of(cfg), device="cpu").to(x.device)
    for number, (k, side) in enumerate(walls):
        beside = box.high[k] - near if side else box.low[k] + near
        x[:, k] = torch.where(chosen == number, beside, x[:, k])
    return x


def _margin(box: Barrier, system: Plant, result: LoopResult) -> Tensor:
    """The distance to the nearest wall at the recorded times, NaN outside the box: (B, T)."""
    return box.margin(result.state if system is box else box.coordinates(result.state))


def _optimum(box: Barrier, cost: Cost, s0: Tensor, chosen: OptimumSettings) -> float | None:
    """The least cost of s from the first state, by direct shooting; None where none was found."""
    shooting = DirectShooting(box, cost, horizon=chosen.horizon, intervals=chosen.intervals)
    found = shooting.solve(s0.double())
    if not bool(found.converged[0]):
        _log.warning("the optimum is not known: %s", found.reason[0])
    return finite(found.value[0])


def _drawn(
    box: Barrier, compared: dict[str, Method], results: dict[str, LoopResult], margins: dict[str, Tensor]
) -> BoxHistory:
    """The first trajectory of every method."""
    of_s = results["LQR of s"]
    states = {name: result.state[0] for name, result in results.items()}
    paths = {name: box.inverse(x) if compared[name].plant is box else x for name, x in states.items()}
    return BoxHistory(
        time=of_s.time.numpy(),
        paths={name: path.cpu().numpy() for name, path in paths.items()},
        margins={name: margin[0].cpu().numpy() for name, margin in margins.items()},
        costs={name: result.running_cost[0].cpu().numpy() for name, result in results.items()},
        barrier_state=of_s.state[0].cpu().numpy(),
        low=box.low.cpu().numpy(),
        high=box.high.cpu().numpy(),
        units=box.plant.units.of_states(len(box.low)),
    )

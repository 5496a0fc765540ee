"""Optimal regulation: the paper's actor-critic, or a policy to compare it with, in closed loop."""

from __future__ import annotations

import dataclasses
import logging
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from ..adp import ActorCritic, Controller, Cost, LoopResult, SafetyFilter, Supervised, simulate
from ..adp.loop.result import LoopAbout, picture
from ..adp.loop.simulation import AdpProblem
from ..adp.planning.shooting.reference_optimum import LoopOptimum, compare
from ..adp.problem.held_linear import HeldLoop
from ..figures.closed_loop import AdpHistory, draw_adp
from ..figures.style import draws, images
from ..lanes.tree import flatten, unflatten
from ..metrics.closed_loop import adp_metrics
from ..results.run_directory import RunDirectory
from ..settings.adp import adp_problem
from ..settings.chase import make_metrics
from ..signs import SHOWN, Progress
from ..systems import Plant
from ..tables.model import significant
from .registry import BatchedExperiment, Metrics, RowsOfJobs, in_calls
from .scenes import animation_kind, loop_scene, write_animation
from .study import histories, log_diverged, trajectories, write_history

_log = logging.getLogger(__name__)
_LINEARISED = 8  # rows of a learning controller whose loop is linearised
_LEARNING = 0.05  # of the optimal cost, from which a word says why more is paid
_SETTLING = 0.25  # share of the first cost rate of a state, below which it is on its way


@dataclasses.dataclass(frozen=True)
class LoopSolution:
    """A closed loop that has been run and has left nothing on disk yet. It can be pickled."""

    result: LoopResult
    optimum: LoopOptimum
    method: str  # plant and policy, for the log
    dt: float  # s
    steps: int
    metrics: Metrics  # what `metrics.json` will hold


class Regulation(BatchedExperiment[LoopSolution]):
    """Optimal regulation; jobs that differ in numbers of plant, cost and controller share a tensor batch."""

    animates = True
    batchable = frozenset(
        {
            *("seed", "initial_state", "spread", "system.*", "kernel.*", "adp.*"),
            *("centers.radius", "centers.directions", "centers.shrink.*"),
        }
    )

    def __call__(self, cfg: DictConfig, directory: Path, progress: Progress = SHOWN) -> Metrics:
        """Run what the settings describe and fill the run directory; `metrics.json` comes last."""
        problem = _problem(cfg)
        return self.write(cfg, directory, _solved(cfg, problem, solve(problem, progress)))

    def held(self, cfg: DictConfig) -> dict[str, Tensor]:
        """Return what a run keeps of its rows."""
        return histories({"": solve(_problem(cfg))})

    def solve(self, cfgs: Sequence[DictConfig], progress: Progress) -> list[LoopSolution | Exception]:
        """Solve several configurations of one group as one tensor batch."""
        prepared: list[AdpProblem | Exception] = []
        for cfg in cfgs:
            try:
                prepared.append(_problem(cfg))
            except Exception as error:  # of this member alone
                prepared.append(error)
        problems = [problem for problem in prepared if isinstance(problem, AdpProblem)]
        results: Iterator[LoopResult] = iter(())
        if problems:
            with progress.over(problems[0].steps, "steps") as advance:
                results = iter(simulate_together(problems, advance))
        return [
            _solved(cfg, problem, next(results)) if isinstance(problem, AdpProblem) else problem
            for cfg, problem in zip(cfgs, prepared, strict=True)
        ]

    def write(self, cfg: DictConfig, directory: Path, solution: LoopSolution) -> Metrics:
        """Fill the run directory with what was solved; `metrics.json` comes last."""
        out = RunDirectory(directory)
        if cfg.history:
            write_history(out, solution.result.time, recorded(solution.result))
        log_diverged(_log, solution.result.state[:, 0], solution.result.frozen_at)
        write_animation(cfg, out, "closed_loop", lambda: loop_scene(adp_problem(cfg), solution.result))
        if draws(cfg.figures):
            out.figure(cfg.task, images(draw_adp(_drawn(solution))))
        _summarise(solution)
        _explain(cfg, solution)
        return out.metrics(solution.metrics)

    def size(self, settings: Mapping[str, object]) -> int:
        """Return about how many bytes the records take: no more than 200 000 states are kept."""
        rows, dt, duration = (settings.get(name) for name in ("trajectories", "dt", "duration"))
        if not all(isinstance(number, int | float) and number > 0 for number in (rows, dt, duration)):
            return 0  # it will be refused
        return int(8 * 40 * min(rows * duration / dt, 2e5))  # type: ignore[operator]


def _problem(cfg: DictConfig) -> AdpProblem:
    problem = adp_problem(cfg)
    animation_kind(cfg, problem.system.dim)
    return problem


def _solved(cfg: DictConfig, problem: AdpProblem, result: LoopResult) -> LoopSolution:
    optimum = compare(problem, result)
    metrics = adp_metrics(
        result,
        optimal_cost=optimum.cost,
        control_error=optimum.control_error,
        value_error=optimum.value_error,
        final=problem.cost.around(problem.system).deviation(result.state[:, -1]),
    )
    metrics["held_spectral_radius"] = held_radius(problem, result)
    if isinstance(problem.controller, SafetyFilter):
        report = problem.controller.report(result)
        metrics |= {f"wall_{name}": report[name] for name in ("minimum_margin", "constraint_violations")}
        metrics["wall_acted"] = report["acted"]
    count_the_restless(problem.cost.around(problem.system), result)
    own = make_metrics(cfg.get("metric"))
    metrics |= {metric.name: metric.worst(result, problem) for metric in own}
    method = f"{type(problem.system).__name__} with {problem.controller.label}"
    return LoopSolution(result, optimum, method, problem.dt, problem.steps, metrics)


def held_radius(problem: AdpProblem, result: LoopResult) -> float | None:
    """The spectral radius of the linearised loop over one dt with the control held, with the weights of the
    end; of a controller with weights the largest of the first rows. None where something has no slope."""
    at = problem.cost.around(problem.system).target

    def radius(row: int) -> float:
        return HeldLoop.of(_frozen(problem, result, row), problem.system, at=at).spectral_radius(problem.dt)

    rows = range(min(_LINEARISED, len(result.state)) if result.actor_weights.shape[-1] else 1)
    radii = [radius(row) for row in rows]
    return max(radii) if all(map(math.isfinite, radii)) else None


def _frozen(problem: AdpProblem, result: LoopResult, row: int) -> Callable[[Tensor], Tensor]:
    """u(x) of the controller with what it had learned at the end of a row."""

    def policy(x: Tensor) -> Tensor:
        leaves, structure = flatten(result.carried)
        carried = unflatten(structure, (part[row].expand(len(x), *part.shape[1:]) for part in leaves))
        drawn = x.new_zeros(len(x), problem.controller.draws, x.shape[-1])
        return problem.controller.step(x, carried, drawn, problem.dt)[0]

    return policy


def solve(problem: AdpProblem, progress: Progress = SHOWN) -> LoopResult:
    """Run the closed loop."""
    with progress.over(problem.steps, "steps") as advance:
        (result,) = simulate_together([problem], advance)
    return result


def simulate_together(
    problems: Sequence[AdpProblem], progress: Callable[[int], None] | None = None
) -> list[LoopResult]:
    """Run problems, at least one; those that differ in numbers alone are one loop with numbers of rows."""

    def run(
        jobs: Sequence[int], objects: Any, rows: RowsOfJobs, advance: Callable[[int], None] | None
    ) -> list[LoopResult]:
        with rows.of():
            return _simulated([problems[i] for i in jobs], objects, advance)

    return in_calls(
        run,
        [(one.controller, one.system, one.cost) for one in problems],
        [len(one.initial_states) for one in problems],
        [(one.dt, one.steps, one.every, one.integrator, one.compile) for one in problems],
        progress,
    )


def _simulated(
    problems: Sequence[AdpProblem],
    objects: tuple[Controller, Plant, Cost],
    progress: Callable[[int], None] | None,
) -> list[LoopResult]:
    """Run problems as one loop of these objects."""
    first = problems[0]
    counts = [len(problem.initial_states) for problem in problems]
    seeds: list[int] = []
    if len(problems) > 1:
        for problem, rows in zip(problems, counts, strict=True):
            seeds += range(problem.seed, problem.seed + rows)
    result = simulate(
        *objects,
        torch.cat([problem.initial_states for problem in problems]),
        dt=first.dt,
        steps=first.steps,
        every=first.every,
        seed=seeds or first.seed,
        integrator=first.integrator,
        compile=first.compile,
        progress=progress,
    )
    if len(problems) == 1:
        return [result]
    return [
        dataclasses.replace(part, about=_about(problem))
        for part, problem in zip(result.split(counts), problems, strict=True)
    ]


def _about(problem: AdpProblem) -> LoopAbout:
    """Return what a result of `simulate` says of the loop of one problem."""

    def again(other: Controller, start: Tensor) -> LoopResult:
        return simulate(
            *(other, problem.system, problem.cost, start),
            dt=problem.dt,
            steps=problem.steps,
            every=problem.every,
            integrator=problem.integrator,
        )

    cost = problem.cost.around(problem.system)
    return LoopAbout.of(problem.controller, problem.system, cost, problem.dt, again)


def innermost(controller: Controller) -> Controller:
    """Return the controller behind supervisors and filters."""
    while isinstance(controller, Supervised | SafetyFilter):
        controller = controller.controller
    return controller


def learner(controller: Controller) -> ActorCritic | None:
    """Return what learns in a controller, behind a supervisor or a filter; None where nothing does."""
    inner = innermost(controller)
    return inner if isinstance(inner, ActorCritic) else None


def recorded(result: LoopResult) -> dict[str, Tensor]:
    """Return what a history holds of a closed loop, by name."""
    names = ("state", "control", "actor_weights", "critic_weights", "running_cost")
    return {name: getattr(result, name) for name in names}


def count_the_restless(cost: Cost, result: LoopResult) -> None:
    """Warn where the state's cost rate in the last quarter of the run never fell to a quarter of what it was
    at first, with the number of such trajectories."""
    rate = cost.state_rate(result.state)  # (B, T)
    late = rate[:, -max(1, rate.shape[1] // 4) :].amin(1)
    moving = (rate[:, 0] > 0) & (late > _SETTLING * rate[:, 0])
    if restless := int((moving & ~result.diverged).sum()):
        _log.warning(
            "%d of %d trajectories are not regulated: in the last quarter of the %.4g s their state never "
            "paid less than a quarter of its first cost rate",
            *(restless, len(rate), float(result.time[-1])),
        )


def _summarise(solved: LoopSolution) -> None:
    def show(name: str) -> str:
        return significant(solved.metrics[name], 5)

    about = solved.method, trajectories(len(solved.result.state)), solved.steps * solved.dt, solved.dt
    _log.info("Closed loop: %s, %s, %g s in steps of %g s", *about)
    _log.info("  cost %s, optimal %s, ratio %s", *map(show, ("cost", "optimal_cost", "cost_ratio")))
    _log.info("  second half: |u - u*| <= %s, |V - V^| <= %s", *map(show, ("control_error", "value_error")))
    names = ("final_state_norm", "regulated_fraction", "diverged_fraction", "held_spectral_radius")
    _log.info("  final |x| %s, regulated %s, diverged %s, held spectral radius %s", *map(show, names))


_PRINTED: Mapping[str, object] = {
    "adp.law._target_": "staf_torch.adp.Published",
    "adp.integrator": "euler",
    "centers.shrink.offset": 0.01,
    "system.as_printed": True,
}
"""What the paper prints of its example, where `staf experiment=adp` has something better or right."""


def _explain(cfg: DictConfig, solved: LoopSolution) -> None:
    """Say what differs from the paper's print, and where a loop that learns pays more than the optimum."""
    if "actor-critic (" not in solved.method or "(Frozen)" in solved.method:
        return
    if solved.method.startswith("TwoState with"):
        here = {name: OmegaConf.select(cfg, name) for name in _PRINTED}
        others = [
            f"{name.removesuffix('._target_')} {_last(value)} (print: {_last(_PRINTED[name])})"
            for name, value in here.items()
            if value != _PRINTED[name]
        ]
        if others:
            told = "  not as the paper prints it: %s; experiment=adp_as_printed is the print"
            _log.info(told, ", ".join(others))
        if here["system.as_printed"]:
            _log.info(
                "  as the paper prints it, with its misprint: the drift lost a '1 -', and the paper's V* "
                "is not that of this plant (system=two_state is that of V*)"
            )
    error, ratio = solved.optimum.control_error, solved.metrics["cost_ratio"]
    if error is not None and ratio is not None and ratio > 1 + _LEARNING:
        told = "  above the optimum: paid wherever u is not u*; at t = 0, by the first weights, |u-u*| is %s"
        _log.info(told, significant(float(error[:, 0].max()), 3))


def _last(value: object) -> str:
    """Return a number, or the name at the end of a dotted path."""
    return value.rpartition(".")[2] if isinstance(value, str) else str(value)


def _drawn(solution: LoopSolution) -> AdpHistory:
    """The first trajectory, its angles in [-pi, pi]."""
    result, optimum = solution.result, solution.optimum

    errors = {"control_error": optimum.control_error, "value_error": optimum.value_error}
    first: dict[str, Any] = {name: rows[0].cpu().numpy() for name, rows in recorded(result).items()}
    first |= {name: None if rows is None else rows[0].cpu().numpy() for name, rows in errors.items()}
    shown = picture(result, [0], lqr=False)
    names = ("state_units", "input_units", "low", "high")
    first |= {"state": shown.state[0], **{name: getattr(shown, name) for name in names}}
    best = None if optimum.cost is None else float(optimum.cost[0])
    return AdpHistory(time=result.time.numpy(), optimal_cost=best, **first)

"""All update laws and predictors side by side, at equal work."""

from __future__ import annotations

import dataclasses
import json
import logging
import math
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from omegaconf import DictConfig
from torch import Tensor

from .. import optim, theory
from ..engine.predictors import Predictor, Secant, Tangent
from ..figures.chase import ConvergenceCurve, draw_convergence
from ..metrics.chase import StateErrorPass
from ..numerics.checks import COMMAND_LINE, fail, integer, positive_real, vector
from ..optim import UpdateLaw
from ..results.run_directory import RunDirectory
from ..settings.chase import ChaseProblem, chase_problem, plain
from ..signs import SHOWN, Progress
from ..systems import simulate
from ..tables import Table
from . import chase_batch
from .registry import Metrics, finite, log_slope
from .study import report

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_log = logging.getLogger(__name__)
_STATES = 400  # at which the a-priori constants are taken
_HEADINGS = {
    "law": "law",
    "iterations": "its",
    "predictor": "predictor",
    "products": "products/s",
    "ultimate_error": "error at x",
    "ball_error": "sup on ball",
    "gradient_error": "gradient error",
    "ultimate_excess_before": "excess before",
    "ultimate_excess": "excess after",
    "contraction_violations": "rate broken",
    "certificate_violations": "bound broken",
}


class LawCase(NamedTuple):
    """A row of the comparison."""

    law: UpdateLaw
    iterations: int  # a time step
    predictor: Predictor | None
    products: int  # M x M products a time step: with K, with K^-1, and of the predictor

    @property
    def name(self) -> str:
        """The law alone, as in a sentence."""
        return self.law.title

    @property
    def predicted(self) -> str:
        """The predictor, as in a sentence."""
        return "none" if self.predictor is None else self.predictor.title

    @property
    def key(self) -> str:
        """The prefix of the row's metrics."""
        words = f"{self.name} x{self.iterations} {'' if self.predictor is None else self.predicted}"
        return "_".join(words.replace("(", "").replace(")", "").split()).lower()


def cases(work: int, count: int) -> list[LawCase]:
    """Every law at up to ``work`` products with K a time step, at least 2, with ``count`` centers, then the
    predictors.

    Laws that are done sooner are not given more, and what a predictor costs is taken from the iterations; one
    is left where it costs as much as all of them.
    """
    many = work - 1
    chosen: list[tuple[UpdateLaw, int, Predictor | None]] = [
        (optim.FixedStep(), 1, None),
        (optim.FixedStep(), many, None),
        (optim.SteepestDescent(), 1, None),
        (optim.SteepestDescent(), many, None),
        (optim.PreconditionedDescent("jacobi"), many, None),
        (optim.BarzilaiBorwein(), many, None),
        (optim.HeavyBall(), many, None),
        (optim.Nesterov(), many, None),
        (optim.ConjugateGradient(), min(2, count), None),
        (optim.ConjugateGradient(), min(count, many), None),
        (optim.PreconditionedDescent("core"), 1, None),
        (optim.Exact(), 1, None),
        (optim.RecursiveLeastSquares(), 1, None),
        (optim.NormalisedLMS(), 1, None),
    ]
    for predictor in (Secant(), Tangent(order=1), Tangent(order=2)):
        rest = max(1, many - predictor.products(count))
        chosen += [(optim.SteepestDescent(), iterations, predictor) for iterations in (1, rest)]
        chosen.append((optim.Exact(), 1, predictor))
    rows = []
    for law, iterations, ahead in chosen:
        products = law.products(count, iterations) + (0 if ahead is None else ahead.products(count))
        rows.append(LawCase(law, iterations, ahead, products))
    return list({case.key: case for case in rows}.values())  # with two centers a row would repeat itself


def curves(work: int, count: int) -> list[LawCase]:
    """The rows worth a curve over the step: each predictor, with the cheapest law and with the exact one."""
    exact, cheap, paper = ("exact", 1), ("steepest descent", 1), ("steepest descent", work - 1)
    shown = {
        "none": (paper, exact),
        "secant": (paper, exact),
        "tangent order 1": (cheap, exact),
        "tangent order 2": (cheap, exact),
    }
    return [row for row in cases(work, count) if (row.name, row.iterations) in shown[row.predicted]]


class LawCurve(NamedTuple):
    """The excess before the correction against the step."""

    case: LawCase
    excess: list[float | None]  # a step
    slope: float | None  # d log(excess) / d log(dt), least squares


def run(cfg: DictConfig, directory: Path, progress: Progress = SHOWN) -> Metrics:
    """Run what the settings describe and fill the run directory; `metrics.json` comes last."""
    problem = dataclasses.replace(chase_problem(cfg), certificate=True)
    work = integer(COMMAND_LINE, "laws.work", cfg.laws.work, least=2)
    excess = positive_real(COMMAND_LINE, "laws.excess", cfg.laws.excess)
    steps = _steps(cfg, problem)
    compared, drawn = cases(work, problem.basis.count), curves(work, problem.basis.count)
    chases = len(compared) + len(drawn) * sum(problem.dt / dt for dt in steps)  # of as many times each
    expected = int(chases * problem.steps) * len(problem.initial_states)
    errors = StateErrorPass(problem.basis, problem.target, expected=expected)  # of the same states always
    rows = table(problem, compared, errors, progress)
    swept = sweep(problem, drawn, steps, errors, progress)
    promised = promises(problem, excess)
    out = RunDirectory(directory)
    every = Table.of([{name: value for name, value in row.items() if name != "key"} for row in rows])
    out.text("laws.json", json.dumps(rows, indent=2, allow_nan=False) + "\n")
    about = f"t >= {problem.settle_time:g} s, dt = {problem.dt:g} s, {problem.basis.count} centers"
    heading = f"Worst over {about}:"
    shown = Table.of(rows, _HEADINGS)
    report(cfg, out, _log, "laws", every, partial(_drawn, swept, steps), shown=shown, heading=heading)
    _summarise(problem, swept, promised, excess)
    numbers = {(row["key"], name): x for row in rows for name, x in row.items() if not isinstance(x, str)}
    numbers |= {(curve.case.key, "slope"): curve.slope for curve in swept}
    return out.metrics({f"{key}.{name}": value for (key, name), value in numbers.items()} | promised)


def table(
    problem: ChaseProblem, compared: list[LawCase], errors: StateErrorPass, progress: Progress = SHOWN
) -> list[dict[str, str | float | None]]:
    """Return a row a case: its law, its cost, and the metrics of its gradient chase."""
    return [
        {
            "key": case.key,
            "law": case.name,
            "iterations": case.iterations,
            "predictor": case.predicted,
            "products": case.products / problem.dt,
            **_metrics(problem, case, errors),
        }
        for case in progress.each(compared, "laws")
    ]


def _metrics(problem: ChaseProblem, case: LawCase, errors: StateErrorPass) -> Metrics:
    law: dict[str, Any] = {"law": case.law, "inner_steps": case.iterations, "predictor": case.predictor}
    (outcome,) = chase_batch.simulate([dataclasses.replace(problem, **law)], [None], [False], errors=errors)
    return outcome.metrics


def sweep(
    problem: ChaseProblem,
    drawn: list[LawCase],
    steps: list[float],
    errors: StateErrorPass,
    progress: Progress = SHOWN,
) -> list[LawCurve]:
    """Each case over the same horizon at every step."""
    duration = problem.dt * problem.steps

    def excess(case: LawCase, dt: float) -> float | None:
        refined = dataclasses.replace(problem, dt=dt, steps=math.floor(duration / dt + 1e-9))
        return _metrics(refined, case, errors)["ultimate_excess_before"]

    found = []
    for case in progress.each(drawn, "laws over all dt"):
        curve = [excess(case, dt) for dt in steps]
        found.append(LawCurve(case, curve, log_slope(steps, curve)))
    return found


def promises(problem: ChaseProblem, excess: float) -> Metrics:
    """Return the a-priori bounds for the paper's law at the problem's step and iterations: the
    a-priori excess, the step and the iterations that a wanted excess needs, and the paper's own step."""
    system, law = problem.system, optim.SteepestDescent()
    states = _states(problem).flatten(0, 1)
    states = states[:: -(-states.shape[0] // _STATES)]
    its, dt = problem.inner_steps, problem.dt
    try:
        velocities = system.drift(states)
        constants = theory.drift_constants(problem.basis, problem.target, states, velocities)
        bound = theory.ultimate_bound(constants, law, dt=dt, inner_steps=its)
        found: Metrics = {
            "a_priori.ultimate_excess_before": bound.before,
            "a_priori.ultimate_excess": bound.after,
            "a_priori.step": theory.step_for_bound(constants, law, excess=excess, inner_steps=its),
            "a_priori.iterations": theory.steps_for_bound(constants, law, excess=excess, dt=dt),
            "a_priori.paper_step": theory.paper_step(
                problem.basis, problem.target, states, velocities, excess=excess
            ).dt,
        }
    except ValueError as error:
        _log.warning("no a-priori bound: %s", error)
        return {}
    return {name: finite(value) for name, value in found.items()}


def _states(problem: ChaseProblem) -> Tensor:
    """Return the states of all rows and times, (B, T, n)."""
    return simulate(problem.system, problem.initial_states, dt=problem.dt, steps=problem.steps)


run.held = lambda cfg: {"state": _states(chase_problem(cfg))}  # type: ignore[attr-defined]


def _steps(cfg: DictConfig, problem: ChaseProblem) -> list[float]:
    name, duration = "laws.steps", problem.dt * problem.steps
    listed = vector(COMMAND_LINE, name, plain(cfg.laws.steps))
    steps = [positive_real(COMMAND_LINE, name, dt) for dt in listed]
    if len(steps) < 2 or max(steps) > duration:
        rule = f"must be two or more steps within the duration ({duration:g} s)"
        raise fail(COMMAND_LINE, name, rule, steps)
    return steps


def _drawn(swept: list[LawCurve], steps: list[float]) -> Figure:
    curves = []
    for case, excess, slope in swept:
        label = f"{case.name} x{case.iterations}" + ("" if case.predictor is None else f", {case.predicted}")
        # a missing excess is NaN
        curves.append(ConvergenceCurve(label, np.array(steps), np.array(excess, dtype=float), slope))
    return draw_convergence(curves)


def _summarise(
    problem: ChaseProblem, swept: list[LawCurve], promised: dict[str, float | None], excess: float
) -> None:
    _log.info("Excess before the correction ~ dt^slope:")
    for curve in swept:
        slope = "-" if curve.slope is None else f"{curve.slope:.2f}"
        _log.info(
            "  %-20s x%-3d %-16s %s", curve.case.name, curve.case.iterations, curve.case.predicted, slope
        )
    if promised:
        show = {name: "none" if value is None else f"{value:.3g}" for name, value in promised.items()}
        _log.info(
            "A priori bound, steepest descent x%d at dt = %g s: excess %s before and %s after the correction",
            *(problem.inner_steps, problem.dt),
            *(show["a_priori.ultimate_excess_before"], show["a_priori.ultimate_excess"]),
        )
        _log.info(
            "For an excess of %g: dt = %s s, or %s iterations; by the paper's own constants, dt = %s s",
            *(excess, show["a_priori.step"], show["a_priori.iterations"], show["a_priori.paper_step"]),
        )

"""All update laws and predictors side by side, at equal work."""

from __future__ import annotations

import dataclasses
import json
import logging
import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf

from .. import optim, theory
from .._checks import fail, integer, positive_real, vector
from ..report import write_metrics, write_text
from ..report.tables import Row, csv_table, markdown_table
from ..systems import trajectory
from .build import ChaseProblem, chase_problem
from .gradient_chase import solve
from .law_cases import Case, cases, curves
from .progress import Progress

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


class Curve(NamedTuple):
    """The excess before the correction against the step."""

    case: Case
    excess: list[float | None]  # a step
    slope: float | None  # d log(excess) / d log(dt), least squares


def run(cfg: DictConfig, directory: Path) -> dict[str, float | None]:
    """Run what the settings describe and fill the run directory; `metrics.json` comes last."""
    problem = dataclasses.replace(chase_problem(cfg), certificate=True)
    work = integer("laws", "work", cfg.laws.work, least=2)
    excess = positive_real("laws", "excess", cfg.laws.excess)
    steps = _steps(cfg, problem)
    rows = table(problem, cases(work, problem.basis.count))
    swept = sweep(problem, curves(work, problem.basis.count), steps)
    promised = promises(problem, excess)
    _write(directory, rows)
    if cfg.figures:
        _draw(swept, steps, directory)
    _summarise(problem, rows, swept, promised, excess)
    metrics = _flat(rows) | {f"{curve.case.key}.slope": curve.slope for curve in swept} | promised
    write_metrics(directory / "metrics.json", metrics)
    return metrics


def table(problem: ChaseProblem, compared: list[Case]) -> list[dict[str, str | float | None]]:
    """One row a case: what it is, what it costs, and the metrics of its gradient chase."""
    rows: list[dict[str, str | float | None]] = []
    progress = Progress(len(compared) * (problem.steps + 1), "times")
    for case in compared:
        about: dict[str, str | float | None] = {
            "key": case.key,
            "law": case.name,
            "iterations": case.iterations,
            "predictor": case.predicted,
            "products": case.products / problem.dt,
        }
        about.update(solve(_with(problem, case), progress=progress).metrics)
        rows.append(about)
    return rows


def sweep(problem: ChaseProblem, drawn: list[Case], steps: list[float]) -> list[Curve]:
    """Each case over the same horizon at every step."""
    duration = problem.dt * problem.steps
    counts = [math.floor(duration / dt + 1e-9) for dt in steps]
    progress = Progress(len(drawn) * (sum(counts) + len(counts)), "times of the sweep over dt")
    found = []
    for case in drawn:
        excess = [
            solve(dataclasses.replace(_with(problem, case), dt=dt, steps=count), progress=progress).metrics[
                "ultimate_excess_before"
            ]
            for dt, count in zip(steps, counts, strict=True)
        ]
        found.append(Curve(case, excess, _slope(steps, excess)))
    return found


def promises(problem: ChaseProblem, excess: float) -> dict[str, float | None]:
    """What can be said before the run, about the paper's law at the problem's step and iterations: the
    a-priori excess, the step and the iterations that a wanted excess needs, and the paper's own step."""
    system, law = problem.system, optim.SteepestDescent()
    pieces = trajectory(system, problem.initial_states, dt=problem.dt, steps=problem.steps)
    states = torch.cat(list(pieces), dim=1).flatten(0, 1)
    states = states[:: -(-states.shape[0] // _STATES)]
    its, dt = problem.inner_steps, problem.dt
    try:
        velocities = system.drift(states)
        constants = theory.drift_constants(problem.basis, problem.target, states, velocities)
        bound = theory.ultimate_bound(constants, law, dt=dt, inner_steps=its)
        found: dict[str, float | None] = {
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
    return {
        name: value if value is not None and math.isfinite(value) else None for name, value in found.items()
    }


def _with(problem: ChaseProblem, case: Case) -> ChaseProblem:
    return dataclasses.replace(problem, law=case.law, inner_steps=case.iterations, predictor=case.predictor)


def _steps(cfg: DictConfig, problem: ChaseProblem) -> list[float]:
    stated = OmegaConf.to_container(cfg.laws.steps) if OmegaConf.is_list(cfg.laws.steps) else cfg.laws.steps
    steps = [positive_real("laws", "steps", dt) for dt in vector("laws", "steps", stated)]
    duration = problem.dt * problem.steps
    if len(steps) < 2 or max(steps) > duration:
        raise fail("laws", "steps", f"must be two or more steps within the duration ({duration:g} s)", steps)
    return steps


def _slope(steps: list[float], excess: list[float | None]) -> float | None:
    points = [
        (math.log(dt), math.log(e)) for dt, e in zip(steps, excess, strict=True) if e is not None and e > 0
    ]
    if len(points) < 2:
        return None
    log_dt, log_excess = np.array(points).T
    return float(np.polyfit(log_dt, log_excess, 1)[0])


def _flat(rows: list[dict[str, str | float | None]]) -> dict[str, float | None]:
    return {
        f"{row['key']}.{name}": value
        for row in rows
        for name, value in row.items()
        if not isinstance(value, str)
    }


def _write(directory: Path, rows: Sequence[Row]) -> None:
    columns = [name for name in rows[0] if name != "key"]
    write_text(directory / "laws.md", markdown_table(rows, _HEADINGS))
    write_text(directory / "laws.csv", csv_table(rows, columns))
    write_text(directory / "laws.json", json.dumps(rows, indent=2, allow_nan=False) + "\n")


def _draw(swept: list[Curve], steps: list[float], directory: Path) -> None:
    # Imported here: matplotlib takes a second, which figures=false need not pay.
    from ..report import plots

    folder = directory / "figures"
    folder.mkdir(exist_ok=True)
    lines = [
        plots.ConvergenceCurve(
            label=f"{curve.case.name} x{curve.case.iterations}"
            + (f", {curve.case.predicted}" if curve.case.predictor is not None else ""),
            step=np.array(steps),
            excess=np.array([np.nan if e is None else e for e in curve.excess]),
            slope=curve.slope,
        )
        for curve in swept
    ]
    plots.save(plots.draw_convergence(lines), folder / "laws")


def _summarise(
    problem: ChaseProblem,
    rows: list[dict[str, str | float | None]],
    swept: list[Curve],
    promised: dict[str, float | None],
    excess: float,
) -> None:
    _log.info(
        "Worst over t >= %g s, dt = %g s, %d centers:", problem.settle_time, problem.dt, problem.basis.count
    )
    for line in markdown_table(rows, _HEADINGS).splitlines():
        _log.info("%s", line)
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
            problem.inner_steps,
            problem.dt,
            show["a_priori.ultimate_excess_before"],
            show["a_priori.ultimate_excess"],
        )
        _log.info(
            "For an excess of %g: dt = %s s, or %s iterations; by the paper's own constants, dt = %s s",
            excess,
            show["a_priori.step"],
            show["a_priori.iterations"],
            show["a_priori.paper_step"],
        )

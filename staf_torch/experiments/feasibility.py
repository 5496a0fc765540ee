"""The smallest number of centers that keeps the error within epsilon along a trajectory."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from omegaconf import DictConfig
from torch import Tensor

from .. import theory
from ..figures.theory import Feasibility, draw_feasibility
from ..results.progress import SHOWN, Progress
from ..results.run_directory import RunDirectory
from ..settings.chase import LocalProblem, case_name, local_problem, numbers
from ..tables import Table
from .registry import Metrics
from .study import report

_log = logging.getLogger(__name__)
Rows = list[dict[str, float | int | None]]


class Needed(NamedTuple):
    """Centers that are needed, of L layouts, at the states (T) for R radii and E values of epsilon."""

    counts: Tensor  # (L,) M of the layouts
    errors: Tensor  # (R, L, T) sup on the ball
    pointwise: Tensor  # (R, E, T) the smallest M at the state, 0 where none does
    overall: Tensor  # (R, E) the smallest M for all states, 0 if none does


def run(cfg: DictConfig, directory: Path, progress: Progress = SHOWN) -> dict[str, float | None]:
    """Run what the settings describe and fill the run directory; `metrics.json` comes last."""
    problem = local_problem(cfg, "feasibility.states")
    radii = numbers(cfg, "feasibility.radii")
    epsilons = numbers(cfg, "feasibility.epsilons")[::-1]
    shown = sorted({*radii, problem.radius})
    needed = solve(problem, shown, epsilons, progress)
    out = RunDirectory(directory)
    rows, wide, metrics = _counted(needed, shown, epsilons)
    headings = {"radius": "r"} | {f"{epsilon:g}": f"eps = {epsilon:g}" for epsilon in epsilons}
    drawing = (lambda: draw_feasibility(_drawn(problem, needed, shown, epsilons))) if cfg.figures else None
    report(
        *(out, _log, "feasibility", Table.of(rows), drawing),
        shown=Table.of(wide, headings),
        heading="Smallest M with sup |V - V^| <= eps on the ball along the trajectory, ideal weights:",
    )
    pointwise = needed.pointwise[shown.index(problem.radius)]  # (E, T)
    out.text("feasibility_pointwise.csv", _pointwise(problem, pointwise, epsilons).csv())
    return out.metrics(metrics)


def solve(
    problem: LocalProblem, radii: list[float], epsilons: list[float], progress: Progress = SHOWN
) -> Needed:
    """All counts. One pass over the layouts a radius serves every epsilon."""
    layouts = theory.standard_layouts(problem.states.shape[-1])
    found = []
    for radius in progress.each(radii, "radii"):
        of_layouts = [
            theory.layout_errors(problem.target, problem.kernel, problem.states, radius, [layout])[0]
            for layout in layouts
        ]
        found.append(torch.stack(of_layouts))
    errors = torch.stack(found).cpu()  # (R, L, T)
    counts = torch.tensor([len(layout) for layout in layouts], dtype=torch.int64)
    allowed = torch.tensor(epsilons, dtype=errors.dtype)
    good = errors.unsqueeze(1) <= allowed[:, None, None]  # (R, E, L, T)
    return Needed(counts, errors, _first(good.mT, counts), _first(good.all(-1), counts))


def _first(good: Tensor, counts: Tensor) -> Tensor:
    """The first count that is good, 0 if none is: (..., L), (L,) -> (...)."""
    return torch.where(good.any(-1), counts[good.int().argmax(-1)], 0)


def _counted(needed: Needed, radii: list[float], epsilons: list[float]) -> tuple[Rows, Rows, Metrics]:
    """A row a radius and epsilon, a row a radius with a column an epsilon, and the metrics."""
    rows: Rows = []
    wide: Rows = []
    metrics: Metrics = {}
    for i, radius in enumerate(radii):
        wide.append({"radius": radius})
        for j, epsilon in enumerate(epsilons):
            count, least = int(needed.overall[i, j]) or None, int(needed.pointwise[i, j].min()) or None
            layout = int((needed.counts == count).int().argmax()) if count else None
            error = float(needed.errors[i, layout].max()) if layout is not None else None
            row = {"radius": radius, "epsilon": epsilon, "count": count}
            rows.append(row | {"least_pointwise": least, "error": error})
            wide[-1][f"{epsilon:g}"] = metrics[f"{case_name(radius, epsilon)}.count"] = count
    return rows, wide, metrics


def _pointwise(problem: LocalProblem, pointwise: Tensor, epsilons: list[float]) -> Table:
    """At the radius of the settings: time, state and M for each epsilon, one row a state."""
    names = ["time", *(f"x{i + 1}" for i in range(problem.states.shape[-1]))]
    names += [f"eps{epsilon:g}" for epsilon in epsilons]
    cells = zip(problem.time.tolist(), problem.states.tolist(), pointwise.mT.tolist(), strict=True)
    rows = [[time, *state, *(count or None for count in counts)] for time, state, counts in cells]
    return Table.of([dict(zip(names, row, strict=True)) for row in rows])


def _drawn(problem: LocalProblem, needed: Needed, radii: list[float], epsilons: list[float]) -> Feasibility:
    return Feasibility(
        time=problem.time.cpu().numpy(),
        state=problem.states.cpu().numpy(),
        radius=problem.radius,
        radii=np.array(radii),
        epsilons=np.array(epsilons),
        counts=needed.counts.numpy(),
        pointwise=needed.pointwise[radii.index(problem.radius)].numpy(),
        overall=needed.overall.numpy(),
    )

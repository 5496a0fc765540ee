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
from ..report import write_metrics, write_text
from ..report.tables import csv_table, markdown_table
from .build_theory import LocalProblem, case_name, local_problem, numbers
from .progress import Progress

_log = logging.getLogger(__name__)
_COLUMNS = ("radius", "epsilon", "count", "least_pointwise", "error")


class Needed(NamedTuple):
    """Centers that are needed, of L layouts, at the states (T) for R radii and E values of epsilon."""

    counts: Tensor  # (L,) M of the layouts
    errors: Tensor  # (R, L, T) sup on the ball
    pointwise: Tensor  # (R, E, T) the smallest M at the state, 0 where none does
    overall: Tensor  # (R, E) the smallest M for all states, 0 if none does


def run(cfg: DictConfig, directory: Path) -> dict[str, float | None]:
    """Run what the settings describe and fill the run directory; `metrics.json` comes last."""
    problem = local_problem(cfg, "feasibility.states")
    radii = numbers(cfg, "feasibility.radii")
    epsilons = numbers(cfg, "feasibility.epsilons")[::-1]
    shown = sorted({*radii, problem.radius})
    needed = solve(problem, shown, epsilons)
    metrics = _write(directory, problem, needed, shown, epsilons)
    if cfg.figures:
        _draw(directory, problem, needed, shown, epsilons)
    write_metrics(directory / "metrics.json", metrics)
    return metrics


def solve(problem: LocalProblem, radii: list[float], epsilons: list[float]) -> Needed:
    """All counts. One pass over the layouts a radius serves every epsilon."""
    layouts = theory.standard_layouts(problem.states.shape[-1])
    progress = Progress(len(radii) * len(layouts), "layouts")
    found = []
    for radius in radii:
        of_layouts = []
        for layout in layouts:
            of_layouts.append(
                theory.layout_errors(problem.target, problem.kernel, problem.states, radius, [layout])[0]
            )
            progress.advance(1)
        found.append(torch.stack(of_layouts))
    progress.close()
    errors = torch.stack(found).cpu()  # (R, L, T)
    counts = torch.tensor([len(layout) for layout in layouts])
    allowed = torch.tensor(epsilons, dtype=errors.dtype)
    good = errors.unsqueeze(1) <= allowed[:, None, None]  # (R, E, L, T)
    return Needed(counts, errors, _first(good.mT, counts), _first(good.all(-1), counts))


def _first(good: Tensor, counts: Tensor) -> Tensor:
    """The first count that is good, 0 if none is: (..., L), (L,) -> (...)."""
    return torch.where(good.any(-1), counts[good.int().argmax(-1)], 0)


def _write(
    directory: Path, problem: LocalProblem, needed: Needed, radii: list[float], epsilons: list[float]
) -> dict[str, float | None]:
    rows: list[dict[str, float | int | None]] = []
    wide: list[dict[str, float | int | None]] = []
    metrics: dict[str, float | None] = {}
    for i, radius in enumerate(radii):
        wide.append({"radius": radius})
        for j, epsilon in enumerate(epsilons):
            count, least = int(needed.overall[i, j]) or None, int(needed.pointwise[i, j].min()) or None
            layout = int((needed.counts == count).int().argmax()) if count else None
            error = float(needed.errors[i, layout].max()) if layout is not None else None
            rows.append(dict(zip(_COLUMNS, (radius, epsilon, count, least, error), strict=True)))
            wide[-1][f"{epsilon:g}"] = metrics[f"{case_name(radius, epsilon)}.count"] = count
    headings = {"radius": "r"} | {f"{epsilon:g}": f"eps = {epsilon:g}" for epsilon in epsilons}
    lines = markdown_table(wide, headings)
    write_text(directory / "feasibility.md", lines)
    write_text(directory / "feasibility.csv", csv_table(rows, _COLUMNS))
    _write_pointwise(directory, problem, needed.pointwise[radii.index(problem.radius)], epsilons)
    _log.info("Smallest M with sup |V - V^| <= eps on the ball along the trajectory, ideal weights:")
    for line in lines.splitlines():
        _log.info("%s", line)
    return metrics


def _write_pointwise(
    directory: Path, problem: LocalProblem, pointwise: Tensor, epsilons: list[float]
) -> None:
    """At the radius of the settings: time, state and M for each epsilon, one row a state."""
    names = ["time", *(f"x{i + 1}" for i in range(problem.states.shape[-1]))]
    names += [f"eps{epsilon:g}" for epsilon in epsilons]
    rows: list[dict[str, float | int | None]] = []
    for time, state, counts in zip(
        problem.time.tolist(), problem.states.tolist(), pointwise.mT.tolist(), strict=True
    ):
        rows.append(dict(zip(names, [time, *state, *(count or None for count in counts)], strict=True)))
    write_text(directory / "feasibility_pointwise.csv", csv_table(rows, names))


def _draw(
    directory: Path, problem: LocalProblem, needed: Needed, radii: list[float], epsilons: list[float]
) -> None:
    # Imported here: matplotlib takes a second, which figures=false need not pay.
    from ..report import plots, plots_theory

    folder = directory / "figures"
    folder.mkdir(exist_ok=True)
    figure = plots_theory.draw_feasibility(
        plots_theory.Feasibility(
            time=problem.time.cpu().numpy(),
            state=problem.states.cpu().numpy(),
            radius=problem.radius,
            radii=np.array(radii),
            epsilons=np.array(epsilons),
            counts=needed.counts.numpy(),
            pointwise=needed.pointwise[radii.index(problem.radius)].numpy(),
            overall=needed.overall.numpy(),
        )
    )
    plots.save(figure, folder / "feasibility")

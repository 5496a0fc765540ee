"""The error of every layout, against the number of centers and against the radius."""

from __future__ import annotations

import dataclasses
import logging
import math
import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from omegaconf import DictConfig
from torch import Tensor

from .. import theory
from ..centers import ball, cross_polytope, polygon, rings, simplex
from ..report import write_metrics, write_text
from ..report.tables import csv_table, markdown_table
from .build_theory import LocalProblem, local_problem, numbers
from .progress import Progress

_log = logging.getLogger(__name__)
_DEGREES = 7  # of `ball`: C(n + k, n) points for k = 0 .. 6
_MOST_CENTERS = 130
_RESOLVED = 100  # rounding errors of V: what is below says nothing about the slope
_HEADINGS = {"layout": "layout", "count": "M", "error": "error", "order": "order", "slope": "slope"}


@dataclasses.dataclass(frozen=True)
class Layout:
    """One layout of a family."""

    family: str
    directions: Tensor  # (M, n)
    order: int  # k + 1: the error is O(r^{k+1})

    @property
    def count(self) -> int:
        """M."""
        return len(self.directions)


class LayoutError(NamedTuple):
    """What a layout leaves, with ideal weights, at the worst state."""

    layout: Layout
    error: float  # at the radius of the settings
    errors: list[float]  # at the radii of the experiment
    slope: float | None  # d log(error) / d log(r), least squares


def run(cfg: DictConfig, directory: Path) -> dict[str, float | None]:
    """Run what the settings describe and fill the run directory; `metrics.json` comes last."""
    problem = local_problem(cfg, "layouts.states")
    radii = numbers(cfg, "layouts.radii")
    found = solve(problem, radii)
    _write(directory, problem, found, radii)
    if cfg.figures:
        _draw(directory, problem, found, radii)
    metrics: dict[str, float | None] = {}
    for result in found:
        key = f"{result.layout.family}{result.layout.count}"
        metrics |= {f"{key}.error": _finite(result.error), f"{key}.slope": result.slope}
    write_metrics(directory / "metrics.json", metrics)
    return metrics


def layouts(dim: int) -> list[Layout]:
    """Every layout of the library in that dimension, the ones of a family in growing size."""
    planar = []
    if dim == 2:
        planar = [Layout("rings", rings(m), k + 1) for k, m in enumerate((3, 6, 10, 15, 21, 28), start=1)]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that a polygon stays second order is what is shown here
            planar += [Layout("polygon", polygon(m), 2) for m in (3, 4, 5, 6, 8, 10, 15, 21, 28)]
    sizes = [(k, math.comb(dim + k, dim)) for k in range(1, _DEGREES)]
    spread = [Layout("ball", ball(m, dim), k + 1) for k, m in sizes if m <= _MOST_CENTERS]
    corners = [
        Layout("simplex", simplex(dim), 2),
        Layout("cross_polytope", cross_polytope(dim), 2),
    ]
    return [*planar, *spread, *corners]


def solve(problem: LocalProblem, radii: list[float]) -> list[LayoutError]:
    """The errors of all layouts."""
    compared = layouts(problem.states.shape[-1])
    at = sorted({*radii, problem.radius})
    errors: dict[float, list[float]] = {}
    progress = Progress(len(at), "radii")
    for radius in at:
        directions = [layout.directions for layout in compared]
        worst = theory.layout_errors(problem.target, problem.kernel, problem.states, radius, directions)
        errors[radius] = worst.amax(-1).tolist()
        progress.advance(1)
    progress.close()
    rounding = torch.finfo(problem.states.dtype).eps * float(problem.target(problem.states).abs().max())
    found = []
    for i, layout in enumerate(compared):
        swept = [errors[radius][i] for radius in radii]
        slope = _slope(radii, swept, _RESOLVED * rounding)
        found.append(LayoutError(layout, errors[problem.radius][i], swept, slope))
    return found


def _slope(radii: list[float], errors: list[float], least: float) -> float | None:
    points = [(math.log(r), math.log(e)) for r, e in zip(radii, errors, strict=True) if e > least]
    if len(points) < 2:
        return None
    log_radius, log_error = np.array(points).T
    return float(np.polyfit(log_radius, log_error, 1)[0])


def _finite(number: float) -> float | None:
    return number if math.isfinite(number) else None


def _write(directory: Path, problem: LocalProblem, found: list[LayoutError], radii: list[float]) -> None:
    rows: list[dict[str, str | float | int | None]] = []
    for result in found:
        layout = result.layout
        row: dict[str, str | float | int | None] = {"layout": layout.family, "count": layout.count}
        row |= {"error": _finite(result.error), "order": layout.order, "slope": result.slope}
        rows.append(row | {f"r{r:g}": _finite(e) for r, e in zip(radii, result.errors, strict=True)})
    lines = markdown_table(rows, _HEADINGS)
    write_text(directory / "layouts.md", lines)
    write_text(directory / "layouts.csv", csv_table(rows, list(rows[0])))
    _log.info("sup |V - V^| on the ball, r = %g, ideal weights, and its slope in r:", problem.radius)
    for line in lines.splitlines():
        _log.info("%s", line)


def _draw(directory: Path, problem: LocalProblem, found: list[LayoutError], radii: list[float]) -> None:
    # Imported here: matplotlib takes a second, which figures=false need not pay.
    from ..report import plots, plots_theory

    folder = directory / "figures"
    folder.mkdir(exist_ok=True)
    curves = [
        plots_theory.LayoutCurve(
            family=result.layout.family,
            count=result.layout.count,
            error=result.error,
            errors=np.array(result.errors),
            slope=result.slope,
        )
        for result in found
    ]
    figure = plots_theory.draw_layouts(curves, problem.radius, np.array(radii))
    plots.save(figure, folder / "layouts")

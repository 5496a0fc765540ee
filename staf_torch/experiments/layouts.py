"""The error of every layout, against the number of centers and against the radius."""

from __future__ import annotations

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
from ..figures.theory import LayoutCurve, draw_layouts
from ..results.progress import SHOWN, Progress
from ..results.run_directory import RunDirectory
from ..settings.chase import LocalProblem, local_problem, numbers
from ..tables import Table
from .registry import finite, log_slope
from .study import report

_log = logging.getLogger(__name__)
_DEGREES = 7  # of `ball`: C(n + k, n) points for k = 0 .. 6
_MOST_CENTERS = 130
_RESOLVED = 100  # rounding errors of V: what is below says nothing about the slope
_HEADINGS = {"layout": "layout", "count": "M", "error": "error", "order": "order", "slope": "slope"}


class Layout(NamedTuple):
    """One layout of a family."""

    family: str
    directions: Tensor  # (M, n)
    order: int  # k + 1: the error is O(r^{k+1})


def run(cfg: DictConfig, directory: Path, progress: Progress = SHOWN) -> dict[str, float | None]:
    """Run what the settings describe and fill the run directory; `metrics.json` comes last."""
    problem = local_problem(cfg, "layouts.states")
    radii = numbers(cfg, "layouts.radii")
    found = solve(problem, radii, progress)
    out = RunDirectory(directory)
    rows = _rows(found, radii)
    drawing = (lambda: draw_layouts(found, problem.radius, np.array(radii))) if cfg.figures else None
    heading = f"sup |V - V^| on the ball, r = {problem.radius:g}, ideal weights, and its slope in r:"
    shown = Table.of(rows, _HEADINGS)
    report(out, _log, "layouts", Table.of(rows), drawing, shown=shown, heading=heading)
    metrics: dict[str, float | None] = {}
    for curve in found:
        key = f"{curve.family}{curve.centers}"
        metrics |= {f"{key}.error": finite(curve.error), f"{key}.slope": curve.slope}
    return out.metrics(metrics)


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


def solve(problem: LocalProblem, radii: list[float], progress: Progress = SHOWN) -> list[LayoutCurve]:
    """The errors that all layouts leave at the worst state, with ideal weights, and their slopes in r."""
    compared = layouts(problem.states.shape[-1])
    at = sorted({*radii, problem.radius})
    errors: dict[float, list[float]] = {}
    shapes = [layout.directions for layout in compared]
    for radius in progress.each(at, "radii"):
        worst = theory.layout_errors(problem.target, problem.kernel, problem.states, radius, shapes)
        errors[radius] = worst.amax(-1).tolist()
    rounding = torch.finfo(problem.states.dtype).eps * float(problem.target(problem.states).abs().max())
    found = []
    for i, (family, directions, order) in enumerate(compared):
        swept = [errors[radius][i] for radius in radii]
        slope = log_slope(radii, swept, _RESOLVED * rounding)
        error = errors[problem.radius][i]
        found.append(LayoutCurve(family, len(directions), order, error, np.array(swept), slope))
    return found


def _rows(found: list[LayoutCurve], radii: list[float]) -> list[dict[str, str | float | None]]:
    rows: list[dict[str, str | float | None]] = []
    for curve in found:
        row: dict[str, str | float | None] = {"layout": curve.family, "count": curve.centers}
        row |= {"error": finite(curve.error), "order": curve.order, "slope": curve.slope}
        rows.append(row | {f"r{r:g}": finite(e) for r, e in zip(radii, curve.errors, strict=True)})
    return rows

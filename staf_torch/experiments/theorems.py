"""Theorems beside measurements: the errors of layouts, the centers needed, the exponential bound."""

from __future__ import annotations

import logging
import math
import warnings
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from omegaconf import DictConfig
from torch import Tensor

from .. import theory
from ..centers import ball, cross_polytope, polygon, rings, simplex
from ..figures.chase import Feasibility, LayoutCurve, draw_exponential_bound, draw_feasibility, draw_layouts
from ..kernels import ExponentialKernel
from ..numerics.checks import COMMAND_LINE, fail, integer, positive_real
from ..results.run_directory import RunDirectory
from ..settings.chase import ChaseProblem, LocalProblem, chase_problem, local_problem, numbers
from ..signs import SHOWN, Progress
from ..tables import Table
from .registry import Metrics, finite, log_slope
from .study import report

_log = logging.getLogger(__name__)
_DEGREES = 7  # of `ball`: C(n + k, n) points for k = 0 .. 6
_MOST_CENTERS = 130
_RESOLVED = 100  # rounding errors of V: what is below says nothing about the slope
_LAYOUTS = {"layout": "layout", "count": "M", "error": "error", "order": "order", "slope": "slope"}
_MEASURED = ("error", "slope")  # of these, for the metrics

Rows = list[dict[str, float | int | None]]
Bounds = dict[tuple[float, float], dict[str, float | None]]
"""What was found, by radius and epsilon."""

_BOUNDS = {
    "radius": "r",
    "epsilon": "epsilon",
    "N": "N",
    "S": "S",
    "count": "C(n+N+S, n)",
    "m": "m",
    "error": "error",
    "degree": "b",
    "one_polynomial_count": "C(n+b, n)",
    "one_polynomial_m": "m (one)",
    "one_polynomial_error": "error (one)",
    "measured_count": "M measured",
}


class NamedLayout(NamedTuple):
    """A layout of a family."""

    family: str
    directions: Tensor  # (M, n)
    order: int  # k + 1: the error is O(r^{k+1})


def layouts(cfg: DictConfig, directory: Path, progress: Progress = SHOWN) -> Metrics:
    """Write the errors that all layouts leave, and their slopes in r; `metrics.json` comes last."""
    problem = local_problem(cfg, "layouts.states")
    radii = numbers(cfg, "layouts.radii")
    found = layout_curves(problem, radii, progress)
    out = RunDirectory(directory)
    rows: list[dict[str, Any]] = []
    for family, count, order, error, errors, slope in found:
        row = {"layout": family, "count": count, "error": finite(error), "order": order, "slope": slope}
        rows.append(row | {f"r{r:g}": finite(e) for r, e in zip(radii, errors, strict=True)})
    heading = f"sup |V - V^| on the ball, r = {problem.radius:g}, ideal weights, and its slope in r:"
    shown = Table.of(rows, _LAYOUTS)
    drawing = partial(draw_layouts, found, problem.radius, np.array(radii))
    report(cfg, out, _log, "layouts", Table.of(rows), drawing, shown=shown, heading=heading)
    return out.metrics({f"{r['layout']}{r['count']}.{name}": r[name] for r in rows for name in _MEASURED})


def all_layouts(dim: int) -> list[NamedLayout]:
    """Return every layout of the library in that dimension, the ones of a family in growing size."""
    planar = []
    if dim == 2:
        planar = [NamedLayout("rings", rings(m), k) for k, m in enumerate((3, 6, 10, 15, 21, 28), start=2)]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that a polygon stays second order is what is shown here
            planar += [NamedLayout("polygon", polygon(m), 2) for m in (3, 4, 5, 6, 8, 10, 15, 21, 28)]
    sizes = [(k, math.comb(dim + k, dim)) for k in range(1, _DEGREES)]
    spread = [NamedLayout("ball", ball(m, dim), k + 1) for k, m in sizes if m <= _MOST_CENTERS]
    corners = [NamedLayout("simplex", simplex(dim), 2), NamedLayout("cross_polytope", cross_polytope(dim), 2)]
    return [*planar, *spread, *corners]


def layout_curves(problem: LocalProblem, radii: list[float], progress: Progress = SHOWN) -> list[LayoutCurve]:
    """Return the errors that all layouts leave at the worst state with ideal weights, and their slopes."""
    compared = all_layouts(problem.states.shape[-1])
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


class Needed(NamedTuple):
    """Centers that are needed, of L layouts, at the states (T) for R radii and E values of epsilon."""

    counts: Tensor  # (L,) M of the layouts
    errors: Tensor  # (R, L, T) sup on the ball
    pointwise: Tensor  # (R, E, T) the smallest M at the state, 0 where none does
    overall: Tensor  # (R, E) the smallest M for all states, 0 if none does


def feasibility(cfg: DictConfig, directory: Path, progress: Progress = SHOWN) -> Metrics:
    """Write the smallest number of centers that keeps within epsilon; `metrics.json` comes last."""
    problem = local_problem(cfg, "feasibility.states")
    radii = numbers(cfg, "feasibility.radii")
    epsilons = numbers(cfg, "feasibility.epsilons")[::-1]
    shown = sorted({*radii, problem.radius})
    needed = needed_centers(problem, shown, epsilons, progress)
    out = RunDirectory(directory)
    rows, wide, metrics = _counted(needed, shown, epsilons)
    headings = {"radius": "r"} | {f"{epsilon:g}": f"eps = {epsilon:g}" for epsilon in epsilons}
    pointwise = needed.pointwise[shown.index(problem.radius)]  # (E, T)
    picture = Feasibility(
        time=problem.time.cpu().numpy(),
        state=problem.states.cpu().numpy(),
        radius=problem.radius,
        radii=np.array(shown),
        epsilons=np.array(epsilons),
        counts=needed.counts.numpy(),
        pointwise=pointwise.numpy(),
        overall=needed.overall.numpy(),
    )
    report(
        *(cfg, out, _log, "feasibility", Table.of(rows), partial(draw_feasibility, picture)),
        shown=Table.of(wide, headings),
        heading="Smallest M with sup |V - V^| <= eps on the ball along the trajectory, ideal weights:",
    )
    out.text("feasibility_pointwise.csv", _pointwise(problem, pointwise, epsilons).csv())
    return out.metrics(metrics)


def needed_centers(
    problem: LocalProblem, radii: list[float], epsilons: list[float], progress: Progress = SHOWN
) -> Needed:
    """All counts. One pass over the layouts a radius serves every epsilon."""
    layouts = theory.standard_layouts(problem.states.shape[-1])
    about = problem.target, problem.kernel, problem.states
    errors = torch.stack(  # (R, L, T)
        [
            torch.cat([theory.layout_errors(*about, radius, [layout]) for layout in layouts])
            for radius in progress.each(radii, "radii")
        ]
    ).cpu()
    counts = torch.tensor([len(layout) for layout in layouts], dtype=torch.int64, device="cpu")
    allowed = torch.tensor(epsilons, dtype=errors.dtype, device=errors.device)
    good = errors.unsqueeze(1) <= allowed[:, None, None]  # (R, E, L, T)
    pointwise, overall = (
        torch.where(enough.any(-1), counts[enough.int().argmax(-1)], 0) for enough in (good.mT, good.all(-1))
    )
    return Needed(counts, errors, pointwise, overall)


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
            wide[-1][f"{epsilon:g}"] = metrics[f"r{radius:g}.eps{epsilon:g}.count"] = count
    return rows, wide, metrics


def _pointwise(problem: LocalProblem, pointwise: Tensor, epsilons: list[float]) -> Table:
    """At the radius of the settings: time, state and M for each epsilon, one row a state."""
    names = ["time", *(f"x{i + 1}" for i in range(problem.states.shape[-1]))]
    names += [f"eps{epsilon:g}" for epsilon in epsilons]
    cells = zip(problem.time.tolist(), problem.states.tolist(), pointwise.mT.tolist(), strict=True)
    rows = [[time, *state, *(count or None for count in counts)] for time, state, counts in cells]
    return Table.of([dict(zip(names, row, strict=True)) for row in rows])


def exponential_bound(cfg: DictConfig, directory: Path, progress: Progress = SHOWN) -> Metrics:
    """Write what the theorem says is enough, beside what is; `metrics.json` comes last."""
    found = bounds(cfg, progress)
    rows = [{"radius": radius, "epsilon": epsilon, **row} for (radius, epsilon), row in found.items()]
    out = RunDirectory(directory)
    drawing = partial(draw_exponential_bound, found)
    report(cfg, out, _log, "exponential_bound", Table.of(rows, _BOUNDS), drawing)
    return out.metrics(
        {f"r{r:g}.eps{e:g}.{name}": value for (r, e), row in found.items() for name, value in row.items()}
    )


def bounds(cfg: DictConfig, progress: Progress = SHOWN) -> Bounds:
    """The bounds, and the smallest count of centers that does on the same states.

    Raises:
        ValueError: if a setting breaks its rule, or the kernel is another one.
    """
    name = "exponential_bound"
    problem = chase_problem(cfg)
    kernel = problem.basis.kernel
    if not isinstance(kernel, ExponentialKernel):
        raise fail(COMMAND_LINE, "kernel", "must be exponential: the theorem holds for no other", kernel)
    dim = problem.initial_states.shape[-1]
    settings = cfg.exponential_bound
    extent = positive_real(COMMAND_LINE, f"{name}.domain", settings.domain)
    count = integer(COMMAND_LINE, f"{name}.states", settings.states, least=2)
    most = integer(COMMAND_LINE, f"{name}.max_degree", settings.max_degree, least=0)
    domain = theory.disc(extent, dim=dim, count=count).to(problem.initial_states)
    radii, epsilons = numbers(cfg, f"{name}.radii"), numbers(cfg, f"{name}.epsilons")[::-1]
    layouts = theory.standard_layouts(dim)
    found: Bounds = {}
    for radius in progress.each(radii, "radii"):
        errors = theory.layout_errors(problem.target, kernel, domain, radius, layouts).amax(-1)  # (L,)
        for epsilon in epsilons:
            enough = torch.nonzero(errors <= epsilon).flatten().tolist()
            measured = len(layouts[enough[0]]) if enough else None
            row = _bound(problem, domain, radius, epsilon, most)
            found[radius, epsilon] = row | {"measured_count": measured}
    return found


def _bound(problem: ChaseProblem, domain: torch.Tensor, radius: float, epsilon: float, most: int) -> Metrics:
    found: Metrics = dict.fromkeys(list(_BOUNDS)[2:])
    about = (problem.target, domain, radius, epsilon)
    try:
        one = theory.one_polynomial_bound(*about, max_degree=most)
        found |= {"degree": one.degree, "one_polynomial_count": one.count}
        found |= {"one_polynomial_m": one.m, "one_polynomial_error": one.error}
        bound = theory.exponential_bound(*about, max_degree=most)
        two = bound.two_polynomials
        found |= {"N": bound.N, "S": bound.S, "count": two.count, "m": two.m, "error": two.error}
    except ValueError as error:
        _log.warning("r = %g: %s", radius, error)
    return found

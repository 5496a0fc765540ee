"""The theorem on the exponential kernel: what it says is enough, beside what is."""

from __future__ import annotations

import logging
from pathlib import Path

import torch
from omegaconf import DictConfig

from .. import theory
from ..figures.theory import draw_exponential_bound
from ..kernels import ExponentialKernel
from ..numerics.checks import COMMAND_LINE, fail, integer, positive_real
from ..results.progress import SHOWN, Progress
from ..results.run_directory import RunDirectory
from ..settings.chase import ChaseProblem, case_name, chase_problem, numbers
from ..tables import Table
from .study import report

Bounds = dict[tuple[float, float], dict[str, float | None]]
"""What was found, by radius and epsilon."""

_log = logging.getLogger(__name__)
_HEADINGS = {
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


def run(cfg: DictConfig, directory: Path, progress: Progress = SHOWN) -> dict[str, float | None]:
    """Run what the settings describe and fill the run directory; `metrics.json` comes last."""
    found = solve(cfg, progress)
    rows = [{"radius": radius, "epsilon": epsilon, **row} for (radius, epsilon), row in found.items()]
    out = RunDirectory(directory)
    drawing = (lambda: draw_exponential_bound(found)) if cfg.figures else None
    report(out, _log, "exponential_bound", Table.of(rows, _HEADINGS), drawing)
    metrics = {
        f"{case_name(*case)}.{name}": value for case, row in found.items() for name, value in row.items()
    }
    return out.metrics(metrics)


def solve(cfg: DictConfig, progress: Progress = SHOWN) -> Bounds:
    """The bounds, and the smallest count of centers that does on the same states.

    Raises:
        ValueError: if a setting breaks its rule, or the kernel is another one.
    """
    name = "exponential_bound"
    problem = chase_problem(cfg)
    kernel = problem.basis.kernel
    if not isinstance(kernel, ExponentialKernel):
        raise fail(COMMAND_LINE, "kernel", "must be exponential: the theorem is about no other", kernel)
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


def _bound(
    problem: ChaseProblem, domain: torch.Tensor, radius: float, epsilon: float, most: int
) -> dict[str, float | None]:
    found: dict[str, float | None] = dict.fromkeys(list(_HEADINGS)[2:])
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

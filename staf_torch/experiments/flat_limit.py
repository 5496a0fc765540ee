"""How many digits are left as the centers close in on the state: the flat limit."""

from __future__ import annotations

import copy
import logging
import math
from pathlib import Path
from typing import NamedTuple

import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from .._checks import COMMAND_LINE, fail, flag, integer, positive_real
from ..basis import StaFBasis, Target
from ..centers import StateFollowingCenters, probe_points, rings
from ..kernels import ExponentialKernel, GaussianKernel, Kernel
from ..report import write_metrics, write_text
from ..report.tables import Cell, csv_table, markdown_table
from ..targets import Paper
from .build import chase_problem
from .decimal_truth import interpolant, relative_error
from .flat_limit_methods import LABELS, METHODS
from .progress import Progress

_log = logging.getLogger(__name__)
_DTYPES = {"float64": torch.float64, "float32": torch.float32}
_POINTS = 9  # of the ball at which the approximants are compared


class Problem(NamedTuple):
    """What the settings describe, checked; all numbers such that float32 can hold them."""

    kernel: Kernel
    target: Target
    state: Tensor  # x, (2,)
    counts: list[int]
    radii: list[float]  # ascending
    per_decade: int


class Sample(NamedTuple):
    """The errors at one count, dtype and radius."""

    centers: int
    dtype: str
    radius: float
    error: dict[str, float]  # a method; inf where it fails


def run(cfg: DictConfig, directory: Path) -> dict[str, float | None]:
    """Run what the settings describe and fill the run directory; `metrics.json` comes last."""
    problem = problem_of(cfg)
    figures = flag(COMMAND_LINE, "figures", cfg.figures)
    samples = solve(problem)
    found = summary(samples)
    table = _table(problem, samples)
    write_text(directory / "flat_limit.md", table)
    write_text(directory / "flat_limit.csv", _csv(samples))
    if figures:
        _draw(samples, directory)
    _log.info("Relative value error against the radius, %s:", type(problem.kernel).__name__)
    for line in table.splitlines():
        _log.info("%s", line)
    write_metrics(directory / "metrics.json", found)
    return found


def problem_of(cfg: DictConfig) -> Problem:
    """The settings, checked.

    Raises:
        ValueError: for another kernel or target than the reference knows, or a setting out of range.
    """
    chase = chase_problem(cfg)
    kernel, target = chase.basis.kernel.double().cpu(), chase.target
    if not isinstance(kernel, ExponentialKernel | GaussianKernel):
        raise fail(COMMAND_LINE, "kernel", "must be exponential or gaussian for flat_limit", cfg.kernel)
    if not isinstance(target, Paper):
        raise fail(COMMAND_LINE, "target", "must be paper for flat_limit", cfg.target)
    state = chase.initial_states[0].cpu().float().double()
    if len(state) != 2:
        raise fail(COMMAND_LINE, "system", "must have two states for flat_limit", len(state))
    name = "flat_limit.radii.per_decade"
    per_decade = integer(COMMAND_LINE, name, cfg.flat_limit.radii.per_decade, least=1)
    return Problem(kernel, target, state, _counts(cfg), _radii(cfg, per_decade), per_decade)


def solve(problem: Problem) -> list[Sample]:
    """Every method in both dtypes, at every count and radius."""
    progress = Progress(len(problem.counts) * len(problem.radii), "radii")
    zeta = probe_points(_POINTS, 2).float().double()
    width = float(problem.kernel.width) if isinstance(problem.kernel, GaussianKernel) else None
    found = []
    for count in problem.counts:
        directions = rings(count)
        for radius in problem.radii:
            truth = interpolant(directions, radius, problem.state, zeta, width)
            for name, dtype in _DTYPES.items():
                kernel = copy.deepcopy(problem.kernel)
                basis = StaFBasis(kernel, StateFollowingCenters(directions, radius)).to(dtype)
                x, z = problem.state.to(dtype), (radius * zeta).to(dtype)
                error = {
                    key: relative_error(method(basis, problem.target, x, z), truth)
                    for key, method in METHODS.items()
                }
                found.append(Sample(count, name, radius, error))
            progress.advance(1)
    progress.close()
    return found


def summary(samples: list[Sample]) -> dict[str, float | None]:
    """By method and dtype: the worst error (null where it fails somewhere), over all counts and at each,
    and the largest radius at which it fails (null where it never does)."""
    found: dict[str, float | None] = {}
    for key in METHODS:
        for dtype in _DTYPES:
            chosen = [s for s in samples if s.dtype == dtype]
            found[f"{key}_error_{dtype}"] = _finite(max(s.error[key] for s in chosen))
            for count in sorted({s.centers for s in chosen}):
                rows = [s for s in chosen if s.centers == count]
                failed = [s.radius for s in rows if not math.isfinite(s.error[key])]
                found[f"{key}_error_{dtype}_{count}"] = _finite(max(s.error[key] for s in rows))
                found[f"{key}_fails_at_{dtype}_{count}"] = max(failed) if failed else None
    return found


def _counts(cfg: DictConfig) -> list[int]:
    stated = cfg.flat_limit.counts
    counts = OmegaConf.to_container(stated) if OmegaConf.is_list(stated) else [stated]
    assert isinstance(counts, list)
    if not counts:
        raise fail(COMMAND_LINE, "flat_limit.counts", "must not be empty", counts)
    return [integer(COMMAND_LINE, "flat_limit.counts", count, least=1) for count in counts]


def _radii(cfg: DictConfig, per_decade: int) -> list[float]:
    """The logarithmic grid and its end, each as float32 holds it."""
    stated = cfg.flat_limit.radii
    smallest = positive_real(COMMAND_LINE, "flat_limit.radii.smallest", stated.smallest)
    largest = positive_real(COMMAND_LINE, "flat_limit.radii.largest", stated.largest)
    if not 1e-30 <= smallest < largest:
        rule = f"must be at least 1e-30 and below the largest radius ({largest:g})"
        raise fail(COMMAND_LINE, "flat_limit.radii.smallest", rule, smallest)
    steps = math.floor(per_decade * math.log10(largest / smallest) * (1 - 1e-9))
    grid = [smallest * 10 ** (k / per_decade) for k in range(steps + 1)]
    return torch.tensor([*grid, largest], dtype=torch.float32).tolist()


def _table(problem: Problem, samples: list[Sample]) -> str:
    """Methods against the radii of whole decades from the smallest up, and the worst of all radii."""
    shown = problem.radii[: -1 : problem.per_decade]
    headings = {"dtype": "dtype", "centers": "centers", "method": "method"}
    headings |= {f"{radius:.0e}": f"r = {radius:.0e}" for radius in shown} | {"worst": "worst"}
    rows = []
    for dtype in _DTYPES:
        for count in problem.counts:
            chosen = [s for s in samples if (s.dtype, s.centers) == (dtype, count)]
            for key, label in LABELS.items():
                row: dict[str, Cell] = {"dtype": dtype, "centers": count, "method": label}
                row |= {f"{s.radius:.0e}": _cell(s.error[key]) for s in chosen if s.radius in shown}
                rows.append(row | {"worst": _cell(max(s.error[key] for s in chosen))})
    return markdown_table(rows, headings)


def _csv(samples: list[Sample]) -> str:
    rows: list[dict[str, Cell]] = []
    for s in samples:
        about: dict[str, Cell] = {"dtype": s.dtype, "centers": s.centers, "radius": s.radius}
        rows.append(about | {key: _finite(error) for key, error in s.error.items()})
    return csv_table(rows, list(rows[0]))


def _cell(error: float) -> str:
    return f"{error:.0e}" if math.isfinite(error) else "fails"


def _finite(error: float) -> float | None:
    return error if math.isfinite(error) else None


def _draw(samples: list[Sample], directory: Path) -> None:
    # Imported here: matplotlib takes a second, which figures=false need not pay.
    from ..report import plots, plots_flat_limit

    panels = [
        plots_flat_limit.ErrorPanel(
            title=f"{count} centers, {name}",
            rounding=torch.finfo(dtype).eps,
            radius=[s.radius for s in samples if (s.centers, s.dtype) == (count, name)],
            error={
                label: [s.error[key] for s in samples if (s.centers, s.dtype) == (count, name)]
                for key, label in LABELS.items()
            },
        )
        for name, dtype in _DTYPES.items()
        for count in dict.fromkeys(s.centers for s in samples)
    ]
    folder = directory / "figures"
    folder.mkdir(exist_ok=True)
    plots.save(plots_flat_limit.draw_errors(panels, rows=len(_DTYPES)), folder / "flat_limit")

"""The flat limit: digits that are left as the centers close in on the state.

The truth in high precision needs nothing but the standard library.
"""

from __future__ import annotations

import copy
import itertools
import logging
import math
from collections.abc import Callable, Sequence
from decimal import Decimal, localcontext
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from omegaconf import DictConfig
from torch import Tensor

from ..approximation.basis import StaFBasis, Target
from ..centers import StateFollowingCenters, probe_points, rings
from ..figures.chase import ErrorPanel, draw_errors
from ..kernels import ExponentialKernel, GaussianKernel, Kernel
from ..local_basis import evaluate_scaled, newton_space
from ..numerics.checks import COMMAND_LINE, fail, integer, positive_real
from ..results.files import grouped
from ..results.reader import Value
from ..results.run_directory import RunDirectory
from ..settings.chase import DTYPES, chase_problem, plain
from ..signs import SHOWN, Progress
from ..tables import Table
from ..targets import Paper
from .registry import Metrics, finite
from .study import report, tell_of_cpu

_log = logging.getLogger(__name__)
_POINTS = 9  # of the ball at which the approximants are compared

Method = Callable[[StaFBasis, Target, Tensor, Tensor], Tensor]
"""Basis, V, x (n,), offsets z (P, n) to V^(x + z) (P,): not finite where the method fails."""


def cholesky(basis: StaFBasis, target: Target, x: Tensor, z: Tensor, jitter: float = 0.0) -> Tensor:
    """K0 + jitter I = L L' and two triangular solves."""
    structure = basis.gram_structure(x)
    scale = torch.ones((), device="cpu").to(x) if structure.scale is None else structure.scale
    identity = torch.eye(basis.count, dtype=x.dtype, device=x.device)
    factor, info = torch.linalg.cholesky_ex(structure.core + jitter * identity)
    right = basis.values(x, target) / scale
    b = torch.cholesky_solve(right.unsqueeze(-1), factor).squeeze(-1)
    value = evaluate_scaled(basis.kernel, basis.centers.offsets(x), x, z, b)
    return torch.where(info == 0, value, torch.nan)


def pivoted(basis: StaFBasis, target: Target, x: Tensor, z: Tensor) -> Tensor:
    """The library's Newton basis, cut off at the numerical rank of K0."""
    space = newton_space(basis.kernel, x, basis.centers.offsets(x))
    return space.evaluate(z, space.fit(basis.values(x, target)))


def graded(basis: StaFBasis, target: Target, x: Tensor, z: Tensor) -> Tensor:
    """The local basis that the library uses for these kernels."""
    space = basis.local(x)
    return space.evaluate(z, space.fit(basis.values(x, target)))


METHODS: dict[str, tuple[str, Method]] = {
    "cholesky": ("Cholesky", cholesky),
    "jitter": ("Cholesky, jitter 1e-12", partial(cholesky, jitter=1e-12)),  # the usual remedy
    "pivoted": ("pivoted Cholesky", pivoted),
    "graded": ("graded basis", graded),
}
"""By the prefix of the metrics: name for people, and method."""


_EXACT = np.vectorize(Decimal, otypes=[object])  # of floats, to the exact numbers that they are
_EXP = np.vectorize(Decimal.exp, otypes=[object])


def paper(x: np.ndarray) -> np.ndarray:
    """V(x) = x1^2 + 5 x2^2 + tanh(x1 x2), as `targets.Paper`, of decimals: (..., 2) -> (...)."""
    square = _EXP(2 * x[..., 0] * x[..., 1])
    value: np.ndarray = x[..., 0] ** 2 + 5 * x[..., 1] ** 2 + (square - 1) / (square + 1)
    return value


def interpolant(
    directions: Tensor, radius: float, x: Tensor, zeta: Tensor, width: float | None
) -> list[Decimal]:
    """V^(x + r zeta) of the ideal weights for V of `paper`, by elimination on the textbook Gram matrix.

    Every float argument is taken as the exact number that it is. The condition number grows like
    r^(-2 degree), and the digits with it. A positive definite matrix needs no pivoting.

    Args:
        directions: u, (M, 2).
        radius: r.
        x: the state, (2,).
        zeta: points of the unit ball, (P, 2).
        width: of the Gaussian kernel, or None for the exponential one.

    Returns:
        P numbers, to 30 digits or more.
    """
    with localcontext() as context:
        context.prec = _digits(len(directions), radius)
        at, u, z = (_EXACT(each.double().numpy()) for each in (x, directions, zeta))
        d, z = Decimal(radius) * u, Decimal(radius) * z
        rate = Decimal(1) if width is None else 1 / Decimal(width) ** 2

        def scale(z: np.ndarray, sign: int) -> np.ndarray:
            """e^{sign s(x, z)}, s = x'z or -|z|^2 / (2 width^2)."""
            s = z @ at if width is None else -rate * (z * z).sum(-1) / 2
            factors: np.ndarray = _EXP(sign * s)
            return factors

        samples = paper(at + d) * scale(d, -1)
        rows = np.concatenate([_EXP(rate * d @ d.T), samples[:, None]], axis=1)  # of k0(z, d) = exp(rate z'd)
        for k in range(len(d)):
            rows[k] = rows[k] / rows[k, k]
            others = np.arange(len(d)) != k
            rows[others] -= rows[others, k, None] * rows[k]
        found: list[Decimal] = (scale(z, 1) * (_EXP(rate * z @ d.T) @ rows[:, -1])).tolist()
        return found


def relative_error(found: Tensor, truth: Sequence[Decimal]) -> float:
    """max |found - truth| / max |truth|; not finite where a value found is not."""
    if not bool(found.isfinite().all()):
        return math.inf
    gaps = [abs(Decimal(float(f)) - t) for f, t in zip(found.flatten(), truth, strict=True)]
    return float(max(gaps) / max(abs(t) for t in truth))


def _digits(count: int, radius: float) -> int:
    """Forty digits beyond log10 of the condition number, whose degree M points of the plane cannot exceed
    by more than the layouts here do: (k + 1)(k + 2) / 2 >= M, and one degree to spare."""
    degree = math.ceil((math.sqrt(8 * count + 1) - 3) / 2) + 1
    return 50 + math.ceil(2 * degree * max(0.0, -math.log10(radius)))


class FlatLimit(NamedTuple):
    """The checked settings, in numbers that float32 can hold."""

    kernel: Kernel
    target: Target
    state: Tensor  # x, (2,)
    counts: list[int]
    radii: list[float]  # ascending
    per_decade: int


class FlatLimitErrors(NamedTuple):
    """The errors at one count, dtype and radius."""

    centers: int
    dtype: str
    radius: float
    error: dict[str, float]  # a method; inf where it fails


def run(cfg: DictConfig, directory: Path, progress: Progress = SHOWN) -> Metrics:
    """Run what the settings describe and fill the run directory; `metrics.json` comes last."""
    problem = problem_of(cfg)
    tell_of_cpu(cfg, _log, "what is compared is rounding, in both dtypes")
    samples = solve(problem, progress)
    out = RunDirectory(directory)
    heading = f"Relative value error against the radius, {type(problem.kernel).__name__}:"
    shown = _shown(problem, samples)
    table, drawing = _every(samples), partial(draw_errors, _panels(samples), len(DTYPES))
    report(cfg, out, _log, "flat_limit", table, drawing, shown=shown, heading=heading)
    return out.metrics(summary(samples))


def problem_of(cfg: DictConfig) -> FlatLimit:
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
    return FlatLimit(kernel, target, state, _counts(cfg), _radii(cfg, per_decade), per_decade)


def solve(problem: FlatLimit, progress: Progress = SHOWN) -> list[FlatLimitErrors]:
    """Every method in both dtypes, at every count and radius."""
    zeta = probe_points(_POINTS, 2).float().double()
    width = float(problem.kernel.width) if isinstance(problem.kernel, GaussianKernel) else None
    found = []
    pairs = list(itertools.product(problem.counts, problem.radii))
    for count, radius in progress.each(pairs, "radii and counts"):
        centers = StateFollowingCenters(rings(count), radius)
        truth = interpolant(rings(count), radius, problem.state, zeta, width)
        for name, dtype in DTYPES.items():
            basis = copy.deepcopy(StaFBasis(problem.kernel, centers)).to(dtype)
            about = basis, problem.target, problem.state.to(dtype), (radius * zeta).to(dtype)
            error = {key: relative_error(method(*about), truth) for key, (_, method) in METHODS.items()}
            found.append(FlatLimitErrors(count, name, radius, error))
    return found


def summary(samples: list[FlatLimitErrors]) -> Metrics:
    """By method and dtype: the worst error (null where it fails somewhere), over all counts and at each,
    and the largest radius at which it fails (null where it never does)."""
    found: Metrics = {}
    for key in METHODS:
        for dtype in DTYPES:
            chosen = [s for s in samples if s.dtype == dtype]
            found[f"{key}_error_{dtype}"] = finite(max(s.error[key] for s in chosen))
            for count, rows in sorted(grouped(chosen, lambda s: s.centers).items()):
                failed = (s.radius for s in rows if not math.isfinite(s.error[key]))
                found[f"{key}_error_{dtype}_{count}"] = finite(max(s.error[key] for s in rows))
                found[f"{key}_fails_at_{dtype}_{count}"] = max(failed, default=None)
    return found


def _counts(cfg: DictConfig) -> list[int]:
    stated = plain(cfg.flat_limit.counts)
    counts = stated if isinstance(stated, list) else [stated]
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
    return torch.tensor([*grid, largest], dtype=torch.float32, device="cpu").tolist()


def _shown(problem: FlatLimit, samples: list[FlatLimitErrors]) -> Table:
    """Methods against the radii of whole decades from the smallest up, and the worst of all radii."""
    shown = problem.radii[: -1 : problem.per_decade]
    headings = {"dtype": "dtype", "centers": "centers", "method": "method"}
    headings |= {f"{radius:.0e}": f"r = {radius:.0e}" for radius in shown} | {"worst": "worst"}
    rows = []
    for dtype, count in itertools.product(DTYPES, problem.counts):
        chosen = [s for s in samples if (s.dtype, s.centers) == (dtype, count)]
        for key, (label, _) in METHODS.items():
            row: dict[str, Value] = {"dtype": dtype, "centers": count, "method": label}
            row |= {f"{s.radius:.0e}": _cell(s.error[key]) for s in chosen if s.radius in shown}
            rows.append(row | {"worst": _cell(max(s.error[key] for s in chosen))})
    return Table.of(rows, headings)


def _every(samples: list[FlatLimitErrors]) -> Table:

    def row(s: FlatLimitErrors) -> dict[str, Value]:
        errors = {key: finite(error) for key, error in s.error.items()}
        return {"dtype": s.dtype, "centers": s.centers, "radius": s.radius, **errors}

    return Table.of([row(s) for s in samples])


def _cell(error: float) -> str:
    return f"{error:.0e}" if math.isfinite(error) else "fails"


def _panels(samples: list[FlatLimitErrors]) -> list[ErrorPanel]:
    """A panel for each dtype and count."""
    groups = grouped(samples, lambda s: (s.dtype, s.centers))
    return [
        ErrorPanel(
            title=f"{count} centers, {name}",
            rounding=torch.finfo(DTYPES[name]).eps,
            radius=[s.radius for s in chosen],
            error={label: [s.error[key] for s in chosen] for key, (label, _) in METHODS.items()},
        )
        for (name, count), chosen in sorted(groups.items(), key=lambda item: list(DTYPES).index(item[0][0]))
    ]

"""A kernel's width and the radius of its centers, learned by gradient along a trajectory."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig
from torch import Tensor

from ..approximation.basis import StaFBasis
from ..centers import ConstantRadius, StateFollowingCenters, probe_points
from ..figures.chase import draw_learned_kernel
from ..kernels import Kernel
from ..lanes import rows
from ..local_basis import evaluate_scaled
from ..numerics.checks import COMMAND_LINE, fail, integer, positive_real
from ..results.reader import Value
from ..results.run_directory import RunDirectory
from ..settings.chase import ChaseProblem, chase_problem
from ..signs import SHOWN, Progress
from ..systems import simulate
from ..tables import Table
from .registry import Metrics, finite
from .study import report

_log = logging.getLogger(__name__)
_POINTS = 25  # of the ball over which the error is a mean
_STEEPEST = 1.0  # gradient of the logarithm of the error by those of width and radius that is followed
_SHOWN = 10  # lines of the log
_SCALES = ("width", "length_scale")  # what a kernel may call its own


class Learning(NamedTuple):
    """Parameters that are learned, and the states they are learned on."""

    problem: ChaseProblem
    kernel: Callable[[Tensor], Kernel]  # of a width or a length scale
    name: str  # of that number, in words
    start: Tensor  # logarithms of width and radius, (2,)
    states: Tensor  # (B, T, n)
    first: int  # time from which the error counts
    offsets: Tensor  # z (P, n) of the ball

    def squares(self, width: Tensor, radius: Tensor, states: Tensor) -> Tensor:
        """The mean of (V(x + z) - V^(x + z))^2 over times and points of the ball, for states x (B, T, n):
        (B,). Width and radius are numbers, or `rows` of one for each trajectory."""
        problem, kernel = self.problem, self.kernel(width)
        centers = StateFollowingCenters(problem.basis.centers.directions, ConstantRadius(radius))
        found = problem.chase(states, basis=StaFBasis(kernel, centers))
        x, b = states[:, self.first :], found.coefficients[:, self.first :]
        z = self.offsets.expand(*x.shape[:-1], -1, -1)
        gap = problem.target(x.unsqueeze(-2) + z) - evaluate_scaled(kernel, centers.offsets(x), x, z, b)
        return gap.square().mean(dim=(-1, -2))

    def error(self, logarithms: Tensor) -> Tensor:
        """The root mean square over all trajectories; the logarithms of width and radius, (2,)."""
        width, radius = logarithms.exp()
        return self.squares(width, radius, self.states).mean().sqrt()

    def grid(self, widths: Tensor, radii: Tensor, progress: Progress = SHOWN) -> Tensor:
        """Return the error at all pairs, (R, W): all radii of a width are rows of one call."""
        batch = self.states.shape[0]
        states = self.states.repeat(len(radii), 1, 1)
        each = rows(radii.repeat_interleave(batch))
        columns = []
        for width in progress.each(list(widths), "widths of the grid"):
            squares = self.squares(rows(width.expand(len(states))), each, states)
            columns.append(squares.reshape(len(radii), batch).mean(1).sqrt())
        return torch.stack(columns, dim=1)


def run(cfg: DictConfig, directory: Path, progress: Progress = SHOWN) -> Metrics:
    """Run what the settings describe and fill the run directory; `metrics.json` comes last."""
    steps = integer(COMMAND_LINE, "learn_kernel.steps", cfg.learn_kernel.steps, least=1)
    rate = positive_real(COMMAND_LINE, "learn_kernel.rate", cfg.learn_kernel.rate)
    axes = [_ratios(cfg, name) for name in ("widths", "radii")]
    problem = problem_of(cfg)
    widths, radii = (axis.to(problem.states) for axis in axes)
    path, errors = learn(problem, steps, rate, progress)
    grid, way = problem.grid(widths, radii, progress), path.exp()
    out = RunDirectory(directory)
    taken: list[dict[str, Value]] = [
        {"step": k, "width": float(w), "radius": float(r), "error": float(e)}
        for k, ((w, r), e) in enumerate(zip(way, errors, strict=True))
    ]
    numbers = [x.cpu().numpy() for x in (widths, radii, grid, way, errors)]
    shown = Table.of(taken[:: -(-len(taken) // _SHOWN)])
    table, drawing = Table.of(taken), partial(draw_learned_kernel, problem.name, *numbers)
    report(cfg, out, _log, "learn_kernel", table, drawing, shown=shown, heading="Along the way:")
    return out.metrics(summary(path, errors, widths, radii, grid))


def problem_of(cfg: DictConfig) -> Learning:
    """The settings, checked.

    Raises:
        ValueError: for a kernel without a width or a length scale, or a radius that depends on the state.
    """
    ball = positive_real(COMMAND_LINE, "learn_kernel.ball", cfg.learn_kernel.ball)
    problem = chase_problem(cfg)
    name = next((n for n in _SCALES if n in cfg.kernel), None)
    if name is None:
        raise fail(COMMAND_LINE, "kernel", "must have a width or a length scale for learn_kernel", cfg.kernel)
    radius = problem.basis.centers.radius
    if not isinstance(radius, ConstantRadius):
        raise fail(COMMAND_LINE, "centers", "must have a constant radius for learn_kernel", cfg.centers)
    make: Callable[..., Kernel] = instantiate(cfg.kernel, _partial_=True, _convert_="all")
    states = simulate(problem.system, problem.initial_states, dt=problem.dt, steps=problem.steps)
    first = math.ceil(problem.settle_time / problem.dt - 1e-9)
    if first >= states.shape[1]:
        raise fail(COMMAND_LINE, "settle_time", "must be before the end", problem.settle_time)
    start = [float(cfg.kernel[name]), float(cfg.centers.radius)]
    return Learning(
        problem,
        kernel=lambda width: make(**{name: width}).to(states),
        name=name.replace("_", " "),
        start=torch.tensor(start, dtype=states.dtype, device=states.device).log(),
        states=states,
        first=first,
        offsets=ball * probe_points(_POINTS, states.shape[-1]).to(states),
    )


def learn(problem: Learning, steps: int, rate: float, progress: Progress = SHOWN) -> tuple[Tensor, Tensor]:
    """Follow the gradient of the logarithm of the error by Adam; return the logarithms of width and radius (S
    + 1, 2) and the errors there (S + 1,), the start first."""
    at = problem.start.clone().requires_grad_()
    optimiser = torch.optim.Adam([at], lr=rate)
    points, errors = [], []
    for k in progress.each(range(steps + 1), "steps of Adam"):
        error = problem.error(at)
        points.append(at.detach().clone())
        errors.append(error.detach())
        if k < steps:
            optimiser.zero_grad()
            error.log().backward()
            # The way of a law over many steps is chaotic here and there: its derivative then says nothing.
            torch.nn.utils.clip_grad_norm_(at, _STEEPEST)
            optimiser.step()
    return torch.stack(points), torch.stack(errors)


def summary(path: Tensor, errors: Tensor, widths: Tensor, radii: Tensor, grid: Tensor) -> Metrics:
    """Errors at the start, at the best step, and of the best pair of the grid, and where these are."""
    step = int(errors.nan_to_num(math.inf).argmin())
    row, column = divmod(int(grid.nan_to_num(math.inf).argmin()), grid.shape[1])
    found: dict[str, Tensor] = {
        "start_error": errors[0],
        "learned_error": errors[step],
        "learned_width": path[step, 0].exp(),
        "learned_radius": path[step, 1].exp(),
        "grid_error": grid[row, column],
        "grid_width": widths[column],
        "grid_radius": radii[row],
    }
    return {name: finite(float(value)) for name, value in found.items()}


def _ratios(cfg: DictConfig, name: str) -> Tensor:
    """The numbers of an axis of the grid, equal ratios apart."""
    stated = cfg.learn_kernel[name]
    group = f"learn_kernel.{name}"
    low, high = (
        positive_real(COMMAND_LINE, f"{group}.{end}", stated[end]) for end in ("smallest", "largest")
    )
    if low >= high:
        raise fail(COMMAND_LINE, f"{group}.largest", f"must be above the smallest ({low:g})", high)
    count = integer(COMMAND_LINE, f"{group}.count", stated.count, least=2)
    return torch.logspace(math.log10(low), math.log10(high), count, dtype=torch.float64, device="cpu")

"""Meshes of times, and a plan on one of half the intervals."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ....systems import Plant
from ...loop.controller import LQR
from .newton import Interval, MeshPlan

_GRADING = 6.0  # ratio of a mesh's last interval to the first


def graded(horizon: float, intervals: int) -> Tensor:
    """Times of a mesh whose intervals grow in geometric progression: (N + 1,) from 0 to the horizon."""
    power = (
        math.log(_GRADING)
        * torch.arange(intervals + 1, dtype=torch.float64, device="cpu")
        / max(1, intervals - 1)
    )
    return horizon * power.expm1() / power[-1].expm1()


def halved(time: Tensor) -> Tensor:
    """Return the times and those half-way: (N + 1,) -> (2N + 1,)."""
    middle = 0.5 * (time[1:] + time[:-1])
    return torch.cat((time[:1], torch.stack((middle, time[1:]), dim=-1).flatten()))


def split(stage: Interval, plan: MeshPlan, feedback: Tensor, lengths: Tensor) -> tuple[MeshPlan, Tensor]:
    """Split the intervals of a plan in half: the same control, and a feedback around it.

    Args:
        stage: of the problem.
        plan: on N intervals.
        feedback: around it, (B, N, 2m, n).
        lengths: of the N intervals, (N,).

    Returns:
        A plan on 2N intervals (of the old cost) and its feedback (B, 2N, 2m, n).
    """
    first, last = plan.control.chunk(2, dim=-1)
    middle = 0.5 * (first + last)
    early, late = torch.cat((first, middle), dim=-1), torch.cat((middle, last), dim=-1)
    between, _ = stage.advance(plan.state[:, :-1], early, 0.5 * lengths.expand(plan.control.shape[:2]))
    state = torch.stack((plan.state[:, :-1], between), dim=2).flatten(1, 2)
    state = torch.cat((state, plan.state[:, -1:]), dim=1)
    control = torch.stack((early, late), dim=2).flatten(1, 2)
    return MeshPlan(state, control, plan.cost), feedback.repeat_interleave(2, dim=1)


def rates_of(system: Plant, lqr: LQR) -> tuple[Tensor, Tensor]:
    """The slowest decay and the fastest rate of the LQR's modes, 1/s, () each."""
    a, b = system.linearisation(lqr.cost.target, lqr.cost.target_input)
    modes = torch.linalg.eigvals(a.to(lqr.p) - b.to(lqr.p) @ lqr.k)
    return -modes.real.max(), modes.abs().max()

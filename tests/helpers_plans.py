"""A plant that is pushed in steps, and trajectories that are marked by their row: for tests of plans."""

from __future__ import annotations

import math

import torch
from helpers import tensor
from torch import Tensor

from staf_torch import adp
from staf_torch.adp.plans import Trajectories


def pushed(x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    after = torch.stack((x[..., 0] + 0.1 * x[..., 1] + 0.02 * u[..., 1], x[..., 1] + 0.1 * u[..., 0]), dim=-1)
    return after, 0.1 * (x.square().sum(-1) + u.square().sum(-1))


BOX = adp.SampledProblem(pushed, dim=2, inputs=2, low=[-1.0, -2.0], high=[0.5, math.inf])


def trajectories(*costs: float, steps: int = 3, mark: float = 0.0) -> Trajectories:
    """Of two states and two inputs, marked by their row."""
    rows = len(costs)
    at = torch.arange(rows).double() + mark
    value = tensor(costs)[:, None] * torch.linspace(1, 0, steps + 1, dtype=torch.float64)
    return Trajectories(
        at[:, None, None].expand(rows, steps + 1, 2).clone(),
        at[:, None, None].expand(rows, steps, 2).clone(),
        at[:, None, None, None].expand(rows, steps, 2, 2).clone(),
        value,
        at[:, None, None].expand(rows, steps + 1, 2).clone(),
        at[:, None, None, None].expand(rows, steps + 1, 2, 2).clone(),
        torch.ones(rows) > 0,
    )

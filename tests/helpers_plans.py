"""A mass that is pushed in steps by two bounded inputs: what the tests of plans share."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from staf_torch import adp


def pushed(x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    after = torch.stack((x[..., 0] + 0.1 * x[..., 1] + 0.02 * u[..., 1], x[..., 1] + 0.1 * u[..., 0]), dim=-1)
    return after, 0.1 * (x.square().sum(-1) + u.square().sum(-1))


BOX = adp.SampledProblem(pushed, dim=2, inputs=2, low=[-1.0, -2.0], high=[0.5, math.inf])

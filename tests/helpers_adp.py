"""The two-state plant under the actor-critic laws: what the tests of closed loops share."""

from __future__ import annotations

import torch
from torch import Tensor

from staf_torch import (
    AnchoredKernel,
    ExponentialKernel,
    Kernel,
    StaFBasis,
    StateFollowingCenters,
    StateRadius,
    adp,
    rings,
    systems,
)
from staf_torch.adp.critic.laws import ActorCriticLaw

PLANT = systems.TwoState()
COST = adp.QuadraticCost(1.0, 1.0, 2, 1)
BOX = StateRadius(2.1, 1e-5)
LAWS = [adp.Information(), adp.Published()]


def staf_basis(gradient: str = "total", kernel: Kernel | None = None) -> adp.StaFValueBasis:
    centers = StateFollowingCenters(rings(3), StateRadius(0.7, 1e-5))
    return adp.StaFValueBasis(StaFBasis(kernel or AnchoredKernel(ExponentialKernel()), centers), gradient)


def learner(law: ActorCriticLaw, extrapolation: adp.Extrapolation | None = None) -> adp.ActorCritic:
    return adp.ActorCritic(staf_basis(), PLANT, COST, extrapolation or adp.RandomPoints(1, BOX), law)


def uniform(rows: int, box: float, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return box * (2 * torch.rand(rows, 2, dtype=torch.float64, generator=generator) - 1)


class Yaw(systems.ControlAffineSystem):
    """An angle that is pushed: theta'' = u."""

    dim, inputs, periodic = 2, 1, (0,)

    def drift(self, x: Tensor) -> Tensor:
        return torch.stack((x[..., 1], 0 * x[..., 1]), -1)

    def effectiveness(self, x: Tensor) -> Tensor:
        return torch.tensor([[0.0], [1.0]]).to(x).expand(*x.shape, 1)

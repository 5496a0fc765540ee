"""Problems that several tests of the chase share."""

from __future__ import annotations

import torch
from torch import Tensor

from staf_torch import (
    ExponentialKernel,
    GaussianKernel,
    MaternKernel,
    PolynomialKernel,
    StaFBasis,
    StateFollowingCenters,
    StateRadius,
    ball,
    optim,
    rings,
    systems,
)

LAW = optim.SteepestDescent()
BASES = {
    "exponential": StaFBasis(ExponentialKernel(), StateFollowingCenters(rings(6), 0.3)),
    "exponential, moving radius": StaFBasis(
        ExponentialKernel(), StateFollowingCenters(rings(3), StateRadius(0.3, 0.5))
    ),
    "gaussian": StaFBasis(GaussianKernel(0.7), StateFollowingCenters(ball(10, 2), 0.5)),
    "matern": StaFBasis(MaternKernel(1.5, 0.8), StateFollowingCenters(rings(10), 0.5)),
    "polynomial": StaFBasis(PolynomialKernel(2), StateFollowingCenters(rings(3), 0.5)),
}


def circles(batch: int, times: int) -> Tensor:
    angle = torch.arange(batch, dtype=torch.float64)
    x0 = torch.stack((angle.cos(), 0.8 * angle.sin()), dim=-1)
    return systems.simulate(systems.Oscillator(), x0, dt=0.05, steps=times - 1)

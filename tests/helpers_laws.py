"""Trajectories and quadratics for the tests of the laws and of the chase."""

from __future__ import annotations

import torch
from torch import Tensor
from variants import SYSTEMS

from staf_torch import (
    ExponentialKernel,
    Kernel,
    StaFBasis,
    StateFollowingCenters,
    optim,
    rings,
    systems,
    targets,
)
from staf_torch.optim.objective import NativeError, Precomputed


def basis(kernel: Kernel | None = None, count: int = 3, radius: float = 0.1) -> StaFBasis:
    """Rings around the state."""
    return StaFBasis(kernel or ExponentialKernel(), StateFollowingCenters(rings(count), radius))


def states(batch: int = 1, steps: int = 60, dt: float = 0.05, system: str = "oscillator") -> Tensor:
    """Trajectories, the first from (1, 0): (B, steps + 1, 2)."""
    generator = torch.Generator().manual_seed(1)
    around = 2 * torch.rand(batch, 2, generator=generator, dtype=torch.float64) - 1
    around[0] = torch.tensor([1.0, 0.0])
    return systems.simulate(SYSTEMS[system](), around, dt=dt, steps=steps)


def quadratic(batch: int = 5, count: int = 4, condition: float = 30.0, seed: int = 0) -> NativeError:
    """Random quadratics with the eigenvalues 1 .. condition, and a sample at a state."""
    generator = torch.Generator().manual_seed(seed)
    random = torch.randn(batch, count, count + 2, generator=generator, dtype=torch.float64)
    q = torch.linalg.qr(random[..., :count])[0]
    eigenvalues = torch.logspace(0, 1, count, base=condition, dtype=torch.float64)
    gram = (q * eigenvalues) @ q.mT
    known = Precomputed(row=random[..., count + 1], sampled=random[:, 0, 0])
    return NativeError((gram + gram.mT) / 2, random[..., count], known)


def iterate(law: optim.UpdateLaw, objective: NativeError, weights: Tensor, steps: int) -> Tensor:
    """The weights after every iteration, the first ones included: (steps + 1, ..., M)."""
    state = law.begin(objective, weights, law.init(weights))
    path = [weights]
    for _ in range(steps):
        weights, state = law.step(objective, weights, state)
        path.append(weights)
    return torch.stack(path)


TARGET = targets.Paper()

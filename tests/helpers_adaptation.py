"""A pendulum with unknown friction and inertia, and one with an unknown mass alone."""

from __future__ import annotations

import torch
from helpers import uniform
from torch import Tensor

from staf_torch import adp
from staf_torch.adp.adaptation.identification import Equation

TRUE = torch.tensor([0.1, 1.0], dtype=torch.float64)


def friction_and_inertia(x: Tensor, u: Tensor) -> Tensor:
    zero = torch.zeros_like(u)
    return torch.stack((torch.cat((zero, -x[..., 1:]), -1), torch.cat((zero, u), -1)), dim=-1)


def gravity(x: Tensor, u: Tensor) -> Tensor:
    return torch.stack((x[..., 1], 9.81 * x[..., 0].sin()), dim=-1)


PENDULUM = adp.ParametricPlant(friction_and_inertia, gravity, dim=2, inputs=1, theta=TRUE)
DAMPING = adp.ParametricPlant(
    lambda x, u: torch.stack((torch.zeros_like(u), -x[..., 1:]), dim=-2),
    lambda x, u: torch.stack((x[..., 1], u[..., 0] - x[..., 0].sin()), dim=-1),
    dim=2,
    inputs=1,
    theta=[0.3],
    rows=[1],
)
"""A pendulum of which the friction alone is unknown."""
COST = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)


def equations(count: int, rows: int, theta: Tensor, states: int = 2, seed: int = 0) -> list[Equation]:
    """S theta = z without noise, S random: ``count`` of them for every one of some rows."""
    found = []
    for k in range(count):
        s = uniform(rows, states, theta.shape[-1], seed=seed + k)
        z = (s * theta.unsqueeze(-2)).sum(-1)
        found.append(Equation(s, z, s.new_zeros(rows), torch.ones(rows, dtype=torch.bool)))
    return found

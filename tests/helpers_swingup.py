"""Gymnasium's Pendulum-v1 as a problem in steps: what the tests of swing-ups share."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from staf_torch import adp, systems


def step(x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    """The environment's own step: semi-implicit, the new rate moves the angle; minus the reward."""
    angle, rate = x.unbind(-1)
    torque = u[..., 0]
    wrapped = angle - 2 * math.pi * torch.round(angle / (2 * math.pi))
    paid = wrapped.square() + 0.1 * rate.square() + 0.001 * torque.square()
    after = (rate + 0.05 * (15 * angle.sin() + 3 * torque)).clamp(-8, 8)
    return torch.stack((angle + 0.05 * after, after), dim=-1), paid


def pendulum() -> adp.SampledProblem:
    return adp.SampledProblem(step, dim=2, inputs=1, low=-2.0, high=2.0, periodic=[0])


REGION = [math.pi, 8.0]

# Gymnasium's Pendulum-v1, reset with the seeds 0 to 7, and what a controller from dynamic programming on a
# grid of 640 x 641 states and 33 controls pays from there in 200 steps.
RESETS = torch.tensor(
    [
        [0.860556, -0.460427],
        [0.074277, 0.900927],
        [-1.497835, -0.403018],
        [-2.603443, -0.526379],
        [2.783804, 0.022655],
        [1.91639, 0.615882],
        [0.239794, -0.313458],
        [0.785998, 0.794428],
    ],
    dtype=torch.float64,
)
GRID = torch.tensor([121.64, 0.37, 115.87, 217.06, 226.77, 113.93, 0.42, 121.54], dtype=torch.float64)


def double_integrator(low: float | None = None, high: float | None = None) -> adp.SampledProblem:
    """A mass that is pushed, in steps of 0.1 s, for x'x + u'u a second."""

    def step(x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        place, speed = x.unbind(-1)
        paid = 0.1 * (x.square().sum(-1) + u.square().sum(-1))
        return torch.stack((place + 0.1 * speed, speed + 0.1 * u[..., 0]), dim=-1), paid

    return adp.SampledProblem(step, dim=2, inputs=1, low=low, high=high)


def cost_of(problem: adp.SampledProblem, x: Tensor, control: Tensor) -> Tensor:
    """What controls (B, T, m) cost from x (B, n), the terminal value with it: (B,)."""
    spent = torch.zeros_like(x[:, 0])
    for u in control.unbind(1):
        x, paid = problem.advance(x, u)
        spent = spent + paid
    return spent + problem.terminal(x)


CART_REGION = [1.0, math.pi, 1.0, 2.0]


def cart_pole(force: float = 10.0) -> adp.SampledProblem:
    """Its swing-up by a bounded force that is held for 20 ms."""
    weights = torch.diag(torch.tensor([1.0, 1.0, 0.1, 0.1], dtype=torch.float64))
    cost = adp.QuadraticCost(weights, 0.01, dim=4, inputs=1, low=-force, high=force)
    return adp.SampledProblem.of(systems.CartPole(gravity=9.8), cost, dt=0.02)

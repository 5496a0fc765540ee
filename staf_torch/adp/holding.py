"""A control that is held for a time: where the plant goes with it, and what is paid."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ..numerics.checks import positive_real
from ..systems import Clocked, Plant, StepPlant
from .cost import Cost
from .sampling import periods


class Holding:
    """x+ and the cost over ``dt`` seconds with u held.

    A plant in continuous time is integrated by Runge-Kutta steps of fourth order, and its cost rate with it;
    one in discrete time takes its steps, each of which pays its period times the cost rate at its start.

    Args:
        call: whose argument ``dt`` is, for messages.
        plant: the plant.
        cost: the cost rate, around the plant.
        dt: s; of a plant in discrete time a multiple of its period.
        substeps: integration steps, at least 1; not for a plant in discrete time.

    Raises:
        ValueError: if ``dt`` is not positive, or no multiple of the plant's period.
    """

    def __init__(self, call: str, plant: Plant, cost: Cost, dt: float, substeps: int = 1) -> None:
        self.plant, self.cost = plant, cost
        self.dt = positive_real(call, "dt", dt)
        self.steps = substeps if plant.period is None else periods(call, plant, dt)

    def __call__(self, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """(..., n), (..., m) -> x+ (..., n) and the cost, discounted from the start, (...)."""
        length = self.dt / self.steps
        spent = torch.zeros_like(x[..., 0])
        share = 1.0
        for _ in range(self.steps):
            x, paid = self._step(x, u, length)
            spent = spent + share * paid if self.steps > 1 else paid
            share *= math.exp(-self.cost.discount * length)
        return x, spent

    def _step(self, x: Tensor, u: Tensor, h: float) -> tuple[Tensor, Tensor]:
        if self.plant.period is not None:
            assert isinstance(self.plant, StepPlant | Clocked)
            return self.plant.step(x, u), h * self.cost.rate(x, u)
        return runge_kutta_held(self.plant, self.cost, x, u, h)


def runge_kutta_held(plant: Plant, cost: Cost, x: Tensor, u: Tensor, h: float) -> tuple[Tensor, Tensor]:
    """x+ and the discounted cost of one Runge-Kutta step with u held."""
    paid = cost.input_rate(u)
    half = math.exp(-0.5 * cost.discount * h)  # what the middle of the step counts; its end, squared
    k1 = plant.velocity(x, u)
    c1 = cost.state_rate(x)
    x2 = plant.displaced(x, 0.5 * h * k1)
    k2 = plant.velocity(x2, u)
    x3 = plant.displaced(x, 0.5 * h * k2)
    k3 = plant.velocity(x3, u)
    x4 = plant.displaced(x, h * k3)
    k4 = plant.velocity(x4, u)
    middle = cost.state_rate(x2) + cost.state_rate(x3)
    if cost.discount:
        paid = paid * (1 + 4 * half + half**2) / 6
    spent = h * (paid + (c1 + 2 * half * middle + half**2 * cost.state_rate(x4)) / 6)
    return plant.displaced(x, (h / 6) * (k1 + 2 * (k2 + k3) + k4)), spent

"""A control that is held for a time: where the plant goes with it, and what is paid."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from ..lanes import repeat
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
        substeps: integration steps, at least 1; not for a plant in discrete time. Where the plant has a
            `Plant.step_limit` the first of them are no longer than that, and the last takes the rest.

    Raises:
        ValueError: if ``dt`` is not positive, or no multiple of the plant's period.
    """

    def __init__(self, call: str, plant: Plant, cost: Cost, dt: float, substeps: int = 1) -> None:
        self.plant, self.cost = plant, cost
        self.dt = positive_real(call, "dt", dt)
        self.steps = substeps if plant.period is None else periods(call, plant, dt)

    def __call__(
        self, x: Tensor, u: Tensor, renewed: Callable[[Tensor], Tensor] | None = None
    ) -> tuple[Tensor, Tensor]:
        """(..., n), (..., m) -> x+ (..., n) and the cost, discounted from the start, (...).

        Args:
            x: (..., n).
            u: (..., m).
            renewed: u from x, asked again before every further substep; None where u is held.
        """
        if self.steps > 1 and (renewed is not None or self.plant.step_limit(x, u) is not None):
            return self._limited(x, u, renewed)
        length = self.dt / self.steps
        spent = torch.zeros_like(x[..., 0])
        share = 1.0
        for _ in range(self.steps):
            x, paid = self._step(x, u, length)
            spent = spent + share * paid if self.steps > 1 else paid
            share *= math.exp(-self.cost.discount * length)
        return x, spent

    def _limited(
        self, x: Tensor, u: Tensor, renewed: Callable[[Tensor], Tensor] | None
    ) -> tuple[Tensor, Tensor]:
        """Substeps of a row's own lengths."""
        none = torch.zeros_like(x[..., 0])

        def substep(now: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
            x, u, spent, left, count = now
            length = left / count
            limit = self.plant.step_limit(x, u)
            if limit is not None:
                length = torch.where((count > 1) & (limit < length), limit, length)
            after, paid = runge_kutta_held(self.plant, self.cost, x, u, length)
            if self.cost.discount:
                paid = paid * torch.exp(-self.cost.discount * (self.dt - left))
            return (
                *(after, u if renewed is None else renewed(after)),
                *(spent + paid, left - length, count - 1),
            )

        x, _, spent, _, _ = repeat(self.steps, substep, (x, u, none, none + self.dt, none + self.steps))
        return x, spent

    def _step(self, x: Tensor, u: Tensor, h: float) -> tuple[Tensor, Tensor]:
        if self.plant.period is not None:
            assert isinstance(self.plant, StepPlant | Clocked)
            return self.plant.step(x, u), h * self.cost.rate(x, u)
        return runge_kutta_held(self.plant, self.cost, x, u, h)


def runge_kutta_held(
    plant: Plant, cost: Cost, x: Tensor, u: Tensor, length: float | Tensor
) -> tuple[Tensor, Tensor]:
    """x+ and the discounted cost of one Runge-Kutta step with u held, of one length, s, or one a row."""
    paid = cost.input_rate(u)
    h: float | Tensor = length
    half: float | Tensor  # what the middle of the step counts; its end, squared
    if isinstance(length, Tensor):
        half, h = torch.exp(-0.5 * cost.discount * length), length.unsqueeze(-1)
    else:
        half = math.exp(-0.5 * cost.discount * length)
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
    spent = length * (paid + (c1 + 2 * half * middle + half**2 * cost.state_rate(x4)) / 6)
    return plant.displaced(x, (h / 6) * (k1 + 2 * (k2 + k3) + k4)), spent

"""A control that is held for a time: where the plant goes with it, and what is paid."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from ...lanes import repeat, scan
from ...numerics.checks import integer, positive_real
from ...systems import Clocked, Plant, StepPlant
from .cost import Cost
from .held_linear import periods


def fewest_and_most(call: str, substeps: int | tuple[int, int]) -> tuple[int, int]:
    """The numbers of integration steps, checked.

    Raises:
        ValueError: if they are no integers, or the most are fewer than the least.
    """
    least, most = (substeps, substeps) if isinstance(substeps, int) else substeps
    return (
        integer(call, "substeps", least, least=1),
        integer(call, "substeps", most, least=least),
    )


RungeKuttaSums = tuple[Tensor, Tensor, Tensor]
"""The slope of the last stage, the sum of what the slopes count, and what was paid."""


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
            `Plant.step_limit` the first of them are no longer than that, and the last takes the rest. Two
            numbers: of such a plant the least where no limit is met, and the most.

    Raises:
        ValueError: if ``dt`` is not positive, or no multiple of the plant's period.
    """

    def __init__(
        self, call: str, plant: Plant, cost: Cost, dt: float, substeps: int | tuple[int, int] = 1
    ) -> None:
        self.plant, self.cost = plant, cost
        self.dt = positive_real(call, "dt", dt)
        least, most = fewest_and_most(call, substeps)
        self.least = least
        self.steps = most if plant.period is None else periods(call, plant, dt)

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
        longest = none + self.dt / self.least
        equal = self.least == self.steps

        def substep(now: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
            x, u, spent, left, count = now
            length = left / count if equal else torch.minimum(left, longest)
            limit = self.plant.step_limit(x, u)
            if limit is not None:
                length = torch.where(limit < length, limit, length)
            length = torch.where(count > 1, length, left)
            after, paid = runge_kutta_held(self.plant, self.cost, x, u, length)
            if self.cost.discount:
                paid = paid * torch.exp(-self.cost.discount * (self.dt - left))
            return after, u, spent + paid, left - length, count - 1

        def further(now: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
            return substep(now if renewed is None else (now[0], renewed(now[0]), *now[2:]))

        first = substep((x, u, none, none + self.dt, none + self.steps))
        some = None if equal else (lambda now: now[3] > 0)
        x, _, spent, _, _ = repeat(self.steps - 1, further, first, where=some)
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
    rate = cost.input_rate(u)

    def field(at: Tensor) -> tuple[Tensor, Tensor]:
        return plant.velocity(at, u), rate + cost.state_rate(at)

    return runge_kutta_loop(plant, field, x, length, cost.discount)


def runge_kutta_loop(
    plant: Plant,
    field: Callable[[Tensor], tuple[Tensor, Tensor]],
    x: Tensor,
    length: float | Tensor,
    discount: float = 0.0,
) -> tuple[Tensor, Tensor]:
    """`numerics.runge_kutta` as a loop over the stages, of which a program then contains one.

    Args:
        plant: whose states these are.
        field: the velocity and the cost rate at a state.
        x: (..., n).
        length: s, a number or one a row.
        discount: 1/s, of what is paid.

    Returns:
        x+ (..., n) and what was paid, (...).
    """

    def stage(now: RungeKuttaSums, share: tuple[Tensor, Tensor, Tensor]) -> tuple[RungeKuttaSums, tuple[()]]:
        slope, moved, paid = now
        ahead, count, value = share
        slope, rate = field(plant.displaced(x, ahead * slope))
        return (slope, moved + count * slope, paid + value * rate), ()

    start = torch.zeros_like(x), torch.zeros_like(x), torch.zeros_like(x[..., 0])
    (_, moved, paid), _ = scan(stage, start, _shares(length, discount, x), dim=0)
    return plant.displaced(x, moved), paid


def _shares(length: float | Tensor, discount: float, like: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return where the stages stand, and weights of slopes and costs, s: (4, ..., 1) twice, (4, ...)."""
    if not isinstance(length, Tensor):
        h, left = length, math.exp(-0.5 * discount * length)  # what the middle still counts; the end, squared
        between = (h / 2, h / 3, left * h / 3)
        table = ((0.0, h / 6, h / 6), between, between, (h, h / 6, left**2 * h / 6))
        asked, counted, worth = torch.tensor(table, dtype=like.dtype, device=like.device).unbind(-1)
        return asked.unsqueeze(-1), counted.unsqueeze(-1), worth
    half = torch.exp(-0.5 * discount * length)
    ends, middle = length / 6, length / 3
    asked = torch.stack((torch.zeros_like(length), 0.5 * length, 0.5 * length, length))
    counted = torch.stack((ends, middle, middle, ends))
    worth = torch.stack((ends, middle * half, middle * half, ends * half.square()))
    return asked.unsqueeze(-1), counted.unsqueeze(-1), worth

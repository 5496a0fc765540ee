"""The classical Runge-Kutta step of fourth order, for whatever has sums and products with numbers."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from ..lanes import scan
from ..lanes.row_numbers import nonzero

SHARES = (0.0, 0.5, 0.5, 1.0)
"""Of the step, at which its four stages stand."""


def runge_kutta_step(
    field: Callable[[Tensor], Tensor],
    x: Tensor,
    dt: float | Tensor,
    displaced: Callable[[Tensor, Tensor], Tensor] = operator.add,
) -> Tensor:
    """Classical fourth-order Runge-Kutta step: (..., n) -> (..., n).

    Example:
        >>> x = systems.runge_kutta_step(lambda x: -x, torch.ones(1).double(), dt=0.1)
        >>> round(float(x), 6)  # exp(-0.1) = 0.904837
        0.904837

        Shown by `staf system=van_der_pol`.

    Args:
        field: x' from x.
        x: (..., n).
        dt: length of the step, a number or (..., 1).
        displaced: the state that a step leads to, as `systems.Plant.displaced`; by default the sum.
    """
    _, slopes = runge_kutta_stages(lambda at, share: field(at), x, dt, displaced)
    return displaced(x, runge_kutta_mean(slopes, dt))


def runge_kutta_stages(
    field: Callable[[Tensor, float], Tensor],
    x: Tensor,
    dt: float | Tensor,
    displaced: Callable[[Tensor, Tensor], Tensor] = operator.add,
) -> tuple[list[Tensor], list[Tensor]]:
    """The four states at which a step from x (..., n) asks the field, and its answers there: x' from x
    and the share of the step that has passed, one of `SHARES`."""
    states, slopes = [x], [field(x, SHARES[0])]
    for share in SHARES[1:]:
        states.append(displaced(x, share * dt * slopes[-1]))
        slopes.append(field(states[-1], share))
    return states, slopes


def runge_kutta_mean(values: Sequence[Tensor], dt: float | Tensor) -> Tensor:
    """The integral over a step of what has these values at its four stages (Simpson's rule)."""
    first, second, third, last = values
    return (dt / 6) * (first + 2 * (second + third) + last)


def exponential(exponent: float | Tensor) -> float | Tensor:
    """e^exponent."""
    return exponent.exp() if isinstance(exponent, Tensor) else math.exp(exponent)


def stage_weights(length: float | Tensor, discount: float, like: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return where the stages stand, and weights of slopes and costs, s: (4, ..., 1) twice, (4, ...)."""
    if not isinstance(length, Tensor):
        h = length
        # What the middle still counts; the end, squared.
        counts = exponential(-0.5 * discount * h) if nonzero(discount) else 1.0
        left = 1.0 if isinstance(counts, Tensor) else counts
        between = (h / 2, h / 3, left * h / 3)
        table = ((0.0, h / 6, h / 6), between, between, (h, h / 6, left**2 * h / 6))
        # Not `torch.tensor`, which torch.func does not take on the meta device.
        asked, counted, worth = torch.as_tensor(table, dtype=like.dtype, device=like.device).unbind(-1)
        if isinstance(counts, Tensor):  # of a row's own, or of the table
            shares = torch.stack((torch.ones_like(counts), counts, counts, counts.square()))
            worth = counted * shares.to(like)
        return asked.unsqueeze(-1), counted.unsqueeze(-1), worth
    half = torch.exp(-0.5 * discount * length)
    ends, middle = length / 6, length / 3
    asked = torch.stack((torch.zeros_like(length), 0.5 * length, 0.5 * length, length))
    counted = torch.stack((ends, middle, middle, ends))
    worth = torch.stack((ends, middle * half, middle * half, ends * half.square()))
    # A number of the table is on the CPU in float64.
    return asked.to(like).unsqueeze(-1), counted.to(like).unsqueeze(-1), worth.to(like)


RungeKuttaSums = tuple[Tensor, Tensor, Tensor]
"""The slope of the last stage, the sum of what the slopes count, and what was paid."""


def runge_kutta_loop(
    displaced: Callable[[Tensor, Tensor], Tensor],
    field: Callable[[Tensor], tuple[Tensor, Tensor]],
    x: Tensor,
    length: float | Tensor,
    discount: float = 0.0,
    watch: bool = False,
) -> tuple[Tensor, ...]:
    """`runge_kutta_step` with what is paid, as a loop over the stages, of which a program then contains one.

    Returns x+ (..., n) and what was paid, (...), discounted by ``discount``, 1/s; with ``watch`` also how
    much the field bends within the step, h |k_3 - k_2|, the largest. The field is the velocity and the cost
    rate at a state, the length in s a number or one a row, ``displaced`` as `systems.Plant.displaced`.
    """

    def stage(now: RungeKuttaSums, share: tuple[Tensor, Tensor, Tensor]) -> tuple[RungeKuttaSums, Any]:
        slope, moved, paid = now
        ahead, count, value = share
        slope, rate = field(displaced(x, ahead * slope))
        return (slope, moved + count * slope, paid + value * rate), slope if watch else ()

    start = torch.zeros_like(x), torch.zeros_like(x), torch.zeros_like(x[..., 0])
    (_, moved, paid), slopes = scan(stage, start, stage_weights(length, discount, x), dim=0)
    after = displaced(x, moved)
    return (after, paid, length * (slopes[2] - slopes[1]).abs().amax(-1)) if watch else (after, paid)

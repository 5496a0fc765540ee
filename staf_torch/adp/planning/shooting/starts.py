"""Guesses to start direct shooting from where one alone may end in a poor local minimum."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from ...loop.controller import Policy
from ...problem.cost import Cost

_SHARES = (0.02, 0.04, 0.08, 0.14, 0.22, 0.32)  # of the horizon, for which a constant control is held first
_KNOTS = 6  # of a random spline
_REACH = 3.0  # times the largest control that the base asks for, where there is no bound


class StartControl(NamedTuple):
    """A control over time: what is added to, or stands in place of, the base policy."""

    knots: Tensor  # (K, m) at equal times over the part of the horizon before the base takes over
    until: float  # s


def guesses(
    cost: Cost, base: Policy, x0: Tensor, horizon: float, count: int, seed: int, *, alone: bool = False
) -> list[StartControl]:
    """Constant controls at both bounds for several times, none at all, and random splines.

    Args:
        cost: with the bounds.
        base: that takes over after each.
        x0: the states, (B, n).
        horizon: s.
        count: random splines.
        seed: of them.
        alone: whether the base is the input at rest: it does not say how large a control is.
    """
    rest = torch.zeros(cost.inputs, dtype=torch.float64, device="cpu")
    rest = rest if cost.target_input is None else cost.target_input
    wanted = (base(x0) - rest.to(x0)).abs().amax(0).clamp(min=1.0 if alone else 1e-3).to(rest)
    low, high = rest - _REACH * wanted, rest + _REACH * wanted
    if cost.bounds is not None:
        low, high = (
            torch.where(torch.isfinite(limit), limit, free)
            for limit, free in ((cost.bounds.low, low), (cost.bounds.high, high))
        )
    found = [StartControl(rest.expand(2, -1), 0.3 * horizon)]
    for share in _SHARES:
        for i in range(cost.inputs):
            for end in (low, high):
                level = torch.where(torch.arange(cost.inputs, device="cpu") == i, end, rest)
                found.append(StartControl(level.expand(2, -1), share * horizon))
    generator = torch.Generator().manual_seed(seed)
    for _ in range(count):
        knots = torch.rand(_KNOTS, cost.inputs, dtype=torch.float64, generator=generator, device="cpu")
        until = float(torch.rand((), dtype=torch.float32, generator=generator, device="cpu")) * 0.6 * horizon
        found.append(StartControl(low + (high - low) * (1.5 * knots - 0.25).clamp(0.0, 1.0), until))
    return found


def guided(guess: StartControl, base: Policy) -> Callable[[Tensor, float], Tensor]:
    """u(x, t) of a guess, the base policy once its time is over."""

    def control(x: Tensor, t: float) -> Tensor:
        if t >= guess.until:
            return base(x)
        place = t / guess.until * (len(guess.knots) - 1)
        k = min(int(place), len(guess.knots) - 2)
        level = guess.knots[k] + (place - k) * (guess.knots[k + 1] - guess.knots[k])
        return level.to(x).expand(*x.shape[:-1], -1)

    return control

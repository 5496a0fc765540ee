"""Differences of states with coordinates that are angles."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

_PROBES = 4  # states at which an output is asked
_SAME = 1e-6  # relative, of two changes that are one


def wrap(difference: Tensor, periodic: Sequence[int]) -> Tensor:
    """Return the difference of two states with its periodic coordinates (rad; negative indices count from
    the end) in [-pi, pi]: (..., n) -> (..., n). Where it lies there already, not a bit of it changes."""
    if not periodic:
        return difference
    size = difference.shape[-1]
    angles = {index % size for index in periodic}
    if len(angles) == size:
        return _wrapped(difference)
    columns = [_wrapped(x) if k in angles else x for k, x in enumerate(difference.unbind(-1))]
    return torch.stack(columns, dim=-1)


def turned(x: Tensor, near: Tensor, periodic: Sequence[int]) -> Tensor:
    """x with its periodic coordinates turned by whole turns to within pi of ``near``: (..., n) -> (..., n).

    Where it lies there already, not a bit of it changes.
    """
    apart = near - x
    return x + (apart - wrap(apart, periodic))


def unwrapped(x: Tensor, periodic: Sequence[int]) -> Tensor:
    """States over time, each turned to within pi of the one before: (..., T, n) -> (..., T, n)."""
    if not periodic:
        return x
    moved = x[..., 1:, :] - x[..., :-1, :]
    turns = (wrap(moved, periodic) - moved).cumsum(-2)
    return torch.cat((x[..., :1, :], x[..., 1:, :] + turns), dim=-2)


def wrap_each(difference: Tensor, periods: Sequence[float]) -> Tensor:
    """Return the difference of two outputs, entry k within half a period around 0, periods q numbers in
    the units of the outputs, 0 for one that has none (`periods_of`): (..., q) -> (..., q)."""
    if not any(periods):
        return difference
    entries = zip(difference.unbind(-1), periods, strict=True)
    return torch.stack([_wrapped(x, period) if period else x for x, period in entries], dim=-1)


def periods_of(output: Callable[[Tensor], Tensor], dim: int, periodic: Sequence[int]) -> tuple[float, ...]:
    """Return by how much every output changes as a periodic coordinate goes around once: q numbers, 0
    where none does by the same amount everywhere. Of two coordinates it is what both are multiples of.
    The output is (B, n) -> (B, q), float64."""
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(_PROBES, dim, dtype=torch.float64, generator=generator, device="cpu")
    with torch.no_grad():
        seen = output(x)
        periods = [0.0] * seen.shape[-1]
        for index in periodic:
            around = x.clone()
            around[:, index] += 2 * math.pi
            jump = (output(around) - seen).abs()
            same = (jump - jump[0]).abs() <= _SAME * (1 + seen.abs().amax(0))
            for k, (turns, size) in enumerate(zip(same.all(0).tolist(), jump[0].tolist(), strict=True)):
                if turns and size > _SAME:
                    periods[k] = _common(periods[k], size)
    return tuple(periods)


def _common(one: float, other: float) -> float:
    """The largest number of which both are multiples, up to rounding."""
    while one > _SAME * other:
        one, other = abs(other - one * round(other / one)), one
    return other


def _wrapped(angle: Tensor, period: float = 2 * math.pi) -> Tensor:
    return angle - period * (angle / period).round()

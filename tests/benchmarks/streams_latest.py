"""Streams that were fixed, with their seeds, before trackers learned anything, and run once after that."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from streams_data import MOST, Array, Series, arm, embedded


def duffing(count: int, step: float = 0.005, every: int = 60) -> Array:
    """x'' = -.3 x' + x - x^3 + .5 cos(1.2 t), every .3 time units, by Euler steps."""
    x, v, found = 0.5, 0.0, []
    for k in range((count + 100) * every):
        if k % every == 0:
            found.append(x)
        x, v = x + step * v, v + step * (-0.3 * v + x - x**3 + 0.5 * np.cos(1.2 * step * k))
    return np.array(found[100:])


def tinkerbell(count: int) -> Array:
    """Both coordinates of x' = x^2 - y^2 + .9 x - .6013 y, y' = 2 x y + 2 x + .5 y, noise of .01."""
    x, y, found = -0.72, -0.64, []
    for _ in range(count + 100):
        found.append([x, y])
        x, y = x * x - y * y + 0.9 * x - 0.6013 * y, 2 * x * y + 2 * x + 0.5 * y
    states = np.array(found[100:])
    return states + 0.01 * np.random.default_rng(31).standard_normal(states.shape)


def fading(count: int) -> Series:
    """Find the symbol s_{k-1} behind tanh of three taps that wander, s_k, s_{k-1}, s_{k-2}, noise .15."""
    draw = np.random.default_rng(32)
    s = draw.choice([-1.0, 1.0], count + 10)
    taps = np.array([0.3, 0.9, 0.3]) + np.cumsum(0.006 * draw.standard_normal((count + 8, 3)), 0)
    sent = np.stack((s[2:], s[1:-1], s[:-2]), 1)
    r = np.tanh((taps * sent).sum(1)) + 0.15 * draw.standard_normal(count + 8)
    x = np.stack([r[3 - i : len(r) - i] for i in range(4)], 1)
    return Series(x[:count], s[4 : 4 + len(x)][:count, None])


def tanks(count: int) -> Series:
    """The level of the second of two tanks from its last two and the last two inflows; noise .02."""
    draw = np.random.default_rng(33)
    inflow = np.repeat(draw.uniform(0.2, 1.2, count // 15 + 2), 15)[: count + 3]
    levels, seen = np.array([1.0, 1.0]), []
    for u in inflow:
        seen.append(levels[1])
        out = 0.5 * np.sqrt(np.maximum(levels, 0))
        levels = levels + 0.4 * np.array([u - out[0], out[0] - out[1]])
    y = np.array(seen) + 0.02 * draw.standard_normal(count + 3)
    at = np.arange(1, count + 1)
    return Series(np.stack((y[at], y[at - 1], inflow[at], inflow[at - 1]), 1), y[at + 1, None])


def _treasury_bills() -> Series:
    from statsmodels import datasets

    return embedded(datasets.macrodata.load_pandas().data["tbilrate"].astype(float).to_numpy(), 4)


def _share_range() -> Series:
    import pmdarima.datasets as packaged

    prices = packaged.load_msft()[["High", "Low"]].to_numpy(float)
    return embedded(np.log(np.maximum(prices[:, 0] / prices[:, 1] - 1, 1e-3)), 5)


def _tinkerbell() -> Series:
    states = tinkerbell(MOST + 1)
    return Series(states[:-1], states[1:, :1])


LATEST: dict[str, Callable[[], Series]] = {
    "Duffing +3": lambda: embedded(duffing(1500), 5, ahead=3),
    "Tinkerbell noisy": _tinkerbell,
    "fading channel": lambda: fading(MOST),
    "two tanks": lambda: tanks(1400),
    "light arm": lambda: arm(1200, seed=34, second=0.6),  # two outputs, two sets
    "treasury bills": _treasury_bills,
    "Microsoft range": _share_range,
}

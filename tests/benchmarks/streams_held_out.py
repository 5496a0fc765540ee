"""Streams of the same kinds that no constant of the regressor was chosen on, when they were run.

`EARLIER` were held out once; what they said was looked at, and constants were chosen on them since.
`HELD_OUT` were fixed, with their seeds, before the first of them was run; whoever changes the bank looks at
the sets of streams_data.py and at the earlier ones, and at these once, at the end. `LATEST` were fixed before
trackers learned anything, and run once after that.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from streams_data import (
    MOST,
    Array,
    Series,
    arch,
    arm,
    embedded,
    mackey_glass,
    orbit,
    pmdarima,
    statsmodels,
    vega,
)


def ikeda(count: int) -> Array:
    """Both parts of z' = 1 + .9 z exp(i (.4 - 6 / (1 + |z|^2)))."""

    def step(k: int, z: complex) -> tuple[complex]:
        return (1 + 0.9 * z * np.exp(1j * (0.4 - 6 / (1 + abs(z) ** 2))),)

    found = orbit(step, (0.1 + 0.1j,), count, skip=101)
    return np.concatenate((found.real, found.imag), 1)


def roessler(count: int, h: float = 0.02) -> Array:
    """The first coordinate of Roessler's system (.2, .2, 5.7), every .2 seconds, by Euler steps."""

    def step(k: int, x: float, y: float, z: float) -> tuple[float, float, float]:
        return x - h * (y + z), y + h * (x + 0.2 * y), z + h * (0.2 + z * (x - 5.7))

    return orbit(step, (1.0, 1.0, 1.0), count, every=10)[:, 0]


def volterra(count: int) -> Series:
    """Find the symbol s_{k-1} behind r + .3 r^2 - .1 r^3, r_k = s_k + .4 s_{k-1} - .3 s_{k-2}, noise .2."""
    draw = np.random.default_rng(11)
    s = draw.choice([-1.0, 1.0], count + 10)
    linear = s[2:] + 0.4 * s[1:-1] - 0.3 * s[:-2]
    r = linear + 0.3 * linear**2 - 0.1 * linear**3 + 0.2 * draw.standard_normal(len(linear))
    x = np.stack([r[3 - i : len(r) - i] for i in range(4)], 1)
    return Series(x[:count], s[4 : 4 + len(x)][:count, None])


def hammerstein_switch(count: int = 1500) -> Series:
    """h'f(x), f = x + .5 x^2 tap by tap, four taps that change at two fifths and drift after; 20 dB."""
    draw = np.random.default_rng(12)
    s = draw.standard_normal(count + 3)
    x = np.stack([s[3 - i : 3 - i + count] for i in range(4)], 1)
    before, after, drift = draw.standard_normal((3, 4))
    time = np.arange(count)[:, None]
    taps = np.where(time < 2 * count // 5, before, after + 0.5 * drift * np.sin(time / 300))
    y = (taps * (x + 0.5 * x**2)).sum(1)
    return Series(x, (y + 0.1 * y.std() * draw.standard_normal(count))[:, None])


def narendra(count: int) -> Series:
    """y' = y / (1 + y^2) + u^3 from (y, u), u a slow sine plus noise; noise of .02 on y."""
    draw = np.random.default_rng(13)
    time = np.arange(count)
    u = 0.8 * np.sin(2 * np.pi * time / 70) + 0.3 * draw.standard_normal(count)
    y = np.zeros(count + 1)
    for k in range(count):
        y[k + 1] = y[k] / (1 + y[k] ** 2) + u[k] ** 3
    seen = y + 0.02 * draw.standard_normal(count + 1)
    return Series(np.stack((seen[:-1], u), 1), seen[1:, None])


def cart_pole_force(count: int) -> Series:
    """Force on the cart from angle, its rate and acceleration, and the cart's rate and acceleration."""
    draw = np.random.default_rng(14)
    time = 0.02 * np.arange(count)
    frequency, phase = draw.uniform(0.2, 1.0, (2, 5)), draw.uniform(0, 2 * np.pi, (2, 5))
    rate = 2 * np.pi * frequency[..., None]
    wave = rate * time + phase[..., None]
    angle, place_rate = 0.6 * np.sin(wave[0]).sum(0), 0.3 * (rate[1] * np.cos(wave[1])).sum(0)
    angle_rate = 0.6 * (rate[0] * np.cos(wave[0])).sum(0)
    angle_acceleration = -0.6 * (rate[0] ** 2 * np.sin(wave[0])).sum(0)
    place_acceleration = -0.3 * (rate[1] ** 2 * np.sin(wave[1])).sum(0)
    swing = angle_acceleration * np.cos(angle) - angle_rate**2 * np.sin(angle)
    y = 1.5 * place_acceleration + 0.3 * swing + 0.8 * np.tanh(4 * place_rate)
    x = np.stack((angle, angle_rate, angle_acceleration, place_rate, place_acceleration), 1)
    return Series(x, (y + 0.05 * y.std() * draw.standard_normal(count))[:, None])


def friedman(count: int) -> Series:
    """Friedman's function of 10 uniform inputs, whose first two coordinates trade places slowly; noise 1."""
    draw = np.random.default_rng(15)
    x = draw.uniform(size=(count, 10))
    share = np.linspace(0, 1, count)
    a, b = (1 - share) * x[:, 0] + share * x[:, 5], x[:, 1]
    y = 10 * np.sin(math.pi * a * b) + 20 * (x[:, 2] - 0.5) ** 2 + 10 * x[:, 3] + 5 * x[:, 4]
    return Series(x, (y + draw.standard_normal(count))[:, None])


def lozi(count: int) -> Array:
    """x' = 1 - 1.7 |x| + y, y' = .5 x."""
    return orbit(lambda k, x, y: (1 - 1.7 * abs(x) + y, 0.5 * x), (0.1, 0.1), count)[:, 0]


def chua(count: int, h: float = 0.002) -> Array:
    """The first coordinate of Chua's circuit (15.6, 28, -8/7, -5/7), every .2 time units, by Euler steps."""

    def step(k: int, x: float, y: float, z: float) -> tuple[float, float, float]:
        current = -5 / 7 * x + 0.5 * (-8 / 7 + 5 / 7) * (abs(x + 1) - abs(x - 1))
        return x + h * 15.6 * (y - x - current), y + h * (x - y + z), z - h * 28 * y

    return orbit(step, (0.7, 0.0, 0.0), count, every=100, skip=50)[:, 0]


def lorenz96(count: int) -> Series:
    """The first of five sites (forcing 8), .15 time units after all five were seen."""

    def step(k: int, x: Array) -> tuple[Array]:
        return (x + 0.005 * ((np.roll(x, -1) - np.roll(x, 2)) * np.roll(x, 1) - x + 8),)

    states = orbit(step, (np.array([8.01, 8.0, 8.0, 8.0, 8.0]),), count, every=10, skip=200)[:, 0]
    return Series(states[:-3], states[3:, :1])


def narma(count: int) -> Series:
    """y' = .3 y + .05 y sum_{i<10} y_{k-i} + 1.5 u_{k-9} u_k + .1 from the last five y and u_k, u_{k-9}."""
    u = np.random.default_rng(21).uniform(0, 0.5, count + 10)
    y = np.zeros(count + 10)
    for k in range(9, count + 9):
        y[k + 1] = 0.3 * y[k] + 0.05 * y[k] * y[k - 9 : k + 1].sum() + 1.5 * u[k - 9] * u[k] + 0.1
    at = np.arange(9, count + 9)
    x = np.stack([*(y[at - i] for i in range(5)), u[at], u[at - 9]], 1)
    return Series(x, y[at + 1, None])


def four_symbols(count: int) -> Series:
    """Find one of four symbols, s_{k-1}, behind .35 s_k + .87 s_{k-1} + .35 s_{k-2} and a cubic, noise .1."""
    draw = np.random.default_rng(22)
    s = draw.choice([-1.0, -1 / 3, 1 / 3, 1.0], count + 10)
    linear = 0.35 * s[2:] + 0.87 * s[1:-1] + 0.35 * s[:-2]
    r = linear + 0.2 * linear**2 - 0.3 * linear**3 + 0.1 * draw.standard_normal(len(linear))
    x = np.stack([r[4 - i : len(r) - i] for i in range(5)], 1)
    return Series(x[:count], s[5 : 5 + len(x)][:count, None])


def wiener_switch(count: int = 1500) -> Series:
    """tanh(h'x), four taps that change twice, at a quarter and at three fifths; 25 dB."""
    draw = np.random.default_rng(23)
    s = draw.standard_normal(count + 3)
    x = np.stack([s[3 - i : 3 - i + count] for i in range(4)], 1)
    h = draw.standard_normal((3, 4))
    y = np.tanh((h[np.searchsorted((count // 4, 3 * count // 5), np.arange(count), "right")] * x).sum(1))
    return Series(x, (y + 10**-1.25 * y.std() * draw.standard_normal(count))[:, None])


def loaded_arm(count: int) -> Series:
    """The arm of streams_data.py with other motion, whose second mass grows by a half at three fifths."""
    free, extra = arm(count, seed=24), arm(count, seed=24, second=1.5)
    late = np.arange(count)[:, None] >= 3 * count // 5
    return Series(free.x, np.where(late, extra.y, free.y))


def chirp(count: int) -> Series:
    """sin of a phase whose rate rises from .05 to .6, amplitude 1 + t / 2; noise .02; embedding 4."""
    time = np.arange(count + 4)
    phase = np.cumsum(np.linspace(0.05, 0.6, count + 4))
    noise = 0.02 * np.random.default_rng(25).standard_normal(count + 4)
    return embedded((1 + time / (2 * count)) * np.sin(phase) + noise, 4)


def _range() -> Series:
    """Logarithm of the day's range of prices from the last five."""
    prices = arch("sp500", "High", "Low")
    return embedded(np.log(np.log(prices[:, 0] / prices[:, 1])), 5)


def _bonds() -> Series:
    """Both yields a month on (two outputs) from those of the last two months."""
    rates = arch("default", "AAA", "BAA")
    return Series(np.concatenate((rates[1:-1], rates[:-2]), 1), rates[2:])


def duffing(count: int, h: float = 0.005) -> Array:
    """x'' = -.3 x' + x - x^3 + .5 cos(1.2 t), every .3 time units, by Euler steps."""

    def step(k: int, x: float, v: float) -> tuple[float, float]:
        return x + h * v, v + h * (-0.3 * v + x - x**3 + 0.5 * np.cos(1.2 * h * k))

    return orbit(step, (0.5, 0.0), count, every=60)[:, 0]


def tinkerbell(count: int) -> Series:
    """x a step on from both of x' = x^2 - y^2 + .9 x - .6013 y, y' = 2 x y + 2 x + .5 y, noise of .01."""

    def step(k: int, x: float, y: float) -> tuple[float, float]:
        return x * x - y * y + 0.9 * x - 0.6013 * y, 2 * x * y + 2 * x + 0.5 * y

    states = orbit(step, (-0.72, -0.64), count)
    states += 0.01 * np.random.default_rng(31).standard_normal(states.shape)
    return Series(states[:-1], states[1:, :1])


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


def _share_range() -> Series:
    import pmdarima.datasets as packaged

    prices = packaged.load_msft()[["High", "Low"]].to_numpy(float)
    return embedded(np.log(np.maximum(prices[:, 0] / prices[:, 1] - 1, 1e-3)), 5)


EARLIER: dict[str, Callable[[], Series]] = {
    "MG23 +1": lambda: embedded(mackey_glass(23, 1620)[10:], 5),
    "Ikeda": lambda: Series(ikeda(MOST + 1)[:-1], ikeda(MOST + 1)[1:, :1]),
    "Roessler +5": lambda: embedded(roessler(1700), 4, ahead=5),
    "Volterra equalisation": lambda: volterra(MOST),
    "Hammerstein switch": hammerstein_switch,
    "Narendra's plant": lambda: narendra(1200),
    "cart-pole force": lambda: cart_pole_force(1200),
    "Friedman drift": lambda: friedman(1200),
    "San Francisco temperature": lambda: embedded(vega("sf_temps", "temp"), 4),
    "Seattle daily maximum": lambda: embedded(vega("seattle_weather", "temp_max"), 4),
    "Nasdaq": lambda: embedded(np.log(arch("nasdaq", "Adj Close")), 3),
    "wine sales": lambda: embedded(pmdarima("wineind"), 12),
    "beer": lambda: embedded(pmdarima("ausbeer"), 4),
    "inflation": lambda: embedded(statsmodels("macrodata", "infl"), 4),
    "Nile": lambda: embedded(statsmodels("nile", "volume"), 3),
}

HELD_OUT: dict[str, Callable[[], Series]] = {
    "MG26 +2": lambda: embedded(mackey_glass(26, 1620, start=1.1)[10:], 6, ahead=2),
    "Lozi": lambda: embedded(lozi(1700), 2),
    "Chua +2": lambda: embedded(chua(1620), 4, ahead=2),
    "Lorenz 96": lambda: lorenz96(1400),
    "NARMA-10": lambda: narma(1400),
    "four symbols": lambda: four_symbols(MOST),
    "Wiener switches": wiener_switch,
    "loaded arm": lambda: loaded_arm(1200),  # two outputs, two sets
    "chirp": lambda: chirp(1000),
    "S&P 500 range": _range,
    "bond yields": _bonds,  # two outputs
    "wind": lambda: embedded(vega("seattle_weather", "wind"), 4),
    "core prices": lambda: embedded(np.diff(np.log(arch("core_cpi", "CPILFESL"))), 6),
    "unemployment": lambda: embedded(statsmodels("macrodata", "unemp"), 4),
    "wool": lambda: embedded(pmdarima("woolyrnq"), 4),
}

LATEST: dict[str, Callable[[], Series]] = {
    "Duffing +3": lambda: embedded(duffing(1500), 5, ahead=3),
    "Tinkerbell noisy": lambda: tinkerbell(MOST + 1),
    "fading channel": lambda: fading(MOST),
    "two tanks": lambda: tanks(1400),
    "light arm": lambda: arm(1200, seed=34, second=0.6),  # two outputs, two sets
    "treasury bills": lambda: embedded(statsmodels("macrodata", "tbilrate"), 4),
    "Microsoft range": _share_range,
}

"""Streams of the same kinds that no constant of the regressor was chosen on.

They were fixed, with their seeds, before the first of them was run; whoever changes the bank looks at the
sets of streams_data.py, and at these once, at the end.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from streams_data import MOST, Array, Series, embedded, mackey_glass


def ikeda(count: int) -> Array:
    """The real part of z' = 1 + .9 z exp(i (.4 - 6 / (1 + |z|^2)))."""
    z, found = 0.1 + 0.1j, []
    for _ in range(count + 100):
        z = 1 + 0.9 * z * np.exp(1j * (0.4 - 6 / (1 + abs(z) ** 2)))
        found.append([z.real, z.imag])
    return np.array(found[100:])


def roessler(count: int, step: float = 0.02, every: int = 10) -> Array:
    """The first coordinate of Roessler's system (.2, .2, 5.7), every .2 seconds, by Euler steps."""
    x, y, z, found = 1.0, 1.0, 1.0, []
    for k in range((count + 100) * every):
        if k % every == 0:
            found.append(x)
        x, y, z = x - step * (y + z), y + step * (x + 0.2 * y), z + step * (0.2 + z * (x - 5.7))
    return np.array(found[100:])


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


def _francisco() -> Series:
    from vega_datasets import local_data

    return embedded(local_data.sf_temps()["temp"].to_numpy(), 4)


def _weather() -> Series:
    from vega_datasets import local_data

    return embedded(local_data.seattle_weather()["temp_max"].to_numpy(), 4)


def _share(name: str) -> Series:
    import importlib

    values = importlib.import_module(f"arch.data.{name}").load()["Adj Close"].astype(float).dropna()
    return embedded(np.log(values.to_numpy()), 3)


def _pmdarima(name: str, size: int) -> Series:
    import pmdarima.datasets as packaged

    values = np.asarray(getattr(packaged, f"load_{name}")(), float)
    return embedded(values[np.isfinite(values)], size)


def _statsmodels(name: str, column: str, size: int) -> Series:
    from statsmodels import datasets

    return embedded(getattr(datasets, name).load_pandas().data[column].astype(float).to_numpy(), size)


HELD_OUT: dict[str, Callable[[], Series]] = {
    "MG23 +1": lambda: embedded(mackey_glass(23, 1620)[10:], 5),
    "Ikeda": lambda: Series(ikeda(MOST + 1)[:-1], ikeda(MOST + 1)[1:, :1]),
    "Roessler +5": lambda: embedded(roessler(1700), 4, ahead=5),
    "Volterra equalisation": lambda: volterra(MOST),
    "Hammerstein switch": hammerstein_switch,
    "Narendra's plant": lambda: narendra(1200),
    "cart-pole force": lambda: cart_pole_force(1200),
    "Friedman drift": lambda: friedman(1200),
    "San Francisco temperature": _francisco,
    "Seattle daily maximum": _weather,
    "Nasdaq": lambda: _share("nasdaq"),
    "wine sales": lambda: _pmdarima("wineind", 12),
    "beer": lambda: _pmdarima("ausbeer", 4),
    "inflation": lambda: _statsmodels("macrodata", "infl", 4),
    "Nile": lambda: _statsmodels("nile", "volume", 3),
}

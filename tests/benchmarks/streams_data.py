"""Public streams: generated from the published equations, or shipped inside packages; at most 1600 samples.

Every set is (x (T, n), y (T, k)) in the order of time: y is asked for at x, then told. The series of kafbox
(Van Vaerenbergh, FreeBSD licence) are generated anew from their equations; packages: river, statsmodels,
scikit-learn, pmdarima, arch, vega_datasets (`pip install -e '.[bench]'`).
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

MOST = 1600
Array = np.ndarray


class Series(NamedTuple):
    """A stream."""

    x: Array  # (T, n)
    y: Array  # (T, k)


def embedded(values: Array, size: int, ahead: int = 1, spacing: int = 1) -> Series:
    """The value ``ahead`` steps on from the last ``size`` values, ``spacing`` steps apart."""
    values = np.asarray(values, float)
    first, last = (size - 1) * spacing, len(values) - ahead
    x = np.stack([values[first - i * spacing : last - i * spacing] for i in range(size)], 1)
    return Series(x[:MOST], values[first + ahead :][:MOST, None])


def mackey_glass(delay: int, count: int, every: int = 6, start: float = 0.89) -> Array:
    """x' = .2 x(t - delay) / (1 + x(t - delay)^10) - .1 x by Runge-Kutta with steps of .1, every 6 seconds.

    With the delay 30 and x = .89 before 0 it is the series mg30 of kafbox, 24 seconds on.
    """
    fine = 10
    past = delay * fine
    x = np.empty(past + count * every * fine + 1)
    x[: past + 1] = start

    def rate(now: float, then: float) -> float:
        return 0.2 * then / (1 + then**10) - 0.1 * now

    for k in range(past, len(x) - 1):
        old, new = x[k - past], x[k - past + 1] if past else x[k]
        middle, h = (old + new) / 2, 1 / fine
        a = rate(x[k], old)
        b = rate(x[k] + h / 2 * a, middle)
        c = rate(x[k] + h / 2 * b, middle)
        d = rate(x[k] + h * c, new)
        x[k + 1] = x[k] + h / 6 * (a + 2 * b + 2 * c + d)
    return x[past :: every * fine][:count]


def orbit(
    step: Callable[..., tuple[Any, ...]], start: tuple[Any, ...], count: int, every: int = 1, skip: int = 100
) -> Array:
    """States of a map (step, *state) -> state, every so many steps, without the first: (count, n)."""
    state, found = start, []
    for k in range((count + skip) * every):
        if k % every == 0:
            found.append(state)
        state = step(k, *state)
    return np.array(found[skip:])


def lorenz(count: int) -> Array:
    """The third coordinate by Euler steps of .01 from (10, 7, 35): kafbox's lorenz.dat to its six digits."""

    def step(k: int, x: float, y: float, z: float) -> tuple[float, float, float]:
        return x + 0.1 * (y - x), y + 0.01 * (x * (28 - z) - y), z + 0.01 * (x * y - 8 / 3 * z)

    return orbit(step, (10.0, 7.0, 35.0), count, skip=0)[:, 2]


def henon(count: int) -> Array:
    x = [0.1, 0.1]
    for _ in range(count):
        x.append(1 - 1.4 * x[-1] ** 2 + 0.3 * x[-2])
    return np.array(x[100:])


def equalisation(count: int) -> Series:
    """Find the symbol s_{k-2} behind a channel with memory and a square, five outputs at hand."""
    draw = np.random.default_rng(1)
    s = draw.choice([-1.0, 1.0], count + 10)
    linear = s[1:] + 0.5 * s[:-1]
    r = linear - 0.9 * linear**2 + 0.4 * draw.standard_normal(len(linear))
    x = np.stack([r[4 - i : len(r) - i] for i in range(5)], 1)
    return Series(x[:count], s[3 : 3 + len(x)][:count, None])


def channel_switch(count: int = 1500, switch: int = 500) -> Series:
    """kafbox's Wiener system tanh(h'x), five taps, 20 dB; h changes at a third."""
    draw = np.random.default_rng(2)
    s = draw.standard_normal(count + 4)
    x = np.stack([s[4 - i : 4 - i + count] for i in range(5)], 1)
    h = np.concatenate((np.ones((2, 1)), draw.standard_normal((2, 4))), 1)
    y = np.tanh(np.where(np.arange(count) < switch, x @ h[0], x @ h[1]))
    return Series(x, (y + 0.1 * y.std() * draw.standard_normal(count))[:, None])


def arm(count: int, seed: int = 3, second: float = 1.0) -> Series:
    """Torques of both joints of a planar arm from angles, rates and accelerations; smooth random motion.

    Links of length 1, masses 1 and ``second`` at their ends, friction that nearly is of Coulomb's kind.
    """
    draw = np.random.default_rng(seed)
    time = 0.02 * np.arange(count)
    frequency, phase = draw.uniform(0.2, 1.2, (2, 6)), draw.uniform(0, 2 * np.pi, (2, 6))
    wave = 2 * np.pi * frequency[..., None] * time + phase[..., None]
    rate = 2 * np.pi * frequency[..., None]
    q = 0.5 * np.sin(wave).sum(1)
    v = 0.5 * (rate * np.cos(wave)).sum(1)
    a = -0.5 * (rate**2 * np.sin(wave)).sum(1)
    c2, s2 = np.cos(q[1]), np.sin(q[1])
    gravity = 9.81 * np.cos(q[0] + q[1])
    shoulder = 2 * (1 + c2) * a[0] + (1 + c2) * a[1] - s2 * (2 * v[0] * v[1] + v[1] ** 2)
    shoulder += 9.81 * np.cos(q[0]) + gravity
    shoulder = second * shoulder + a[0] + 9.81 * np.cos(q[0]) + 2 * np.tanh(5 * v[0])
    elbow = second * ((1 + c2) * a[0] + a[1] + s2 * v[0] ** 2 + gravity) + np.tanh(5 * v[1])
    y = np.stack((shoulder, elbow), 1) / 20
    return Series(np.concatenate((q, v, a)).T, y + 0.05 * draw.standard_normal(y.shape))


def vega(name: str, column: str) -> Array:
    from vega_datasets import local_data

    return getattr(local_data, name)()[column].to_numpy(float)


def _river(name: str) -> Series:
    import river.datasets

    rows = list(getattr(river.datasets, name)())
    return Series(
        np.array([list(x.values()) for x, _ in rows], float), np.array([[y] for _, y in rows], float)
    )


def _water() -> Array:
    from river.datasets import WaterFlow

    return np.array([y for _, y in WaterFlow()])


def pmdarima(name: str) -> Array:
    import pmdarima.datasets as packaged

    values = np.asarray(getattr(packaged, f"load_{name}")(), float)
    return values[np.isfinite(values)]


def statsmodels(name: str, column: str) -> Array:
    from statsmodels import datasets

    values = getattr(datasets, name).load_pandas().data[column].astype(float)
    return values.interpolate().to_numpy()


def _el_nino() -> Array:
    from statsmodels import datasets

    return datasets.elnino.load_pandas().data.iloc[:, 1:].to_numpy(float).ravel()


def arch(name: str, *columns: str) -> Array:
    values = importlib.import_module(f"arch.data.{name}").load()[list(columns)].astype(float)
    return values.dropna().to_numpy().squeeze()


def _diabetes() -> Series:
    from sklearn.datasets import load_diabetes

    x, y = load_diabetes(return_X_y=True)
    return Series(x, y[:, None])


def _noisy() -> Array:
    values = mackey_glass(30, 1620)
    return values + 0.05 * values.std() * np.random.default_rng(4).standard_normal(len(values))


SETS: dict[str, Callable[[], Series]] = {
    "MG30 +1": lambda: embedded(mackey_glass(30, 1620)[10:], 7),
    "MG17 +84": lambda: embedded(mackey_glass(17, 1720)[20:], 4, ahead=14),
    "Henon": lambda: embedded(henon(1700), 2),
    "Lorenz +5": lambda: embedded(lorenz(1700), 3, ahead=5),
    "Lorenz +10": lambda: embedded(lorenz(1700), 6, ahead=10),
    "channel equalisation": lambda: equalisation(MOST),
    "channel switch": channel_switch,
    "Seattle temperature": lambda: embedded(vega("seattle_temps", "temp"), 4),
    "Trump approval": lambda: _river("TrumpApproval"),
    "Taylor load": lambda: embedded(pmdarima("taylor"), 3),
    "CO2": lambda: embedded(statsmodels("co2", "co2"), 4),
    "VIX": lambda: embedded(arch("vix", "vix"), 3),
    "arm": lambda: arm(1200),  # two outputs, two sets
    "WaterFlow": lambda: embedded(_water(), 4),
    "MG30 noisy": lambda: embedded(_noisy(), 7),
    "chick weights": lambda: _river("ChickWeights"),
    "diabetes": _diabetes,
    "airline": lambda: embedded(pmdarima("airpassengers"), 3),
    "El Nino": lambda: embedded(_el_nino(), 12),
    "sunspots": lambda: embedded(statsmodels("sunspots", "SUNACTIVITY"), 3),
    "lynx": lambda: embedded(np.log(pmdarima("lynx")), 2),
    "crude oil": lambda: embedded(arch("wti", "DCOILWTICO"), 3),
    "heart rate": lambda: embedded(pmdarima("heartrate"), 4),
}

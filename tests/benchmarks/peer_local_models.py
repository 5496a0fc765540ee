"""Local models of the samples at hand, one stream each, NumPy."""

from __future__ import annotations

import math

import numpy as np
from scipy.linalg import cho_factor, cho_solve

Array = np.ndarray


class WindowedGP:
    """The exact Gaussian process of the last ``window`` samples around their mean, Gaussian kernel."""

    def __init__(self, window: int, width: float, noise: float) -> None:
        self.window, self.gamma, self.noise = window, -0.5 / width**2, noise
        self.x: list[Array] = []
        self.y: list[float] = []

    def predict(self, x: Array) -> float:
        if not self.x:
            return 0.0
        points, values = np.array(self.x), np.array(self.y)
        norms = np.square(points).sum(1)
        square = np.maximum(norms[:, None] + norms - 2 * points @ points.T, 0)
        gram = np.exp(self.gamma * square)
        gram.flat[:: len(gram) + 1] += self.noise
        row, mean = np.exp(self.gamma * np.square(points - x).sum(1)), values.mean()
        return float(mean + row @ cho_solve(cho_factor(gram), values - mean))

    def learn(self, x: Array, y: float) -> None:
        self.x, self.y = [*self.x[-self.window + 1 :], x], [*self.y[-self.window + 1 :], y]


class LocalLinear:
    """Ridge regression on the ``count`` (n + 1) nearest samples of all seen, tricube weights."""

    def __init__(self, count: float, ridge: float) -> None:
        self.count, self.ridge = count, ridge
        self.x: list[Array] = []
        self.y: list[float] = []

    def predict(self, x: Array) -> float:
        if not self.x:
            return 0.0
        z = np.array(self.x) - x
        distance = np.sqrt(np.square(z).sum(1))
        most = min(len(z), math.ceil(self.count * (z.shape[1] + 1)))
        near = np.argpartition(distance, most - 1)[:most]
        reach = distance[near].max() * 1.0001 + 1e-300
        weight = (1 - (distance[near] / reach) ** 3) ** 3
        values = np.array(self.y)[near]
        mean = weight @ values / weight.sum() if weight.sum() > 0 else values.mean()
        design = np.column_stack((np.ones(most), z[near]))
        normal = design.T @ (weight[:, None] * design)
        normal.flat[:: len(normal) + 1] += self.ridge * weight.sum() * reach**2 + 1e-300
        return float(mean + np.linalg.lstsq(normal, design.T @ (weight * (values - mean)), rcond=None)[0][0])

    def learn(self, x: Array, y: float) -> None:
        self.x.append(x)
        self.y.append(y)


class Persistence:
    """The last value seen."""

    def __init__(self) -> None:
        self.last = 0.0

    def predict(self, x: Array) -> float:
        return self.last

    def learn(self, x: Array, y: float) -> None:
        self.last = y

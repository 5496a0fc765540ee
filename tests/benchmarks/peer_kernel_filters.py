"""Kernel adaptive filters, one stream each, NumPy, the Gaussian kernel exp(-|x - x'|^2 / (2 width^2)).

Written from the papers: Engel, Mannor and Meir (2004) for ALD-KRLS, Van Vaerenbergh, Lazaro-Gredilla and
Santamaria (2012) for KRLS-T, Chen et al. (2012) for QKLMS; random Fourier features: Rahimi and Recht (2007).
"""

from __future__ import annotations

import math

import numpy as np

Array = np.ndarray


class _Dictionary:
    """Samples and the kernel at them."""

    def __init__(self, width: float, capacity: int) -> None:
        self.gamma, self.capacity, self.points = -0.5 / width**2, capacity, np.empty((0, 0))

    def row(self, x: Array) -> Array:
        if not len(self.points):
            return np.empty(0)
        return np.exp(self.gamma * np.square(self.points - x).sum(1))

    def add(self, x: Array) -> None:
        self.points = np.vstack((self.points, x)) if len(self.points) else x[None].copy()


class Krls(_Dictionary):
    """Recursive least squares on the samples that are not almost linearly dependent, threshold nu."""

    def __init__(self, width: float, nu: float, capacity: int = 500) -> None:
        super().__init__(width, capacity)
        self.nu, self.weights, self.inverse, self.p = nu, np.empty(0), np.empty((0, 0)), np.empty((0, 0))

    def predict(self, x: Array) -> float:
        return float(self.row(x) @ self.weights)

    def learn(self, x: Array, y: float) -> None:
        k, m = self.row(x), len(self.weights)
        a = self.inverse @ k
        rest, error = 1 - float(k @ a), y - float(k @ self.weights)
        if m == 0 or (rest > self.nu and m < self.capacity):
            grown = np.zeros((m + 1, m + 1))
            grown[:m, :m] = self.inverse
            direction = np.append(a, -1.0)
            self.inverse = grown + np.outer(direction, direction) / rest
            self.p = np.pad(self.p, (0, 1))
            self.p[m, m] = 1
            self.weights = np.append(self.weights, 0.0) - direction * (error / rest)
            self.add(x)
            return
        q = self.p @ a
        q /= 1 + a @ q
        self.p -= np.outer(q, a @ self.p)
        self.weights = self.weights + self.inverse @ q * error


class KrlsTracker(_Dictionary):
    """A Gaussian process on at most ``capacity`` samples that fades towards its prior by ``forgetting``."""

    def __init__(self, width: float, noise: float, forgetting: float, capacity: int = 100) -> None:
        super().__init__(width, capacity)
        self.noise, self.forgetting = noise, forgetting
        self.amplitude = 1.0

    def predict(self, x: Array) -> float:
        return float(self.row(x) @ self.inverse @ self.mean) if len(self.points) else 0.0

    def learn(self, x: Array, y: float) -> None:
        jitter = 1e-6
        if not len(self.points):
            self.add(x)
            k = 1 + jitter
            self.inverse, self.gram = np.array([[1 / k]]), np.array([[k]])
            self.mean = np.array([y * k / (k + self.noise)])
            self.cov = np.array([[k - k**2 / (k + self.noise)]])
            return
        self.cov = self.forgetting * self.cov + (1 - self.forgetting) * self.gram
        self.mean = math.sqrt(self.forgetting) * self.mean
        k = self.row(x)
        q = self.inverse @ k
        expected, rest = float(q @ self.mean), max(1 + jitter - float(k @ q), jitter)
        h = self.cov @ q
        spread = rest + float(q @ h)
        total = spread + self.noise
        direction, p = np.append(q, -1.0), np.append(h, spread)
        self.inverse = np.pad(self.inverse, (0, 1)) + np.outer(direction, direction) / rest
        self.gram = np.block([[self.gram, k[:, None]], [k[None], np.array([[1 + jitter]])]])
        self.mean = np.append(self.mean, expected) + (y - expected) / total * p
        self.cov = (
            np.block([[self.cov, h[:, None]], [h[None], np.array([[spread]])]]) - np.outer(p, p) / total
        )
        self.add(x)
        if len(self.points) > self.capacity or rest < 10 * jitter:
            diagonal = np.diag(self.inverse)
            drop = (
                int(np.argmin(np.abs(self.inverse @ self.mean) / diagonal)) if rest >= 10 * jitter else len(q)
            )
            self._drop(drop)

    def _drop(self, i: int) -> None:
        keep = np.arange(len(self.points)) != i
        column = self.inverse[keep, i]
        self.inverse = self.inverse[np.ix_(keep, keep)] - np.outer(column, column) / self.inverse[i, i]
        self.gram, self.cov = self.gram[np.ix_(keep, keep)], self.cov[np.ix_(keep, keep)]
        self.mean, self.points = self.mean[keep], self.points[keep]


class Qklms(_Dictionary):
    """Least mean squares; a sample within ``quantum`` of a center adds to that center's weight."""

    def __init__(self, width: float, rate: float, quantum: float, capacity: int = 1600) -> None:
        super().__init__(width, capacity)
        self.rate, self.quantum, self.weights = rate, quantum, np.empty(0)

    def predict(self, x: Array) -> float:
        return float(self.row(x) @ self.weights)

    def learn(self, x: Array, y: float) -> None:
        step = self.rate * (y - self.predict(x))
        if len(self.points):
            distance = np.square(self.points - x).sum(1)
            nearest = int(distance.argmin())
            if distance[nearest] <= self.quantum**2:
                self.weights[nearest] += step
                return
        self.add(x)
        self.weights = np.append(self.weights, step)


class RandomFeatures:
    """Recursive least squares on ``count`` random Fourier features and the inputs themselves."""

    def __init__(self, width: float, ridge: float, forgetting: float, count: int = 200) -> None:
        self.arguments, self.ridge, self.forgetting = (width, count), ridge, forgetting
        self.weights: Array | None = None

    def _features(self, x: Array) -> Array:
        if self.weights is None:
            width, count = self.arguments
            draw = np.random.default_rng(0)
            self.w, self.b = draw.standard_normal((count, len(x))) / width, draw.uniform(0, 2 * np.pi, count)
            self.weights = np.zeros(count + len(x) + 1)
            self.p = np.eye(len(self.weights)) / self.ridge
        return np.concatenate((np.cos(self.w @ x + self.b) * math.sqrt(2 / len(self.b)), x, [1.0]))

    def predict(self, x: Array) -> float:
        phi = self._features(x)
        return float(phi @ self.weights)

    def learn(self, x: Array, y: float) -> None:
        phi = self._features(x)
        g = self.p @ phi
        total = self.forgetting + phi @ g
        self.weights = self.weights + g * ((y - phi @ self.weights) / total)
        self.p -= np.outer(g, g / total)
        self.p = (self.p + self.p.T) / (2 * self.forgetting)  # else it loses its symmetry, as rounding has it

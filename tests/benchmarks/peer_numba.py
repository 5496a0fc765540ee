"""The gradient chase as scalar loops in numba, trajectories in parallel: exponential kernel, the paper's
V and law, K = S K0 S from M exponentials and g <- g - 2 lambda K g in place of a new residual."""

from __future__ import annotations

import math

import numba
import numpy as np


@numba.njit(parallel=True)
def chase(states: np.ndarray, d: np.ndarray, core: np.ndarray, inner_steps: int) -> np.ndarray:
    """(B, T, 2) to (B, T, M)."""
    batch, times, _ = states.shape
    m = d.shape[0]
    out = np.empty((batch, times, m), states.dtype)
    for b in numba.prange(batch):
        a, g, y, s = (
            np.zeros(m, states.dtype),
            np.zeros(m, states.dtype),
            np.zeros(m, states.dtype),
            np.zeros(m, states.dtype),
        )
        gram = np.zeros((m, m), states.dtype)
        half = states.dtype.type(0.5)
        last = states[b, 0, 0] ** 2 + states[b, 0, 1] ** 2
        for t in range(times):
            x1, x2 = states[b, t, 0], states[b, t, 1]
            gain = x1 * x1 + x2 * x2
            unit, inverse = math.exp(gain - last), math.exp(-gain)
            last = gain
            for i in range(m):
                s[i] = math.exp(x1 * d[i, 0] + x2 * d[i, 1])
            for i in range(m):
                a[i] *= unit
                for j in range(m):
                    gram[i, j] = s[i] * core[i, j] * s[j]
            for i in range(m):
                c1, c2 = x1 + d[i, 0], x2 + d[i, 1]
                rest = c1 * c1 + 5 * c2 * c2 + math.tanh(c1 * c2)
                for j in range(m):
                    rest -= gram[i, j] * a[j]
                g[i] = 2 * rest
            for _ in range(inner_steps):
                slope = x1 - x1
                curvature = x1 - x1
                for i in range(m):
                    total = x1 - x1
                    for j in range(m):
                        total += gram[i, j] * g[j]
                    y[i] = total
                    slope += g[i] * g[i]
                    curvature += g[i] * total
                if curvature > 0:
                    twice = slope / curvature
                    for i in range(m):
                        a[i] += half * twice * g[i]
                        g[i] -= twice * y[i]
            for i in range(m):
                out[b, t, i] = a[i] * inverse
    return out

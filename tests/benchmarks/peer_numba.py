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


@numba.njit(parallel=True, error_model="numpy")
def chase_blocks(states: np.ndarray, d: np.ndarray, core: np.ndarray, inner_steps: int) -> np.ndarray:
    """(T, 2, B) to (T, M, B): the same, blocks of 64 trajectories side by side in every inner loop."""
    times, _, batch = states.shape
    m, width = d.shape[0], 64
    out = np.empty((times, m, batch), states.dtype)
    one = states.dtype.type(1)
    half = states.dtype.type(0.5)
    for block in numba.prange((batch + width - 1) // width):
        first = block * width
        n = min(width, batch - first)
        state = np.zeros((4, m, width), states.dtype)
        a, g, y, s = state[0], state[1], state[2], state[3]
        gram = np.zeros((m, m, width), states.dtype)
        scalars = np.zeros((4, width), states.dtype)
        last, unit, slope, curvature = scalars[0], scalars[1], scalars[2], scalars[3]
        for k in range(n):
            last[k] = states[0, 0, first + k] ** 2 + states[0, 1, first + k] ** 2
        for t in range(times):
            x1, x2 = states[t, 0, first : first + n], states[t, 1, first : first + n]
            for k in range(n):
                gain = x1[k] * x1[k] + x2[k] * x2[k]
                unit[k] = math.exp(gain - last[k])
                last[k] = gain
            for i in range(m):
                for k in range(n):
                    s[i, k] = math.exp(x1[k] * d[i, 0] + x2[k] * d[i, 1])
                    c1, c2 = x1[k] + d[i, 0], x2[k] + d[i, 1]
                    g[i, k] = c1 * c1 + 5 * c2 * c2 + math.tanh(c1 * c2)
                    a[i, k] *= unit[k]
            for i in range(m):
                for j in range(m):
                    for k in range(n):
                        gram[i, j, k] = s[i, k] * core[i, j] * s[j, k]
            for i in range(m):
                for j in range(m):
                    for k in range(n):
                        g[i, k] -= gram[i, j, k] * a[j, k]
            g *= 2
            for _ in range(inner_steps):
                y[:] = 0
                slope[:] = 0
                curvature[:] = 0
                for i in range(m):
                    for j in range(m):
                        for k in range(n):
                            y[i, k] += gram[i, j, k] * g[j, k]
                    for k in range(n):
                        slope[k] += g[i, k] * g[i, k]
                        curvature[k] += g[i, k] * y[i, k]
                for k in range(n):
                    slope[k] = slope[k] / curvature[k] if curvature[k] > 0 else 0 * one
                for i in range(m):
                    for k in range(n):
                        a[i, k] += half * slope[k] * g[i, k]
                        g[i, k] -= slope[k] * y[i, k]
            for k in range(n):
                unit[k] = math.exp(-last[k])
            for i in range(m):
                for k in range(n):
                    out[t, i, first + k] = a[i, k] * unit[k]
    return out

"""The chase under other laws as JAX programs and as numba loops: exponential kernel, the paper's V.

`scanned` is jit(vmap(scan)) of one trajectory as one writes it; `stacked` keeps the batch last, takes
K = S K0 S from M exponentials and its spectrum in bulk before the scan. All return the paper's weights.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

LAWS = ("SteepestDescent", "Nesterov", "ConjugateGradient", "HeavyBall", "Exact")
Program = Callable[[Any], Any]


def jax_programs(law: str, offsets: np.ndarray, inner_steps: int) -> dict[str, tuple[Program, bool]]:
    """Name to (program, whether it takes the states as (T, n, B) instead of (B, T, n))."""
    import jax
    import jax.numpy as jnp
    from jax import lax

    jax.config.update("jax_enable_x64", True)

    def ratio(a: Any, b: Any) -> Any:
        return jnp.where(b > 0, a / jnp.where(b > 0, b, 1), 0)

    def value(c1: Any, c2: Any) -> Any:
        return c1 * c1 + 5 * c2 * c2 + jnp.tanh(c1 * c2)

    # Vectors are (M,) or (M, B); `dot` sums over M.
    def dot(a: Any, b: Any) -> Any:
        return (a * b).sum(0)

    def iterate(product: Any, values: Any, spectrum: Any, a: Any, velocity: Any) -> tuple[Any, Any]:
        def slope_at(a: Any) -> Any:
            return 2 * (values - product(a))

        if law == "SteepestDescent":

            def descend(_: int, pair: Any) -> Any:
                a, g = pair
                y = product(g)
                twice = ratio(dot(g, g), dot(g, y))
                return a + 0.5 * twice * g, g - twice * y

            return lax.fori_loop(0, inner_steps, descend, (a, slope_at(a)))[0], velocity
        if law == "ConjugateGradient":

            def conjugate(_: int, state: Any) -> Any:
                a, p, before = state
                g = slope_at(a)
                slope = dot(g, g)
                p = g + ratio(slope, before) * p
                return a + 0.5 * ratio(dot(g, p), dot(p, product(p))) * p, p, slope

            zero = jnp.zeros_like(a)
            return lax.fori_loop(0, inner_steps, conjugate, (a, zero, dot(zero, zero)))[0], velocity
        low, high = spectrum
        q = jnp.sqrt(ratio(low, high))

        def momentum(_: int, pair: Any) -> Any:
            a, v = pair
            ahead = a + (1 - q) / (1 + q) * v if law == "Nesterov" else a
            g = slope_at(ahead)
            lost = -dot(ahead, values + g / 2) > 0
            if law == "Nesterov":
                moved = ahead + g / (2 * high)
                return moved, jnp.where(lost, 0, moved - a)
            moved = ((1 - q) / (1 + q)) ** 2 * v + 4 / (1 + q) ** 2 * g / (2 * high)
            descent = 0.5 * ratio(dot(g, g), dot(g, product(g))) * g
            return a + jnp.where(lost, descent, moved), jnp.where(lost, 0, moved)

        return lax.fori_loop(0, inner_steps, momentum, (a, velocity))

    def scanned(states: Any) -> Any:
        d = jnp.asarray(offsets, states.dtype)
        core = jnp.exp(d @ d.T)

        def step(carry: Any, x: Any) -> Any:
            a, v, last = carry
            gain, s = x @ x, jnp.exp(d @ x)
            gram, values = s[:, None] * core * s, value(*(x + d).T)
            unit = jnp.exp(gain - last)
            if law == "Exact":
                a = jnp.linalg.solve(gram, values)
            else:
                needed = law in ("Nesterov", "HeavyBall")
                spectrum = jnp.linalg.eigvalsh(gram)[jnp.array([0, -1])] if needed else (0, 0)
                a, v = iterate(lambda u: gram @ u, values, spectrum, a * unit, v * unit)
            return (a, v, gain), a * jnp.exp(-gain)

        zero = jnp.zeros(len(offsets), states.dtype)
        return lax.scan(step, (zero, zero, states.dtype.type(0)), states)[1]

    def stacked(states: Any) -> Any:
        d = np.asarray(offsets, states.dtype)
        core = jnp.asarray(np.exp(offsets @ offsets.T), states.dtype)
        scales = jnp.exp(jnp.einsum("mn,tnb->tmb", d, states))
        if law in ("Nesterov", "HeavyBall"):
            grams = jnp.einsum("tib,ij,tjb->tbij", scales, core, scales)
            spectra = jnp.moveaxis(jnp.linalg.eigvalsh(grams)[..., jnp.array([0, -1])], -1, 1)
        else:
            spectra = jnp.zeros((len(states), 2, states.shape[2]), states.dtype)
        inverse = jnp.linalg.inv(core)

        def step(carry: Any, at: Any) -> Any:
            a, v, last = carry
            x, s, spectrum = at
            gain = x[0] * x[0] + x[1] * x[1]
            values = value(x[0] + d[:, :1], x[1] + d[:, 1:])
            unit = jnp.exp(gain - last)
            if law == "Exact":
                a = (inverse @ (values / s)) / s
            else:
                a, v = iterate(lambda u: s * (core @ (s * u)), values, spectrum, a * unit, v * unit)
            return (a, v, gain), a * jnp.exp(-gain)

        batch = states.shape[2]
        zero = jnp.zeros((len(d), batch), states.dtype)
        return lax.scan(step, (zero, zero, jnp.zeros(batch, states.dtype)), (states, scales, spectra))[1]

    return {"jit(vmap(scan))": (jax.jit(jax.vmap(scanned)), False), "batch last": (jax.jit(stacked), True)}


def jax_apart(offsets: np.ndarray, inner_steps: int) -> Program:
    """A scan with every component an array (B,) of its own, all iterations written out: (T, n, B) states.

    Steepest descent; returns M arrays (T, B). What XLA makes of it is one kernel or two a time, its numbers
    in registers.
    """
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)
    core = np.exp(offsets @ offsets.T).tolist()

    def dot(a: Any, b: Any) -> Any:
        return sum(x * y for x, y in zip(a, b, strict=True))

    def ratio(a: Any, b: Any) -> Any:
        return jnp.where(b > 0, a / jnp.where(b > 0, b, 1), 0)

    def step(carry: Any, at: Any) -> Any:
        (a, last), (x, y) = carry, at
        gain = x * x + y * y
        places = [(x + p, y + q) for p, q in offsets.tolist()]
        values = [c * c + 5 * d * d + jnp.tanh(c * d) for c, d in places]
        scale = [jnp.exp(p * x + q * y) for p, q in offsets.tolist()]

        def product(u: Any) -> Any:
            scaled = [s * each for s, each in zip(scale, u, strict=True)]
            return [s * dot(row, scaled) for s, row in zip(scale, core, strict=True)]

        unit = jnp.exp(gain - last)
        a = [each * unit for each in a]
        g = [2 * (v - k) for v, k in zip(values, product(a), strict=True)]
        for _ in range(inner_steps):
            image = product(g)
            twice = ratio(dot(g, g), dot(g, image))
            a = [each + 0.5 * twice * down for each, down in zip(a, g, strict=True)]
            g = [down - twice * each for down, each in zip(g, image, strict=True)]
        weight = jnp.exp(-gain)
        return (tuple(a), gain), tuple(each * weight for each in a)

    def run(states: Any) -> Any:
        zero = jnp.zeros(states.shape[2], states.dtype)
        start = (zero,) * len(offsets), zero
        return jax.lax.scan(step, start, (states[:, 0], states[:, 1]))[1]

    return jax.jit(run)


def numba_program(law: str, offsets: np.ndarray, inner_steps: int) -> Program:
    """Loops over rows, times and iterations: (B, T, n) to (B, T, M)."""
    import numba

    kind, count = LAWS.index(law), len(offsets)

    @numba.njit(fastmath=False)
    def run(states: Any, d: Any, core: Any) -> Any:
        batch, times, _ = states.shape
        out = np.empty((batch, times, count), states.dtype)
        gram, values, s = (
            np.empty((count, count), states.dtype),
            np.empty(count, states.dtype),
            np.empty(count),
        )
        for b in range(batch):
            a, v, last = np.zeros(count, states.dtype), np.zeros(count, states.dtype), 0.0
            for t in range(times):
                x = states[b, t]
                gain = x[0] * x[0] + x[1] * x[1]
                for i in range(count):
                    s[i] = np.exp(d[i, 0] * x[0] + d[i, 1] * x[1])
                    c1, c2 = x[0] + d[i, 0], x[1] + d[i, 1]
                    values[i] = c1 * c1 + 5 * c2 * c2 + np.tanh(c1 * c2)
                for i in range(count):
                    for j in range(count):
                        gram[i, j] = s[i] * core[i, j] * s[j]
                unit = np.exp(gain - last)
                a, v, last = a * unit, v * unit, gain
                if kind == 4:
                    a = np.linalg.solve(gram, values)
                if kind in (1, 3):
                    w = np.linalg.eigvalsh(gram)
                    high, q = w[count - 1], np.sqrt(max(w[0], 0.0) / w[count - 1])
                p, before = np.zeros(count, states.dtype), 0.0
                g = 2 * (values - gram @ a)
                for _ in range(inner_steps if kind != 4 else 0):
                    if kind == 0:
                        y = gram @ g
                        bend = g @ y
                        twice = (g @ g) / bend if bend > 0 else 0.0
                        a, g = a + 0.5 * twice * g, g - twice * y
                    elif kind == 2:
                        g = 2 * (values - gram @ a)
                        slope = g @ g
                        p = g + (slope / before if before > 0 else 0.0) * p
                        bend = p @ (gram @ p)
                        a, before = a + (0.5 * (g @ p) / bend if bend > 0 else 0.0) * p, slope
                    else:
                        ahead = a + (1 - q) / (1 + q) * v if kind == 1 else a
                        g = 2 * (values - gram @ ahead)
                        lost = -(ahead @ (values + g / 2)) > 0
                        if kind == 1:
                            moved = ahead + g / (2 * high)
                            v = np.zeros(count, states.dtype) if lost else moved - a
                            a = moved
                        else:
                            v = ((1 - q) / (1 + q)) ** 2 * v + 4 / (1 + q) ** 2 * g / (2 * high)
                            if lost:
                                a, v = a + 0.5 * (g @ g) / (g @ (gram @ g)) * g, np.zeros(count, states.dtype)
                            else:
                                a = a + v
                out[b, t] = a * np.exp(-gain)
        return out

    core = np.exp(offsets @ offsets.T)
    # numba types scalars as float64, which small loops of one row do not feel: float32 comes and goes.
    return lambda states: run(states.astype(np.float64), offsets, core).astype(states.dtype)

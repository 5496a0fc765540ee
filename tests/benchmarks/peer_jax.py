"""The gradient chase as JAX programs: exponential kernel, the paper's V and law.

`straightforward` is what one writes first; the others are the best that we could write. All compute
V at the centers, the Gram matrix and the weights at every time; all but the first keep the batch last
and take K = S K0 S from M exponentials and g <- g - 2 lambda K g in place of a new residual.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

jax.config.update("jax_enable_x64", True)
Program = Callable[[Any], Any]


def programs(offsets: np.ndarray, inner_steps: int) -> dict[str, tuple[Program, bool]]:
    """Name to (program, whether it takes the states as (T, n, B) instead of (B, T, n))."""
    found = {"jit(vmap(scan))": (straightforward(offsets, inner_steps), False)}
    variants: list[tuple[str, Any, bool]] = [
        ("stacked", stacked, False),
        ("stacked, unrolled", stacked, True),
    ]
    if len(offsets) <= 6:  # XLA compiles the unrolled components of 15 centers for minutes
        variants.append(("components", components, False))
    if len(offsets) <= 3:
        variants.append(("components, unrolled", components, True))
    for name, program, unroll in variants:
        found[name] = (program(offsets, inner_steps, unroll), True)
    return found


def _value(x1: Any, x2: Any) -> Any:
    return x1 * x1 + 5 * x2 * x2 + jnp.tanh(x1 * x2)


def _ratio(slope: Any, curvature: Any) -> Any:
    usable = curvature > 0
    return jnp.where(usable, slope / jnp.where(usable, curvature, 1), 0)


def straightforward(offsets: np.ndarray, inner_steps: int) -> Program:
    def trajectory(states: Any) -> Any:
        d = jnp.asarray(offsets, states.dtype)

        def descend(a: Any, _: None, gram: Any, values: Any) -> tuple[Any, None]:
            g = 2 * (values - gram @ a)
            return a + 0.5 * _ratio(g @ g, g @ (gram @ g)) * g, None

        def step(a: Any, x: Any) -> tuple[Any, Any]:
            c = x + d
            gram, values = jnp.exp(c @ c.T), _value(c[:, 0], c[:, 1])
            a, _ = lax.scan(partial(descend, gram=gram, values=values), a, None, length=inner_steps)
            return a, a

        return lax.scan(step, jnp.zeros(len(offsets), states.dtype), states)[1]

    return jax.jit(jax.vmap(trajectory))


def _iterate(descend: Callable[[Any], Any], pair: Any, steps: int, unroll: bool) -> Any:
    if not unroll:
        return lax.fori_loop(0, steps, lambda _, p: descend(p), pair)
    for _ in range(steps):
        pair = descend(pair)
    return pair


def stacked(offsets: np.ndarray, inner_steps: int, unroll: bool) -> Program:
    """Weights (M, B), the core as one matrix product."""

    def run(states: Any) -> Any:
        d = np.asarray(offsets, states.dtype)
        core = jnp.asarray(np.exp(offsets @ offsets.T), states.dtype)

        def step(carry: Any, x: Any) -> Any:
            a, last = carry
            gain = x[0] * x[0] + x[1] * x[1]
            s = jnp.exp(d[:, :1] * x[0] + d[:, 1:] * x[1])
            values = _value(x[0] + d[:, :1], x[1] + d[:, 1:])

            def descend(pair: Any) -> Any:
                a, g = pair
                y = s * (core @ (s * g))
                twice = _ratio((g * g).sum(0), (g * y).sum(0))
                return a + 0.5 * twice * g, g - twice * y

            a = a * jnp.exp(gain - last)
            g = 2 * (values - s * (core @ (s * a)))
            a, _ = _iterate(descend, (a, g), inner_steps, unroll)
            return (a, gain), a * jnp.exp(-gain)

        batch = states.shape[2]
        first = jnp.zeros((len(d), batch), states.dtype), jnp.zeros(batch, states.dtype)
        return lax.scan(step, first, states)[1]

    return jax.jit(run)


def components(offsets: np.ndarray, inner_steps: int, unroll: bool) -> Program:
    """One array (B,) a weight and a Gram entry."""
    m = range(len(offsets))

    def run(states: Any) -> Any:
        d = np.asarray(offsets, states.dtype)
        core = np.exp(offsets @ offsets.T).astype(states.dtype)

        def step(carry: Any, x: Any) -> Any:
            a, last = carry
            gain = x[0] * x[0] + x[1] * x[1]
            s = [jnp.exp(x[0] * d[i, 0] + x[1] * d[i, 1]) for i in m]
            lower = [[s[i] * core[i, j] * s[j] for j in range(i + 1)] for i in m]
            gram = [[lower[max(i, j)][min(i, j)] for j in m] for i in m]

            def product(v: Any) -> Any:
                return [sum(gram[i][j] * v[j] for j in m) for i in m]

            def descend(pair: Any) -> Any:
                a, g = pair
                y = product(g)
                twice = _ratio(sum(gi * gi for gi in g), sum(gi * yi for gi, yi in zip(g, y, strict=True)))
                return [a[i] + 0.5 * twice * g[i] for i in m], [g[i] - twice * y[i] for i in m]

            unit = jnp.exp(gain - last)
            a = [ai * unit for ai in a]
            y = product(a)
            g = [2 * (_value(x[0] + d[i, 0], x[1] + d[i, 1]) - y[i]) for i in m]
            a, _ = _iterate(descend, (a, g), inner_steps, unroll)
            inverse = jnp.exp(-gain)
            return (a, gain), [ai * inverse for ai in a]

        zero = jnp.zeros(states.shape[2], states.dtype)
        return lax.scan(step, ([zero for _ in m], zero), states)[1]

    return jax.jit(run)

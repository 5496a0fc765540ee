"""The gradient chase by `torch.compile` of one step, batch last: exponential kernel, the paper's V and law,
K = S K0 S from M exponentials and g <- g - 2 lambda K g in place of a new residual."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

Step = Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor, Tensor]]


def program(offsets: Tensor, inner_steps: int, batch: int) -> Callable[[Tensor], Tensor]:
    """(T, 2, B) to (T, M, B)."""
    make = components if len(offsets) <= 6 else stacked
    step = torch.compile(make(offsets, inner_steps), fullgraph=True)

    def run(states: Tensor) -> Tensor:
        a, gain = states.new_zeros(len(offsets), batch), states[0].square().sum(0)
        out = states.new_empty(len(states), len(offsets), batch)
        for t, x in enumerate(states):
            out[t], a, gain = step(a, gain, x)
        return out

    return run


def _value(x1: Tensor, x2: Tensor) -> Tensor:
    return x1 * x1 + 5 * x2 * x2 + (x1 * x2).tanh()


def _ratio(slope: Tensor, curvature: Tensor) -> Tensor:
    return torch.where(curvature > 0, slope / curvature, 0)


def components(offsets: Tensor, inner_steps: int) -> Step:
    """Every weight and Gram entry by itself, so that all of it fuses."""
    d, m = offsets.tolist(), range(len(offsets))
    core = (offsets @ offsets.mT).exp().tolist()

    def step(a: Tensor, last: Tensor, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        gain = x[0] * x[0] + x[1] * x[1]
        unit = (gain - last).exp()
        s = [(x[0] * d[i][0] + x[1] * d[i][1]).exp() for i in m]
        lower = [[s[i] * core[i][j] * s[j] for j in range(i + 1)] for i in m]

        def product(v: list[Tensor]) -> list[Tensor]:
            return [sum((lower[max(i, j)][min(i, j)] * v[j] for j in m), start=0 * v[0]) for i in m]

        w = [a[i] * unit for i in m]
        y = product(w)
        g = [2 * (_value(x[0] + d[i][0], x[1] + d[i][1]) - y[i]) for i in m]
        for _ in range(inner_steps):
            y = product(g)
            twice = _ratio(sum(gi * gi for gi in g), sum(gi * yi for gi, yi in zip(g, y, strict=True)))
            w = [w[i] + 0.5 * twice * g[i] for i in m]
            g = [g[i] - twice * y[i] for i in m]
        after = torch.stack(w)
        return after * (-gain).exp(), after, gain

    return step


def stacked(offsets: Tensor, inner_steps: int) -> Step:
    """Weights (M, B), the core as one matrix product."""
    core = (offsets @ offsets.mT).exp()

    def step(a: Tensor, last: Tensor, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        gain = x[0] * x[0] + x[1] * x[1]
        s = (offsets @ x).exp()
        a = a * (gain - last).exp()
        g = 2 * (_value(x[0] + offsets[:, :1], x[1] + offsets[:, 1:]) - s * (core @ (s * a)))
        for _ in range(inner_steps):
            y = s * (core @ (s * g))
            twice = _ratio((g * g).sum(0), (g * y).sum(0))
            a = a + 0.5 * twice * g
            g = g - twice * y
        return a * (-gain).exp(), a, gain

    return step

"""Forward and backward passes over the compiled forward pass, on one core, beside JAX where it is installed.

With nothing else running: `python tests/benchmarks/gradients.py [--only lorenz,chase3]`. JAX
(`pip install jax`) differentiates the same step: `jax.grad` of the `lax.scan`, jitted, in float64, all rows
in one array.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any

import torch
from timing import spent
from torch import Tensor

from staf_torch import (
    GaussianKernel,
    StaFBasis,
    StateFollowingCenters,
    chase_weights,
    lanes,
    optim,
    rings,
    systems,
)

F64 = torch.float64
Loss = Callable[[], Tensor]


def least(function: Callable[[], Any], seconds: float = 4.0) -> float:
    """The least processor time of a call, in ms, over some seconds of calls."""
    function()
    best, end = float("inf"), time.perf_counter() + seconds
    while time.perf_counter() < end:
        best = min(best, spent(function)[0])
    return 1e3 * best


def lorenz_step(x: Tensor, now: Any, rho: Tensor) -> tuple[Tensor, tuple[()]]:
    """A classical Runge-Kutta step."""

    def rate(x: Tensor) -> Tensor:
        a, b, c = x.unbind(-1)
        return torch.stack((10.0 * (b - a), a * (rho - c) - b, a * b - 8.0 / 3.0 * c), dim=-1)

    h = 0.001
    k1 = rate(x)
    k2 = rate(x + h / 2 * k1)
    k3 = rate(x + h / 2 * k2)
    return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(x + h * k3)), ()


def lorenz() -> tuple[Loss, list[Tensor]]:
    program = lanes.Program(lorenz_step)
    x0 = torch.tensor([1.0, 0.0, 0.0], dtype=F64).repeat(1000, 1).requires_grad_()
    rho = torch.linspace(0.0, 21.0, 1000, dtype=F64).requires_grad_()
    return lambda: program(x0, (), rho, steps=1000)[0].square().sum(), [x0, rho]


def chased(count: int, times: int) -> tuple[Loss, list[Tensor]]:
    """By the width, V's parameters and the first weights."""
    states = systems.simulate(systems.Oscillator(), torch.randn(1000, 2, dtype=F64), dt=0.01, steps=times - 1)
    width, scale = torch.tensor(1.1, dtype=F64), torch.tensor([1.0, 0.5], dtype=F64)
    first = torch.randn(1000, count, dtype=F64)
    wanted = [each.requires_grad_() for each in (width, scale, first)]
    basis = StaFBasis(GaussianKernel(width), StateFollowingCenters(rings(count), radius=0.3))
    law = optim.SteepestDescent()

    def value(x: Tensor) -> Tensor:
        return (scale * x.square()).sum(-1) + x[..., 0] * x[..., 1].sin()

    return lambda: chase_weights(states, basis, value, law, weights=first).weights.square().mean(), wanted


CASES: dict[str, Callable[[], tuple[Loss, list[Tensor]]]] = {
    "lorenz": lorenz,
    "chase3": lambda: chased(3, 100),
}


def of_jax() -> float | None:
    """Milliseconds of JAX's forward and backward pass of `lorenz`; None without JAX."""
    try:
        import jax
        import jax.numpy as jnp
    except ImportError:
        return None
    jax.config.update("jax_enable_x64", True)

    def rate(x: Any, rho: Any) -> Any:
        a, b, c = x
        return 10.0 * (b - a), a * (rho - c) - b, a * b - 8.0 / 3.0 * c

    def along(x: Any, share: float, k: Any) -> Any:
        return tuple(p + share * q for p, q in zip(x, k, strict=True))

    def step(state: Any, _: Any) -> tuple[Any, None]:
        (x, rho), h = state, 0.001
        k1 = rate(x, rho)
        k2 = rate(along(x, h / 2, k1), rho)
        k3 = rate(along(x, h / 2, k2), rho)
        k4 = rate(along(x, h, k3), rho)
        stages = zip(x, k1, k2, k3, k4, strict=True)
        return (tuple(p + h / 6 * (a + 2 * b + 2 * c + d) for p, a, b, c, d in stages), rho), None

    def loss(x: Any, rho: Any) -> Any:
        (end, _), _ = jax.lax.scan(step, (x, rho), None, length=1000)
        return sum((part**2).sum() for part in end)

    both = jax.jit(jax.grad(loss, argnums=(0, 1)))
    x, rho = (jnp.ones(1000), jnp.zeros(1000), jnp.zeros(1000)), jnp.linspace(0.0, 21.0, 1000)
    return least(lambda: jax.block_until_ready(both(x, rho)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default=",".join(CASES))
    chosen = parser.parse_args().only.split(",")
    torch.manual_seed(0)
    torch.set_num_threads(1)
    for name in chosen:
        loss, wanted = CASES[name]()

        def both(loss: Loss = loss, wanted: list[Tensor] = wanted) -> Any:
            return torch.autograd.grad(loss(), wanted)

        with torch.no_grad():
            forward = least(loss)
        first = spent(both)[0]
        together = least(both)
        ratio = f"ratio {together / forward:.2f}; first {first:.1f} s"
        print(f"{name:8} forward {forward:8.2f} ms, with gradient {together:8.2f} ms, {ratio}")
        if name == "lorenz" and (peer := of_jax()) is not None:
            print(f"{name:8} JAX      {peer:.2f} ms of processor time: {peer / together:.1f} times")


if __name__ == "__main__":
    main()

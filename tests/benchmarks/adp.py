"""Closed-loop speed: the information laws on the two-state plant, 10 s at 1 ms.

    python tests/benchmarks/adp.py [rows ...] [--json FILE]

Prints a table: CPU seconds of this process after warm-up, the least of some runs, torch and JAX's
jit(vmap(scan)) in turn. A peer that is not installed is named and left out. Exits with 1 where a goal is
missed. Not collected by pytest.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from staf_torch import (
    AnchoredKernel,
    ExponentialKernel,
    StaFBasis,
    StateFollowingCenters,
    StateRadius,
    adp,
    rings,
    systems,
)

STEPS, DT, RUNS = 10_000, 1e-3, 5
GOALS = {1: 0.02, 1000: 0.5}  # s, of staf_torch
FASTER = 5.0  # than JAX, at 1000 rows


def torch_run(batch: int) -> Callable[[], float]:
    """A run that returns the median cost; the compiled step is kept from call to call."""
    plant, cost = systems.TwoState(), adp.QuadraticCost(1.0, 1.0, 2, 1)
    centers = StateFollowingCenters(rings(3), StateRadius(0.7, 1e-5))
    basis = adp.StaFValueBasis(StaFBasis(AnchoredKernel(ExponentialKernel()), centers))
    learner = adp.ActorCritic(basis, plant, cost, adp.RandomPoints(1, StateRadius(2.1, 1e-5)))
    x0 = torch.tensor([-1.0, 1.0], dtype=torch.float64).repeat(batch, 1)

    def run() -> float:
        result = adp.simulate(learner, plant, cost, x0, dt=DT, steps=STEPS, every=STEPS, compile=True)
        return float(result.cost.median())

    return run


def jax_run(batch: int) -> Callable[[], float] | None:
    """The same laws, plant integrator and number of random draws in JAX; None without JAX."""
    try:
        import jax
        import jax.numpy as jnp
    except ImportError:
        return None
    jax.config.update("jax_enable_x64", True)
    directions = jnp.asarray(rings(3).numpy())

    def field(x, u):  # type: ignore[no-untyped-def]
        h = jnp.cos(2 * x[0]) + 2
        return jnp.array([x[1] - x[0], -0.5 * x[0] - 0.5 * x[1] * (1 - h * h) + h * u])

    def terms(y, actor):  # type: ignore[no-untyped-def]
        q = y @ y
        nu, slope = 0.7 * (q + 1e-5) / (1 + q), 1.4 * (1 - 1e-5) / (1 + q) ** 2 * y
        c = y + nu * directions
        ds = jnp.exp(c @ y)[:, None] * (c + y + (directions @ y)[:, None] * slope)
        h = jnp.cos(2 * y[0]) + 2
        u = -0.5 * h * (ds[:, 1] @ actor)
        return u, ds @ field(y, u), y @ y + u * u, -2 * h * u * ds[:, 1]

    def step(carry, draw):  # type: ignore[no-untyped-def]
        x, spent, critic, actor, gain = carry
        q = x @ x
        points = jnp.stack((x, x + 2.1 * (q + 1e-5) / (1 + q) * draw))
        u, w, r, push = jax.vmap(terms, (0, None))(points, actor)
        a = jnp.array([0.001, 0.25])
        rho = 1 + 0.05 * (w * w).sum(-1)
        along = w @ critic
        force = ((a / rho) * (r + along)) @ w
        curvature = jnp.einsum("p,pi,pj->ij", a / rho, w, w)
        gain = jnp.exp(-0.003 * DT) * gain + DT * jnp.einsum("p,pi,pj->ij", 1 / rho**2, w, w)
        moved = critic - jnp.linalg.solve(gain + DT * curvature, DT * force)
        actor = (actor + DT * (1.2 * moved + (a / rho * along / 4) @ push)) / (1 + DT * 1.21)
        k1 = field(x, u[0])
        k2 = field(x + DT / 2 * k1, u[0])
        k3 = field(x + DT / 2 * k2, u[0])
        k4 = field(x + DT * k3, u[0])
        states = (x, x + DT / 2 * k1, x + DT / 2 * k2, x + DT * k3)
        c = [s @ s for s in states]
        spent = spent + DT * (u[0] ** 2 + (c[0] + 2 * (c[1] + c[2]) + c[3]) / 6)
        return (x + DT / 6 * (k1 + 2 * (k2 + k3) + k4), spent, moved, actor, gain), None

    def trajectory(key):  # type: ignore[no-untyped-def]
        draws = jax.random.uniform(key, (STEPS, 2), minval=-1, maxval=1, dtype=jnp.float64)
        start = (jnp.array([-1.0, 1.0]), 0.0, jnp.full(3, 0.4), jnp.full(3, 0.28), jnp.eye(3) / 250)
        return jax.lax.scan(step, start, draws)[0][1]

    fast = jax.jit(jax.vmap(trajectory))
    keys = jax.random.split(jax.random.key(0), batch)
    return lambda: float(jnp.median(fast(keys).block_until_ready()))


def measure(batch: int) -> list[dict[str, Any]]:
    """Both programs in turn, a row each."""
    runs = {"staf_torch": torch_run(batch), "JAX": jax_run(batch)}
    seconds: dict[str, list[float]] = {}
    rows: dict[str, dict[str, Any]] = {}
    for name, run in runs.items():
        if run is None:
            print(f"{name} is not installed: left out", file=sys.stderr)
            continue
        start = time.process_time()
        cost = run()
        warm_up = time.process_time() - start
        rows[name] = {"program": name, "B": batch, "warm_up": warm_up, "median_cost": cost}
        seconds[name] = []
    for _ in range(RUNS):
        for name in rows:
            start = time.process_time()
            runs[name]()  # type: ignore[misc]
            seconds[name].append(time.process_time() - start)
    for name, row in rows.items():
        row["seconds"] = min(seconds[name])
        row["microseconds_a_step"] = 1e6 * row["seconds"] / STEPS
    return list(rows.values())


def missed(rows: list[dict[str, Any]]) -> list[str]:
    """The goals that the rows do not reach."""
    took = {(row["program"], row["B"]): row["seconds"] for row in rows}
    late = [
        f"B = {batch}: {took['staf_torch', batch]:.2f} s, wanted {goal:g} s"
        for batch, goal in GOALS.items()
        if took.get(("staf_torch", batch), 0.0) > goal
    ]
    peer = took.get(("JAX", 1000))
    if peer is not None and FASTER * took["staf_torch", 1000] > peer:
        late.append(
            f"B = 1000: {peer / took['staf_torch', 1000]:.1f} times as fast as JAX, wanted {FASTER:g}"
        )
    return late


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("rows", type=int, nargs="*", default=[1, 1000])
    parser.add_argument("--json", type=Path, help="write the results here as well")
    options = parser.parse_args()
    print("| program | B | warm-up (s) | 10 s at 1 ms (CPU s) | us a step | median cost |")
    print("|---|---|---|---|---|---|")
    found = []
    for batch in options.rows:
        for row in measure(batch):
            found.append(row)
            timed = f"{row['warm_up']:.1f} | {row['seconds']:.4f} | {row['microseconds_a_step']:.0f}"
            print(f"| {row['program']} | {row['B']} | {timed} | {row['median_cost']:.4f} |", flush=True)
    about = {"torch": torch.__version__, "cores": os.cpu_count(), "machine": platform.machine()}
    if options.json:
        options.json.write_text(
            json.dumps(about | {"cases": found, "missed": missed(found)}, indent=1) + "\n"
        )
    print("\n".join(missed(found)) or "goals: met")
    sys.exit(1 if missed(found) else 0)


if __name__ == "__main__":
    main()

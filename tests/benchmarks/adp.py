"""Closed-loop speed: actor-critic laws, 10 s at 1 ms, and one control of a rollout policy.

    python tests/benchmarks/adp.py [rows ...] [--json FILE]

Prints tables: CPU and wall seconds after warm-up, the least of some runs, torch and JAX's jit(vmap(scan)) of
the information law in turn. A peer that is not installed is named and left out. Exits with
1 where a goal is missed. Not collected by pytest.
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
from typing import Any, NamedTuple

import torch

from staf_torch import (
    AnchoredKernel,
    ExponentialKernel,
    StaFBasis,
    StateFollowingCenters,
    StateRadius,
    adp,
    lanes,
    rings,
    systems,
)

STEPS, DT, RUNS = 10_000, 1e-3, 5
GOALS = {(2, 1): 0.02, (2, 1000): 0.5, (3, 1): 0.04, (3, 1000): 2.0}  # states, rows: s, of staf_torch
FASTER = 5.0  # than JAX


class Example(NamedTuple):
    """A published example: two states and three centers, or three and eight."""

    plant: systems.ControlAffineSystem
    offsets: list[list[float]]
    radius: StateRadius
    box: StateRadius | float
    q: float
    x0: list[float]
    gains: adp.Gains
    critic: float = 0.4
    actor: float = 0.28
    gain: float = 250.0

    def reach(self, square: Any) -> Any:
        """Half the width of the box around a state of this x'x."""
        return self.box if isinstance(self.box, float) else shrinking(self.box)[0](square)


def shrinking(radius: StateRadius) -> tuple[Callable[[Any], Any], Callable[[Any], Any]]:
    """nu as a function of x'x, and twice its derivative, in numbers that are nobody's tensors."""
    size, offset, gain = (float(number) for number in (radius.radius, radius.offset, radius.gain))
    return (
        lambda square: size * (square + offset) / (1 + gain * square),
        lambda square: 2 * size * (1 - gain * offset) / (1 + gain * square) ** 2,
    )


_A, _B, _C = 0.5773502691896258, 0.4999853, 0.14433756729740646
THREE = [[0, _A, 0], [_B, -_A / 2, _A], [-_B, -_A / 2, -_C], [_A, _A, 0]]
THREE += [[0, 0, 0], [_A, _A, _A], [_A, 0, _A / 2], [-_A, _A, -_C]]
_TWO_BOX, _SHRINKING = StateRadius(2.1, 1e-5), StateRadius(0.08 * 3**0.5, 0.0, gain=2.0)
_GAINS = adp.Gains(
    critic_extrapolated=10.0, actor=15.0, actor_decay=0.001, forgetting=1e-4, normalisation=0.5
)
EXAMPLES = {
    2: Example(
        systems.TwoState(),
        rings(3).tolist(),
        StateRadius(0.7, 1e-5),
        _TWO_BOX,
        1.0,
        [-1.0, 1.0],
        adp.Gains(),
    ),
    3: Example(
        systems.ThreeState(), THREE, _SHRINKING, 0.24, 10.0, [-0.5, 0.5, -0.25], _GAINS, 1.0, 0.85, 100.0
    ),
}
LAWS: dict[str, Callable[[adp.Gains], adp.ActorCriticLaw]] = {
    "information": adp.Information,
    "published": adp.Published,
    "frozen": lambda gains: adp.Frozen(),
    "policy iteration": adp.PolicyIteration,
}


def torch_run(batch: int, states: int, law: str = "information") -> Callable[[], float]:
    """A run that returns the median cost; the compiled step is kept from call to call."""
    own = EXAMPLES[states]
    plant, cost = own.plant, adp.QuadraticCost(own.q, 1.0, states, own.plant.inputs)
    centers = StateFollowingCenters(torch.tensor(own.offsets, dtype=torch.float64), own.radius)
    basis = adp.StaFValueBasis(StaFBasis(AnchoredKernel(ExponentialKernel()), centers))
    start = {"critic": own.critic, "actor": own.actor, "gain": own.gain}
    points: adp.Extrapolation = adp.RandomPoints(1, own.box)
    if law == "policy iteration":  # whose regression needs more than one point
        points = adp.QuadraturePoints(2, states, own.box)
    learner = adp.ActorCritic(basis, plant, cost, points, LAWS[law](own.gains), **start)
    x0 = torch.tensor(own.x0, dtype=torch.float64).repeat(batch, 1)

    def run() -> float:
        result = adp.simulate(learner, plant, cost, x0, dt=DT, steps=STEPS, every=STEPS, compile=True)
        return float(result.cost.median())

    return run


def jax_run(batch: int, states: int) -> Callable[[], float] | None:
    """The same laws, plant integrator and number of random draws in JAX; None without JAX."""
    try:
        import jax
        import jax.numpy as jnp
    except ImportError:
        return None
    jax.config.update("jax_enable_x64", True)
    own = EXAMPLES[states]
    offsets, g = jnp.asarray(own.offsets), own.gains
    count, (radius, twice_slope) = len(offsets), shrinking(own.radius)

    def effectiveness(x):  # type: ignore[no-untyped-def]
        if states == 2:
            return jnp.array([[0.0], [1.0]]) * (jnp.cos(2 * x[0]) + 2)
        return jnp.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])

    def field(x, u):  # type: ignore[no-untyped-def]
        if states == 2:
            h = jnp.cos(2 * x[0]) + 2
            return jnp.array([x[1] - x[0], -0.5 * x[0] - 0.5 * x[1] * (1 - h * h) + h * u[0]])
        square = x[0] * (x[0] + x[1] + x[2]) + x[1] * (x[1] + x[2]) + x[2] * x[2]
        return jnp.array([x[1], x[2] + u[0], jnp.sqrt(square) + u[1]])

    def terms(y, actor):  # type: ignore[no-untyped-def]
        q = y @ y
        nu, slope = radius(q), twice_slope(q) * y
        c = y + nu * offsets
        ds = jnp.exp(c @ y)[:, None] * (c + y + (offsets @ y)[:, None] * slope)
        push = ds @ effectiveness(y)
        u = -0.5 * (actor @ push)
        return u, ds @ field(y, u), own.q * (y @ y) + u @ u, -2 * push @ u

    def step(carry, draw):  # type: ignore[no-untyped-def]
        x, spent, critic, actor, gain = carry
        q = x @ x
        points = jnp.stack((x, x + own.reach(q) * draw))
        u, w, r, push = jax.vmap(terms, (0, None))(points, actor)
        a = jnp.array([g.critic, g.critic_extrapolated])
        rho = 1 + g.normalisation * (w * w).sum(-1)
        along = w @ critic
        force = ((a / rho) * (r + along)) @ w
        curvature = jnp.einsum("p,pi,pj->ij", a / rho, w, w)
        gain = jnp.exp(-g.forgetting * DT) * gain + DT * jnp.einsum("p,pi,pj->ij", 1 / rho**2, w, w)
        moved = critic - jnp.linalg.solve(gain + DT * curvature, DT * force)
        actor = (actor + DT * (g.actor * moved + (a / rho * along / 4) @ push)) / (
            1 + DT * (g.actor + g.actor_decay)
        )
        v = u[0]
        k1 = field(x, v)
        k2 = field(x + DT / 2 * k1, v)
        k3 = field(x + DT / 2 * k2, v)
        k4 = field(x + DT * k3, v)
        at = (x, x + DT / 2 * k1, x + DT / 2 * k2, x + DT * k3)
        c = [own.q * (s @ s) for s in at]
        spent = spent + DT * (v @ v + (c[0] + 2 * (c[1] + c[2]) + c[3]) / 6)
        return (x + DT / 6 * (k1 + 2 * (k2 + k3) + k4), spent, moved, actor, gain), None

    def trajectory(key):  # type: ignore[no-untyped-def]
        draws = jax.random.uniform(key, (STEPS, states), minval=-1, maxval=1, dtype=jnp.float64)
        weights = jnp.full(count, own.critic), jnp.full(count, own.actor), jnp.eye(count) / own.gain
        return jax.lax.scan(step, (jnp.array(own.x0), 0.0, *weights), draws)[0][1]

    fast = jax.jit(jax.vmap(trajectory))
    keys = jax.random.split(jax.random.key(0), batch)
    return lambda: float(jnp.median(fast(keys).block_until_ready()))


def measure(batch: int, states: int) -> list[dict[str, Any]]:
    """Both programs in turn, and ours under the other laws: a row each."""
    runs = {"staf_torch, information": torch_run(batch, states), "JAX, information": jax_run(batch, states)}
    runs |= {f"staf_torch, {law}": torch_run(batch, states, law) for law in LAWS if law != "information"}
    seconds: dict[str, list[float]] = {}
    walls: dict[str, list[float]] = {}
    rows: dict[str, dict[str, Any]] = {}
    for name, run in runs.items():
        if run is None:
            print(f"{name} is not installed: left out", file=sys.stderr)
            continue
        begun = time.process_time()
        cost = run()
        warm_up = time.process_time() - begun
        rows[name] = {"program": name, "n": states, "B": batch, "warm_up": warm_up, "median_cost": cost}
        seconds[name], walls[name] = [], []
    for _ in range(RUNS):
        for name in rows:
            begun, clock = time.process_time(), time.perf_counter()
            runs[name]()  # type: ignore[misc]
            seconds[name].append(time.process_time() - begun)
            walls[name].append(time.perf_counter() - clock)
    for name, row in rows.items():
        row["seconds"], row["wall"] = min(seconds[name]), min(walls[name])
    return list(rows.values())


def missed(rows: list[dict[str, Any]]) -> list[str]:
    """The goals that the rows do not reach."""
    late = []
    for row in rows:
        goal = GOALS.get((row["n"], row["B"]))
        if row["program"].startswith("staf_torch") and goal is not None and row["wall"] > goal:
            late.append(f"{row['program']}, {row['B']} rows: {row['wall']:.3f} s, wanted {goal:g} s")
    took = {(row["program"], row["n"], row["B"]): row["seconds"] for row in rows}
    for (name, states, batch), peer in took.items():
        ours = took["staf_torch, information", states, batch]
        if name.startswith("JAX") and FASTER * ours > peer:
            late.append(
                f"{states} states, {batch} rows: {peer / ours:.1f} times JAX's speed, wanted {FASTER:g}"
            )
    return late


POLICIES = {  # policy or plant, centers, states at once: goal, us a call
    ("TwoState", 6, 1): 25.0,
    ("TwoState", 6, 1000): 2000.0,
    ("PlanarQuadrotor", 28, 1): 150.0,
    ("near_optimal of Pendulum", 6, 1): 40.0,
}


def policy_of(name: str, centers: int) -> Any:
    """Return a policy of `POLICIES`."""
    if name == "near_optimal of Pendulum":  # as on the front page
        bounded = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1, low=-8.0, high=8.0)
        return adp.near_optimal(systems.Pendulum(), bounded, dt=0.05)
    plant = getattr(systems, name)()
    cost = adp.QuadraticCost(1.0, 1.0, plant.dim, plant.inputs)
    return adp.RolloutPolicy.of_lqr(plant, cost, centers=centers)


def policies() -> list[str]:
    """Print what a call of a policy takes; the goals that are missed."""
    late = []
    print("\n| policy, or plant of a rollout policy | centers | states | us a call |\n|---|---:|---:|---:|")
    for (name, centers, batch), goal in POLICIES.items():
        policy = policy_of(name, centers)
        x = 0.3 * torch.randn(batch, policy.cost.dim, generator=torch.Generator().manual_seed(0)).double()
        with torch.no_grad():
            if not lanes.ready(policy, x):
                raise RuntimeError("the policy was not compiled")
            calls = max(10, 2000 // batch)
            best = float("inf")
            for _ in range(20):
                begun = time.process_time()
                for _ in range(calls):
                    policy(x)
                best = min(best, 1e6 * (time.process_time() - begun) / calls)
        print(f"| {name} | {centers} | {batch} | {best:.1f} |", flush=True)
        if best > goal:
            late.append(f"policy of {name}, {batch} states: {best:.0f} us, wanted {goal:g}")
    return late


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("rows", type=int, nargs="*", default=[1, 1000])
    parser.add_argument("--json", type=Path, help="write the results here as well")
    options = parser.parse_args()
    print("| program | states | rows | warm-up (s) | 10 s at 1 ms (CPU s) | wall (s) | median cost |")
    print("|---|---:|---:|---:|---:|---:|---:|")
    found = []
    for states in (2, 3):
        for batch in options.rows:
            for row in measure(batch, states):
                found.append(row)
                timed = f"{row['warm_up']:.1f} | {row['seconds']:.4f} | {row['wall']:.4f}"
                print(
                    f"| {row['program']} | {states} | {row['B']} | {timed} | {row['median_cost']:.4f} |",
                    flush=True,
                )
    late = missed(found) + policies()
    about = {"torch": torch.__version__, "cores": os.cpu_count(), "machine": platform.machine()}
    if options.json:
        options.json.write_text(json.dumps(about | {"cases": found, "missed": late}, indent=1) + "\n")
    print("\n" + ("\n".join(late) or "goals: met"))
    sys.exit(1 if late else 0)


if __name__ == "__main__":
    main()

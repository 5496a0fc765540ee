"""Closed-loop speed: actor-critic laws, 10 s at 1 ms, and one control of a rollout policy.

    python tests/benchmarks/adp.py [rows ...]

Prints tables: CPU and wall seconds after warm-up, the least of some runs, torch and JAX's jit(vmap(scan)) of
the information law in turn. A peer that is not installed is named and left out. Not collected by pytest.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import torch
from timing import in_turn, spent

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


def measure(batch: int, states: int) -> None:
    """Print a row a program: both in turn, and ours under the other laws."""
    runs = {"staf_torch, information": torch_run(batch, states), "JAX, information": jax_run(batch, states)}
    runs |= {f"staf_torch, {law}": torch_run(batch, states, law) for law in LAWS if law != "information"}
    programs = {name: run for name, run in runs.items() if run is not None}
    if len(programs) < len(runs):
        print("JAX is not installed: left out", file=sys.stderr)
    warm = {name: spent(run)[0] for name, run in programs.items()}
    for name, times in in_turn(programs, RUNS).items():
        cpu, wall = (min(each) for each in zip(*times, strict=True))
        timed = f"{warm[name]:.1f} | {cpu:.4f} | {wall:.4f} | {programs[name]():.4f}"
        print(f"| {name} | {states} | {batch} | {timed} |", flush=True)


# policy or plant, centers, states at once
POLICIES = (
    ("TwoState", 6, 1),
    ("TwoState", 6, 1000),
    ("PlanarQuadrotor", 28, 1),
    ("near_optimal of Pendulum", 6, 1),
)


def policy_of(name: str, centers: int) -> Any:
    """Return a policy of `POLICIES`."""
    if name == "near_optimal of Pendulum":  # as on the front page
        bounded = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1, low=-8.0, high=8.0)
        return adp.near_optimal(systems.Pendulum(), bounded, dt=0.05)
    plant = getattr(systems, name)()
    cost = adp.QuadraticCost(1.0, 1.0, plant.dim, plant.inputs)
    return adp.RolloutPolicy.of_lqr(plant, cost, centers=centers)


def policies() -> None:
    """Print what a call of a policy takes."""
    print("\n| policy, or plant of a rollout policy | centers | states | us a call |\n|---|---:|---:|---:|")
    for name, centers, batch in POLICIES:
        policy = policy_of(name, centers)
        x = 0.3 * torch.randn(batch, policy.cost.dim, generator=torch.Generator().manual_seed(0)).double()
        with torch.no_grad():
            if not lanes.ready(policy, x):
                raise RuntimeError("the policy was not compiled")
            best = min(spent(partial(policy, x), max(10, 2000 // batch))[0] for _ in range(20))
        print(f"| {name} | {centers} | {batch} | {1e6 * best:.1f} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("rows", type=int, nargs="*", default=[1, 1000])
    rows = parser.parse_args().rows
    print("| program | states | rows | warm-up (s) | 10 s at 1 ms (CPU s) | wall (s) | median cost |")
    print("|---|---:|---:|---:|---:|---:|---:|")
    for states in (2, 3):
        for batch in rows:
            measure(batch, states)
    policies()


if __name__ == "__main__":
    main()

"""The improved policy against its base from many random states: it must never cost more by over 1 %.

    python tests/benchmarks/never_worse.py [--states 300] [--only TwoState,Pendulum] [--json FILE]

A row a plant: the cost of `adp.near_optimal(...).controller()` over that of its LQR where both regulate, and
how many states each regulates. Ends with an error where a state costs more than 1.01 of the base's. Not
collected by pytest.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import torch

from staf_torch import adp, systems
from staf_torch.experiments.rival_plants import CASES

_WORSE = 1.01
_LEFT = 1e-2  # share of the distance from the set-point at the end, below which a row is regulated

# plant, cost weights (Q, R), bounds, period in s, half the width of the box, periods of a run
PLANTS = {
    "TwoState": (systems.TwoState, (1.0, 1.0), None, 0.05, 2.0, 200),
    "Pendulum": (systems.Pendulum, (1.0, 1.0), None, 0.05, 1.5, 200),
    "VanDerPol": (systems.VanDerPol, (1.0, 1.0), None, 0.05, 1.5, 200),
    "ThreeState": (systems.ThreeState, (10.0, 1.0), None, 0.02, 0.5, 1000),
    "CartPole": (systems.CartPole, (1.0, 1.0), 5.0, 0.02, 0.3, 800),
    "PlanarQuadrotor": (systems.PlanarQuadrotor, (1.0, 1.0), None, 0.02, 0.4, 400),
    "Pendulum-v1": (CASES["pendulum"].plant, ([[20.0, 0.0], [0.0, 2.0]], 0.02), None, 0.05, 1.0, 200),
}


@torch.no_grad()
def measure(name: str, count: int) -> dict[str, float | int]:
    """One row of the table."""
    make, (q, r), bound, dt, width, periods = PLANTS[name]
    plant = make()
    cost = adp.QuadraticCost(q, r, plant.dim, plant.inputs)
    limits = {} if bound is None else {"low": -bound, "high": bound}
    policy = adp.near_optimal(plant, cost, dt=dt, **limits)
    generator = torch.Generator().manual_seed(12345)
    x0 = width * (2 * torch.rand(count, plant.dim, generator=generator, dtype=torch.float64) - 1)
    runs = [
        adp.simulate(
            one,
            plant,
            policy.cost,
            x0,
            dt=dt,
            steps=periods,
            every=periods,
            substeps=policy.substeps,
        )
        for one in (adp.Feedback(policy.lqr), policy.controller())
    ]
    left = [policy.cost.deviation(run.state[:, -1]).norm(dim=-1) for run in runs]
    base, ours = (
        ~run.diverged & (end <= _LEFT * x0.norm(dim=-1)) for run, end in zip(runs, left, strict=True)
    )
    ratio = (runs[1].cost / runs[0].cost)[base & ours]
    return {
        "median": float(ratio.median()),
        "mean": float(ratio.mean()),
        "max": float(ratio.max()),
        "regulated by the LQR": int(base.sum()),
        "regulated": int(ours.sum()),
        "lost": int((base & ~ours).sum()),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--states", type=int, default=300)
    parser.add_argument("--only", default=",".join(PLANTS))
    parser.add_argument("--json", type=Path)
    settings = parser.parse_args()
    torch.set_num_threads(1)
    found = {}
    for name in settings.only.split(","):
        found[name] = measure(name, settings.states)
        print(name, found[name], flush=True)
    if settings.json is not None:
        settings.json.write_text(json.dumps(found, indent=2))
    worse = [name for name, row in found.items() if row["max"] > _WORSE or row["lost"]]
    if worse:
        sys.exit(f"worse than the base: {', '.join(worse)}")


if __name__ == "__main__":
    main()

"""The improved policy against its base from many random states: it must never cost more by over 1 %.

    python tests/benchmarks/never_worse.py [states]

A row a plant, by `near_optimal(...).report`. Ends with an error where a state costs more than 1.01
of its LQR.
"""

from __future__ import annotations

import sys

import torch

from staf_torch import adp, systems
from staf_torch.experiments.rival_plants import CASES

_WORSE = 1.01
# plant, cost weights (Q, R), bound, period in s, half the width of the box
PLANTS = {
    "TwoState": (systems.TwoState, (1.0, 1.0), None, 0.05, 2.0),
    "Pendulum": (systems.Pendulum, (1.0, 1.0), None, 0.05, 1.5),
    "VanDerPol": (systems.VanDerPol, (1.0, 1.0), None, 0.05, 1.5),
    "ThreeState": (systems.ThreeState, (10.0, 1.0), None, 0.02, 0.5),
    "CartPole": (systems.CartPole, (1.0, 1.0), 5.0, 0.02, 0.3),
    "PlanarQuadrotor": (systems.PlanarQuadrotor, (1.0, 1.0), None, 0.02, 0.4),
    "Pendulum-v1": (CASES["pendulum"].plant, ([[20.0, 0.0], [0.0, 2.0]], 0.02), None, 0.05, 1.0),
}


def main(states: int) -> int:
    torch.set_num_threads(1)
    worst = 0.0
    for name, (make, (q, r), bound, dt, width) in PLANTS.items():
        plant = make()
        cost = adp.QuadraticCost(q, r, plant.dim, plant.inputs)
        limits = {} if bound is None else {"low": -bound, "high": bound}
        told = adp.near_optimal(plant, cost, dt=dt, **limits).report(
            states=states, spread=width, full=True, seed=12345
        )
        print(
            name, {key: told[key] for key in ("over_base_median", "over_base_max", "regulated")}, flush=True
        )
        worst = max(worst, told["over_base_max"])
    return int(worst > _WORSE)


if __name__ == "__main__":
    sys.exit(main(*map(int, sys.argv[1:] or [300])))

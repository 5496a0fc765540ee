"""A planar quadrotor whose position alone is measured: 100 starts, two Kalman filters, beside the full state.

python tests/benchmarks/output_feedback.py [rows] [seed]
"""

from __future__ import annotations

import sys
import time

import torch
from torch import Tensor

from staf_torch import adp, systems

NOISE, DT, SECONDS = 0.01, 0.005, 10.0  # m, s, s
NEAR = 0.15  # norm of the state, over the last second, of a row that is regulated


def position(x: Tensor) -> Tensor:
    return x[..., :2]


def main(rows: int, seed: int = 0) -> None:
    plant = systems.PlanarQuadrotor()
    cost = adp.QuadraticCost(1.0, 1.0, dim=6, inputs=2)
    lqr = adp.Feedback(adp.LQR(plant, cost))
    generator = torch.Generator().manual_seed(seed)
    spread = torch.tensor([1.0, 1.0, 0.3, 0.5, 0.5, 0.3], dtype=torch.float64)
    x0 = spread * (2 * torch.rand(rows, 6, generator=generator, dtype=torch.float64) - 1)
    settings = {"noise": [NOISE, NOISE], "process": 0.01}
    deviation = spread.tolist()
    controllers = {"full state": lqr}
    for name, kind in (("extended", adp.ExtendedKalman), ("unscented", adp.UnscentedKalman)):
        inside = adp.Observed(lqr, kind(plant, position, **settings), deviation=deviation)
        controllers[name] = adp.Measured(inside, noise=NOISE, dim=2, output=position)
    full: Tensor | None = None
    print("| state from | regulated | cost, median | over the full state's, median | largest | us a step |")
    print("|---|---|---|---|---|---|")
    for name, controller in controllers.items():
        steps = round(SECONDS / DT)
        for _ in range(2):  # the first run compiles
            began = time.process_time()
            run = adp.simulate(controller, plant, cost, x0, dt=DT, steps=steps, every=10, compile=True)
            spent = time.process_time() - began
        late = run.time >= SECONDS - 1
        regulated = (run.state[:, late].norm(dim=-1) < NEAR).all(-1) & ~run.diverged
        full = run.cost if full is None else full
        ratio = run.cost / full
        print(
            f"| {name} | {int(regulated.sum())} of {rows} | {run.cost.median():.4g} | {ratio.median():.4g} "
            f"| {ratio.max():.4g} | {1e6 * spent / steps / rows:.2f} |"
        )


if __name__ == "__main__":
    main(*map(int, sys.argv[1:] or [100]))

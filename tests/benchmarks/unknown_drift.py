"""A drift of which no form is known, learned by `adp.StreamDrift` while `adp.DriftLQR` regulates the plant.

    python tests/benchmarks/unknown_drift.py [rows]

Three plants whose last state's rate is unknown but for the input's part; states uniform in [-2, 2]^2, 10 s at
5 ms, x'x + u'u, over the least cost (of the two states V*, else direct shooting). No setting knows the plant.
"""

from __future__ import annotations

import sys
import time

import torch
from torch import Tensor

from staf_torch import GaussianKernel, adp, rings, systems
from staf_torch.systems import ControlAffineSystem

DT, STEPS, NOISE = 0.005, 2000, 1e-3
PLANTS = {
    "two states": systems.TwoState(),
    "pendulum": systems.Pendulum(),
    "Van der Pol": systems.VanDerPol(),
}


class Known(ControlAffineSystem):
    """A plant without the drift of its last state."""

    def __init__(self, plant: ControlAffineSystem) -> None:
        super().__init__()
        self.plant, self.dim, self.inputs = plant, plant.dim, plant.inputs

    def drift(self, x: Tensor) -> Tensor:
        return torch.cat((self.plant.drift(x)[..., :-1], torch.zeros_like(x[..., -1:])), dim=-1)

    def effectiveness(self, x: Tensor) -> Tensor:
        return self.plant.effectiveness(x)


def learner(plant: ControlAffineSystem, cost: adp.Cost, deviation: float, noise: float) -> adp.DriftLQR:
    drift = adp.StreamDrift(
        Known(plant),
        GaussianKernel(3.0),
        0.5 * rings(3),
        rows=[1],
        deviation=deviation,
        length=0.05 if noise else DT,
        noise=noise,
        floor=1e-5,
        smooth=noise > 0,
    )
    return adp.DriftLQR(drift, cost)


def main(rows: int) -> None:
    torch.set_num_threads(1)
    cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
    x0 = 4 * torch.rand(rows, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) - 2
    heads = (
        "plant",
        "policy",
        "over the optimum, median",
        "mean",
        "largest",
        "regulated",
        "certain",
        "in 2 sd",
    )
    print(f"| {' | '.join(heads)} | CPU s |")
    print("|---" * (len(heads) + 1) + "|")
    for name, plant in PLANTS.items():
        best = plant.optimal_value(x0, cost.q, cost.r)
        if best is None:
            found = adp.DirectShooting(plant, cost).solve(x0)
            best = torch.where(found.converged, found.value, torch.nan)
        policies: dict[str, adp.Controller] = {
            "LQR of what is known": adp.Feedback(adp.LQR(Known(plant), cost)),
            "informed LQR": adp.Feedback(adp.LQR(plant, cost)),
            "learned": learner(plant, cost, 3.0, 0.0),
            "learned, deviation 10 / s": learner(plant, cost, 10.0, 0.0),
            "learned, noise 1e-3": learner(plant, cost, 3.0, NOISE),
        }
        for label, policy in policies.items():
            clock = time.process_time()
            seen = adp.Measured(policy, noise=NOISE if "noise" in label else 0.0, dim=2)
            run = adp.simulate(seen, plant, cost, x0, dt=DT, steps=STEPS, compile=True)
            spent = time.process_time() - clock
            ratio = (run.cost / best)[torch.isfinite(best)]
            far = 0.05 if "noise" in label else 0.01
            settled = int((run.state[:, -1].norm(dim=-1) < far).sum())
            row = [name, label, *(f"{float(v):.3f}" for v in (ratio.median(), ratio.mean(), ratio.max()))]
            row += [f"{settled} of {rows}", *_honest(policy, plant, run), f"{spent:.1f}"]
            print("| " + " | ".join(row) + " |", flush=True)


def _honest(policy: adp.Controller, plant: ControlAffineSystem, run: adp.LoopResult) -> tuple[str, str]:
    """Share of the times at which the model was trusted, and at which the drift was within two deviations."""
    if not isinstance(policy, adp.DriftLQR):
        return "-", "-"
    now = policy.adaptation(run.identifier)
    moving = run.state.norm(dim=-1) > 0.05
    mean, spread = policy.drift.predict(now.estimate, run.state)
    near = (plant.drift(run.state)[..., 1:] - mean).abs() < 2 * spread + 1e-9
    return f"{float(now.certain.mean()):.3f}", f"{float(near[moving].double().mean()):.3f}"


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 100)

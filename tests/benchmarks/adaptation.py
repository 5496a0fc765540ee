"""Time of closed loops that learn while they run, or move among discs: 1000 rows, 10 s at 1 ms, compiled.

    python tests/benchmarks/adaptation.py [rows]

A run is repeated and the second one counts, wall clock and CPU time; the first compiles.
"""

from __future__ import annotations

import sys
import time

import torch

from staf_torch import adp
from staf_torch.experiments import avoidance, faults, icl
from staf_torch.experiments.vehicles import VEHICLES, vehicle
from staf_torch.settings.adp import updated
from staf_torch.sweeps.hydra_compat import Composer, config_loader

STEPS, DT = 10_000, 0.001


def loops(rows: int) -> dict[str, tuple[adp.Controller, object, adp.Cost, torch.Tensor]]:
    found: dict[str, tuple[adp.Controller, object, adp.Cost, torch.Tensor]] = {}
    for name, make in faults.CASES.items():
        case = make(rows, torch.Generator().manual_seed(0))
        truth = adp.ChangingPlant(case.model)
        seen = adp.Measured(case.adaptive, noise=case.noise, dim=case.x0.shape[1])
        z0 = truth.start(case.x0, case.before, case.after, case.at)
        found[f"faults, {name}"] = seen, truth, truth.cost(case.cost), z0
    plant = icl.published()
    cost = adp.QuadraticCost(1.0, 1.0, 5, 2, output=lambda z: z[..., :2] - icl.reference(z)[0])
    tracker = adp.ConcurrentTracker(plant, icl.reference, length=0.1, feedback=8.0, gain=0.1)
    seen = adp.Measured(tracker, noise=[0.3, 0.3, 0.0, 0.0, 0.0], dim=5)
    x0 = torch.tensor([[1.0, 0.0, 1.0, 0.0, 1.0]], dtype=torch.float64).repeat(rows, 1)
    found["icl"] = seen, plant, cost, x0
    return found | {f"avoidance, {kind}": among_discs(rows, kind) for kind in VEHICLES}


def among_discs(rows: int, kind: str) -> tuple[adp.Controller, object, adp.Cost, torch.Tensor]:
    """A vehicle of `staf experiment=avoidance` behind its filter."""
    composer = Composer(config_loader(), hydra_node=False)
    given = ["experiment=avoidance", f"trajectories={rows}", f"avoidance.vehicle={kind}", f"dt={DT}"]
    cfg = updated(composer(given))
    own, chosen = vehicle(cfg, DT), cfg.avoidance
    plant = avoidance.AmongDiscs(own, chosen.discs)
    discs = [avoidance.apart(own, k, chosen.radius) for k in range(chosen.discs)]
    bounds = {"low": [-bound for bound in own.bounds], "high": list(own.bounds)}
    settings = {"dt": DT, "decay": chosen.decay, "margin": chosen.margin, **bounds}
    guard = adp.SafetyFilter(lambda x: own.policy(x[..., : own.size]), plant, discs, **settings)
    return guard, plant, avoidance.vehicle_cost(cfg, own, plant.dim or 0), avoidance.scenarios(cfg)


def main(rows: int) -> None:
    print("| loop | wall s | CPU s |")
    print("|---|---|---|")
    for name, (controller, plant, cost, x0) in loops(rows).items():
        settings = {"dt": DT, "steps": STEPS, "every": STEPS // 10, "compile": True}
        adp.simulate(controller, plant, cost, x0, **settings)  # type: ignore[arg-type]
        wall, cpu = time.perf_counter(), time.process_time()
        adp.simulate(controller, plant, cost, x0, **settings)  # type: ignore[arg-type]
        print(f"| {name} | {time.perf_counter() - wall:.2f} | {time.process_time() - cpu:.2f} |", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 1000)

"""Time of closed loops that learn while they run, move among discs, stay in a box: 1000 rows, 10 s at 1 ms.

    python tests/benchmarks/adaptation.py [rows]

Compiled; a run is repeated and the second one counts, wall clock and CPU time.
"""

from __future__ import annotations

import sys
import time

import torch

from staf_torch import adp, systems
from staf_torch.experiments import avoidance, faults, icl, safe_box
from staf_torch.experiments.vehicles import VEHICLES, vehicle
from staf_torch.settings.adp import make_cost
from staf_torch.settings.adp import plant as make_plant
from staf_torch.settings.chase import initial_states
from staf_torch.sweeps.hydra_compat import Composer, config_loader

STEPS, DT = 10_000, 0.001
Loop = tuple[adp.Controller, object, adp.Cost, torch.Tensor]


def loops(rows: int) -> dict[str, Loop]:
    found: dict[str, Loop] = {}
    for name, make in faults.CASES.items():
        case = make(rows, torch.Generator().manual_seed(0))
        truth = adp.ChangingPlant(case.model)
        seen = adp.Measured(case.adaptive, noise=case.noise, dim=case.x0.shape[1])
        z0 = truth.start(case.x0, case.before, case.after, case.at)
        found[f"faults, {name}"] = seen, truth, truth.cost(case.cost), z0
    published = icl.published()
    cost = adp.QuadraticCost(1.0, 1.0, 5, 2, output=lambda z: z[..., :2] - icl.reference(z)[0])
    tracker = adp.ConcurrentTracker(published, icl.reference, length=0.1, feedback=8.0, gain=0.1)
    seen = adp.Measured(tracker, noise=[0.3, 0.3, 0.0, 0.0, 0.0], dim=5)
    x0 = torch.tensor([[1.0, 0.0, 1.0, 0.0, 1.0]], dtype=torch.float64).repeat(rows, 1)
    found["icl"] = seen, published, cost, x0
    return found | {f"avoidance, {kind}": among_discs(rows, kind) for kind in VEHICLES}


def in_the_box(rows: int) -> dict[str, tuple[Loop, dict[str, object]]]:
    """The methods of `staf experiment=safe_box`, each with the settings of its loop."""
    composer = Composer(config_loader())
    cfg = composer(["experiment=safe_box", f"trajectories={rows}", f"dt={DT}"])
    system = make_plant(cfg)
    box = systems.Barrier(system, list(cfg.safe_box.low), list(cfg.safe_box.high))
    x0 = initial_states(cfg, system.dim)
    found = {}
    for name, method in safe_box.methods(cfg, box, make_cost(cfg, system)).items():
        start = box.transform(x0) if method.plant is box else x0
        loop = method.controller, method.plant, method.cost, start
        found[f"safe_box, {name}"] = loop, {"substeps": method.substeps, "renew": method.renew}
    return found


def among_discs(rows: int, kind: str) -> Loop:
    """A vehicle of `staf experiment=avoidance` behind its filter."""
    composer = Composer(config_loader())
    given = ["experiment=avoidance", f"trajectories={rows}", f"avoidance.vehicle={kind}", f"dt={DT}"]
    cfg = composer(given)
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
    plain = {name: (loop, {}) for name, loop in loops(rows).items()}
    for name, ((controller, plant, cost, x0), more) in (plain | in_the_box(rows)).items():
        settings = {"dt": DT, "steps": STEPS, "every": STEPS // 10, "compile": True, **more}
        adp.simulate(controller, plant, cost, x0, **settings)  # type: ignore[arg-type]
        wall, cpu = time.perf_counter(), time.process_time()
        adp.simulate(controller, plant, cost, x0, **settings)  # type: ignore[arg-type]
        print(f"| {name} | {time.perf_counter() - wall:.2f} | {time.process_time() - cpu:.2f} |", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 1000)

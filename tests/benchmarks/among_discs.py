"""Vehicles among moving discs behind the filter, alone, with detours and with plans, beside an NMPC by IPOPT.

    python tests/benchmarks/among_discs.py [scenarios] [--rival N] [--vehicle unicycle] [--seed K]

It needs casadi.

The scenarios of `staf experiment=avoidance`: a mass, |u_i| <= 1 m/s^2, or a unicycle, and three discs of
radius 0.4 m whose velocities all know; 15 s, a control held for 0.1 s. The rival plans 4 s ahead with the
value that detours have at their end, keeps the vehicle outside of the discs at the times of its plan, begins
each search with the plan before and, where IPOPT finds none, follows that one. Costs are those of the loop,
from the same integration. Detours keep a unicycle's point ahead outside of wider discs, plans its center
outside of the discs, as the rival does. Times of a control are of the loop, without what begins it.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import casadi
import numpy as np
import torch
from timing import spent
from torch import Tensor

from staf_torch import adp, systems
from staf_torch.experiments import avoidance
from staf_torch.sweeps.hydra_compat import Composer, config_loader

DT, STEPS, AHEAD, RADIUS, DISCS = 0.1, 150, 40, 0.4, 3
ALONE, ROUNDS = 20, 7  # scenarios whose loops are timed one by one, and how often
_TOUCH = 1e-6  # m: IPOPT keeps its constraints up to its tolerance


class Model(NamedTuple):
    """A vehicle in CasADi."""

    size: int
    rate: Callable[[Any, Any], Any]
    paid: Callable[[Any], Any]  # a second, without the input's part
    end: Callable[[Any], Any]


class Predictive(adp.Controller):
    """IPOPT at every control, row after row.

    Args:
        model: how the vehicle moves, what a rate of its cost is and what its end costs.
        bounds: of the two inputs.
    """

    def __init__(self, model: Model, bounds: tuple[float, float]) -> None:
        super().__init__()
        self.period = DT
        n = self.size = model.size
        x0, discs = casadi.SX.sym("x0", n), casadi.SX.sym("discs", 4 * DISCS)
        x, u = casadi.SX.sym("x", n, AHEAD + 1), casadi.SX.sym("u", 2, AHEAD)
        paid, same, apart = 0, [x[:, 0] - x0], []
        for k in range(AHEAD):
            now, a = x[:, k], u[:, k]
            paid += DT * (model.paid(now) + casadi.sumsqr(a))
            k1 = model.rate(now, a)
            k2 = model.rate(now + DT / 2 * k1, a)
            k3 = model.rate(now + DT / 2 * k2, a)
            k4 = model.rate(now + DT * k3, a)
            same.append(x[:, k + 1] - now - DT / 6 * (k1 + 2 * k2 + 2 * k3 + k4))
            for i in range(DISCS):
                center = discs[4 * i : 4 * i + 2] + (k + 1) * DT * discs[4 * i + 2 : 4 * i + 4]
                apart.append(casadi.sumsqr(x[:2, k + 1] - center))
        paid += model.end(x[:, AHEAD])
        problem = {
            "x": casadi.vertcat(casadi.vec(x), casadi.vec(u)),
            "p": casadi.vertcat(x0, discs),
            "f": paid,
            "g": casadi.vertcat(*same, *apart),
        }
        quiet = {"print_level": 0, "sb": "yes", "warm_start_init_point": "yes", "max_iter": 200}
        self.solver = casadi.nlpsol("nmpc", "ipopt", problem, {"print_time": False, "ipopt": quiet})
        free = n * (AHEAD + 1)
        self.bounds = np.array(bounds)
        self.within = {
            "lbx": [-math.inf] * free + [-bound for bound in bounds] * AHEAD,
            "ubx": [math.inf] * free + list(bounds) * AHEAD,
            "lbg": [0.0] * free + [RADIUS**2] * (DISCS * AHEAD),
            "ubg": [0.0] * free + [math.inf] * (DISCS * AHEAD),
        }
        self.before: dict[int, np.ndarray] = {}
        self.failed, self.seconds, self.asked = 0, 0.0, 0

    def init(self, x0: Tensor) -> Tensor:
        return torch.zeros_like(x0[:, 0])

    def step(self, x: Tensor, carried: Tensor, uniform: Tensor, dt: float) -> tuple[Tensor, Tensor]:
        return torch.tensor(np.array([self.row(k, row) for k, row in enumerate(x.numpy())])), carried

    def row(self, number: int, z: np.ndarray) -> np.ndarray:
        n = self.size
        states = n * (AHEAD + 1)
        guess = self.before.get(number)
        if guess is None:
            guess = np.concatenate(
                (np.outer(1 - np.arange(AHEAD + 1) / AHEAD, z[:n]).ravel(), np.zeros(2 * AHEAD))
            )
        else:  # a step on
            x, u = guess[:states].reshape(-1, n), guess[states:].reshape(-1, 2)
            guess = np.concatenate((x[1:].ravel(), x[-1], u[1:].ravel(), np.zeros(2)))
        clock = time.process_time()
        found = self.solver(x0=guess, p=z, **self.within)
        self.seconds, self.asked = self.seconds + time.process_time() - clock, self.asked + 1
        if self.solver.stats()["success"]:
            guess = np.array(found["x"]).ravel()
        else:
            self.failed += 1
        self.before[number] = guess
        return np.clip(guess[states : states + 2], -self.bounds, self.bounds)


def mass(value: np.ndarray) -> Model:
    """The LQR's value at the end."""
    return Model(
        4,
        lambda x, u: casadi.vertcat(x[2:], u),
        casadi.sumsqr,
        lambda x: casadi.bilin(casadi.DM(value), x, x),
    )


def unicycle(ahead: float) -> Model:
    """Speed and turning; its point ahead is what costs, at the end as `among` says."""

    def squared(x: Any) -> Any:
        return casadi.sumsqr(x[:2] + ahead * casadi.vertcat(casadi.cos(x[2]), casadi.sin(x[2])))

    def rate(x: Any, u: Any) -> Any:
        return casadi.vertcat(u[0] * casadi.cos(x[2]), u[0] * casadi.sin(x[2]), u[1])

    return Model(3, rate, squared, squared)


class Loop(NamedTuple):
    """Vehicles among discs, and the controllers to compare."""

    plant: avoidance.AmongDiscs
    cost: adp.Cost
    x0: Tensor
    ours: dict[str, adp.SafetyFilter]
    rival: Predictive


def among(kind: str, count: int, seed: int) -> Loop:
    """The scenarios of `staf experiment=avoidance` with a period of 0.1 s."""
    given = ["experiment=avoidance", f"trajectories={count}", f"avoidance.vehicle={kind}", f"seed={seed}"]
    cfg = Composer(config_loader())([*given, f"dt={DT}"])
    own, x0 = avoidance.chosen_vehicle(cfg, DT), avoidance.scenarios(cfg)
    plant = avoidance.AmongDiscs(own, DISCS)
    cost = avoidance.vehicle_cost(cfg, own, int(plant.dim or 0))
    n, free = own.size, adp.QuadraticCost(1.0, 1.0, dim=4, inputs=2)
    if kind == "mass":
        plane = (np.kron(part, np.eye(2)).tolist() for part in ([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]]))
        value = adp.SampledProblem.of(systems.Linear(*plane), free, dt=DT).p
        rival = Predictive(mass(value.numpy()), own.bounds)

        def end(x: Tensor) -> Tensor:
            return ((x[..., None, :n] * value).sum(-1) * x[..., :n]).sum(-1)
    else:
        rival = Predictive(unicycle(own.reach), own.bounds)

        def end(x: Tensor) -> Tensor:
            return own.point(x[..., :n]).square().sum(-1)

    def wanted(x: Tensor) -> Tensor:
        u: Tensor = own.policy(x[..., :n])
        return u

    walls = [avoidance.apart(own, k, RADIUS) for k in range(DISCS)]
    bounds = {"low": [-bound for bound in own.bounds], "high": list(own.bounds)}
    behind = {"dt": DT, "decay": 3.0, "margin": 1e-3, **bounds}
    looking = {"axes": torch.eye(2, plant.dim), "dt": DT, "steps": AHEAD, "stride": 2, "terminal": end}
    detours = adp.DetourRollout(wanted, plant, cost, walls, margin=0.04, **looking)  # type: ignore[arg-type]
    # Of a unicycle: what the rival keeps outside.
    parts = dict(zip(type(own).__match_args__, own, strict=True))
    center = type(own)(**(parts | {"point": lambda x: x[..., :2], "reach": 0.0}))
    near = [avoidance.apart(center, k, RADIUS) for k in range(DISCS)]
    # What a vehicle cuts of a disc between samples at 1.5 m/s of each other is 7 mm.
    ways = adp.DetourRollout(wanted, plant, cost, near, margin=0.02, **looking)  # type: ignore[arg-type]
    plans = adp.DetourPlans(ways, moved=n)
    # Plans keep their distance themselves: the filter asks a unicycle for 2 mm at the next sample alone.
    last = {"dt": DT, "margin": 2e-3, "degree": 1, "decay": 60.0, **bounds}
    if kind == "mass":
        last |= {"degree": 2, "decay": 3.0, "margin": 0.0}
    ours = {
        f"{own.label} behind the filter": adp.SafetyFilter(wanted, plant, walls, **behind),  # type: ignore[arg-type]
        "with detours": adp.SafetyFilter(detours, plant, walls, **behind),  # type: ignore[arg-type]
        "with plans": adp.SafetyFilter(plans, plant, near, **last),  # type: ignore[arg-type]
    }
    return Loop(plant, cost, x0, ours, rival)


def main(count: int, rivals: int, kind: str, seed: int) -> None:
    torch.set_num_threads(1)
    loop = among(kind, count, seed)
    n = loop.rival.size
    costs: dict[str, Tensor] = {}

    def told(name: str, found: adp.LoopResult) -> None:
        discs = found.state[..., n:].unflatten(-1, (-1, 4))[..., :2]
        gaps = (found.state[..., None, :2] - discs).norm(dim=-1).amin((1, 2)) - RADIUS
        deep = int((gaps < -_TOUCH).sum())
        costs[name] = found.cost
        print(f"{name}: cost {float(found.cost.mean()):.3f}, collisions {deep} of {len(gaps)}, ", end="")
        print(f"least distance {float(gaps.min()):.5f} m", flush=True)

    def run(controller: adp.Controller, x0: Tensor) -> adp.LoopResult:
        compiled = controller is not loop.rival
        return adp.simulate(controller, loop.plant, loop.cost, x0, dt=DT, steps=STEPS, compile=compiled)

    def seconds(controller: adp.Controller, x0: Tensor) -> float:
        """A control in a loop in one program, plant included, less what begins it: each the least of some."""
        rounds = range(1 if len(x0) > 1 else ROUNDS)
        before = min(spent(lambda: controller.init(x0))[0] for _ in rounds)
        begun[len(x0)] = before / len(x0)
        return (min(spent(lambda: run(controller, x0))[0] for _ in rounds) - before) / len(x0) / STEPS

    times = {}
    begun: dict[int, float] = {}
    for name, controller in loop.ours.items():
        told(name, run(controller, loop.x0))
        alone = [seconds(controller, row[None]) for row in loop.x0[:ALONE]]
        times[name] = sum(alone) / len(alone), max(alone), seconds(controller, loop.x0)
        print(
            f"  before the loop {1e3 * begun[1]:.2f} ms alone, {1e3 * begun[len(loop.x0)]:.2f} a row of many"
        )
    told("NMPC by IPOPT", run(loop.rival, loop.x0[:rivals]))
    theirs = loop.rival.seconds / loop.rival.asked
    print(f"NMPC: {1e6 * theirs:.0f} us a control, {loop.rival.failed} of {loop.rival.asked} not solved")
    for name, (mean, most, many) in times.items():
        print(f"{name}: a control {1e6 * mean:.1f} us alone ({theirs / mean:.0f} times less), ")
        print(f"  slowest of {ALONE} loops {1e6 * most:.1f}; {1e6 * many:.2f} us a row ({theirs / many:.0f})")
        mine = costs[name][:rivals]
        ratio = mine / costs["NMPC by IPOPT"]
        means = float(mine.mean() / costs["NMPC by IPOPT"].mean())
        print(f"  over NMPC's cost: of the means {means:.4f}, median {float(ratio.median()):.4f}, ", end="")
        print(f"largest {float(ratio.max()):.4f}")
        print(f"  at most 1.05 of it in {int((ratio <= 1.05).sum())} of {rivals}", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("scenarios", type=int, nargs="?", default=1000)
    parser.add_argument("--rival", type=int, default=30, help="scenarios that the NMPC drives")
    parser.add_argument("--vehicle", default="mass", choices=("mass", "unicycle"))
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    main(given.scenarios, min(given.rival, given.scenarios), given.vehicle, given.seed)

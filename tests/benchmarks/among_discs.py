"""The safety filter among moving discs beside a model-predictive control that IPOPT solves at every control.

    python tests/benchmarks/among_discs.py [scenarios]      (needs casadi)

A mass in the plane, |u_i| <= 1 m/s^2, three discs of radius 0.4 m whose velocities both know, the scenarios
of `staf experiment=avoidance`, 15 s, a control held for 0.1 s; the filter keeps a margin of 1e-3 m^2. The
rival plans 4 s ahead with the LQR's value at their end, keeps outside of the discs at the times of its plan,
begins each search with the plan before and, where IPOPT finds none, follows that one. Costs are those of the
loop, x'x + u'u, from the same integration.
"""

from __future__ import annotations

import math
import sys
import time

import casadi
import numpy as np
import torch
from omegaconf import OmegaConf
from torch import Tensor

from staf_torch import adp, systems
from staf_torch.adp.safety_filter import Constraint
from staf_torch.experiments.avoidance import scenarios as drawn

DT, STEPS, AHEAD, RADIUS, DISCS = 0.1, 150, 40, 0.4, 3
_TOUCH = 1e-6  # m: IPOPT keeps its constraints up to its tolerance


class Plane(systems.ControlAffineSystem):
    """The mass and its discs, (p, v, c_1, c_1', ...)."""

    dim, inputs = 4 + 4 * DISCS, 2

    def drift(self, x: Tensor) -> Tensor:
        pairs = x.unflatten(-1, (-1, 2, 2))[..., 1, :]  # speeds
        return torch.cat((pairs.unsqueeze(-2), torch.zeros_like(pairs).unsqueeze(-2)), dim=-2).flatten(-3)

    def effectiveness(self, x: Tensor) -> Tensor:
        push = torch.zeros(self.dim, 2, dtype=x.dtype)
        push[2, 0] = push[3, 1] = 1.0
        return push.expand(*x.shape[:-1], -1, -1)


class Predictive(adp.Controller):
    """IPOPT at every control, row after row."""

    def __init__(self, value: np.ndarray) -> None:
        super().__init__()
        self.period = DT
        x0, discs = casadi.SX.sym("x0", 4), casadi.SX.sym("discs", 4 * DISCS)
        x, u = casadi.SX.sym("x", 4, AHEAD + 1), casadi.SX.sym("u", 2, AHEAD)
        paid, same, apart = 0, [x[:, 0] - x0], []
        for k in range(AHEAD):
            p, v, a = x[:2, k], x[2:, k], u[:, k]
            paid += DT * (casadi.sumsqr(x[:, k]) + casadi.sumsqr(a))
            same.append(x[:, k + 1] - casadi.vertcat(p + DT * v + 0.5 * DT**2 * a, v + DT * a))
            for i in range(DISCS):
                center = discs[4 * i : 4 * i + 2] + (k + 1) * DT * discs[4 * i + 2 : 4 * i + 4]
                apart.append(casadi.sumsqr(x[:2, k + 1] - center))
        paid += casadi.bilin(casadi.DM(value), x[:, AHEAD], x[:, AHEAD])
        problem = {
            "x": casadi.vertcat(casadi.vec(x), casadi.vec(u)),
            "p": casadi.vertcat(x0, discs),
            "f": paid,
            "g": casadi.vertcat(*same, *apart),
        }
        quiet = {"print_level": 0, "sb": "yes", "warm_start_init_point": "yes", "max_iter": 200}
        self.solver = casadi.nlpsol("nmpc", "ipopt", problem, {"print_time": False, "ipopt": quiet})
        free = 4 * (AHEAD + 1)
        self.within = {
            "lbx": [-math.inf] * free + [-1.0] * (2 * AHEAD),
            "ubx": [math.inf] * free + [1.0] * (2 * AHEAD),
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
        states = 4 * (AHEAD + 1)
        guess = self.before.get(number)
        if guess is None:
            guess = np.concatenate(
                (np.outer(1 - np.arange(AHEAD + 1) / AHEAD, z[:4]).ravel(), np.zeros(2 * AHEAD))
            )
        else:  # a step on
            x, u = guess[:states].reshape(-1, 4), guess[states:].reshape(-1, 2)
            guess = np.concatenate((x[1:].ravel(), x[-1], u[1:].ravel(), np.zeros(2)))
        clock = time.process_time()
        found = self.solver(x0=guess, p=z, **self.within)
        self.seconds, self.asked = self.seconds + time.process_time() - clock, self.asked + 1
        if self.solver.stats()["success"]:
            guess = np.array(found["x"]).ravel()
        else:
            self.failed += 1
        self.before[number] = guess
        return np.clip(guess[states : states + 2], -1, 1)


def scenarios(count: int) -> Tensor:
    """As `staf experiment=avoidance` draws them, seed 0."""
    chosen = {"discs": DISCS, "radius": RADIUS, "distance": 3.0, "speed": 0.3, "vehicle": "mass"}
    return drawn(OmegaConf.create({"trajectories": count, "seed": 0, "avoidance": chosen}))


def apart(k: int) -> Constraint:
    return lambda x, t: (x[:, :2] - x[:, 4 + 4 * k : 6 + 4 * k]).square().sum(-1) - RADIUS**2


def main(count: int) -> None:
    torch.set_num_threads(1)
    x0, plant = scenarios(count), Plane()
    mass = systems.Linear(
        *(np.kron(m, np.eye(2)).tolist() for m in ([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]]))
    )
    own = adp.QuadraticCost(1.0, 1.0, dim=4, inputs=2, low=-1.0, high=1.0)
    lqr = adp.LQR(mass, own, period=DT)
    weights = torch.zeros(plant.dim, plant.dim, dtype=torch.float64)
    weights[:4, :4] = torch.eye(4)
    cost = adp.QuadraticCost(weights, 1.0, dim=plant.dim, inputs=2, low=-1.0, high=1.0)
    rival = Predictive(adp.SampledProblem.of(mass, own, dt=DT).p.numpy())
    settings = {"dt": DT, "low": -1.0, "high": 1.0, "decay": 3.0, "margin": 1e-3}
    walls = [apart(k) for k in range(DISCS)]
    guard = adp.SafetyFilter(lambda x: lqr(x[..., :4]), plant, walls, **settings)  # type: ignore[arg-type]
    costs = {}
    for name, controller in (("LQR behind the filter", guard), ("NMPC by IPOPT", rival)):
        run = adp.simulate(controller, plant, cost, x0, dt=DT, steps=STEPS, compile=False)
        discs = run.state[..., 4:].unflatten(-1, (-1, 4))[..., :2]
        gaps = (run.state[..., None, :2] - discs).norm(dim=-1).amin((1, 2)) - RADIUS
        costs[name] = run.cost
        deep = int((gaps < -_TOUCH).sum())
        print(f"{name}: cost {float(run.cost.mean()):.3f}, collisions {deep} of {count}, ", end="")
        print(f"least distance {float(gaps.min()):.5f} m")
    clock = time.process_time()
    for k in range(1000):
        guard(x0[k % count, None])
    single = (time.process_time() - clock) / 1000
    theirs = rival.seconds / rival.asked
    print(f"a control: the filter {1e6 * single:.0f} us, NMPC {1e6 * theirs:.0f} us", end="")
    print(f" ({theirs / single:.0f} times), {rival.failed} of {rival.asked} not solved")
    many = x0.repeat(1000 // count + 1, 1)
    for _ in range(2):  # the first compiles
        clock = time.process_time()
        adp.simulate(guard, plant, cost, many, dt=DT, steps=STEPS, compile=True)
    spent = (time.process_time() - clock) / (len(many) * STEPS)
    print(
        f"{len(many)} rows in one program, plant included: {1e6 * spent:.2f} us ({theirs / spent:.0f} times)"
    )
    ratio = costs["LQR behind the filter"] / costs["NMPC by IPOPT"]
    mine, other = (each.mean() for each in costs.values())
    parts = {
        "of the means": mine / other,
        "median": ratio.median(),
        "largest": ratio.max(),
        "least": ratio.min(),
    }
    print("cost over NMPC's: " + ", ".join(f"{key} {float(value):.4f}" for key, value in parts.items()))
    print(f"at most 1.05 of it in {int((ratio <= 1.05).sum())} of {count}")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 30)

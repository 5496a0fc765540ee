"""`adp.DirectShooting` beside IPOPT on the same discretisation: is what it calls converged the optimum?

    python tests/benchmarks/shooting.py [--cases CASE,CASE] [--states 4] [--starts 6] [--seed 0]

Needs casadi. Every plant on which `experiments/rival_plants.py` compares methods, in continuous time, from
random states of its box, and swing-ups from hanging and from random states; the mesh, the Runge-Kutta
steps, the controls (linear on an interval) and the terminal cost are those that `DirectShooting` chose.
IPOPT starts at its plan, at that plan shaken, and from controls that jump between the bounds around the
ways to each goal that differs by full turns. Prints the value over the least that any of these found. A row
that claims to have converged and costs more than 1.0001 of that is an error (exit code 1). Not collected by
pytest.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import sys
import time
from collections.abc import Sequence
from typing import Any

import casadi
import numpy as np
import torch
from torch import Tensor

from staf_torch import adp
from staf_torch.experiments.rival_plants import CASES, RivalPlant

_SAME = 1e-4  # relative
Row = dict[str, Any]


def hanging_pendulum(m: Any, x: Sequence[Any], u: Sequence[Any]) -> Sequence[Any]:
    """Pendulum-v1 in continuous time, without the limit of its rate."""
    return x[1], 15.0 * m.sin(x[0]) + 3.0 * u[0]


def three_states(m: Any, x: Sequence[Any], u: Sequence[Any]) -> Sequence[Any]:
    """`systems.TwoState`'s drift with a third state that decays."""
    pull = m.cos(2 * x[0]) + 2
    return -x[0] + x[1], -0.5 * x[0] - 0.5 * x[1] * (1 - pull * pull) + pull * u[0], -2 * x[2] + x[0] + u[0]


def short_period(m: Any, x: Sequence[Any], u: Sequence[Any]) -> Sequence[Any]:
    """An F/A-18's, its first actuator at .7."""
    return (
        -1.175 * x[0] + 0.9871 * x[1] - 0.7 * 0.194 * u[0],
        -8.458 * x[0] - 0.8776 * x[1] - 0.7 * 19.29 * u[0],
    )


_PENDULUM = RivalPlant(
    "pendulum",
    hanging_pendulum,
    0.05,
    1,
    ((20.0, 2.0), (0.02,)),
    (-2.0,),
    (2.0,),
    (math.pi, 1.0),
    periodic=(0,),
)
_CART = CASES["cart_pole_swing_up"]


_DOWN = ((0.0, math.pi, 0.0, 0.0),)
SHOTS: dict[str, tuple[RivalPlant, tuple[tuple[float, ...], ...]]] = {  # states beside random ones of the box
    "double integrator": (CASES["double_integrator"], ((5.0, 0.0),)),
    "two states and a third": (
        RivalPlant("three", three_states, 0.1, 1, ((1.0,) * 3, (1.0,)), (-9.0,), (9.0,), (1.0,) * 3),
        (),
    ),
    "short period": (
        RivalPlant(
            "short_period", short_period, 0.1, 1, ((0.25, 0.25), (5.0,)), (-2.0,), (2.0,), (25.0, 10.0)
        ),
        ((25.0, -10.0),),
    ),
    "cart-pole free": (dataclasses.replace(CASES["cart_pole_10N"], low=(-1e3,), high=(1e3,)), ()),
    "cart-pole 10 N": (CASES["cart_pole_10N"], ()),
    "cart-pole 5 N": (CASES["cart_pole_5N"], ()),
    "cart-pole to 1 m": (CASES["cart_pole_to_1m"], ()),
    "quadrotor": (dataclasses.replace(CASES["quadrotor"], box=(0.8,) * 6), ()),
    "pendulum up": (_PENDULUM, ((math.pi, 0.0), (3.0, 0.0))),
    "cart-pole up 10 N": (_CART, _DOWN),
    "cart-pole up 5 N": (dataclasses.replace(_CART, low=(-5.0,), high=(5.0,)), _DOWN),
}


class Peer:
    """IPOPT on a mesh of Runge-Kutta steps, as `DirectShooting` solves it; (x - goal)'P(x - goal) at the end.

    A control is linear on an interval, its values at both ends free; or it is held.
    """

    def __init__(self, case: RivalPlant, p: Tensor, lengths: Tensor, held: bool = False) -> None:
        n, m, steps = case.dim, case.inputs, len(lengths)
        size = m if held else 2 * m
        self.case, self.sizes = case, (size, m, steps)
        goal = case.goal().tolist()
        weights = case.weights

        def deviation(x: Any) -> list[Any]:
            away = [x[i] - goal[i] for i in range(n)]
            turns = {i: casadi.floor(away[i] / (2 * math.pi) + 0.5) for i in case.periodic}
            return [part - 2 * math.pi * turns[i] if i in turns else part for i, part in enumerate(away)]

        def motion(x: Any, u: Any) -> tuple[Any, Any]:
            parts = case.equations(casadi, [x[i] for i in range(n)], [u[j] for j in range(m)])
            paid = sum(q * e**2 for q, e in zip(weights[0], deviation(x), strict=True))
            return casadi.vertcat(*parts), paid + sum(r * u[j] ** 2 for j, r in enumerate(weights[1]))

        x, v, h = casadi.MX.sym("x", n), casadi.MX.sym("v", size), casadi.MX.sym("h")
        first, last = v[:m], v[size - m :]
        k1, c1 = motion(x, first)
        k2, c2 = motion(x + 0.5 * h * k1, 0.5 * (first + last))
        k3, c3 = motion(x + 0.5 * h * k2, 0.5 * (first + last))
        k4, c4 = motion(x + h * k3, last)
        after, paid = x + h / 6 * (k1 + 2 * (k2 + k3) + k4), h / 6 * (c1 + 2 * (c2 + c3) + c4)
        step = casadi.Function("step", [x, v, h], [after, paid])
        states, controls = casadi.MX.sym("X", n, steps + 1), casadi.MX.sym("V", size, steps)
        start = casadi.MX.sym("p", n)
        moved, costs = step.map(steps)(states[:, :-1], controls, casadi.DM(lengths.tolist()).T)
        end = casadi.vertcat(*deviation(states[:, -1]))
        program = {
            "x": casadi.vertcat(casadi.vec(states), casadi.vec(controls)),
            "p": start,
            "f": casadi.sum2(costs) + casadi.bilin(p.numpy(), end, end),
            "g": casadi.vertcat(states[:, 0] - start, casadi.vec(states[:, 1:] - moved)),
        }
        quiet = {"ipopt.print_level": 0, "ipopt.sb": "yes", "print_time": False, "error_on_fail": False}
        self.solver = casadi.nlpsol("peer", "ipopt", program, {**quiet, "ipopt.max_iter": 500})
        free = np.full(n * (steps + 1), np.inf)
        self.low = np.concatenate([-free, np.tile(case.low, size // m * steps)])
        self.high = np.concatenate([free, np.tile(case.high, size // m * steps)])

    def solve(self, x0: Tensor, states: np.ndarray, controls: np.ndarray) -> float:
        """The cost that it finds from a guess (T + 1, n), (T, m or 2 m); inf where it gives up."""
        guess = np.concatenate([states.ravel(), np.clip(controls.ravel(), self.low[-1], self.high[-1])])
        bounds = {"lbx": self.low, "ubx": self.high, "lbg": 0.0, "ubg": 0.0}
        found = self.solver(x0=guess, p=x0.numpy(), **bounds)
        return float(found["f"]) if self.solver.stats()["success"] else math.inf

    def costs(
        self, x0: Tensor, plan: tuple[Tensor, Tensor] | None, count: int, draw: np.random.Generator
    ) -> list[float]:
        """What it finds from so many guesses: half at and around a plan, if there is one, the others cold."""
        size, m, steps = self.sizes
        low, high = (np.tile(each, size // m) for each in (self.case.low, self.case.high))
        found = []
        for k in range((count + 1) // 2 if plan else 0):
            x, v = (part.numpy() for part in plan)
            shaken = v + 0.1 * k * (high - low) * draw.normal(size=v.shape)
            found.append(self.solve(x0, x + 0.1 * k * draw.normal(size=x.shape), shaken))
        while len(found) < count:
            goal = self.case.goal().numpy().copy()
            for i in self.case.periodic:
                goal[i] += 2 * math.pi * draw.integers(-1, 2)
            share = np.linspace(0, 1, steps + 1)[:, None] ** 0.5
            jumps = np.sign(draw.normal(size=(steps // 8 + 1, m))).repeat(8, 0)[:steps]
            states = (1 - share) * x0.numpy() + share * goal
            found.append(self.solve(x0, states, np.tile(jumps, size // m) * np.minimum(high, 20.0)))
        return found


def checked(name: str, count: int, starts: int, seed: int) -> list[Row]:
    """A row a state."""
    case, first = SHOTS[name]
    shooting = adp.DirectShooting(case.plant(), case.cost())
    assert shooting.lqr is not None
    x0 = torch.tensor(first, dtype=torch.float64).reshape(-1, case.dim)
    x0 = torch.cat((x0, case.states(count, seed)))
    began = time.process_time()
    best = shooting.solve(x0)
    spent = (time.process_time() - began) / len(x0)
    lengths = best.time.diff()
    peer = Peer(case, shooting.lqr.p, lengths)
    costs = on_mesh(shooting, best, lengths)
    rows = []
    for k, state in enumerate(x0):
        draw = np.random.default_rng([seed, k])
        plan = None
        if bool(torch.isfinite(best.value[k])):
            plan = best.state[k], best.plan[k].flatten(-2)
        values = peer.costs(state, plan, starts, draw)
        ours, least = float(costs[k]), min(values)
        known = min(least, ours) if math.isfinite(ours) else least
        rows.append(
            {
                "case": name,
                "state": [round(v, 3) for v in state.tolist()],
                "ours": ours,
                "ipopt": values,
                "over": ours / known,
                "converged": bool(best.converged[k]),
                "reason": best.reason[k],
                "cpu_s": spent,
            }
        )
        print(line(rows[-1]), flush=True)
    return rows


def on_mesh(shooting: adp.DirectShooting, best: adp.Optimum, lengths: Tensor) -> Tensor:
    """The cost of the plans on the mesh on which they were optimised, (B,)."""
    _, paid = shooting.stage.advance(
        best.state[:, :-1], best.plan.flatten(-2), lengths.expand(best.plan.shape[:2])
    )
    return paid.sum(-1) + shooting.terminal(best.state[:, -1])


def line(row: Row) -> str:
    cold = ", ".join(
        f"{value / row['ours'] if math.isfinite(row['ours']) else value:.5g}" for value in row["ipopt"]
    )
    said = "converged" if row["converged"] else row["reason"]
    cells = [row["case"], row["state"], f"{row['ours']:.6g}", f"{row['over']:.6f}", cold, said]
    return "| " + " | ".join(str(cell) for cell in (*cells, f"{row['cpu_s']:.1f}")) + " |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", default=",".join(SHOTS))
    parser.add_argument("--states", type=int, default=4, help="random ones a case")
    parser.add_argument("--starts", type=int, default=6, help="of IPOPT")
    parser.add_argument("--seed", type=int, default=0)
    settings = parser.parse_args()
    torch.set_num_threads(1)
    print("| case | state | value on the mesh | over the least known | IPOPT's over it | said | CPU s |")
    print("|---" * 7 + "|")
    rows: list[Row] = []
    for name in settings.cases.split(","):
        rows += checked(name, settings.states, settings.starts, settings.seed)
    claimed = [row for row in rows if row["converged"]]
    wrong = [row for row in claimed if row["over"] > 1 + _SAME]
    local = sum(row["reason"].startswith("local") for row in rows)
    print(
        f"{len(rows)} states: {len(claimed)} converged, {len(wrong)} of them wrongly; {local} local", end=""
    )
    print(f", {len(rows) - len(claimed) - local} without a plan")
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()

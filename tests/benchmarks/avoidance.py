"""`adp.plan_around` beside IPOPT: a double integrator in the plane, |u| <= 1, a disc of radius 0.5 at (1, 0).

    python tests/benchmarks/avoidance.py [starts] [seed]      (needs casadi)

Starts at rest in [1.7, 3] x [-1.5, 1.5], Q = I, R = I; both hold the control for 0.1 s over 10 s, with one
Runge-Kutta step each, the LQR's value at the end and the disc at the same times. IPOPT begins on either side.
"""

from __future__ import annotations

import sys
import time

import casadi
import numpy as np
import torch

from staf_torch import adp, systems

DT, STEPS = 0.1, 100
CENTER, RADIUS = (1.0, 0.0), 0.5


def disc(x: torch.Tensor) -> torch.Tensor:
    return (x[..., 0] - CENTER[0]).square() + (x[..., 1] - CENTER[1]).square() - RADIUS**2


def ipopt(x0: np.ndarray, terminal: np.ndarray, sides: tuple[float, ...] = (-1.0, 1.0)) -> float:
    """The least cost found from guesses on both sides."""
    best = np.inf
    for side in sides:
        o = casadi.Opti()
        x, u = o.variable(4, STEPS + 1), o.variable(2, STEPS)
        total = 0
        for k in range(STEPS):
            p, v, a = x[:2, k], x[2:, k], u[:, k]
            o.subject_to(x[:2, k + 1] == p + DT * v + 0.5 * DT**2 * a)
            o.subject_to(x[2:, k + 1] == v + DT * a)
            # The same quadrature as a Runge-Kutta step: Simpson's, the middle by its two slopes.
            mid2, mid3, end = p + DT / 2 * v, p + DT / 2 * (v + DT / 2 * a), p + DT * (v + DT / 2 * a)
            half, last = v + DT / 2 * a, v + DT * a
            rate = casadi.sumsqr(p) + casadi.sumsqr(v) + 2 * (casadi.sumsqr(mid2) + casadi.sumsqr(half))
            rate += 2 * (casadi.sumsqr(mid3) + casadi.sumsqr(half)) + casadi.sumsqr(end) + casadi.sumsqr(last)
            total += DT / 6 * rate + DT * casadi.sumsqr(a)
            o.subject_to(casadi.sumsqr(x[:2, k + 1] - casadi.DM(CENTER)) >= RADIUS**2)
        o.subject_to(o.bounded(-1, casadi.vec(u), 1))
        o.subject_to(x[:, 0] == x0)
        o.minimize(total + casadi.bilin(casadi.DM(terminal), x[:, STEPS], x[:, STEPS]))
        share = np.linspace(0, 1, STEPS + 1)
        guess = np.outer(x0[:2], (1 - share) ** 2)
        guess[1] += side * 1.5 * np.sin(np.pi * np.minimum(1, 1.5 * share))
        o.set_initial(x[:2, :], guess)
        o.solver("ipopt", {"print_time": False, "ipopt": {"print_level": 0, "sb": "yes"}})
        try:
            best = min(best, float(o.solve().value(o.f)))
        except RuntimeError:
            continue
    return best


def main(count: int, seed: int = 0) -> None:
    torch.set_num_threads(1)
    a, b = np.kron([[0.0, 1.0], [0.0, 0.0]], np.eye(2)), np.kron([[0.0], [1.0]], np.eye(2))
    plant = systems.Linear(a.tolist(), b.tolist())
    cost = adp.AvoidanceCost(
        1.0, 1.0, dim=4, inputs=2, obstacles=disc, reach=0.5, weight=1.0, kind="log", low=-1.0, high=1.0
    )
    generator = torch.Generator().manual_seed(seed)
    place = torch.rand(count, 2, dtype=torch.float64, generator=generator)
    x0 = torch.cat(
        (torch.tensor([1.7, -1.5]) + place * torch.tensor([1.3, 3.0]), torch.zeros(count, 2)), dim=-1
    ).double()
    start = time.process_time()
    found = adp.plan_around(plant, cost, x0, dt=DT, steps=STEPS)
    mine = time.process_time() - start
    terminal = adp.SampledProblem.of(plant, cost, dt=DT).p.numpy()
    start = time.process_time()
    best = torch.tensor([ipopt(x.numpy(), terminal) for x in x0])
    theirs = time.process_time() - start
    ratio = found.cost / best
    print(f"{count} starts: {mine / count:.3f} s a start here, {theirs / count:.3f} s by IPOPT")
    print(
        f"cost over IPOPT's: median {float(ratio.median()):.4f}, "
        f"largest {float(ratio.max()):.4f}, least {float(ratio.min()):.4f}"
    )
    print(f"collisions {int((found.margin < 0).sum())}, least h {float(found.margin.min()):.2e}")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:] or [50]))

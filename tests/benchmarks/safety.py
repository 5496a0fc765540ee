"""`adp.SafetyFilter` alone: time a row on one core, and the program against a dense solver.

    python tests/benchmarks/safety.py [rows] [seed]

100 000 rows of a double integrator in the plane, two discs (one moves), bounds of 1. The dense solver is
Lawson and Hanson's least distance programming in SciPy, on the first 2000 rows whose inequalities can be
met.
"""

from __future__ import annotations

import sys

import numpy as np
import torch
from scipy.optimize import nnls
from timing import spent
from torch import Tensor

from staf_torch import adp, systems
from staf_torch.adp.safety.quadratic_program import nearest_admissible

INTEGRATOR = ([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])


def disc(x: Tensor, t: Tensor) -> Tensor:
    return (x[:, 0] - 1).square() + x[:, 1].square() - 0.25


def passing(x: Tensor, t: Tensor) -> Tensor:
    return (x[:, 0] - 0.3 * t).square() + (x[:, 1] - 1).square() - 0.1


def dense(wanted: np.ndarray, rows: np.ndarray, least: np.ndarray) -> np.ndarray | None:
    """The nearest point with rows u >= least; None where there is none."""
    matrix = np.vstack([rows.T, (least - rows @ wanted)[None]])
    right = np.zeros(len(matrix))
    right[-1] = 1.0
    left = matrix @ nnls(matrix, right, maxiter=1000)[0] - right
    return None if np.linalg.norm(left) < 1e-9 else wanted - left[:-1] / left[-1]


def main(count: int, seed: int = 0) -> None:
    torch.set_num_threads(1)
    plant = systems.Linear(*(np.kron(part, np.eye(2)).tolist() for part in INTEGRATOR))
    lqr = adp.LQR(plant, adp.QuadraticCost(1.0, 1.0, dim=4, inputs=2))
    guard = adp.SafetyFilter(lqr, plant, [disc, passing], dt=0.01, low=-1.0, high=1.0)
    generator = torch.Generator().manual_seed(seed)
    x = 3 * torch.rand(count, 4, dtype=torch.float64, generator=generator) - 1.5
    t = torch.rand(count, dtype=torch.float64, generator=generator)
    u = lqr(x)
    found = guard.restrain(x, u, t)
    taken = min(spent(lambda: guard.restrain(x, u, t))[0] for _ in range(10))
    acted = (found.control != guard.bounds.clip(u)).any(-1).double().mean()
    print(f"{1e6 * taken / count:.3f} us a row and core; acts in {100 * float(acted):.1f} % of the rows,")
    print(f"{100 * float((found.slack > 1e-6).double().mean()):.1f} % cannot be met within the bounds")

    wanted = guard.bounds.clip(u[:2000])
    normals, least, _ = guard.inequalities(x[:2000], wanted, t[:2000])
    mine = nearest_admissible(wanted, normals, least, guard.bounds.low, guard.bounds.high, guard.table)
    eye, worst, solved = np.eye(2), 0.0, 0
    for row in range(2000):
        rows = np.vstack([normals[row].numpy(), eye, -eye])
        limits = np.concatenate([least[row].numpy(), -np.ones(4)])
        best = dense(wanted[row].numpy(), rows, limits)
        if best is not None and (rows @ best - limits).min() > -1e-7:
            worst = max(worst, float(np.abs(best - mine.point[row].numpy()).max()))
            solved += 1
    print(f"largest difference to the dense solver: {worst:.1e} in {solved} rows")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:] or [100_000]))

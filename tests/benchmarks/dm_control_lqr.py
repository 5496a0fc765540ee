"""dm_control's chains of masses, lqr_2_1 and lqr_6_2, against the exact solution that dm_control ships.

    python tests/benchmarks/dm_control_lqr.py          # needs dm_control 1.0.50 with mujoco 3.17

`systems.MujocoPlant` of the task's own model, `adp.LQR` of its own cost. A row a task and seed: the largest
difference of gains and of the value's matrix, over the largest entry, and of the cost of an episode of 20 000
steps from 20 of the task's initial states over x'Px/2. Ends with an error beyond 1e-6. Not collected by
pytest.
"""

from __future__ import annotations

import sys

import torch

from staf_torch import adp, systems

_GOAL, _STEPS = 1e-6, 20_000


def main() -> None:
    from dm_control.suite import lqr, lqr_solver

    torch.set_num_threads(1)
    worst = 0.0
    for make in (lqr.lqr_2_1, lqr.lqr_6_2):
        for seed in range(3):
            env = make(random=seed)
            env.reset()
            p, k, _ = (torch.as_tensor(part) for part in lqr_solver.solve(env))
            plant = systems.MujocoPlant(env.physics.model.ptr)
            n, m = plant.dim // 2, plant.inputs
            weights = 0.5 * torch.diag(torch.cat((torch.ones(n), torch.zeros(n))).double())
            cost = adp.QuadraticCost(weights, 0.5 * env.task.control_cost_coef, dim=2 * n, inputs=m)
            policy = adp.LQR(plant, cost)
            found = 2 * policy.p / plant.period  # its cost is of time, dm_control's a step
            place = torch.randn(20, n, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
            x = torch.cat((2**0.5 * place / place.norm(dim=1, keepdim=True), torch.zeros_like(place)), dim=1)
            # The chain is linear: the loop is that of the slopes that MuJoCo gives.
            a, b = plant.linearisation(None, None)
            closed, spent, at = a - b @ policy.k, torch.zeros(20, dtype=torch.float64), x
            for _ in range(_STEPS):
                spent = spent + cost.rate(at, -at @ policy.k.mT)
                at = at @ closed.mT
            value = 0.5 * ((x @ p) * x).sum(1)
            errors = {
                "gains": float((policy.k + k).abs().max() / k.abs().max()),
                "matrix": float((found - p).abs().max() / p.abs().max()),
                "cost": float((spent / value - 1).abs().max()),
            }
            worst = max(worst, *errors.values())
            print(make.__name__, seed, *(f"{name} {error:.1e}" for name, error in errors.items()), flush=True)
    if not worst <= _GOAL:
        sys.exit(f"differs by {worst:.1e}")


if __name__ == "__main__":
    main()

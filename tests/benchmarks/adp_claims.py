"""What the closed loops are claimed to reach, measured in full: 200 seeds, 200 initial states, 10 s.

    python tests/benchmarks/adp_claims.py

The suite tests the same on shorter runs and fewer rows; the experiments adp_three_state, adp_comparison and
adp_initial_weights measure the rest. Takes some minutes. Not collected by pytest.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import torch
from torch import Tensor

from staf_torch import (
    AnchoredKernel,
    ExponentialKernel,
    StaFBasis,
    StateFollowingCenters,
    StateRadius,
    adp,
    ball,
    cross_polytope,
    rings,
    systems,
)

ROWS = 200
PLANT, COST = systems.TwoState(), adp.QuadraticCost(1.0, 1.0, 2, 1)
QUADROTOR_BOX = torch.tensor([1.0, 1.0, 0.5, 1.0, 1.0, 0.5], dtype=torch.float64)


def box(half_width: Tensor, rows: int = ROWS) -> Tensor:
    generator = torch.Generator().manual_seed(0)
    return half_width * (2 * torch.rand(rows, len(half_width), dtype=torch.float64, generator=generator) - 1)


def square(side: float) -> Tensor:
    return box(torch.full((2,), side, dtype=torch.float64))


def learner() -> adp.ActorCritic:
    centers = StateFollowingCenters(rings(3), StateRadius(0.7, 1e-5))
    basis = adp.StaFValueBasis(StaFBasis(AnchoredKernel(ExponentialKernel()), centers))
    return adp.ActorCritic(basis, PLANT, COST, adp.RandomPoints(1, StateRadius(2.1, 1e-5)))


def learned(x0: Tensor, dt: float) -> dict[str, float]:
    steps = round(10 / dt)
    run = adp.simulate(learner(), PLANT, COST, x0, dt=dt, steps=steps, every=steps, compile="auto")
    return summary(run, run.cost / PLANT.optimal_value(x0, COST.q, COST.r))


def seeds(dt: float) -> dict[str, float]:
    return learned(torch.tensor([-1.0, 1.0], dtype=torch.float64).repeat(ROWS, 1), dt)


def rollout(
    plant: systems.ControlAffineSystem,
    cost: adp.Cost,
    x0: Tensor,
    directions: Tensor,
    radius: float | StateRadius,
    horizon: float,
    seconds: float,
) -> dict[str, float]:
    lqr = adp.LQR(plant, cost)
    basis = StaFBasis(ExponentialKernel(), StateFollowingCenters(directions, radius))
    policy = adp.RolloutPolicy(basis, plant, cost, lqr, lqr.value, horizon=horizon, steps=10)
    settings = {"dt": 0.01, "steps": round(seconds / 0.01), "every": round(seconds / 0.01)}
    run = adp.simulate(adp.Feedback(policy), plant, cost, x0, **settings)
    base = adp.simulate(adp.Feedback(lqr), plant, cost, x0, **settings)
    best = adp.DirectShooting(plant, cost).solve(x0)
    assert best.converged.all()
    found = summary(run, run.cost / best.value)
    over_base = run.cost / base.cost
    return found | {"over LQR, mean": float(over_base.mean()), "over LQR, max": float(over_base.max())}


def summary(run: adp.LoopResult, ratio: Tensor) -> dict[str, float]:
    regulated = ~run.diverged & (run.state[:, -1].norm(dim=-1) < 1e-3)
    return {
        "regulated": float(regulated.double().mean()),
        "diverged": float(run.diverged.double().mean()),
        "cost, median": float(run.cost.median()),
        "cost, min": float(run.cost.min()),
        "cost, max": float(run.cost.max()),
        "J/J*, mean": float(ratio.mean()),
        "J/J*, max": float(ratio.max()),
    }


def quadrotor() -> dict[str, float]:
    corners = cross_polytope(6)
    directions = torch.cat((corners, torch.zeros_like(corners[:1])))
    plant, cost = systems.PlanarQuadrotor(), adp.QuadraticCost(1.0, 1.0, 6, 2)
    return rollout(plant, cost, box(QUADROTOR_BOX), directions, 0.05, 0.5, 15.0)


def three_state() -> dict[str, float]:
    plant, cost = systems.ThreeState(), adp.QuadraticCost(10.0, 1.0, 3, 2)
    x0 = torch.tensor([[-0.5, 0.5, -0.25]], dtype=torch.float64)
    return rollout(plant, cost, x0, ball(10, 3), StateRadius(0.1, 1e-5), 1.0, 20.0)


CLAIMS: dict[str, Callable[[], dict[str, float]]] = {
    "information, (-1, 1), 200 seeds, 5 ms": lambda: seeds(0.005),
    "information, (-1, 1), 200 seeds, 1 ms": lambda: seeds(0.001),
    "information, 200 states of [-1, 1]^2, 5 ms": lambda: learned(square(1.0), 0.005),
    "information, 200 states of [-1, 1]^2, 1 ms": lambda: learned(square(1.0), 0.001),
    "rollout, two-state, 200 states of [-2, 2]^2": lambda: rollout(
        PLANT, COST, square(2.0), rings(6), 0.1, 0.5, 10.0
    ),
    "rollout, three-state, published x0": three_state,
    "rollout, quadrotor, 200 states of +-(1, 1, .5, 1, 1, .5)": quadrotor,
}


def main() -> None:
    for name, claim in CLAIMS.items():
        start = time.perf_counter()
        with torch.no_grad():
            numbers = ", ".join(f"{key} {value:.6g}" for key, value in claim().items())
        print(f"{name} ({time.perf_counter() - start:.0f} s)\n    {numbers}", flush=True)


if __name__ == "__main__":
    main()

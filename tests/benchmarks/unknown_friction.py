"""Two published examples of safe adaptation, 200 seeds each: friction, and gravity, unknown; h >= 0.

    python tests/benchmarks/unknown_friction.py [rows] [seed]

A double integrator in the plane with unknown friction among two discs, and a pendulum whose gravity and
friction are unknown and whose angle must stay below pi/4, though its policy wants it to go beyond. Source of
the numbers: AdaptiveCBFToolbox.jl (ACC 2022).
"""

from __future__ import annotations

import math
import sys
import time

import torch
from torch import Tensor

from staf_torch import adp

DISCS = ((-1.75, 2.0), (-1.0, 0.5))
Example = tuple[adp.ChangingPlant, adp.QuadraticCost, Tensor, dict[str, adp.Controller], float, int]


def friction(x: Tensor, u: Tensor) -> Tensor:
    """-diag(v) in the rates of v: (..., 4) -> (..., 4, 2)."""
    return torch.cat((torch.zeros_like(x[..., :2]).diag_embed(), -x[..., 2:].diag_embed()), dim=-2)


def outside(place: tuple[float, float]):
    def h(x: Tensor, t: Tensor) -> Tensor:
        return (x[:, :2] - torch.tensor(place).to(x)).square().sum(-1) - 0.25

    return h


def double_integrator(rows: int, generator: torch.Generator) -> Example:
    plant = adp.ParametricPlant(
        friction, lambda x, u: torch.cat((x[..., 2:], u), -1), dim=4, inputs=2, theta=[1.5, 1.5], rows=[2, 3]
    )
    cost = adp.QuadraticCost(1.0, 1.0, dim=4, inputs=2)
    wanted = adp.Feedback(adp.LQR(plant, cost))
    windows = adp.IntegralWindows(plant, 0.5, first=0.02)
    law = adp.LeastSquares([1.5, 1.5], deviation=1.5, floor=1e-4)
    box = {"theta_low": [0.0, 0.0], "theta_high": [3.0, 3.0]}
    constraints = [outside(place) for place in DISCS]
    safe = adp.RobustFilter(wanted, plant, constraints, windows, law, dt=0.01, decay=1.0, **box)
    true = 3 * torch.rand(rows, 2, generator=generator, dtype=torch.float64)
    x0 = torch.tensor([[-2.5, 2.5, 0.0, 0.0]], dtype=torch.float64).repeat(rows, 1)
    return (
        adp.ChangingPlant(plant),
        cost,
        torch.cat((x0, true), -1),
        {"adaptive": safe, "none": wanted},
        0.01,
        2000,
    )


def pendulum(rows: int, generator: torch.Generator) -> Example:
    mass = length = 0.7

    def regressor(x: Tensor, u: Tensor) -> Tensor:
        pushed = torch.stack((x[..., 0].sin() / length, -x[..., 1] / (mass * length**2)), dim=-1)
        return torch.stack((torch.zeros_like(pushed), pushed), dim=-2)

    def known(x: Tensor, u: Tensor) -> Tensor:
        return torch.cat((x[..., 1:], u / (mass * length**2)), dim=-1)

    plant = adp.ParametricPlant(regressor, known, dim=2, inputs=1, theta=[10.0, 1.5], rows=[1])
    cost = adp.QuadraticCost(1.0, 10.0, dim=2, inputs=1)
    # What is wanted lies beyond the edge, so that the constraint is active for most of the time.
    wanted = adp.Feedback(lambda x: -10 * (x[..., :1] - 1.0) - 3 * x[..., 1:])
    windows = adp.IntegralWindows(plant, 0.1, first=0.02)
    law = adp.LeastSquares([10.0, 1.5], deviation=[3.0, 1.5], floor=1e-4)
    box = {"theta_low": [7.0, 0.0], "theta_high": [13.0, 3.0]}

    def upright(x: Tensor, t: Tensor) -> Tensor:
        return (math.pi / 4) ** 2 - x[:, 0].square()

    safe = adp.RobustFilter(wanted, plant, upright, windows, law, dt=0.01, decay=5.0, **box)
    drawn = torch.rand(rows, 4, generator=generator, dtype=torch.float64)
    true = torch.stack((7 + 6 * drawn[:, 0], 3 * drawn[:, 1]), dim=-1)
    angle = 0.7 * (2 * drawn[:, 2] - 1)
    x0 = torch.stack((angle, angle.sign() * drawn[:, 3] * 0.3), dim=-1)
    return (
        adp.ChangingPlant(plant),
        cost,
        torch.cat((x0, true), -1),
        {"adaptive": safe, "none": wanted},
        0.01,
        1000,
    )


def main(rows: int, seed: int = 0) -> None:
    print("| example | filter | least h | rows with h < 0 | largest shortfall | theta error | CPU s |")
    print("|---|---|---|---|---|---|---|")
    for example in (double_integrator, pendulum):
        truth, cost, given, controllers, dt, steps = example(rows, torch.Generator().manual_seed(seed))
        n = truth.own
        z0 = truth.start(given[:, :n], given[:, n:])
        safe = controllers["adaptive"]
        assert isinstance(safe, adp.RobustFilter)
        for name, inner in controllers.items():
            began = time.process_time()
            seen = adp.Measured(inner, noise=0.0, dim=n)
            run = adp.simulate(seen, truth, truth.cost(cost), z0, dt=dt, steps=steps, every=1, compile=True)
            spent = time.process_time() - began
            h = safe.filter.margins(run.state).amin(-1).amin(-1)
            shortfall = error = float("nan")
            if name == "adaptive":
                now = safe.guarded(run.identifier[:, -1])
                shortfall = float(now.slack.max())
                error = float((now.estimate.theta - given[:, n:]).abs().max())
            print(
                f"| {example.__name__} | {name} | {h.min():.3g} | {int((h < 0).sum())} of {rows} "
                f"| {shortfall:.2g} | {error:.2g} | {spent:.1f} |"
            )


if __name__ == "__main__":
    main(*map(int, sys.argv[1:] or [200]))

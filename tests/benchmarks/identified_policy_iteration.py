"""`adp.PolicyIteration` on a drift that is identified while it controls: what 200 fresh states cost.

    python tests/benchmarks/identified_policy_iteration.py [--states 200] [--seed 1] [--episodes 20]
        [--noise 0] [--start 1]

The two-state plant of the paper, x' = theta's(x) + g(x) u with theta (3, 2) unknown, 0 at first; 10 s at 5
ms from uniform states of [-2, 2]^2. Only x is measured; `AdaptiveActorCritic` finds theta by least squares
from integrals, and the weights rest at those of --start x'x while the Bellman equation is in doubt. Four
rows: no learning, these weights throughout; the drift known; nothing known at the beginning of each state's
first and only episode; and what one learner knows after its own episodes, one after the other, from other
states. Prints the cost over V* where the state is regulated: |x| < 1e-3 at the end, with noise 20 standard
deviations of it. Not collected by pytest.
"""

from __future__ import annotations

import argparse

import torch
from torch import Tensor

from staf_torch import (
    AnchoredKernel,
    GaussianKernel,
    StaFBasis,
    StateFollowingCenters,
    StateRadius,
    adp,
    rings,
    systems,
)
from staf_torch.adp.tracking import regressor, true_parameters

_DT, _STEPS = 0.005, 2000
PLANT, COST = systems.TwoState(), adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)


def both_rows(x: Tensor, u: Tensor) -> Tensor:
    """Y(x), (..., 2, 6): three unknown factors in each rate."""
    s = regressor(x)
    zero = torch.zeros_like(s)
    return torch.stack((torch.cat((s, zero), -1), torch.cat((zero, s), -1)), dim=-2)


def pushed(x: Tensor, u: Tensor) -> Tensor:
    """g(x) u, which is known."""
    return (PLANT.effectiveness(x) * u.unsqueeze(-2)).sum(-1)


def learners(noise: float, start: float) -> tuple[adp.ActorCritic, adp.ActorCritic, adp.AdaptiveActorCritic]:
    """That does not learn, on the drift itself, and on one that is identified."""
    centers = StateFollowingCenters(rings(3), StateRadius(0.7, offset=1e-5))
    basis = adp.StaFValueBasis(StaFBasis(AnchoredKernel(GaussianKernel(4.0)), centers))
    points = adp.QuadraturePoints(order=3, dim=2, half_width=0.2)
    first = 5.56 * start
    laws = adp.Frozen(), adp.PolicyIteration()
    still, learner = (
        adp.ActorCritic(basis, PLANT, COST, points, law, critic=first, actor=first) for law in laws
    )
    model = adp.ParametricPlant(both_rows, pushed, dim=2, inputs=1, theta=[0.0] * 6)
    windows = adp.IntegralWindows(model, _DT)
    if noise:
        windows = adp.IntegralWindows(model, 0.16, shape="smooth", first=0.02, noise=noise)
    law = adp.LeastSquares([0.0] * 6, deviation=3.0, floor=1e-6)
    return still, learner, adp.AdaptiveActorCritic(learner, model, windows, law)


def measure(controller: adp.Controller, x0: Tensor, noise: float) -> tuple[list[str], adp.LoopResult]:
    """What the regulated states cost over the optimum, and how many they are."""
    seen = adp.Measured(controller, noise=noise, dim=2) if noise else controller
    run = adp.simulate(seen, PLANT, COST, x0, dt=_DT, steps=_STEPS, every=10, compile=True)
    ratio = run.cost / PLANT.optimal_value(x0, COST.q, COST.r)
    near = 20 * noise if noise else 1e-3
    fine = (run.state[:, -1].norm(dim=1) < near) & ~run.diverged
    ratio = ratio[fine]
    row = [f"{int(fine.sum())} of {len(x0)}", *(f"{float(v):.4f}" for v in (ratio.mean(), ratio.max()))]
    return row, run


def uniform(count: int, generator: torch.Generator) -> Tensor:
    return 4 * torch.rand(count, 2, generator=generator, dtype=torch.float64) - 2


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--states", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--noise", type=float, default=0.0, help="standard deviation of the measured states")
    parser.add_argument("--start", type=float, default=1.0, help="the first value over x'x")
    settings = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(settings.seed)
    generator = torch.Generator().manual_seed(settings.seed)
    x0, noise = uniform(settings.states, generator), settings.noise
    still, known, identified = learners(noise, settings.start)
    print("| drift | regulated | cost over V*, mean | largest | weights moved, share | parameter error |")
    print("|---|---|---|---|---|---|")
    for label, learner, share in (("no learning", still, 0), ("known", known, 1)):
        row, _ = measure(learner, x0, noise)
        print(f"| {label} | {' | '.join(row)} | {share} | - |")
    row, run = measure(identified, x0, noise)
    print(f"| unknown, first episode | {' | '.join(row)} | {' | '.join(_known(identified, run))} |")
    learned = identified
    for _ in range(settings.episodes):
        _, run = measure(learned, uniform(1, generator), noise)
        estimate = identified.knowledge(run.identifier).estimate
        learned = identified.knowing(adp.Estimate(*(part[0, -1] for part in estimate)))
    row, run = measure(learned, x0, noise)
    label = f"unknown, after {settings.episodes} episodes"
    print(f"| {label} | {' | '.join(row)} | {' | '.join(_known(identified, run))} |")


def _known(learner: adp.AdaptiveActorCritic, run: adp.LoopResult) -> list[str]:
    """Share of the times at which the weights moved, and the largest error of a parameter at the end."""
    now = learner.knowledge(run.identifier)
    error = now.estimate.theta[:, -1] - true_parameters().mT.flatten()
    return [f"{float(now.certain.mean()):.3f}", f"{float(error.abs().max()):.2g}"]


if __name__ == "__main__":
    main()

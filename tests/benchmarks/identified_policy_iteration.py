"""`adp.PolicyIteration` on a drift that is identified while it controls: what 200 fresh states cost.

    python tests/benchmarks/identified_policy_iteration.py [--states 200] [--gain GAIN]

The two-state plant of the paper, x' = theta's(x) + g(x) u with theta (3, 2) unknown, 0 at first; 10 s at 5 ms
from uniform states of [-2, 2]^2, an episode each, which begins with nothing known. The rate x' is measured
without noise, as in `experiment=adp_tracking`; concurrent learning identifies theta, and the weights rest at
those of x'x until six pairs are remembered. Prints the cost over V* where the state is regulated (|x| < 1e-3
at the end), and the same with the drift known. Not collected by pytest.
"""

from __future__ import annotations

import argparse
import json

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
from staf_torch.adp.tracking import parametric_drift, regressor

GAIN = 5000.0
_PAIRS = 6  # that are remembered before the weights move
_DT, _STEPS = 0.005, 2000
PLANT, COST = systems.TwoState(), adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)


class Believed(systems.ControlAffineSystem):
    """The plant with a drift of the moment, a theta (..., 3, 2) a row."""

    dim, inputs = 2, 1

    def __init__(self, theta: Tensor) -> None:
        super().__init__()
        self.theta = theta

    def drift(self, x: Tensor) -> Tensor:
        return parametric_drift(self.theta, x)

    def effectiveness(self, x: Tensor) -> Tensor:
        return PLANT.effectiveness(x)


class Identifying(adp.Controller):
    """The learner on the drift that is believed now."""

    def __init__(self, learner: adp.ActorCritic, identifier: adp.ConcurrentLearning) -> None:
        super().__init__()
        self.learner, self.identifier, self.draws = learner, identifier, learner.draws

    def init(self, x0: Tensor) -> tuple[adp.ControllerState, adp.Identified]:
        return self.learner.init(x0), self.identifier.init(x0.new_zeros(len(x0), 3, 2))

    def step(
        self, x: Tensor, carried: tuple[adp.ControllerState, adp.Identified], uniform: Tensor, dt: float
    ) -> tuple[Tensor, tuple[adp.ControllerState, adp.Identified]]:
        weights, known = carried
        u, moved = self.learner.step_with(Believed(known.theta.unsqueeze(-3)), x, weights, uniform, dt)
        enough = (known.regressors.square().sum(-1) > 0).sum(-1) >= _PAIRS
        kept = (
            torch.where(enough[(..., *[None] * (new.dim() - 1))], new, old)
            for new, old in zip(moved, weights, strict=True)
        )
        measured = PLANT.drift(x)  # x' - g u
        return u, (adp.ControllerState(*kept), self.identifier.step(known, regressor(x), measured, dt))


def measure(controller: adp.Controller, x0: Tensor) -> dict[str, float | int]:
    """What the regulated states cost over the optimum, and how many they are."""
    compiles = isinstance(controller, adp.ActorCritic)  # eigenvalues of a stack of twenty do not pay
    run = adp.simulate(controller, PLANT, COST, x0, dt=_DT, steps=_STEPS, every=_STEPS, compile=compiles)
    ratio = run.cost / PLANT.optimal_value(x0, COST.q, COST.r)
    fine = (run.state[:, -1].norm(dim=1) < 1e-3) & ~run.diverged
    return {"regulated": int(fine.sum()), "mean": float(ratio[fine].mean()), "max": float(ratio[fine].max())}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--states", type=int, default=200)
    parser.add_argument("--gain", type=float, default=GAIN, help="of the identifier, 1/s")
    settings = parser.parse_args()
    torch.set_num_threads(1)
    generator = torch.Generator().manual_seed(1)
    x0 = 4 * torch.rand(settings.states, 2, generator=generator, dtype=torch.float64) - 2
    centers = StateFollowingCenters(rings(3), StateRadius(0.7, offset=1e-5))
    basis = adp.StaFValueBasis(StaFBasis(AnchoredKernel(GaussianKernel(4.0)), centers))
    points = adp.QuadraturePoints(order=3, dim=2, half_width=0.2)
    learner = adp.ActorCritic(basis, PLANT, COST, points, adp.PolicyIteration(), critic=5.56, actor=5.56)
    identifier = adp.ConcurrentLearning(3, 2, size=20, gain=settings.gain, novelty=0.01)
    found = {"known": measure(learner, x0), "identified": measure(Identifying(learner, identifier), x0)}
    print(json.dumps(found, indent=2))


if __name__ == "__main__":
    main()

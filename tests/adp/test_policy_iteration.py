"""The law that solves the Bellman equation of the moment: fixed points, Riccati, and the two-state plant."""

from __future__ import annotations

import pytest
import torch
from helpers_adp import COST, PLANT, uniform

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
from staf_torch.adp.laws import ActorCriticLaw, BellmanSums, Weights


def learner(plant: systems.ControlAffineSystem, critic: list[float], law: ActorCriticLaw) -> adp.ActorCritic:
    points = adp.QuadraturePoints(3, 2, half_width=0.5)
    return adp.ActorCritic(adp.QuadraticBasis(2), plant, COST, points, law, critic=critic, actor=critic)


def held(control: adp.ActorCritic, x: torch.Tensor, steps: int) -> torch.Tensor:
    """The critic weights after so many steps at a state that does not move."""
    carried = control.init(x)
    for _ in range(steps):
        carried = control.step(x, carried, x.new_zeros(len(x), 0, 2), 0.01)[1]
    return carried.critic


def test_weights_that_solve_the_hjb_equation_stay() -> None:
    exact = [0.5, 0.0, 1.0]  # of V*
    x = uniform(40, 2.0, seed=3)
    found = held(learner(PLANT, exact, adp.PolicyIteration()), x, 20)
    torch.testing.assert_close(found, torch.tensor(exact).double().expand(len(x), 3), rtol=0, atol=1e-10)


@pytest.mark.parametrize("start", [[3.0, 2.0, 2.0], [1.0, 2.0, 4.0]])
def test_a_linear_plant_gets_the_riccati_value_from_any_stabilising_start(start: list[float]) -> None:
    plant = systems.Linear([[0.0, 1.0], [0.3, 0.2]], [[0.0], [1.0]])
    p = adp.LQR(plant, COST).p
    wanted = torch.stack((p[0, 0], 2 * p[0, 1], p[1, 1]))
    found = held(learner(plant, start, adp.PolicyIteration(damping=1e-9, settling=1e-9)), uniform(5, 1.0), 40)
    torch.testing.assert_close(found, wanted.expand(5, 3), rtol=1e-6, atol=1e-6)


def test_a_short_step_is_the_law_in_continuous_time() -> None:
    generator = torch.Generator().manual_seed(0)
    w = torch.randn(7, 3, 3, dtype=torch.float64, generator=generator)
    force, critic, actor = torch.randn(3, 7, 3, dtype=torch.float64, generator=generator)
    zero = torch.zeros_like(w)
    sums = BellmanSums(force, w @ w.mT, zero, torch.zeros_like(force))
    law = adp.PolicyIteration(adp.Gains(1.0, 1.0, actor=7.0, actor_decay=0.5))
    now = Weights(critic, actor, zero)
    short = 1e-9
    for before, after, rate in zip(now, law.step(sums, now, short), law.rates(sums, now), strict=True):
        torch.testing.assert_close((after - before) / short, rate, rtol=1e-4, atol=1e-4)


def test_every_state_of_the_box_is_regulated_near_the_optimum_in_its_first_episode() -> None:
    centers = StateFollowingCenters(rings(3), StateRadius(0.7, offset=1e-5))
    basis = adp.StaFValueBasis(StaFBasis(AnchoredKernel(GaussianKernel(4.0)), centers))
    start = basis.weights_near_square()
    points = adp.QuadraturePoints(3, 2, half_width=0.2)
    law = adp.PolicyIteration()
    control = adp.ActorCritic(basis, PLANT, COST, points, law, critic=start, actor=start)
    x0 = uniform(60, 2.0, seed=11)
    run = adp.simulate(control, PLANT, COST, x0, dt=0.02, steps=250, every=250, compile=True)
    ratio = run.cost / (0.5 * x0[:, 0] ** 2 + x0[:, 1] ** 2)
    assert float(run.state[:, -1].norm(dim=-1).max()) < 0.05
    assert float(ratio.mean()) < 1.02
    assert float(ratio.max()) < 1.08

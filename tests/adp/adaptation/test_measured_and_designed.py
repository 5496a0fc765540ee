"""What is seen with noise, plants that change and designs that are under way, beside what is written out."""

from __future__ import annotations

import torch
from helpers import tensor, uniform
from helpers_adaptation import COST, PENDULUM

from staf_torch import adp, systems
from staf_torch.adp.adaptation.adaptive_lqr import Redesign
from staf_torch.adp.estimation import Belief
from staf_torch.numerics.riccati import riccati_rows


def test_a_plant_changes_when_its_clock_has_run_down() -> None:
    plant = adp.ChangingPlant(PENDULUM)
    assert (plant.dim, plant.inputs, plant.bounds) == (7, 1, None)
    x0 = uniform(3, 2, seed=1)
    z0 = plant.start(x0, [0.1, 1.0], [0.3, 3.0], at=tensor([0.0, 1.0, 4.0]))
    assert z0.dtype == torch.float64
    torch.testing.assert_close(z0[:, -1], (tensor([0.0, 1.0, 4.0]) / 10).exp())
    torch.testing.assert_close(plant.theta(z0), tensor([[0.3, 3.0], [0.1, 1.0], [0.1, 1.0]]))
    rate = plant.rate(z0, torch.ones(3, 1).double())
    torch.testing.assert_close(rate[:, -1], -z0[:, -1] / 10)
    assert not bool(rate[:, 2:-1].any())


def test_the_cost_of_a_changing_plant_is_that_of_its_state() -> None:
    plant = adp.ChangingPlant(PENDULUM)
    wide, z = plant.cost(COST), uniform(4, 7, seed=3)
    torch.testing.assert_close(wide.state_rate(z), COST.state_rate(z[:, :2]))


def test_a_design_that_went_wrong_keeps_the_one_before() -> None:
    q, r = torch.eye(2).double(), torch.eye(1).double()
    made = Redesign("here", COST, 6)
    a, b = uniform(2, 2, 2, seed=1), uniform(2, 2, 1, seed=2)
    good = made.step(torch.zeros(2, 2, 2).double(), a, b)
    torch.testing.assert_close(good, riccati_rows(a, b, q, r, doublings=6), rtol=0, atol=0)
    bad = a.clone()
    bad[1] = torch.nan
    assert torch.equal(made.step(good, bad, b), good)


def test_noise_of_a_filter_of_a_plant_in_steps_counts_by_its_period() -> None:
    plant = systems.StepPlant(
        lambda x, u: torch.stack((x[..., 0] + 0.1 * x[..., 1], 0.9 * x[..., 1] + u[..., 0]), -1),
        dim=2,
        inputs=1,
        dt=0.1,
        equilibrium=[0.0, 0.0],
    )
    x, u = uniform(4, 2, seed=1), uniform(4, 1, seed=2)
    for kind in (adp.ExtendedKalman, adp.UnscentedKalman):
        filter = kind(plant, lambda x: x[..., :1], noise=[0.1], process=[0.2, 0.5])
        size = torch.diag(tensor([0.3, 0.2])).expand(4, 2, 2)
        after = filter.predicted(Belief(x, size, u), 0.1)
        flow = tensor([[1.0, 0.1], [0.0, 0.9]])
        torch.testing.assert_close(after.mean, x @ flow.mT + torch.cat((0 * u, u), -1))
        wanted = flow @ size[0] @ flow.mT + torch.diag(tensor([0.04, 0.25])) * 0.1
        torch.testing.assert_close(after.covariance, wanted.expand(4, 2, 2))
        assert torch.equal(after.u, u)


def test_noise_has_the_deviations_that_are_asked_for() -> None:
    seen: list[torch.Tensor] = []

    def policy(x: torch.Tensor) -> torch.Tensor:
        seen.append(x)
        return 0 * x[..., :1]

    measured = adp.Measured(
        adp.Feedback(policy), noise=[0.5, 0.0, 2.0], dim=3, output=lambda x: x[..., [0, 1, 0]]
    )
    x, draws = torch.ones(20000, 2).double(), uniform(20000, measured.draws, 3, seed=1)
    measured.step(x, measured.init(x), draws, 0.1)
    (y,) = seen
    torch.testing.assert_close(y.mean(0), tensor([1.0, 1.0, 1.0]), rtol=0, atol=0.05)
    torch.testing.assert_close(y.std(0), tensor([0.5, 0.0, 2.0]), rtol=0.03, atol=0)
    assert abs(float(torch.corrcoef(y[:, [0, 2]].mT)[0, 1])) < 0.03

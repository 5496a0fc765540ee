"""Tracking as regulation, and the drift identified online."""

from __future__ import annotations

import pytest
import torch
from helpers_adp import staf_basis
from torch import Tensor

from staf_torch import adp, systems
from staf_torch.adp.tracking import desired_rate, feedforward, regressor, true_parameters

TRACKING = adp.TwoStateTracking()


def states(rows: int, dim: int, seed: int = 0) -> Tensor:
    return torch.randn(rows, dim, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def test_true_parameters_are_those_of_the_two_state_plant() -> None:
    x = states(50, 2)
    torch.testing.assert_close(regressor(x) @ true_parameters(), systems.TwoState().drift(x))


def test_error_plant_is_the_two_state_plant_seen_from_the_desired_state() -> None:
    x = states(50, 4)
    state, desired = x[:, :2] + x[:, 2:], x[:, 2:]
    plant = systems.TwoState()
    pushed = plant.effectiveness(state)[..., 0] * feedforward(desired, TRACKING.theta).unsqueeze(-1)
    error_rate = plant.drift(state) + pushed - desired_rate(desired)
    torch.testing.assert_close(TRACKING.drift(x), torch.cat((error_rate, desired_rate(desired)), dim=-1))
    on_track = torch.cat((torch.zeros(50, 2, dtype=torch.float64), desired), dim=-1)
    assert TRACKING.drift(on_track)[:, :2].abs().max() < 1e-14


def test_desired_trajectory_solves_its_equation() -> None:
    time = torch.linspace(0, 6, 50, dtype=torch.float64)
    slope = (adp.desired_trajectory(time + 1e-6) - adp.desired_trajectory(time - 1e-6)) / 2e-6
    torch.testing.assert_close(slope, desired_rate(adp.desired_trajectory(time)), rtol=1e-8, atol=1e-8)


def test_identified_drift_converges_and_the_error_with_it() -> None:
    cost = adp.tracking_cost(10.0, 1.0)
    basis = adp.LeadingCoordinates(staf_basis(), 4)
    learner = adp.ActorCritic(basis, TRACKING, cost, adp.RandomPoints(1, 0.3), critic=1.5, actor=1.5)
    x0 = torch.tensor([[-0.5, 0.5, 0.0, 1.0], [0.4, 0.2, 0.0, 1.0]], dtype=torch.float64)
    start = torch.zeros(3, 2, dtype=torch.float64)
    tracker = adp.IdentifyingTracker(learner, TRACKING, adp.ConcurrentLearning(3, 2, 6, gain=5.0), start)
    known = adp.simulate(learner, TRACKING, cost, x0, dt=0.01, steps=500, every=10, compile=True)
    run = adp.simulate(tracker, TRACKING, cost, x0, dt=0.01, steps=500, every=10, compile=True)
    assert not run.diverged.any()
    theta = run.identifier[:, -1, :6].reshape(2, 3, 2)
    assert (theta - true_parameters()).abs().max() < 5e-3
    assert (run.state[:, -1, :2].norm(dim=-1) < 2e-2).all()
    assert (known.state[:, -1, :2].norm(dim=-1) < 2e-2).all()
    torch.testing.assert_close(run.state[:, :, 2:], known.state[:, :, 2:], rtol=1e-9, atol=1e-9)


def test_memory_alone_identifies_where_the_present_excites_nothing() -> None:
    truth = states(3, 2, seed=5)
    law = adp.ConcurrentLearning(3, 2, size=5, gain=10.0)
    state = law.init(torch.zeros(1, 3, 2, dtype=torch.float64))
    for row in states(5, 3, seed=6):
        state = law.step(state, row.unsqueeze(0), row.unsqueeze(0) @ truth, 0.01)
    for _ in range(800):
        still = torch.zeros(1, 3, dtype=torch.float64)
        state = law.step(state, still, still @ truth, 0.05)
    torch.testing.assert_close(state.theta[0], truth, rtol=1e-6, atol=1e-6)


def test_least_singular_value_of_the_full_stack_never_falls() -> None:
    law = adp.ConcurrentLearning(3, 2, size=4)
    state = law.init(torch.zeros(2, 3, 2, dtype=torch.float64))
    least = torch.zeros(2, dtype=torch.float64)
    first = None
    for row in states(200, 3, seed=7).unsqueeze(1) * torch.tensor([[1.0], [3.0]], dtype=torch.float64):
        state = law.remember(state, row, row[..., :2])
        now = torch.linalg.svdvals(state.regressors)[..., -1]
        full = (state.regressors.square().sum(-1) > 0).all(-1)
        assert (~full | (now >= least * (1 - 1e-12))).all()
        least = torch.where(full, now, least)
        first = least.clone() if first is None and bool(full.all()) else first
    assert first is not None
    assert (least > 2 * first).all()
    torch.testing.assert_close(state.rates, state.regressors[..., :2])


def test_bad_arguments_are_refused_by_name() -> None:
    with pytest.raises(ValueError, match=r"`TwoStateTracking\(theta=...\)` must be \(..., 3, 2\)"):
        adp.TwoStateTracking([[1.0, 2.0]])
    with pytest.raises(ValueError, match=r"`TwoStateTracking\(theta=...\)` must be"):
        adp.TwoStateTracking(torch.full((3, 2), torch.nan, dtype=torch.float64))
    with pytest.raises(ValueError, match=r"`ConcurrentLearning\(size=...\)` must be at least 3"):
        adp.ConcurrentLearning(3, 2, size=2)
    with pytest.raises(ValueError, match=r"`LeadingCoordinates\(dim=...\)` must be at least 2"):
        adp.LeadingCoordinates(staf_basis(), 1)
    with pytest.raises(ValueError, match=r"`QuadraticCost\(state=...\)` must be positive"):
        adp.tracking_cost(-1.0, 1.0)


def test_a_full_stack_takes_a_pair_only_where_the_least_eigenvalue_grows() -> None:
    """Of vectors along the axes the eigenvalues are exact: along an axis that is known, nothing grows."""
    learning = adp.ConcurrentLearning(2, 1, size=2)
    known = learning.init(torch.zeros(1, 2, 1).double())
    y, kept = torch.ones(1, 1).double(), known
    for s in ([2.0, 0.0], [3.0, 0.0]):
        kept = learning.remember(kept, torch.tensor([s]).double(), y)
    again = learning.remember(kept, torch.tensor([[5.0, 0.0]]).double(), y)
    assert torch.equal(again.regressors, kept.regressors)
    other = learning.remember(kept, torch.tensor([[0.0, 1.0]]).double(), y)
    assert other.regressors.tolist() == [[[2.0, 0.0], [0.0, 1.0]]] or other.regressors.tolist() == [
        [[0.0, 1.0], [3.0, 0.0]]
    ]
    better = learning.remember(other, torch.tensor([[0.0, 2.0]]).double(), y)
    assert bool((torch.linalg.eigvalsh(better.regressors.mT @ better.regressors)[:, 0] > 1.0).all())

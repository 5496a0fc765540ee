"""A drift without a form: the filter of its weights, what it says of itself, and the policy on it."""

from __future__ import annotations

import pytest
import torch
from helpers import changed, tensor, uniform
from torch import Tensor

from staf_torch import GaussianKernel, adp, rings, systems
from staf_torch.adp.adaptation.drift import DriftEstimate
from staf_torch.adp.adaptation.identification import Equation

KNOWN = systems.Linear([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])
COST = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
CENTERS = 0.5 * rings(3)


def made(**settings: object) -> adp.StreamDrift:
    given = {"rows": [1], "deviation": 3.0, "length": 0.05, "floor": 1e-3} | settings
    return adp.StreamDrift(KNOWN, GaussianKernel(2.0), CENTERS, **given)  # type: ignore[arg-type]


def equation(drift: adp.StreamDrift, now: DriftEstimate, x: Tensor, z: Tensor) -> Equation:
    """That the drift at x is z / length, as a window in which the state rests would say."""
    s = drift.windows.length * drift.window_of(now).model.regressor(x, x[..., :1])[..., drift.rows, :]
    return Equation(s, z, torch.zeros(len(x)).double(), torch.ones(len(x)).bool())


def test_without_moving_centers_the_posterior_is_that_of_the_gaussian_process() -> None:
    # Where samples are at the centers no part of the process is left out: the joint normal is exact.
    drift = made()
    at, z = drift.offsets, tensor([[0.3], [-0.1], [0.2]])
    now = drift.init(torch.zeros(1, 2).double())
    for x, value in zip(at.unsqueeze(1), z.unsqueeze(1), strict=True):
        now = drift.step(now, equation(drift, now, x, value), x, 0.05)
    tried = tensor([[0.2, 0.1], [0.4, -0.3]])

    def covariance(x: Tensor, y: Tensor) -> Tensor:  # of d = a'e with independent a_j
        return 9.0 * drift.kernel(x, y) * (x @ y.mT)

    length = drift.windows.length
    gram = length**2 * covariance(at, at) + drift.floor**2 * torch.eye(3).double()
    across = length * covariance(tried, at)
    wanted = across @ torch.linalg.solve(gram, z)
    mean, _ = drift.predict(DriftEstimate(*(part.expand(2, *part.shape[1:]) for part in now)), tried)
    # Between the centers the local functions are an interpolation: it errs by what the rest has.
    torch.testing.assert_close(mean, wanted, rtol=0.02, atol=0.02)
    at_centers, spread = drift.predict(DriftEstimate(*(part.expand(3, *part.shape[1:]) for part in now)), at)
    torch.testing.assert_close(
        at_centers, length * covariance(at, at) @ torch.linalg.solve(gram, z), rtol=1e-9, atol=1e-9
    )
    left = covariance(at, at) - length**2 * covariance(at, at) @ torch.linalg.solve(gram, covariance(at, at))
    torch.testing.assert_close(spread[:, 0], left.diagonal().sqrt(), rtol=1e-6, atol=1e-7)


def test_moved_centers_keep_what_was_known_and_own_up_to_what_they_lost() -> None:
    drift = made()
    start = torch.zeros(1, 2).double()
    now = drift.init(start)
    for x in 0.6 * uniform(40, 1, 2, seed=3):
        now = changed(now, anchor=start)  # keep them, whatever x is
        now = drift.step(now, equation(drift, now, x, x.sum(-1, keepdim=True)), start, 0.05)
    x = tensor([[0.4, 0.45]])  # beyond the ball of 0.5
    s, z, variance, ready = equation(drift, now, x, x[:, :1])
    ended = Equation(0 * s, 0 * z, variance, ready)  # says nothing, but a window ends
    moved = drift.step(now, ended, x, 0.05)
    assert torch.equal(moved.anchor, x)
    before, after = drift.predict(now, x), drift.predict(moved, x)
    torch.testing.assert_close(after[0], before[0], rtol=0.02, atol=0.05)
    assert float(after[1]) >= float(before[1]) * 0.98
    far, spread = drift.predict(moved, x + 20.0)
    assert abs(float(far)) < 1e-6
    assert float(spread) == pytest.approx(3.0 * float((x + 20.0).norm()))  # the prior's


@pytest.fixture(scope="module")
def learned() -> tuple[adp.DriftLQR, adp.LoopResult, Tensor]:
    plant = systems.TwoState()
    known = _WithoutSecond(plant)
    drift = adp.StreamDrift(
        known, GaussianKernel(3.0), CENTERS, rows=[1], deviation=3.0, length=0.04, floor=1e-4
    )
    control = adp.DriftLQR(drift, COST, doublings=10)
    x0 = tensor([[1.5, -1.0], [-1.0, 1.5], [0.5, 1.0]])
    run = adp.simulate(control, plant, COST, x0, dt=0.04, steps=50, compile=False)
    return control, run, plant.optimal_value(x0, COST.q, COST.r)  # type: ignore[return-value]


class _WithoutSecond(systems.ControlAffineSystem):
    dim, inputs = 2, 1

    def __init__(self, plant: systems.ControlAffineSystem) -> None:
        super().__init__()
        self.plant = plant

    def drift(self, x: Tensor) -> Tensor:
        return self.plant.drift(x) * torch.tensor([1.0, 0.0]).to(x)

    def effectiveness(self, x: Tensor) -> Tensor:
        return self.plant.effectiveness(x)


def test_an_unknown_drift_is_learned_well_enough_to_regulate_near_the_optimum(learned) -> None:
    control, run, best = learned
    assert float((run.cost / best).max()) < 1.15
    ignorant = adp.Feedback(adp.LQR(control.model, COST))
    blind = adp.simulate(ignorant, systems.TwoState(), COST, run.state[:, 0], dt=0.04, steps=80)
    assert float((blind.cost / best).min()) > 1.5  # that is not because nothing had to be known


def test_the_robust_policy_has_the_control_until_the_model_is_certain(learned) -> None:
    control, run, _ = learned
    certain = run["certain"][:, 1:].bool()
    assert not certain[:, 0].any()
    assert certain[:, 5:].double().mean() > 0.9
    x, u = run.state[:, :-1], run.control[:, :-1]
    torch.testing.assert_close(u[~certain], control.robust(x)[~certain])
    assert float((u - control.robust(x))[certain].abs().max()) > 0.1

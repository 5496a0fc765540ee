"""The filter around an estimate: Kalman's where theta is known, and what an error of theta does to it."""

from __future__ import annotations

import math

import pytest
import torch
from helpers import tensor, uniform
from helpers_adaptation import PENDULUM

from staf_torch import adp, systems

DT = 0.05


def estimate(theta: torch.Tensor, variance: float) -> adp.Estimate:
    eye = torch.eye(theta.shape[-1]).to(theta).expand(*theta.shape, -1)
    zero = torch.zeros_like(theta[..., 0])
    return adp.Estimate(theta, variance * eye, zero, zero)


def test_where_theta_is_known_the_filter_is_that_of_kalman() -> None:
    rows, theta = 4, tensor([[0.1, 1.0]]).expand(4, 2)
    own = adp.ConsiderFilter(PENDULUM, noise=[0.1, 0.3], process=[0.05, 0.2])
    kalman = adp.ExtendedKalman(PENDULUM, lambda x: x, noise=[0.1, 0.3], process=[0.05, 0.2])
    y, u = uniform(rows, 2, seed=1), uniform(rows, 1, seed=2)
    now = own.step(own.init(y), y, u, estimate(theta, 0.0), DT)
    belief = adp.Belief(now.mean, now.covariance, u)
    for k in range(3):
        y = uniform(rows, 2, seed=3 + k)
        now = own.step(now, y, u, estimate(theta, 0.0), DT)
        belief = kalman.step(belief, y, DT, torch.zeros(rows, dtype=torch.bool))
        torch.testing.assert_close(now.mean, belief.mean)
        torch.testing.assert_close(now.covariance, belief.covariance)


def test_once_theta_is_found_the_mean_is_where_it_would_have_been_with_that_theta_from_the_start() -> None:
    # x' = theta u is linear in theta, and measured without noise: no other error is in the mean.
    plant = adp.ParametricPlant(lambda x, u: u.unsqueeze(-1), dim=1, inputs=1, theta=[2.0])
    filter, x, u = adp.ConsiderFilter(plant, noise=0.3), tensor([[0.5]]), tensor([[1.5]])
    doubt = estimate(tensor([[1.0]]), 0.25)
    now = filter.step(filter.init(x), x, u, doubt, DT)
    for _ in range(6):
        x = x + DT * 2.0 * u
        now = filter.step(now, x, u, doubt, DT)
    assert float((now.mean - x).abs()) > 0.01
    torch.testing.assert_close(now.mean + now.sensitivity[..., 0] * 1.0, x)
    x = x + DT * 2.0 * u
    torch.testing.assert_close(filter.step(now, x, u, estimate(tensor([[2.0]]), 0.0), DT).mean, x)


def test_the_less_is_known_of_theta_the_more_a_measurement_counts() -> None:
    filter, theta, u = adp.ConsiderFilter(PENDULUM, noise=0.01), tensor([[0.1, 1.0]]), tensor([[2.0]])
    shares = []
    for variance in (0.0, 0.1, 1.0, 1e6):
        now = filter.init(tensor([[0.3, 0.0]]))
        for k in range(5):
            before, y = now, tensor([[0.3, 0.1 * k]])
            now = filter.step(now, y, u, estimate(theta, variance), DT)
        away = filter.step(before, y + tensor([[0.0, 1.0]]), u, estimate(theta, variance), DT)
        shares.append(float((away.mean - now.mean)[0, 1]))
    assert shares == sorted(shares)
    assert shares[0] < 0.7
    assert shares[-1] > 0.999


DRAGGED = [[-1.0, -4.0], [1.0, 4.0]]  # the box of a pendulum whose mass is not known


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_behind_a_barrier_the_mean_of_the_filter_costs_less_than_what_is_measured(factor: float) -> None:
    plant = adp.ParametricPlant.of_effectiveness(systems.Pendulum())
    box, truth = (systems.Barrier(each, *DRAGGED) for each in (plant, plant.believing(tensor([1 / factor]))))
    model, cost = adp.ParametricPlant.of_barrier(box), adp.QuadraticCost(1.0, 1.0, 2, 1)
    s0 = box.transform(torch.stack((uniform(20, seed=4) * 0.4, uniform(20, seed=5) * 0.5), dim=-1))
    paid = {}
    for filtered in (False, True):
        windows = adp.IntegralWindows(plant, 0.05, states=box.inverse)
        law = adp.LeastSquares([1.0], deviation=0.5, floor=1e-6)
        filter = adp.ConsiderFilter(model, noise=0.01) if filtered else None
        adaptive = adp.AdaptiveLQR(model, cost, windows, law, filter=filter, doublings=7)  # a short program
        own = adp.Measured(adaptive, noise=0.01, dim=2)
        run = adp.simulate(own, truth, cost, s0, dt=0.005, steps=600, every=20, compile=True)
        assert not bool(run.diverged.any())
        assert float(box.margin(run.state).min()) > 0.2
        paid[filtered] = run.cost
    assert float(paid[True].mean()) < float(paid[False].mean())


@pytest.mark.parametrize("wrong", [0.0, -0.1, math.nan, [0.1], [0.1, 0.1, 0.1], "0.1"])
def test_noise_that_cannot_be_is_refused(wrong: object) -> None:
    with pytest.raises(ValueError, match="noise"):
        adp.ConsiderFilter(PENDULUM, noise=wrong)  # type: ignore[arg-type]
    if wrong != 0.0:
        with pytest.raises(ValueError, match="process"):
            adp.ConsiderFilter(PENDULUM, noise=0.1, process=wrong)  # type: ignore[arg-type]


def test_a_filter_of_other_states_is_refused() -> None:
    other = adp.ConsiderFilter(adp.ParametricPlant.of_effectiveness(systems.CartPole()), noise=0.1)
    cost, law = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1), adp.LeastSquares([0.1, 1.0], 1.0)
    with pytest.raises(ValueError, match="filter"):
        adp.AdaptiveLQR(PENDULUM, cost, adp.IntegralWindows(PENDULUM, 0.1), law, filter=other)


def test_what_noise_was_given_is_kept_to_the_last_bit() -> None:
    for given in (0.1, [0.1, 0.3]):
        made = adp.ConsiderFilter(PENDULUM, noise=given, process=0.7)
        wanted = torch.tensor([0.1, 0.1] if given == 0.1 else given, dtype=torch.float64)
        assert torch.equal(made.noise, wanted)
        assert torch.equal(made.process, torch.tensor([0.7, 0.7], dtype=torch.float64))

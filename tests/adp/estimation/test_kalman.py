"""Kalman filters: exact on a linear plant, the same compiled, and in front of any controller."""

from __future__ import annotations

import pytest
import torch
from helpers import tensor, uniform
from helpers_adaptation import PENDULUM
from torch import Tensor

from staf_torch import adp, systems
from staf_torch.adp.adaptation.identification import Estimate
from staf_torch.adp.estimation import Belief, KalmanFilter
from staf_torch.adp.loop.step import ClosedLoop, program

LINEAR = systems.Linear([[0.0, 1.0, 0.0], [2.0, -0.5, 1.0], [0.0, 0.3, -1.0]], [[0.0], [1.0], [0.5]])
C = tensor([[1.0, 0.0, 0.5], [0.0, 1.0, 0.0]])
NOISE, PROCESS, DT = [0.1, 0.3], [0.05, 0.1, 0.2], 0.05
KINDS = (adp.ExtendedKalman, adp.UnscentedKalman)


def outputs(x: Tensor) -> Tensor:
    return (C.to(x) * x.unsqueeze(-2)).sum(-1)


def believed(rows: int) -> Belief:
    root = uniform(rows, 3, 3, seed=1) + torch.eye(3).double()
    return Belief(uniform(rows, 3, seed=2), root @ root.mT, uniform(rows, 1, seed=3))


@pytest.mark.parametrize("kind", KINDS)
def test_on_a_linear_plant_a_filter_is_that_of_kalman(kind: type[KalmanFilter]) -> None:
    filter, belief, y = (
        kind(LINEAR, outputs, noise=NOISE, process=PROCESS),
        believed(4),
        uniform(4, 2, seed=4),
    )
    a, b = DT * LINEAR.matrix, DT * LINEAR.input_matrix
    series = torch.eye(3).double() + a / 2 + a @ a / 6 + a @ a @ a / 24  # a step of Runge-Kutta, exactly
    flow = torch.eye(3).double() + series @ a
    mean = belief.mean @ flow.mT + belief.u @ (series @ b).mT
    covariance = flow @ belief.covariance @ flow.mT + torch.diag(DT * tensor(PROCESS) ** 2)
    gain = covariance @ C.mT @ torch.linalg.inv(C @ covariance @ C.mT + torch.diag(tensor(NOISE) ** 2))
    wanted = mean + ((y - mean @ C.mT).unsqueeze(-2) @ gain.mT).squeeze(-2)
    got = filter.step(belief, y, DT, torch.zeros(4, dtype=torch.bool))
    torch.testing.assert_close(got.mean, wanted, rtol=1e-11, atol=1e-12)
    torch.testing.assert_close(got.covariance, covariance - gain @ C @ covariance, rtol=1e-11, atol=1e-11)
    begun = filter.step(belief, y, DT, torch.ones(4, dtype=torch.bool))  # no time has passed
    at_once = filter.corrected(belief, y)
    torch.testing.assert_close(begun.mean, at_once.mean, rtol=0, atol=0)


@pytest.mark.parametrize("kind", KINDS)
def test_an_unstable_pendulum_is_held_by_its_angle_alone(kind: type[KalmanFilter]) -> None:
    plant, cost = systems.Pendulum(), adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
    filter = kind(plant, lambda x: x[..., :1].sin(), noise=[0.01], process=0.02)
    inside = adp.Observed(adp.Feedback(adp.LQR(plant, cost)), filter, deviation=0.5)
    seen = adp.Measured(inside, noise=0.01, dim=1, output=lambda x: x[..., :1].sin())
    x0 = tensor([[0.3, -0.4], [-0.4, 0.2], [0.0, 0.5]])
    run = adp.simulate(seen, plant, cost, x0, dt=0.02, steps=120, compile=False)
    assert float(run.state[:, -20:].norm(dim=-1).max()) < 0.25
    away = (run["mean"] - run.state)[:, 60:]
    sigmas = away / run["covariance"][:, 60:].diagonal(dim1=-2, dim2=-1).sqrt()
    assert 0.3 < float(sigmas.square().mean()) < 3.0  # it knows how much it does not know
    torch.testing.assert_close(run.carried.belief.u, run.control[:, -2])


@pytest.mark.needs_compiler
@pytest.mark.parametrize("kind", KINDS)
def test_compiled_filters_are_those_of_the_definition_row_by_row(kind: type[KalmanFilter]) -> None:
    plant = systems.Linear([[0.0, 1.0], [2.0, -0.5]], [[0.0], [1.0]])  # two states: a shorter program
    cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)

    def seen(x: Tensor) -> Tensor:
        return torch.stack((x[..., 0] + 0.5 * x[..., 1], x[..., 1]), dim=-1)

    filter = kind(plant, seen, noise=NOISE, process=PROCESS[:2])
    inside = adp.Observed(adp.Feedback(adp.LQR(plant, cost)), filter, deviation=1.0)
    loop = ClosedLoop(adp.Measured(inside, noise=0.1, dim=2, output=seen), plant, cost, dt=DT)
    steps, x0 = program(loop, True), uniform(7, 2, seed=1)
    draws, state = uniform(7, 20, loop.controller.draws, 2, seed=2), loop.init(x0)
    assert steps.compiles(state, draws)
    got, want = steps(state, draws)[0], steps.definition(state, draws)[0]
    torch.testing.assert_close(got.x, want.x, rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(got.carried, want.carried, rtol=1e-10, atol=1e-10)
    alone = steps(loop.init(x0[:3]), draws[:3])[0]
    assert torch.equal(alone.carried.belief.mean, got.carried.belief.mean[:3])


DT = 0.05


def estimate(theta: torch.Tensor, variance: float) -> Estimate:
    eye = torch.eye(theta.shape[-1]).to(theta).expand(*theta.shape, -1)
    zero = torch.zeros_like(theta[..., 0])
    return Estimate(theta, variance * eye, zero, zero)


def test_where_theta_is_known_the_filter_is_that_of_kalman() -> None:
    rows, theta = 4, tensor([[0.1, 1.0]]).expand(4, 2)
    own = adp.ConsiderFilter(PENDULUM, noise=[0.1, 0.3], process=[0.05, 0.2])
    kalman = adp.ExtendedKalman(PENDULUM, lambda x: x, noise=[0.1, 0.3], process=[0.05, 0.2])
    y, u = uniform(rows, 2, seed=1), uniform(rows, 1, seed=2)
    now = own.step(own.init(y), y, u, estimate(theta, 0.0), DT)
    belief = Belief(now.mean, now.covariance, u)
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

"""Kalman filters: exact on a linear plant, the same compiled, and in front of any controller."""

from __future__ import annotations

import pytest
import torch
from helpers import tensor, uniform
from torch import Tensor

from staf_torch import adp, systems
from staf_torch.adp.closed_loop import ClosedLoop, program

LINEAR = systems.Linear([[0.0, 1.0, 0.0], [2.0, -0.5, 1.0], [0.0, 0.3, -1.0]], [[0.0], [1.0], [0.5]])
C = tensor([[1.0, 0.0, 0.5], [0.0, 1.0, 0.0]])
NOISE, PROCESS, DT = [0.1, 0.3], [0.05, 0.1, 0.2], 0.05
KINDS = (adp.ExtendedKalman, adp.UnscentedKalman)


def outputs(x: Tensor) -> Tensor:
    return (C.to(x) * x.unsqueeze(-2)).sum(-1)


def believed(rows: int) -> adp.Belief:
    root = uniform(rows, 3, 3, seed=1) + torch.eye(3).double()
    return adp.Belief(uniform(rows, 3, seed=2), root @ root.mT, uniform(rows, 1, seed=3))


@pytest.mark.parametrize("kind", KINDS)
def test_on_a_linear_plant_a_filter_is_that_of_kalman(kind: type[adp.KalmanFilter]) -> None:
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
def test_an_unstable_pendulum_is_held_by_its_angle_alone(kind: type[adp.KalmanFilter]) -> None:
    plant, cost = systems.Pendulum(), adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
    filter = kind(plant, lambda x: x[..., :1].sin(), noise=[0.01], process=0.02)
    inside = adp.Observed(adp.Feedback(adp.LQR(plant, cost)), filter, deviation=0.5)
    seen = adp.Measured(inside, noise=0.01, dim=1, output=lambda x: x[..., :1].sin())
    x0 = tensor([[0.3, -0.4], [-0.4, 0.2], [0.0, 0.5]])
    run = adp.simulate(seen, plant, cost, x0, dt=0.02, steps=120, compile=False)
    assert float(run.state[:, -20:].norm(dim=-1).max()) < 0.25
    belief = inside.belief(run.identifier)
    away = (belief.mean - run.state)[:, 60:]
    sigmas = away / belief.covariance[:, 60:].diagonal(dim1=-2, dim2=-1).sqrt()
    assert 0.3 < float(sigmas.square().mean()) < 3.0  # it knows how much it does not know
    torch.testing.assert_close(belief.u[:, 1:, 0], run.control[:, :-1, 0])


@pytest.mark.needs_compiler
@pytest.mark.parametrize("kind", KINDS)
def test_compiled_filters_are_those_of_the_definition_row_by_row(kind: type[adp.KalmanFilter]) -> None:
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
    torch.testing.assert_close(got.carried.identifier, want.carried.identifier, rtol=1e-10, atol=1e-10)
    alone = steps(loop.init(x0[:3]), draws[:3])[0]
    assert torch.equal(alone.carried.identifier, got.carried.identifier[:3])


@pytest.mark.parametrize(
    ("settings", "rule"),
    [
        ({"noise": []}, "noise"),
        ({"noise": [0.1]}, "output"),
        ({"noise": [0.1, 0.1], "process": -1.0}, "process"),
    ],
)
def test_what_breaks_a_rule_is_refused_with_its_name(settings: dict, rule: str) -> None:
    with pytest.raises(ValueError, match=rule):
        adp.ExtendedKalman(LINEAR, outputs, **settings)


@pytest.mark.parametrize("deviation", [0.0, "1", [1.0], [1.0, -1.0, 1.0]])
def test_a_first_guess_needs_a_deviation_for_every_state(deviation: object) -> None:
    filter = adp.ExtendedKalman(LINEAR, outputs, noise=NOISE)
    with pytest.raises(ValueError, match="deviation"):
        adp.Observed(adp.Feedback(lambda x: x[..., :1]), filter, deviation=deviation)  # type: ignore[arg-type]

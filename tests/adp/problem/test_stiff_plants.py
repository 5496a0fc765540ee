"""Plants with modes that are fast beside the period: simulator, designers and filters agree."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from helpers import tensor
from scipy.integrate import solve_ivp
from torch import Tensor

from staf_torch import adp, systems

MOTOR = systems.Linear([[0.0, 1.0], [0.0, -127.0]], [[0.0], [27.8]])
WEIGHTS = torch.diag(tensor([1550.0, 15.5]))
COST = adp.QuadraticCost(WEIGHTS, 1 / 144, dim=2, inputs=1)
AWAY = tensor([[0.5, 0.0]])


def geared(fast: float) -> systems.RatePlant:
    """A pendulum behind a gear: a user's plant of one fast mode."""
    return systems.RatePlant(
        lambda x, u: torch.stack((x[:, 1], fast * (u[:, 0] - x[:, 1]) - 5 * x[:, 0].sin()), -1),
        dim=2,
        inputs=1,
    )


CUBIC = systems.RatePlant(lambda x, u: u - x**3, dim=1, inputs=1)
"""As stiff as it is far away."""


def followed(
    plant: systems.Plant, cost: adp.Cost, policy: Any, x: Tensor, dt: float, steps: int
) -> tuple[Tensor, float]:
    """The last state and the cost of one row by SciPy."""
    state, paid = x.clone(), 0.0
    for k in range(steps):
        u = policy(state)

        def rate(t: float, y: Any, u: Tensor = u, begun: float = k * dt) -> Any:
            at = torch.as_tensor(y[:-1])
            due = float(cost.rate(at, u)) * math.exp(-cost.discount * (begun + t))
            return [*plant.motion(at, u).tolist(), due]

        y = solve_ivp(rate, (0, dt), [*state.tolist(), 0.0], "LSODA", rtol=1e-11, atol=1e-13).y[:, -1]
        state, paid = torch.as_tensor(y[:-1].copy()), paid + y[-1]
    return state, paid


@pytest.mark.needs_compiler
def test_a_motor_whose_control_is_held_long_costs_what_its_regulator_promises() -> None:
    lqr = adp.LQR(MOTOR, COST, period=0.02)
    run = adp.simulate(adp.Feedback(lqr), MOTOR, COST, AWAY, dt=0.02, steps=200, compile=True)
    torch.testing.assert_close(run.cost, lqr.value(AWAY), rtol=1e-9, atol=0)
    assert float(run.cost) == pytest.approx(40.184, abs=1e-3)


@pytest.mark.parametrize("plant", [MOTOR, geared(135.0)])
def test_designers_of_a_stiff_plant_have_one_regulator(plant: systems.Plant) -> None:
    lqr, problem = adp.LQR(plant, COST, period=0.02), adp.SampledProblem.of(plant, COST, dt=0.02)
    torch.testing.assert_close(problem.k, lqr.k, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(problem.p, lqr.p, rtol=1e-5, atol=1e-6)
    assert adp.near_optimal(plant, COST, dt=0.02).holding.steps < 4
    if plant is MOTOR:
        assert problem.k.flatten().tolist() == pytest.approx([53.42, 1.506], rel=1e-3)


def test_too_few_steps_are_a_warning_with_the_error(caplog: pytest.LogCaptureFixture) -> None:
    adp.SampledProblem.of(MOTOR, COST, dt=0.02, substeps=1)
    assert "SampledProblem.of: with 1 integration steps" in caplog.text
    for settings in ({"substeps": 1}, {"integrator": "euler"}):
        caplog.clear()
        lqr = adp.Feedback(adp.LQR(MOTOR, COST, period=0.02))
        adp.simulate(lqr, MOTOR, COST, AWAY, dt=0.02, steps=4, **settings)  # type: ignore[arg-type]
        assert "the next state is wrong by more than 1e-05 of its size in 1 rows" in caplog.text


@pytest.mark.parametrize(("plant", "discount"), [(geared(3.0), 0.8), (MOTOR, 0.0)])
def test_simulated_stiff_plants_go_where_scipy_goes(plant: Any, discount: float) -> None:
    cost = adp.QuadraticCost([2.0, 0.1], 0.3, dim=2, inputs=1, discount=discount)
    lqr = adp.LQR(plant, cost, period=0.05)
    x0 = tensor([[1.2, -0.5]])
    run = adp.simulate(lqr, plant, cost, x0, dt=0.05, steps=5, compile=False)
    last, paid = followed(plant, cost, lqr, x0[0], 0.05, 5)
    torch.testing.assert_close(run.state[0, -1], last, rtol=0, atol=1e-5)
    assert float(run.cost) == pytest.approx(paid, rel=1e-5)


def test_one_stiff_row_takes_its_own_steps_and_changes_no_other(caplog: pytest.LogCaptureFixture) -> None:
    plant, cost = CUBIC, adp.QuadraticCost(1.0, 1.0, dim=1, inputs=1)
    lqr, x0 = adp.LQR(plant, cost, period=0.05), tensor([[0.5], [10.0], [1.0]])
    run = adp.simulate(lqr, plant, cost, x0, dt=0.05, steps=4, compile=False)
    alone = adp.simulate(lqr, plant, cost, x0[:1], dt=0.05, steps=4, compile=False)
    assert torch.equal(run.state[0], alone.state[0])
    for row in range(3):
        _, paid = followed(plant, cost, lqr, x0[row], 0.05, 4)
        assert float(run.cost[row]) == pytest.approx(paid, rel=1e-5)
    assert not bool(run.diverged.any())
    assert not caplog.text


def test_kalman_filters_of_a_stiff_plant_have_the_deviation_of_the_exact_step() -> None:
    found = adp.UnscentedKalman(MOTOR, lambda x: x[..., :1], noise=[0.01], process=0.1)
    belief = adp.estimation.Belief(torch.zeros(1, 2).double(), torch.eye(2).double()[None], tensor([[0.0]]))
    f = torch.linalg.matrix_exp(0.02 * torch.stack((MOTOR.matrix, MOTOR.matrix)))[0]
    p = torch.eye(2).double()
    for _ in range(10):
        belief = found.step(belief, tensor([[0.0]]), 0.02, torch.tensor([False]))
        p = f @ p @ f.mT + 0.02 * 0.01 * torch.eye(2).double()
        p = p - p[:, :1] @ p[:1] / (p[0, 0] + 1e-4)
    torch.testing.assert_close(belief.covariance[0], p, rtol=1e-8, atol=1e-12)


def test_trajectories_without_control_take_the_steps_that_they_need(caplog: pytest.LogCaptureFixture) -> None:
    plant, x0 = systems.Linear([[0.0, 1.0], [-1.0, -300.0]]), tensor([[1.0, 1.0], [0.0, 0.0]])

    class Written(systems.ControlAffineSystem):
        dim = 2

        def drift(self, x: Tensor) -> Tensor:
            return plant.drift(x)

    times = 0.02 * torch.arange(6, dtype=torch.float64)
    found = systems.simulate(Written(), x0, dt=0.02, steps=5)
    torch.testing.assert_close(found, plant.flow(x0, times), rtol=0, atol=1e-6)
    assert not caplog.text


def test_a_rate_that_is_not_affine_in_the_control_may_be_stiff() -> None:
    def rate(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        return np.stack((x[:, 1], -300 * x[:, 1] - 5 * np.sin(x[:, 0]) + 300 * u[:, 0] + u[:, 0] ** 2), 1)

    plant, cost = systems.RatePlant(rate, dim=2, inputs=1), adp.QuadraticCost(1.0, 0.1, dim=2, inputs=1)
    lqr = adp.LQR(plant, cost, period=0.05)
    run = adp.simulate(lqr, plant, cost, AWAY, dt=0.05, steps=2, compile=False)
    fine = adp.simulate(lqr, plant, cost, AWAY, dt=0.05, steps=2, substeps=100, compile=False)
    torch.testing.assert_close(run.cost, fine.cost, rtol=1e-5, atol=0)


def test_a_rollout_in_too_few_steps_is_a_warning_and_takes_more_by_itself(
    caplog: pytest.LogCaptureFixture,
) -> None:
    adp.RolloutPolicy.of_lqr(MOTOR, COST, horizon=0.1, steps=2)
    assert "with 2 integration steps over the horizon" in caplog.text
    assert adp.RolloutPolicy.of_lqr(MOTOR, COST, horizon=0.1).steps > 5

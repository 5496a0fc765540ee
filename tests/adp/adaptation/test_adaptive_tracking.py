"""Tracking: the error as a plant of its own, the drift identified online; costs along a path of the time."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from helpers import tensor, uniform
from helpers_adp import staf_basis
from torch import Tensor

from staf_torch import adp, systems
from staf_torch.numerics.derivatives import use_forward_mode
from staf_torch.systems.two_state_tracking import desired_rate, true_parameters

use_forward_mode()
TRACKING = systems.TwoStateTracking()


def test_the_error_plant_is_written_out() -> None:
    theta = uniform(3, 2, seed=1)
    plant = systems.TwoStateTracking(theta)
    x, u = uniform(5, 4, seed=2), uniform(5, 1, seed=3)
    for row in range(5):
        e1, e2, d1, d2 = x[row].tolist()

        def s(a: float, b: float) -> np.ndarray:
            return np.array([a, b, b * (1 - (math.cos(2 * a) + 2) ** 2)])

        rate = np.array([d2 - d1, d2 - 2 * d1])
        push = (rate - theta.numpy().T @ s(d1, d2))[1] / (math.cos(2 * d1) + 2)
        gain = math.cos(2 * (e1 + d1)) + 2
        error = theta.numpy().T @ s(e1 + d1, e2 + d2) - rate
        wanted = [error[0], error[1] + gain * (push + float(u[row])), *rate]
        torch.testing.assert_close(plant.rate(x[row], u[row]), tensor(wanted))
    rows = uniform(5, 3, 2, seed=4)
    believed = plant.believing(rows)
    assert torch.equal(plant.theta, theta)
    for row in range(5):
        torch.testing.assert_close(believed.drift(x)[row], systems.TwoStateTracking(rows[row]).drift(x[row]))
    cost = adp.tracking_cost([[2.0, 0.5], [0.5, 1.0]], 3.0)
    assert cost.q.tolist() == [[2, 0.5, 0, 0], [0.5, 1, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]]


def test_the_true_error_plant_rests_on_the_track() -> None:
    on_track = torch.cat((torch.zeros(50, 2).double(), uniform(50, 2, seed=5)), dim=-1)
    assert TRACKING.drift(on_track)[:, :2].abs().max() < 1e-14


def test_desired_trajectory_solves_its_equation() -> None:
    time = torch.linspace(0, 6, 50, dtype=torch.float64)
    slope = (systems.desired_trajectory(time + 1e-6) - systems.desired_trajectory(time - 1e-6)) / 2e-6
    torch.testing.assert_close(slope, desired_rate(systems.desired_trajectory(time)), rtol=1e-8, atol=1e-8)


def test_identified_drift_converges_and_the_error_with_it() -> None:
    cost = adp.tracking_cost(10.0, 1.0)
    basis = adp.LeadingCoordinates(staf_basis(), 4)
    learner = adp.ActorCritic(basis, TRACKING, cost, adp.RandomPoints(1, 0.3), critic=1.5, actor=1.5)
    x0 = torch.tensor([[-0.5, 0.5, 0.0, 1.0], [0.4, 0.2, 0.0, 1.0]], dtype=torch.float64)
    start = torch.zeros(3, 2, dtype=torch.float64)
    tracker = adp.IdentifyingTracker(learner, TRACKING, adp.ConcurrentLearning(3, 2, 6, gain=5.0), start)
    run = adp.simulate(tracker, TRACKING, cost, x0, dt=0.01, steps=500, every=100, compile=True)
    assert not run.diverged.any()
    theta = run["theta"][:, -1]
    assert (theta - true_parameters()).abs().max() < 5e-3
    assert (run.state[:, -1, :2].norm(dim=-1) < 2e-2).all()
    desired = systems.desired_trajectory(run.time).expand(2, -1, -1)
    torch.testing.assert_close(run.state[:, :, 2:], desired, rtol=1e-6, atol=1e-6)


# --- costs along a path -------------------------------------------------------------------------------------


DT, STEPS = 0.1, 10
NONE = torch.empty(0, dtype=torch.float64)
X0 = torch.tensor([[0.2, 0.0, 0.0], [-0.4, 1.0, 0.0]], dtype=torch.float64)


def waves(t: Tensor) -> Tensor:
    """A place and a speed that a mass cannot have together."""
    return torch.stack((t.sin(), 0.5 * (2 * t).cos()), dim=-1)


def mass() -> systems.StepPlant:
    def step(x: Tensor, u: Tensor) -> Tensor:
        return torch.stack((x[:, 0] + DT * x[:, 1], x[:, 1] + DT * u[:, 0]), dim=-1)

    return systems.StepPlant(step, dim=2, inputs=1, dt=DT)


PLANT = systems.Clocked(mass())
COST = adp.TrackingCost(4.0, 0.3, dim=2, inputs=1, path=waves)
PROBLEM = adp.SampledProblem.of(PLANT, COST)


def paid(controls: Tensor) -> Tensor:
    """What controls (B, T, 1) cost from X0, with the LQR's value at the end."""
    x, spent = X0, torch.zeros(len(X0), dtype=torch.float64)
    for u in controls.unbind(1):
        x, now = PROBLEM.advance(x, u)
        spent = spent + now
    return spent + PROBLEM.terminal(x)


def drive(mpc: adp.RecedingHorizon, x: Tensor, steps: int) -> tuple[Tensor, Tensor]:
    carried, controls = mpc.init(x), []
    for _ in range(steps):
        u, carried = mpc.step(x, carried, NONE, DT)
        x, _ = PROBLEM.advance(x, u)
        controls.append(u)
    return torch.stack(controls, dim=1), x


def test_plan_is_the_minimum_of_the_quadratic_program() -> None:
    none = torch.zeros(len(X0), STEPS, 1, dtype=torch.float64)
    slope = torch.func.grad(lambda u: paid(u).sum())(none).flatten(1)
    bent: Tensor = torch.func.hessian(lambda u: paid(u.expand(2, -1, -1))[0])(none[:1]).reshape(STEPS, STEPS)
    best = -torch.linalg.solve(bent, slope.mT).mT.unsqueeze(-1)
    found = adp.BoxDDP(PROBLEM, steps=STEPS, compile=False).solve(X0)
    torch.testing.assert_close(found.control, best, rtol=0, atol=1e-6)
    torch.testing.assert_close(found.cost, paid(best), rtol=1e-10, atol=0)


def test_feedback_is_the_plant_s_own_carried_along_the_path() -> None:
    lqr, still = adp.LQR(PLANT, COST), adp.LQR(mass(), adp.QuadraticCost(4.0, 0.3, dim=2, inputs=1))
    x = torch.tensor([[0.3, -0.2, 1.7]]).double()
    away = x[:, :2] - waves(x[:, 2])
    torch.testing.assert_close(lqr(x), still(away))
    torch.testing.assert_close(lqr.value(x), still.value(away))
    torch.testing.assert_close(PROBLEM.linear_feedback(x), lqr(x))
    torch.testing.assert_close(COST.rate(x, lqr(x)), 4 * away.square().sum(-1) + 0.3 * lqr(x)[:, 0].square())


def test_one_plan_is_followed_and_after_it_the_feedback() -> None:
    found = adp.BoxDDP(PROBLEM, steps=STEPS, compile=False).solve(X0)
    mpc = adp.RecedingHorizon(PROBLEM, steps=STEPS, iterations=0, compile=False)
    controls, last = drive(mpc, X0, STEPS)
    torch.testing.assert_close(controls, found.control, rtol=0, atol=1e-12)
    beyond, after = drive(mpc, X0, STEPS + 1)
    torch.testing.assert_close(beyond[:, -1], PROBLEM.linear_feedback(last))
    pushed, _ = drive(mpc, X0, 1)
    carried = mpc.init(X0)
    aside = X0 + torch.tensor([0.1, 0.0, 0.0]).double()
    answered, _ = mpc.step(aside, carried, NONE, DT)
    torch.testing.assert_close(answered[:, 0] - pushed[:, 0, 0], 0.1 * found.feedback[:, 0, 0, 0])
    assert after[:, 2].tolist() == pytest.approx([DT * (STEPS + 1)] * 2)


def test_receding_horizon_plans_along_the_path_from_the_time_that_it_is() -> None:
    mpc = adp.RecedingHorizon(PROBLEM, steps=10, iterations=1, compile=False)
    controls, _ = drive(mpc, X0, 3)
    _, x = drive(mpc, X0, 2)
    plan = adp.BoxDDP(PROBLEM, steps=10, compile=False).solve(x)
    torch.testing.assert_close(controls[:, 2], plan.control[:, 0], rtol=0, atol=1e-3)  # one iteration
    assert float((PROBLEM.linear_feedback(x) - controls[:, 2]).abs().min()) > 0.01


def test_what_cannot_follow_a_path_says_so() -> None:
    with pytest.raises(ValueError, match=r"`TrackingCost\(plant=...\)` must have a clock"):
        adp.LQR(mass(), COST)
    with pytest.raises(ValueError, match=r"`near_optimal\(plant=...\)` must have no clock"):
        adp.near_optimal(PLANT, COST)
    with pytest.raises(ValueError, match=r"`DirectShooting\(system=...\)` must have no clock"):
        adp.DirectShooting(systems.Clocked(systems.Pendulum()), COST)
    with pytest.raises(ValueError, match=r"`held_stability\(at=...\)` must be a state of the path"):
        adp.held_stability(adp.LQR(PLANT, COST), PLANT, DT)
    with pytest.raises(ValueError, match=r"`SampledProblem\(step=...\)` must move the time"):
        adp.SampledProblem(lambda x, u: (x, u[:, 0].square()), dim=3, inputs=1, path=waves)
    assert (
        adp.held_stability(adp.LQR(PLANT, COST), PLANT, DT, at=waves(NONE.new_zeros(()))).spectral_radius < 1
    )


def test_a_cost_along_a_path_takes_bounds_angles_and_rest_from_its_plant() -> None:
    pendulum = systems.Pendulum()
    pendulum.periodic, pendulum.bounds = (0,), systems.Bounds(-3.0, 4.0, 1)
    plant = systems.Clocked(pendulum)
    cost = adp.TrackingCost([2.0, 0.5], 0.3, 2, 1, path=lambda t: torch.stack((t, 0 * t), -1))
    placed = cost.around(plant)
    assert placed.bounds is pendulum.bounds
    assert placed.periodic == (0,)
    assert placed.regulated(plant) == (pendulum, placed.still)
    x, u = tensor([[0.3, -0.2, 1.5], [6.5, 0.1, 0.2]]), tensor([[0.5], [-1.0]])
    away = tensor([[0.3 - 1.5, -0.2], [6.3 - 2 * torch.pi, 0.1]])
    torch.testing.assert_close(placed.deviation(x), torch.cat((away, torch.zeros(2, 1).double()), -1))
    wanted = (away.square() * tensor([2.0, 0.5])).sum(-1) + 0.3 * u[:, 0].square()
    torch.testing.assert_close(placed.rate(x, u), wanted)
    narrow = placed.bounded(-0.1, 0.2)
    for limits in (narrow.bounds, narrow.still.bounds):
        assert (limits.low.tolist(), limits.high.tolist()) == ([-0.1], [0.2])
    own = adp.TrackingCost(1.0, 1.0, 2, 1, path=cost.path, low=-1.0, high=1.5)
    assert own.around(plant).bounds.high.tolist() == [1.5]
    with pytest.raises(ValueError, match=r"must map rows \(5,\) to \(5, 2\), .*got \(5,\)"):
        adp.TrackingCost(1.0, 1.0, 2, 1, path=lambda t: t)

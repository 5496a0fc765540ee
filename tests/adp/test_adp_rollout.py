"""The rollout policy: one Newton step on the HJB equation."""

from __future__ import annotations

import pytest
import torch
from helpers_adp import COST, PLANT, uniform

from staf_torch import (
    ExponentialKernel,
    GaussianKernel,
    Kernel,
    StaFBasis,
    StateFollowingCenters,
    StateRadius,
    adp,
    ball,
    cross_polytope,
    rings,
    systems,
)

LQR = adp.LQR(PLANT, COST)


def rollout(
    plant: systems.ControlAffineSystem = PLANT, kernel: Kernel | None = None, **settings: object
) -> adp.RolloutPolicy:
    cost = settings.pop("cost", COST)
    lqr = adp.LQR(plant, cost)
    directions = settings.pop("directions", rings(6))
    basis = StaFBasis(
        kernel or ExponentialKernel(), StateFollowingCenters(directions, settings.pop("radius", 0.1))
    )
    return adp.RolloutPolicy(basis, plant, cost, lqr, lqr.value, **settings)


@torch.no_grad()
def test_rollout_of_the_optimal_policy_returns_the_optimal_value() -> None:
    basis = StaFBasis(ExponentialKernel(), StateFollowingCenters(rings(6), 0.1))

    def value(x: torch.Tensor) -> torch.Tensor:
        return PLANT.optimal_value(x, COST.q, COST.r)

    def best(x: torch.Tensor) -> torch.Tensor:
        return COST.policy(PLANT.effectiveness(x), adp.value_gradient(value, x))

    policy = adp.RolloutPolicy(basis, PLANT, COST, best, value, horizon=0.5, steps=20)
    x = uniform(30, 2.0)
    torch.testing.assert_close(policy.rollout(x), value(x), rtol=2e-5, atol=1e-6)
    torch.testing.assert_close(policy(x), best(x), rtol=0, atol=0.02)


@torch.no_grad()
def test_linear_plant_is_left_with_its_lqr() -> None:
    plant = systems.Linear([[0.0, 1.0], [2.0, -1.0]], [[0.0], [1.0]])
    policy = rollout(plant, radius=1e-3)
    x = uniform(20, 2.0)
    torch.testing.assert_close(policy(x), policy.base(x), rtol=1e-4, atol=1e-4)


@torch.no_grad()
def test_two_state_is_regulated_at_almost_the_optimal_cost() -> None:
    x0 = uniform(200, 2.0, seed=1)
    optimal = PLANT.optimal_value(x0, COST.q, COST.r)
    policy = rollout(horizon=0.5, steps=5)
    run = adp.simulate(adp.Feedback(policy), PLANT, COST, x0, dt=0.01, steps=400, every=400, compile=True)
    # From here on the LQR: all states are so near to the origin that the rest costs less than 1e-6.
    rest = adp.simulate(
        adp.Feedback(LQR), PLANT, COST, run.state[:, -1], dt=0.05, steps=120, every=120, compile=False
    )
    ratio = (run.cost + rest.cost) / optimal
    assert (rest.state[:, -1].norm(dim=-1) < 1e-3).all()
    assert float(ratio.mean()) <= 1.01
    assert float(ratio.max()) <= 1.06
    assert float(ratio.min()) >= 1 - 1e-6


@torch.no_grad()
def test_three_state_beats_the_lqr_and_the_published_cost() -> None:
    plant, cost = systems.ThreeState(), adp.QuadraticCost(10.0, 1.0, 3, 2)
    x0 = torch.tensor([[-0.5, 0.5, -0.25]], dtype=torch.float64)
    # The radius shrinks: the plant has no derivative at 0, and a constant ball around the state would hold 0.
    radius = StateRadius(0.1, 1e-5)
    policy = rollout(plant, directions=ball(10, 3), radius=radius, cost=cost, horizon=1.0, steps=10)
    run = adp.simulate(adp.Feedback(policy), plant, cost, x0, dt=0.02, steps=400, every=400, compile=True)
    lqr = adp.simulate(
        adp.Feedback(adp.LQR(plant, cost)), plant, cost, x0, dt=0.005, steps=2000, every=2000, compile=True
    )
    assert float(lqr.cost) == pytest.approx(2.786, abs=2e-3)
    assert 2.7047 <= float(run.cost) <= 2.7055  # the optimum is 2.70471
    assert run.state[0, -1].norm() < 1e-3


@torch.no_grad()
def test_quadrotor_is_regulated_at_less_than_the_cost_of_the_lqr() -> None:
    plant, cost = systems.PlanarQuadrotor(), adp.QuadraticCost(1.0, 1.0, 6, 2)
    box = torch.tensor([1.0, 1.0, 0.5, 1.0, 1.0, 0.5], dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    x0 = box * (2 * torch.rand(24, 6, dtype=torch.float64, generator=generator) - 1)
    corners = cross_polytope(6)
    cross = torch.cat((corners, torch.zeros_like(corners[:1])))
    policy = rollout(plant, directions=cross, radius=0.05, cost=cost, horizon=0.5, steps=10)
    base = adp.Feedback(adp.LQR(plant, cost))
    whole = adp.simulate(base, plant, cost, x0, dt=0.01, steps=1200, every=1200, compile=True)
    start = adp.simulate(adp.Feedback(policy), plant, cost, x0, dt=0.01, steps=200, every=200, compile=True)
    rest = adp.simulate(base, plant, cost, start.state[:, -1], dt=0.01, steps=1000, every=1000, compile=True)
    ratio = (start.cost + rest.cost) / whole.cost
    assert (rest.state[:, -1].norm(dim=-1) < 1e-3).all()
    assert float(ratio.mean()) < 0.996
    assert float(ratio.max()) < 1.001


@torch.no_grad()
def test_repetition_approaches_the_optimal_policy() -> None:
    x = uniform(20, 1.5, seed=3)
    best = COST.policy(
        PLANT.effectiveness(x), adp.value_gradient(lambda y: PLANT.optimal_value(y, COST.q, COST.r), x)
    )
    errors = [float((rollout(horizon=0.6, steps=6, depth=depth)(x) - best).abs().mean()) for depth in (1, 2)]
    assert errors[1] < 0.5 * errors[0]


@torch.no_grad()
def test_bounded_policy_respects_its_bound_and_regulates() -> None:
    plant = systems.Pendulum()
    cost = adp.BoundedInputCost(1.0, 0.1, 2, 1, bound=8.0)
    policy = rollout(plant, cost=cost, horizon=0.3, steps=6)
    x0 = uniform(20, 0.4)
    run = adp.simulate(adp.Feedback(policy), plant, cost, x0, dt=0.1, steps=60, compile=False)
    assert run.control[:, :-1].abs().max() < 8.0
    assert run.control.nan_to_num().abs().max() > 4.0
    assert (run.state[:, -1].norm(dim=-1) < 1e-2).all()


@pytest.mark.parametrize("kernel", [ExponentialKernel(), GaussianKernel(1.0)], ids=lambda k: type(k).__name__)
@torch.no_grad()
def test_rows_and_leading_dimensions_are_alone(kernel: Kernel) -> None:
    policy = rollout(kernel=kernel, steps=3)
    x = uniform(6, 1.0).reshape(2, 3, 2)
    whole = policy(x)
    rows = torch.stack([policy(row) for row in x.reshape(6, 2)]).reshape(2, 3, 1)
    torch.testing.assert_close(whole, rows, rtol=1e-10, atol=1e-11)


def test_bad_arguments_are_refused_by_name() -> None:
    for settings, message in (
        ({"horizon": 0.0}, r"`RolloutPolicy\(horizon=...\)` must be positive"),
        ({"steps": 0}, r"`RolloutPolicy\(steps=...\)` must be at least 1"),
        ({"depth": 0}, r"`RolloutPolicy\(depth=...\)` must be at least 1"),
        ({"directions": ball(10, 3)}, r"`RolloutPolicy\(basis=...\)` must have the plant's 2 states; got 3"),
    ):
        with pytest.raises(ValueError, match=message):
            rollout(**settings)


def test_in_barrier_coordinates_rollouts_move_the_distances_to_the_walls() -> None:
    """Steps of 50 ms in s itself overflow from the published start, and left no control at all."""
    box = systems.Barrier(systems.TwoStateChain(), [-7.0, -5.0], [5.0, 7.0])
    cost = adp.QuadraticCost(10.0, 0.1, dim=2, inputs=1)
    s0 = box.transform(torch.tensor([[-6.5, 6.5]], dtype=torch.float64))
    coarse, fine = (adp.RolloutPolicy.of_lqr(box, cost, steps=steps).rollout(s0) for steps in (10, 200))
    torch.testing.assert_close(coarse, fine, rtol=0.05, atol=0)
    assert float(fine) == pytest.approx(70.78, rel=0.05)  # of the LQR of s, here 0.5 s of it and its value


def test_beside_a_wall_the_slope_of_a_rollout_policy_is_that_of_what_its_rollouts_cost() -> None:
    box = systems.Barrier(systems.TwoStateChain(), (-7, -5), (5, 7))
    cost = adp.QuadraticCost(10.0, 0.1, dim=2, inputs=1)
    policy = adp.RolloutPolicy.of_lqr(box, cost, steps=100)
    s = box.transform(torch.tensor([-6.5, 6.5], dtype=torch.float64))
    apart = 0.01 * torch.eye(2, dtype=torch.float64)
    wanted = (policy.rollout(s + apart) - policy.rollout(s - apart)) / 0.02
    torch.testing.assert_close(policy.gradient(s), wanted, rtol=0.01, atol=0.02)

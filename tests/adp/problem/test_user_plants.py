"""Plants that a user brings: a step or a rate, in NumPy or torch, with angles and a rest of their own."""

from __future__ import annotations

import functools
import logging
import math
import time

import numpy as np
import pytest
import torch
from torch import Tensor

import staf_torch as st
from staf_torch import adp, systems

PERIOD = 0.05


def turn(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """A step of Gymnasium's Pendulum-v1, its bounds inside."""
    angle, rate = x[:, 0], x[:, 1]
    rate = np.clip(rate + (15.0 * np.sin(angle) + 3.0 * np.clip(u[:, 0], -2.0, 2.0)) * PERIOD, -8.0, 8.0)
    return np.stack((angle + rate * PERIOD, rate), axis=1)


def turn_torch(x: Tensor, u: Tensor) -> Tensor:
    angle, rate = x[:, 0], x[:, 1]
    rate = (rate + (15.0 * angle.sin() + 3.0 * u[:, 0].clamp(-2.0, 2.0)) * PERIOD).clamp(-8.0, 8.0)
    return torch.stack((angle + rate * PERIOD, rate), dim=1)


def pendulum(function: object = turn, **more: object) -> systems.StepPlant:
    given = {"dim": 2, "inputs": 1, "dt": PERIOD, "periodic": [0], "low": -2.0, "high": 2.0} | more
    return systems.StepPlant(function, **given)


COST = adp.QuadraticCost([[20.0, 0.0], [0.0, 2.0]], 0.02, dim=2, inputs=1)
X0 = torch.tensor([[0.1, 0.0], [2 * math.pi - 0.1, 0.0], [-0.15, 0.4]], dtype=torch.float64)


@torch.no_grad()
def test_black_box_is_regulated_like_the_same_plant_in_torch() -> None:
    runs = []
    for function in (turn, turn_torch):
        plant = pendulum(function)
        assert plant.traceable is (function is turn_torch)
        lqr = adp.LQR(plant, COST)
        assert lqr.period == PERIOD
        runs.append(adp.simulate(adp.Feedback(lqr), plant, COST, X0, steps=100, compile=False))
    torch.testing.assert_close(runs[0].cost, runs[1].cost, rtol=1e-9, atol=0)
    # The second state is the mirror of the first, a turn further on: it comes to rest there.
    torch.testing.assert_close(runs[0].cost[1], runs[0].cost[0])
    goal = torch.tensor([[0.0, 0.0], [2 * math.pi, 0.0], [0.0, 0.0]], dtype=torch.float64)
    torch.testing.assert_close(runs[0].state[:, -1], goal, rtol=0, atol=1e-6)


def test_lqr_of_a_step_plant_pays_its_value_and_holds_for_several_periods() -> None:
    a, b = np.array([[1.0, 0.1], [2.0, 1.1]]), np.array([[0.005], [0.1]])
    plant = systems.StepPlant(lambda x, u: x @ a.T + u @ b.T, dim=2, inputs=1, dt=0.1)
    lqr, x0 = adp.LQR(plant, COST), torch.tensor([[0.1, -0.2]], dtype=torch.float64)
    run = adp.simulate(lqr, plant, COST, x0, steps=100)
    assert float(run.cost) == pytest.approx(float(lqr.value(x0)), rel=1e-8)
    assert adp.held_stability(adp.LQR(plant, COST, period=0.3), plant, 0.3).spectral_radius < 1
    with pytest.raises(ValueError, match=r"must be a multiple of the plant's period of 0.1 s; got 0.25"):
        adp.LQR(plant, COST, period=0.25)


def test_rest_is_searched_from_the_guess() -> None:
    def hang(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        return np.stack((x[:, 1], -9.81 * np.sin(x[:, 0]) + 1e-5 + u[:, 0]), axis=1)

    held = systems.RatePlant(hang, dim=2, inputs=1, equilibrium=[math.pi - 0.2, 0.0])
    assert float(held.resting_input()) == pytest.approx(9.81 * math.sin(0.2) - 1e-5, rel=1e-6)

    def free(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        return np.stack((x[:, 1] + 0 * u[:, 0], -9.81 * np.sin(x[:, 0]) + u[:, 0] * x[:, 1]), axis=1)

    top = systems.RatePlant(free, dim=2, inputs=1, equilibrium=([math.pi - 0.2, 0.0], [0.0]))
    torch.testing.assert_close(
        top.equilibrium(), torch.tensor([math.pi, 0.0], dtype=torch.float64), rtol=0, atol=1e-9
    )


@torch.no_grad()
def test_costs_with_outputs_discount_and_blind_directions() -> None:
    linear = systems.Linear([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])
    x0 = torch.tensor([[1.0, -0.5]], dtype=torch.float64)
    seen = adp.QuadraticCost([[1.0]], 1.0, dim=2, inputs=1, output=lambda x: x[..., :1])
    blind = adp.QuadraticCost([[1.0, 0.0], [0.0, 0.0]], 1.0, dim=2, inputs=1)
    torch.testing.assert_close(adp.LQR(linear, seen).p, adp.LQR(linear, blind).p)
    for cost in (seen, adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1, discount=0.7)):
        period = None if cost is seen else 0.2
        lqr, dt = adp.LQR(linear, cost, period=period), period or 0.08
        settings = {"dt": dt, "steps": round(8 / dt), "substeps": 4, "renew": period is None}
        run = adp.simulate(adp.Feedback(lqr), linear, cost, x0, compile=False, **settings)
        assert float(run.cost) == pytest.approx(float(lqr.value(x0)), rel=2e-4)
    unseen = adp.QuadraticCost([[0.0, 0.0], [0.0, 1.0]], 1.0, dim=2, inputs=1)
    with pytest.raises(ValueError, match=r"not detectable: the cost Q does not see its mode .* 0 1/s"):
        adp.LQR(linear, unseen)


def test_loop_that_is_held_too_long_is_said_to_be_unstable(caplog: pytest.LogCaptureFixture) -> None:
    falling = systems.Linear([[0.0, 1.0], [20.0, 0.0]], [[0.0], [1.0]])
    lqr, x0 = adp.LQR(falling, COST), torch.ones(1, 2, dtype=torch.float64)
    with caplog.at_level(logging.WARNING):
        adp.simulate(adp.Feedback(lqr), falling, COST, x0, dt=0.3, steps=2)
    stability = adp.held_stability(lqr, falling, 0.3)
    assert (
        f"dt = 0.3 s, at which the linearised loop has the spectral radius {stability[0]:.4g}" in caplog.text
    )
    assert f"it is stable up to {stability.largest_period:.4g} s" in caplog.text
    caplog.clear()
    adp.simulate(adp.Feedback(lqr), falling, COST, x0, dt=0.01, steps=2)
    adp.simulate(adp.Feedback(adp.LQR(falling, COST, period=0.3)), falling, COST, x0, steps=2)
    assert caplog.text == ""


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda x, u: x, r"`StepPlant\(step=...\)` ignores u"),
        (lambda x, u: 1 / 0, r"`StepPlant\(step=...\)` raised ZeroDivisionError \(division by zero\)"),
        (lambda x, u: np.nan * (x + u), r"returned values that are not finite near x"),
    ],
)
def test_bad_steps_are_refused_with_a_sentence(function: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        pendulum(function)


def test_a_plant_that_rests_nowhere_is_refused_by_what_regulates_alone() -> None:
    plant = pendulum(lambda x, u: x + 1.0 + 0.01 * np.sin(u))
    assert plant.equilibrium().tolist() == [0.0, 0.0]
    with pytest.raises(ValueError, match=r"StepPlant does not rest .* moves by \[1.0, 1.0\].*None is near"):
        adp.near_optimal(plant, COST)


def test_kinks_are_named() -> None:
    kinked = pendulum(lambda x, u: x + 0.1 * np.abs(x[:, ::-1] + u - 1e-4) - 1e-5)
    with pytest.raises(ValueError, match=r"`StepPlant\(step=...\)` is not smooth at the state"):
        adp.LQR(kinked, COST)


@pytest.mark.parametrize(("seconds", "said"), [(0.04, False), (0.06, True)])
def test_share_of_the_period_that_a_control_takes_is_said_from_a_half_on(
    seconds: float, said: bool, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = iter(range(1000))
    monkeypatch.setattr(time, "perf_counter", lambda: seconds * next(now))
    with caplog.at_level(logging.WARNING):
        adp.near_optimal(pendulum(turn, dt=0.1), COST, horizon=0.4, reach="local")
    share = f"{100 * seconds / 0.1:.0f} % of the 0.1 s for which it is held: a slower moment and it is late"
    assert (share in caplog.text) == said
    assert bool(caplog.text) == said


PENDULUM, COST = systems.Pendulum(), adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
START = torch.zeros(1, 2, dtype=torch.float64)
DOORS = {
    "simulate": lambda plant, cost: adp.simulate(lambda x: -x[..., :1], plant, cost, START, dt=0.1, steps=1),
    "near_optimal": lambda plant, cost: adp.near_optimal(plant, cost, dt=0.1),
    "DirectShooting": lambda plant, cost: adp.DirectShooting(plant, cost),
    "LQR": lambda plant, cost: adp.LQR(plant, cost),
    "plan_around": lambda plant, cost: adp.plan_around(plant, cost, START, dt=0.1, steps=4),
    "DetourRollout": lambda plant, cost: adp.DetourRollout(
        adp.LQR(PENDULUM, COST), plant, cost, [], axes=[[1.0, 0.0]], dt=0.1, steps=4, terminal=torch.sum
    ),
}


@pytest.mark.parametrize("door", DOORS)
def test_what_is_no_plant_and_what_is_no_cost_is_refused_with_what_to_write(door: str) -> None:
    made = rf"`{door}\((plant|system)=...\)` must be a Plant: `systems.RatePlant\(f"
    for wrong in (lambda x, u: u, st.GaussianKernel):
        with pytest.raises(ValueError, match=made):
            DOORS[door](wrong, COST)
        with pytest.raises(ValueError, match=rf"`{door}\(cost=...\)` must be a Cost: `QuadraticCost\("):
            DOORS[door](PENDULUM, wrong)
    with pytest.raises(ValueError, match=r"must be an object, and is the class: write `Pendulum\(...\)`"):
        DOORS[door](systems.Pendulum, COST)


def test_a_spread_is_one_number_or_one_a_coordinate() -> None:
    def wheel(spread: object) -> systems.Linear:  # a position in km, a speed in m/s
        plant = systems.Linear([[0.0, 1e-3], [0.0, 0.0]], [[0.0], [1.0]])
        plant.spread = spread
        return plant

    cost = adp.QuadraticCost([[1e6, 0.0], [0.0, 1.0]], 1.0, dim=2, inputs=1)
    near = functools.partial(adp.near_optimal, cost=cost, dt=0.05, reach="local", horizon=0.2)
    assert near(wheel(np.array([2e-3, 5.0]))).box.tolist() == [2e-3, 5.0]
    assert systems.Clocked(wheel((2e-3, 5.0))).spread == [2e-3, 5.0, 5.0]
    for wrong in ([1.0, 2.0, 3.0], [1.0, -1.0], "wide"):
        with pytest.raises(ValueError, match=r"`Linear\(spread=...\)` must be one positive number, or one"):
            near(wheel(wrong))


class InNumPy(systems.ControlAffineSystem):
    """A drift that can be evaluated and not differentiated."""

    dim, inputs = 1, 1

    def drift(self, x: torch.Tensor) -> torch.Tensor:
        return torch.as_tensor(np.sin(x.numpy()))

    def effectiveness(self, x: torch.Tensor) -> torch.Tensor:
        return torch.ones_like(x).unsqueeze(-1)


def test_a_drift_in_numpy_is_told_of_the_doors_for_it() -> None:
    cost = adp.QuadraticCost(1.0, 1.0, dim=1, inputs=1)
    with pytest.raises(ValueError, match=r"`InNumPy.drift` must be of torch's operations.*StepPlant"):
        adp.near_optimal(InNumPy(), cost, dt=0.02, reach="local")

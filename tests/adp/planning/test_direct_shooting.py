"""Direct shooting: against every optimum that is known, and against the HJB equation where none is."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from helpers import uniform as random
from helpers_adp import COST, PLANT, uniform
from torch import Tensor

from staf_torch import adp, systems
from staf_torch.adp.critic.laws import value_gradient

DOUBLE = systems.Linear([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])
LINEAR = systems.Linear([[0.0, 1.0], [2.0, -1.0]], [[0.0], [1.0]])
X3 = torch.tensor([[-0.5, 0.5, -0.25]], dtype=torch.float64)


@pytest.mark.parametrize("plant", [PLANT, LINEAR], ids=lambda p: type(p).__name__)
def test_known_optimum_is_found_and_bounded_from_above(plant: systems.ControlAffineSystem) -> None:
    x = uniform(2, 2.0, seed=2)
    best = adp.DirectShooting(plant, COST).solve(x)
    known = plant.optimal_value(x, COST.q, COST.r)
    assert best.converged.all()
    excess = best.value / known - 1
    assert excess.min() > -1e-8
    assert excess.max() < 3e-6
    assert (excess <= best.mesh_error + best.horizon_error).all()
    gradient = value_gradient(lambda y: plant.optimal_value(y, COST.q, COST.r), x)
    torch.testing.assert_close(best.gradient, gradient, rtol=1e-4, atol=1e-5)
    control = COST.policy(plant.effectiveness(x), gradient)
    torch.testing.assert_close(best.control, control, rtol=1e-4, atol=2e-4)


def test_error_falls_with_the_mesh() -> None:
    x = uniform(2, 1.5, seed=3)
    known = LINEAR.optimal_value(x, COST.q, COST.r)
    excess = [adp.DirectShooting(LINEAR, COST, intervals=n).solve(x).value / known - 1 for n in (14, 28)]
    assert (excess[1] < excess[0] / 8).all()


def test_three_state_optimum() -> None:
    plant, cost = systems.ThreeState(), adp.QuadraticCost(10.0, 1.0, 3, 2)
    best = adp.DirectShooting(plant, cost).solve(torch.cat((X3, 0.1 * X3)))
    # The rollout policy reaches 2.708, the LQR 2.786. The plant is homogeneous, so V* is, of degree 2.
    assert float(best.value[0]) == pytest.approx(2.70471, abs=2e-5)
    torch.testing.assert_close(best.value[1], 0.01 * best.value[0], rtol=1e-6, atol=0)


def test_gradient_and_control_solve_the_hjb_equation() -> None:
    plant, cost = systems.Pendulum(), adp.BoundedInputCost(1.0, 0.1, 2, 1, bound=8.0)
    x = 0.2 * torch.randn(1, plant.dim, dtype=torch.float64, generator=torch.Generator().manual_seed(4))
    best = adp.DirectShooting(plant, cost, intervals=48).solve(x)
    assert best.converged.all()
    g = plant.effectiveness(x)
    rate = plant.drift(x) + (g @ best.control.unsqueeze(-1)).squeeze(-1)
    residual = cost.rate(x, best.control) + (best.gradient * rate).sum(-1)
    assert (residual.abs() < 1e-4 * cost.rate(x, best.control)).all()
    torch.testing.assert_close(best.control, cost.policy(g, best.gradient))
    lqr = adp.LQR(plant, cost)
    run = adp.simulate(adp.Feedback(lqr), plant, cost, x, dt=0.1, steps=100, every=100, compile=False)
    assert (best.value < run.cost * (1 + 1e-4)).all()


def test_row_that_fails_on_the_coarse_mesh_starts_again_on_the_fine_one() -> None:
    x = uniform(6, 2.0)[:1]
    best = adp.DirectShooting(PLANT, COST, intervals=32, iterations=10, starts=1).solve(x)
    assert torch.isinf(best.mesh_error).all()  # nothing to compare with
    assert best.converged.all()
    assert (best.value / PLANT.optimal_value(x, COST.q, COST.r) - 1).abs().max() < 1e-4


def test_too_few_iterations_are_reported_and_not_passed_off_as_an_optimum() -> None:
    best = adp.DirectShooting(PLANT, COST, intervals=8, iterations=1).solve(uniform(2, 2.0))
    assert not best.converged.any()
    assert torch.isnan(best.value).all()
    assert all(reason.startswith("not stationary") for reason in best.reason)


def test_what_cannot_be_shot_is_refused_by_name() -> None:
    stuck = systems.Linear([[1.5, 0.0], [0.0, -1.0]], [[0.0], [1.0]])
    with pytest.raises(ValueError, match=r"Linear .* not stabilisable.*eigenvalue 1.5 1/s"):
        adp.DirectShooting(stuck, COST)
    with pytest.raises(ValueError, match=r"`DirectShooting.solve\(x0=...\)` must have 2 entries"):
        adp.DirectShooting(PLANT, COST).solve(torch.zeros(1, 3, dtype=torch.float64))
    with pytest.raises(ValueError, match=r"`DirectShooting\(intervals=...\)` must be even"):
        adp.DirectShooting(PLANT, COST, intervals=81)
    step = systems.StepPlant(lambda x, u: 0.5 * x + u, dim=1, inputs=1, dt=0.1)
    with pytest.raises(ValueError, match=r"`DirectShooting\(system=...\)` must be in continuous time"):
        adp.DirectShooting(step, adp.QuadraticCost(1.0, 1.0, dim=1, inputs=1))
    with pytest.raises(ValueError, match=r"`DirectShooting\(cost=...\)` must have no discount"):
        adp.DirectShooting(DOUBLE, adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1, discount=0.1))


def test_at_the_set_point_one_start_is_enough_and_nothing_is_paid() -> None:
    shooting = adp.DirectShooting(systems.VanDerPol(), COST, intervals=16, horizon=2.0)
    best = shooting.solve(torch.zeros(1, 2, dtype=torch.float64))
    assert bool(best.converged.all())
    assert float(best.value) == 0.0
    assert int(best.iterations) <= 6


# Inputs with bounds, several starts ---------------------------------------------------------------------


@pytest.fixture(scope="module")
def convex() -> adp.Optimum:
    start = torch.tensor([[5.0, 0.0], [0.5, 0.0], [-5.0, 0.0]], dtype=torch.float64)
    return adp.DirectShooting(DOUBLE, COST, low=-1.0, high=1.0).solve(start)


def test_double_integrator_with_a_hard_bound_is_solved(convex: adp.Optimum) -> None:
    # 53.1619: IPOPT on 400 intervals over 20 s of a control that is linear on each (Runge-Kutta).
    assert convex.converged.all()
    assert float(convex.value[0]) == pytest.approx(53.162, rel=1e-4)
    torch.testing.assert_close(convex.value[2], convex.value[0], rtol=1e-9, atol=0)
    assert (convex.plan.abs() <= 1.0).all()
    assert float(convex.plan[0].min()) == -1.0
    assert float(convex.optimality.max()) < 1e-4
    free = adp.DirectShooting(DOUBLE, COST).solve(torch.tensor([[0.5, 0.0]], dtype=torch.float64))
    torch.testing.assert_close(convex.value[1], free.value[0], rtol=1e-5, atol=0)
    assert repr(convex).startswith("Optimum(3 states, value ")


@torch.no_grad()
def test_plan_is_replayed_at_its_cost(convex: adp.Optimum) -> None:
    steps, x0 = round(float(convex.time[-1]) / 0.05), convex.state[:, 0]
    run = adp.simulate(convex.replay(), DOUBLE, COST, x0, dt=0.05, steps=steps, compile=False)
    torch.testing.assert_close(run.cost, convex.value, rtol=3e-3, atol=0)
    assert (run.state[:, -1].norm(dim=-1) < 1e-2).all()


class Swing(systems.ControlAffineSystem):
    """x1'' = 15 sin x1 + 3 u."""

    dim, inputs = 2, 1

    def drift(self, x: Tensor) -> Tensor:
        return torch.stack((x[..., 1], 15 * x[..., 0].sin()), dim=-1)

    def effectiveness(self, x: Tensor) -> Tensor:
        return torch.tensor([[0.0], [3.0]]).to(x).expand(*x.shape[:-1], 2, 1)


def test_swing_up_that_ipopt_finds_from_one_of_six_starts_is_found() -> None:
    """casadi 3.7, IPOPT on 80 intervals, its best of six starts: others end at 30 to 36."""
    x0 = torch.tensor([[1.0, 0.0]], dtype=torch.float64)
    cost = adp.QuadraticCost([[1.0, 0.0], [0.0, 0.1]], 0.01, dim=2, inputs=1, low=-2.0, high=2.0)
    found = adp.DirectShooting(Swing(), cost, horizon=4.0).solve(x0)
    assert float(found.value) == pytest.approx(17.2734, rel=2e-3)
    assert found.converged.all()
    assert float(found.plan.abs().max()) <= 2


def test_a_linear_plant_whose_cost_has_two_valleys_is_not_believed_at_once() -> None:
    """x' = u, an output that is 0 at 0 and at 3: the valley at 3 is the near one, the LQR leads to 0."""
    plant = systems.Linear([[0.0]], [[1.0]])
    cost = adp.QuadraticCost(
        1.0, 0.1, dim=1, inputs=1, low=-3.0, high=3.0, output=lambda x: x * (1 - x / 3) * (1 + x / 30)
    )
    given: dict[str, Any] = {"horizon": 4.0, "intervals": 24, "terminal": lambda x: 0 * x.square().sum(-1)}
    search = adp.DirectShooting(plant, cost, **given, starts=3)
    found = search.solve(torch.tensor([[2.4]], dtype=torch.float64))
    assert found.reason[0].startswith("local: one start alone found it")
    y = torch.linspace(2.4, 3.0, 2001, dtype=torch.float64)
    best = float(torch.trapezoid(2 * 0.1**0.5 * (y * (1 - y / 3) * (1 + y / 30)).abs(), y))
    assert float(found.value) == pytest.approx(best, rel=0.02)


def test_row_without_a_finite_start_says_so() -> None:
    class Exploding(systems.Linear):
        def drift(self, x: torch.Tensor) -> torch.Tensor:
            return super().drift(x) + torch.where(x[..., :1] > 2.0, math.inf, 0.0)

    plant = Exploding([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])
    best = adp.DirectShooting(plant, COST, intervals=20).solve(torch.tensor([[3.0, 0.0]]).double())
    assert best.reason == (
        "the cost is not finite from here under any start: give a `base` that does not diverge",
    )


def test_the_horizon_grows_until_little_is_left_at_its_end() -> None:
    far = torch.tensor([[60.0, 0.0]], dtype=torch.float64)
    given = {"low": -1.0, "high": 1.0, "intervals": 24, "starts": 1, "iterations": 60}
    search = adp.DirectShooting(DOUBLE, COST, **given)
    found = search.solve(far)
    assert float(found.time[-1]) / search.horizon in (2.0, 4.0, 8.0)
    assert float(found.horizon_error) < 1e-3
    stated = adp.DirectShooting(DOUBLE, COST, **given, horizon=8.0).solve(far)
    assert float(stated.time[-1]) == pytest.approx(8.0)
    assert float(stated.horizon_error) > 1e-3
    near = 0.1 * random(256, 2, seed=1)
    with pytest.raises(ValueError, match=r"state a `horizon` of 2[0-9.]+ s, or solve at most 256 states"):
        search.solve(torch.cat((near, far)))


def test_more_states_than_are_solved_at_once_are_those_of_each_alone() -> None:
    x, search = uniform(258, 1.0, seed=6), adp.DirectShooting(LINEAR, COST, intervals=8, horizon=1.0)
    found, alone = search.solve(x), search.solve(x[[3, 257]])
    for part in ("value", "gradient", "control", "state", "plan", "mesh_error", "optimality"):
        torch.testing.assert_close(getattr(found, part)[[3, 257]], getattr(alone, part), rtol=1e-9, atol=1e-9)
    assert found.reason == ("",) * 258


def test_of_two_valleys_the_lower_one_is_found_from_several_starts() -> None:
    """x' = u and a cost y(x)^2 + u^2, 0 at 0 and at 10: V = 2 int |y| to the valley nearer by area."""

    def y(x: Tensor) -> Tensor:
        return 11 - x - 11 / (1 + x)

    plant, ridge = systems.RatePlant(lambda x, u: 1 * u, dim=1, inputs=1), 11**0.5 - 1
    cost = adp.QuadraticCost(1.0, 1.0, dim=1, inputs=1, output=y)
    x = torch.tensor([[3.2]], dtype=torch.float64)  # to 0 the area is 14.3, to 10, downhill, 19.3
    left = 11 * 3.2 - 3.2**2 / 2 - 11 * math.log(1 + 3.2)
    given: dict[str, Any] = {"base": lambda x: torch.where(x < ridge, -y(x), y(x)), "horizon": 4.0}
    given["terminal"] = lambda x: y(x)[..., 0].square()
    alone = adp.DirectShooting(plant, cost, **given, intervals=40).solve(x)  # no LQR to doubt it by
    search = adp.DirectShooting(plant, cost, **given, intervals=40, starts=3)
    found = search.solve(torch.cat((x, 0.1 * x)))
    assert float(alone.value) == pytest.approx(2 * left, rel=1e-2)
    assert float(found.value[0]) == pytest.approx(2 * left, rel=1e-2)
    assert found.reason[0] == "" or found.reason[0].startswith("local: one start alone found it")
    again = search.solve(torch.cat((x, 0.1 * x)), warm=found)
    torch.testing.assert_close(again.value, found.value, rtol=1e-6, atol=0)
    assert again.converged.tolist() == [True, True]  # an earlier plan is a start that agrees


# Its pieces -----------------------------------------------------------------------------------------------


SLOW = systems.Linear([[0.0, 1.0], [-2.0, -3.0]], [[0.0], [1.0]])
LIGHT = adp.QuadraticCost(1e-6, 1.0, dim=2, inputs=1)  # the feedback hardly moves the modes


def test_horizon_and_intervals_follow_the_modes_of_the_loop() -> None:
    for limits, many in (({}, 240), ({"low": -1.0, "high": 1.0}, 120)):
        found = adp.DirectShooting(SLOW, LIGHT, **limits)  # modes of -1 and -2 in 1/s
        assert found.horizon == pytest.approx(9.2, rel=1e-5)
        assert found.intervals == 80  # 37 would resolve them
        assert adp.DirectShooting(SLOW, LIGHT, horizon=60.0, **limits).intervals == many

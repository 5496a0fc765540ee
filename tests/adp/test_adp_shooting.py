"""Direct shooting: against every optimum that is known, and against the HJB equation where none is."""

from __future__ import annotations

import pytest
import torch
from helpers_adp import COST, PLANT, uniform
from torch import Tensor

from staf_torch import adp, systems

LINEAR = systems.Linear([[0.0, 1.0], [2.0, -1.0]], [[0.0], [1.0]])
X3 = torch.tensor([[-0.5, 0.5, -0.25]], dtype=torch.float64)


@pytest.mark.parametrize("plant", [PLANT, LINEAR], ids=lambda p: type(p).__name__)
def test_known_optimum_is_found_and_bounded_from_above(plant: systems.ControlAffineSystem) -> None:
    x = uniform(10, 2.0, seed=2)
    best = adp.DirectShooting(plant, COST).solve(x)
    known = plant.optimal_value(x, COST.q, COST.r)
    assert best.converged.all()
    excess = best.value / known - 1
    assert excess.min() > -1e-8
    assert excess.max() < 3e-6
    assert (excess <= best.mesh_error + best.horizon_error).all()
    gradient = adp.value_gradient(lambda y: plant.optimal_value(y, COST.q, COST.r), x)
    torch.testing.assert_close(best.gradient, gradient, rtol=1e-4, atol=1e-5)
    control = COST.policy(plant.effectiveness(x), gradient)
    torch.testing.assert_close(best.control, control, rtol=1e-4, atol=2e-4)


def test_error_falls_with_the_mesh() -> None:
    x = uniform(5, 1.5, seed=3)
    known = LINEAR.optimal_value(x, COST.q, COST.r)
    excess = [adp.DirectShooting(LINEAR, COST, intervals=n).solve(x).value / known - 1 for n in (20, 40)]
    assert (excess[1] < excess[0] / 8).all()


def test_three_state_optimum() -> None:
    plant, cost = systems.ThreeState(), adp.QuadraticCost(10.0, 1.0, 3, 2)
    best = adp.DirectShooting(plant, cost).solve(torch.cat((X3, 0.1 * X3)))
    # The rollout policy reaches 2.708, the LQR 2.786. The plant is homogeneous, so V* is, of degree 2.
    assert float(best.value[0]) == pytest.approx(2.70471, abs=2e-5)
    torch.testing.assert_close(best.value[1], 0.01 * best.value[0], rtol=1e-6, atol=0)


@pytest.mark.parametrize(
    ("plant", "cost", "intervals"),
    [
        (systems.Pendulum(), COST, 40),
        (systems.VanDerPol(), COST, 40),
        (systems.Pendulum(), adp.BoundedInputCost(1.0, 0.1, 2, 1, bound=8.0), 48),
        (systems.PlanarQuadrotor(), adp.QuadraticCost(1.0, 1.0, 6, 2), None),
    ],
    ids=["pendulum", "van der pol", "bounded pendulum", "quadrotor"],
)
def test_gradient_and_control_solve_the_hjb_equation(
    plant: systems.ControlAffineSystem, cost: adp.Cost, intervals: int | None
) -> None:
    x = 0.2 * torch.randn(5, plant.dim, dtype=torch.float64, generator=torch.Generator().manual_seed(4))
    best = adp.DirectShooting(plant, cost, intervals=intervals).solve(x)
    assert best.converged.all()
    g = plant.effectiveness(x)
    rate = plant.drift(x) + (g @ best.control.unsqueeze(-1)).squeeze(-1)
    residual = cost.rate(x, best.control) + (best.gradient * rate).sum(-1)
    assert (residual.abs() < 1e-4 * cost.rate(x, best.control)).all()
    torch.testing.assert_close(best.control, cost.policy(g, best.gradient))
    lqr = adp.LQR(plant, cost)
    run = adp.simulate(adp.Feedback(lqr), plant, cost, x, dt=0.1, steps=100, every=100)
    assert (best.value < run.cost * (1 + 1e-4)).all()


def test_tracking_has_an_optimum_with_a_base_and_a_terminal_value_of_its_own() -> None:
    lqr = adp.LQR(PLANT, adp.QuadraticCost(10.0, 1.0, 2, 1))
    shooting = adp.DirectShooting(
        adp.TwoStateTracking(),
        adp.tracking_cost(10.0, 1.0),
        base=lambda x: lqr(x[..., :2]),
        terminal=lambda x: lqr.value(x[..., :2]),
        horizon=4.0,
        intervals=60,
    )
    best = shooting.solve(torch.tensor([[-0.5, 0.5, 0.0, 1.0]], dtype=torch.float64))
    assert float(best.value) == pytest.approx(1.4223, abs=1e-4)


class HalfBroken(systems.TwoState):
    def drift(self, x: Tensor) -> Tensor:
        return torch.where(x[..., :1] > 1.0, torch.nan, super().drift(x))


def test_row_that_fails_on_the_coarse_mesh_starts_again_on_the_fine_one() -> None:
    x = uniform(6, 2.0)[:1]
    best = adp.DirectShooting(PLANT, COST, intervals=32, iterations=10).solve(x)
    assert torch.isinf(best.mesh_error).all()  # nothing to compare with
    assert best.converged.all()
    assert (best.value / PLANT.optimal_value(x, COST.q, COST.r) - 1).abs().max() < 1e-4


def test_rows_are_alone_and_a_row_without_optimum_is_reported() -> None:
    x = torch.tensor([[-1.0, 1.0], [1.2, 0.3], [0.0, 0.0], [0.4, -0.7]], dtype=torch.float64)
    best = adp.DirectShooting(HalfBroken(), COST, horizon=4.0, intervals=24, starts=2).solve(x)
    assert best.converged.tolist() == [True, False, True, True]
    assert torch.isnan(best.value[1])
    assert torch.isnan(best.control[1]).all()
    assert float(best.value[2]) == 0.0
    assert torch.equal(best.gradient[2], torch.zeros(2, dtype=torch.float64))
    alone = adp.DirectShooting(PLANT, COST, horizon=4.0, intervals=24).solve(x[3:])
    torch.testing.assert_close(best.value[3], alone.value[0], rtol=1e-11, atol=0)
    torch.testing.assert_close(best.gradient[3], alone.gradient[0], rtol=1e-7, atol=1e-9)


def test_too_few_iterations_are_reported_and_not_passed_off_as_an_optimum() -> None:
    best = adp.DirectShooting(PLANT, COST, intervals=8, iterations=1).solve(uniform(4, 2.0))
    assert not best.converged.any()
    assert torch.isnan(best.value).all()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"horizon": -1.0}, r"`DirectShooting\(horizon=...\)` must be positive"),
        ({"intervals": 2}, r"`DirectShooting\(intervals=...\)` must be at least 4"),
        ({"intervals": 81}, r"`DirectShooting\(intervals=...\)` must be even"),
        ({"tolerance": 0.0}, r"`DirectShooting\(tolerance=...\)` must be positive"),
        ({"iterations": 0}, r"`DirectShooting\(iterations=...\)` must be at least 1"),
    ],
)
def test_bad_arguments_are_refused_by_name(settings: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        adp.DirectShooting(PLANT, COST, **settings)


def test_plant_that_cannot_be_stabilised_and_states_of_another_size_are_refused() -> None:
    stuck = systems.Linear([[1.5, 0.0], [0.0, -1.0]], [[0.0], [1.0]])
    with pytest.raises(ValueError, match=r"Linear .* not stabilisable.*eigenvalue 1.5 1/s"):
        adp.DirectShooting(stuck, COST)
    with pytest.raises(ValueError, match=r"`DirectShooting.solve\(x0=...\)` must have 2 entries"):
        adp.DirectShooting(PLANT, COST).solve(torch.zeros(1, 3, dtype=torch.float64))


def test_an_earlier_plan_is_a_start_that_costs_what_it_did() -> None:
    x = uniform(2, 1.0, seed=5)
    shooting = adp.DirectShooting(LINEAR, COST, intervals=16)
    best = shooting.solve(x)
    start = shooting._warm(best, x, torch.arange(2), best.time)
    torch.testing.assert_close(start.cost, best.value, rtol=1e-2, atol=0)
    torch.testing.assert_close(start.state, best.state, rtol=0, atol=0.02)


def test_at_the_set_point_one_start_is_enough_and_nothing_is_paid() -> None:
    shooting = adp.DirectShooting(systems.VanDerPol(), COST, intervals=16, horizon=2.0)
    best = shooting.solve(torch.zeros(1, 2, dtype=torch.float64))
    assert bool(best.converged.all())
    assert float(best.value) == 0.0
    assert int(best.iterations) <= 6

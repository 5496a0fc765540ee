"""Following a path: exact on a linear plant, by feedback, by plans that go on, by one that is followed."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from staf_torch import adp, systems
from staf_torch.numerics.forward_mode import use_forward_mode

use_forward_mode()

DT, STEPS = 0.1, 20
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


def test_closed_loop_in_continuous_time_counts_the_distance_from_the_path() -> None:
    plant = systems.Clocked(systems.Linear([[0.0]], [[1.0]]))
    cost = adp.TrackingCost(2.0, 1.0, dim=1, inputs=1, path=lambda t: t.unsqueeze(-1), low=-1.0, high=1.0)
    run = adp.simulate(
        adp.Feedback(lambda x: torch.ones_like(x[..., :1])), plant, cost, plant.at(NONE.new_zeros(1, 1)),
        dt=0.1, steps=20,
    )  # fmt: skip
    torch.testing.assert_close(run.state[0, -1], torch.tensor([2.0, 2.0]).double())
    torch.testing.assert_close(run.cost, torch.tensor([2.0]).double())  # of the control alone


def test_what_cannot_follow_a_path_says_so() -> None:
    with pytest.raises(ValueError, match=r"`TrackingCost\(plant=...\)` must have a clock"):
        adp.LQR(mass(), COST)
    with pytest.raises(ValueError, match=r"`near_optimal\(plant=...\)` must have no clock"):
        adp.near_optimal(PLANT, COST)
    with pytest.raises(ValueError, match=r"`DirectShooting\(system=...\)` must have no clock"):
        adp.DirectShooting(systems.Clocked(systems.Pendulum()), COST)
    with pytest.raises(ValueError, match=r"`held_stability\(at=...\)` must be a state of the path"):
        adp.held_stability(adp.LQR(PLANT, COST), PLANT, DT)
    with pytest.raises(
        ValueError, match=r"`TrackingCost\(path=...\)` must map times \(2,\) to states \(2, 2\)"
    ):
        adp.TrackingCost(1.0, 1.0, dim=2, inputs=1, path=lambda t: t)
    library = adp.BoxDDP(PROBLEM, steps=5, compile=False).solve(X0)
    with pytest.raises(ValueError, match=r"`GlobalValue\(problem=...\)` must have a goal that stays"):
        adp.GlobalValue(PROBLEM, library, region=[1.0, 1.0, 1.0])
    with pytest.raises(ValueError, match=r"`SampledProblem\(step=...\)` must move the time"):
        adp.SampledProblem(lambda x, u: (x, u[:, 0].square()), dim=3, inputs=1, path=waves)
    assert (
        adp.held_stability(adp.LQR(PLANT, COST), PLANT, DT, at=waves(NONE.new_zeros(()))).spectral_radius < 1
    )


def test_the_set_point_is_the_path_at_its_beginning_in_double_precision() -> None:
    cost = adp.TrackingCost(1.0, 1.0, dim=2, inputs=1, path=lambda t: torch.stack((0.1 + t, 0.3 - t), dim=-1))
    assert torch.equal(cost.set_point(), torch.tensor([0.1, 0.3], dtype=torch.float64))


def test_the_input_counts_from_where_it_rests_and_within_its_bounds_with_and_without_the_clock() -> None:
    cost = adp.TrackingCost(
        2.0, 3.0, dim=1, inputs=1, path=lambda t: t.unsqueeze(-1), low=-1.0, high=2.0, target_input=[0.5]
    )
    x, u = torch.tensor([[1.4, 1.0]], dtype=torch.float64), torch.tensor([[1.5]], dtype=torch.float64)
    torch.testing.assert_close(cost.rate(x, u), torch.tensor([2 * 0.4**2 + 3.0]).double())
    torch.testing.assert_close(cost.still.rate(x[:, :1], u), torch.tensor([2 * 1.4**2 + 3.0]).double())
    for each in (cost, cost.still):
        assert each.bounds is not None
        assert (each.bounds.low.item(), each.bounds.high.item()) == (-1.0, 2.0)
        assert each.target_input is not None
        assert each.target_input.item() == 0.5

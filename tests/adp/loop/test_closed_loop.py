"""The closed loop: rows are alone, trouble stays in its row, every argument matters, bad input is refused."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from helpers import tensor
from helpers_adp import COST, learner
from helpers_adp import PLANT as TWO_STATE
from torch import Tensor

from staf_torch import adp, systems
from staf_torch.lanes.trace import philox

PLANT = systems.Linear([[0.0, 1.0], [-1.0, -0.5]], [[0.0], [1.0]])
UNFORCED = torch.cat((PLANT.matrix, PLANT.input_matrix), 1)
PAID = adp.QuadraticCost(2.0, 0.5, dim=2, inputs=1)
X0 = tensor([[1.0, 0.0], [-0.5, 0.8], [0.2, -0.3]])
STEP = systems.StepPlant(lambda x, u: 0.9 * x + u, dim=2, inputs=1, dt=0.25)


class Noisy(adp.Controller):
    """u is the sum of its random numbers; it carries how many steps it has taken, and the last dt."""

    draws = 2

    def init(self, x0: Tensor) -> Tensor:
        return x0.new_zeros(len(x0), 2)

    def step(self, x: Tensor, carried: Tensor, uniform: Tensor, dt: float) -> tuple[Tensor, Tensor]:
        assert uniform.shape == (len(x), 2, 2)
        return uniform.flatten(1).sum(-1, keepdim=True), carried + tensor([1.0, dt])


def zero(x: Tensor) -> Tensor:
    return torch.zeros_like(x[..., :1])


def run(controller: Any = zero, plant: Any = PLANT, cost: Any = PAID, x0: Tensor = X0, **given: Any) -> Any:
    with torch.no_grad():
        return adp.simulate(controller, plant, cost, x0, **{"dt": 0.01, "steps": 6, "compile": False} | given)


class BrokenStrip(systems.TwoState):
    """Returns NaN in a strip that the state from (-1, 1) runs into."""

    def drift(self, x: Tensor) -> Tensor:
        return torch.where((x[..., :1] + 0.5).abs() < 0.3, torch.nan, super().drift(x))


def test_a_row_whose_plant_returns_nan_freezes_with_its_weights_and_the_others_do_not_notice() -> None:
    x0 = tensor([[0.1, 0.1], [-1.0, 1.0]])
    controller = learner(adp.Information(), adp.RandomPoints(1, 1e-3))
    found = adp.simulate(controller, BrokenStrip(), COST, x0, dt=0.01, steps=60)
    alone = adp.simulate(controller, TWO_STATE, COST, x0[:1], dt=0.01, steps=60)
    assert found.diverged.tolist() == [False, True]
    torch.testing.assert_close(found.state[0], alone.state[0], rtol=1e-12, atol=0)
    torch.testing.assert_close(found.critic_weights[0], alone.critic_weights[0], rtol=1e-12, atol=0)
    frozen = round(float(found.frozen_at[1]) / 0.01)
    assert 0 < frozen < 60
    for kept in (found.state, found.critic_weights, found.running_cost):
        assert torch.isfinite(kept).all()
        assert torch.equal(kept[1, frozen:], kept[1, -1].expand_as(kept[1, frozen:]))
    assert torch.isnan(found.control[1, frozen:]).all()


def test_the_value_of_an_lqr_solves_the_hjb_equation_with_its_discount() -> None:
    plant, x = systems.Linear([[0.0, 1.0], [2.0, -1.0]], [[0.0], [1.0]]), tensor([[1.0, -0.3], [-0.4, 2.0]])
    cost = adp.QuadraticCost(1.5, 0.5, dim=2, inputs=1, discount=0.7)
    lqr = adp.LQR(plant, cost)
    u, slope = lqr(x), torch.func.grad(lambda x: lqr.value(x).sum())(x)
    residual = cost.rate(x, u) + (slope * plant.motion(x, u)).sum(-1) - 0.7 * lqr.value(x)
    assert float(residual.abs().max()) < 1e-10
    torch.testing.assert_close(plant.optimal_value(x, COST.q, COST.r), adp.LQR(plant, COST).value(x))


# --- the arguments of a run ---------------------------------------------------------------------------------


def test_a_control_is_held_for_the_period_of_the_controller_or_the_plant_or_a_millisecond() -> None:
    held = Noisy()
    held.period = 0.5
    for controller, plant, dt, wanted in (
        (zero, PLANT, None, 0.001),
        (zero, PLANT, 0.02, 0.02),
        (zero, STEP, None, 0.25),
        (zero, STEP, 0.5, 0.5),
        (held, PLANT, None, 0.5),
        (held, STEP, None, 0.5),
        (adp.LQR(PLANT, PAID, period=0.1), PLANT, None, 0.1),
    ):
        found = run(controller, plant, dt=dt, steps=4, every=2)
        torch.testing.assert_close(found.time, tensor([0.0, 2.0, 4.0]) * wanted)
        assert found.time.dtype == torch.float64


@pytest.mark.compiled
def test_pieces_of_a_run_change_nothing() -> None:
    """Random numbers are those of the row's seed and the step, however many steps a call takes."""
    step, done, x = torch.arange(1050, dtype=torch.float64), [], [X0[0]]
    u = philox.uniform(philox.seed_parts([3], step).expand(1050, 4), step, 4).sum(-1)
    given = {"dt": 0.25, "steps": 1050, "seed": 3, "every": 7, "compile": True, "progress": done.append}
    found = run(Noisy(), STEP, x0=X0[:1], **given)
    assert len(done) > 1
    assert sum(done) == 1050
    torch.testing.assert_close(found.time, 0.25 * torch.arange(0, 1051, 7).double())
    torch.testing.assert_close(found.control[0, :-1, 0], u[::7])
    for each in u:
        x.append(0.9 * x[-1] + each)
    torch.testing.assert_close(found.state[0], torch.stack(x[::7]), rtol=1e-9, atol=1e-9)


def test_rows_draw_from_seeds_of_their_own() -> None:
    first = run(Noisy(), seed=5)
    for row in range(3):
        alone = run(Noisy(), x0=X0[row : row + 1], seed=5 + row)
        torch.testing.assert_close(first.control[row, :-1], alone.control[0, :-1])
    listed = run(Noisy(), seed=[7, 5, 7])
    torch.testing.assert_close(listed.control[1, :-1], first.control[0, :-1])
    torch.testing.assert_close(listed.control[0, :-1], listed.control[2, :-1])
    torch.testing.assert_close(listed.control[0, :-1], first.control[2, :-1])
    assert not torch.allclose(first.control[0, :-1], first.control[1, :-1])
    torch.testing.assert_close(run(Noisy()).control[:, :-1], run(Noisy(), seed=0).control[:, :-1])
    numbers = run(Noisy(), x0=X0.repeat(50, 1), steps=10).control[:, :-1] / 4  # of four, even on [-1, 1]
    assert float(numbers.abs().max()) <= 1
    assert abs(float(numbers.mean())) < 0.03
    assert float(numbers.square().mean()) == pytest.approx(1 / 12, rel=0.1)


@pytest.mark.parametrize("discount", [0.0, 0.7])
@pytest.mark.parametrize("integrator", ["runge_kutta", "euler"])
def test_what_is_paid_is_the_sum_over_the_steps(discount: float, integrator: str) -> None:
    cost = adp.QuadraticCost(2.0, 0.5, dim=2, inputs=1, discount=discount)
    found = run(Noisy(), cost=cost, dt=0.1, steps=8, integrator=integrator)
    spent, x = torch.zeros(3).double(), X0
    for k in range(8):
        u = found.control[:, k]
        if integrator == "euler":
            step, paid = x + 0.1 * PLANT.rate(x, u), 0.1 * cost.rate(x, u)
        else:
            z = torch.cat((x, u), -1)
            flow = torch.cat((UNFORCED, torch.zeros(1, 3).double()))
            step, paid = (z @ torch.linalg.matrix_exp(0.1 * flow).mT)[:, :2], torch.zeros(3).double()
            for share, mass in ((0.0, 1.0), (0.5, 4.0), (1.0, 1.0)):  # Simpson's rule
                at = (z @ torch.linalg.matrix_exp(0.1 * share * flow).mT)[:, :2]
                paid = paid + 0.1 * mass / 6 * math.exp(-discount * 0.1 * share) * cost.rate(at, u)
        spent, x = spent + math.exp(-discount * 0.1 * k) * paid, step
        torch.testing.assert_close(found.state[:, k + 1], x, rtol=1e-6, atol=1e-6)
        torch.testing.assert_close(found.running_cost[:, k + 1], spent, rtol=1e-5, atol=1e-6)
        x = found.state[:, k + 1]
    assert torch.equal(found.cost, found.running_cost[:, 8])
    assert torch.equal(found.running_cost[:, 0], torch.zeros(3).double())
    assert bool(found.control[:, 8].isnan().all())
    assert found.control.shape == (3, 9, 1)


def test_a_row_at_the_limit_lives_and_one_beyond_is_frozen_in_time() -> None:
    still = systems.StepPlant(lambda x, u: x + u, dim=2, inputs=1, dt=0.5)

    def off(x: Tensor) -> Tensor:  # the third row walks away, a unit a step
        return torch.where(x[..., :1] == x[..., 1:], torch.ones_like(x[..., :1]), 0.0)

    x0 = tensor([[3.0, 4.0], [4.0, 3.1], [0.0, 0.0], [math.nan, 0.0]])
    cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
    found = run(off, still, cost, x0, dt=0.5, steps=8, limit=5.0)
    assert found.frozen_at.tolist() == [math.inf, 0.0, 1.5, 0.0]
    assert found.diverged.tolist() == [False, True, True, True]
    assert found.state[2, :, 0].tolist() == [0.0, 1.0, 2.0, 3.0, 3.0, 3.0, 3.0, 3.0, 3.0]
    assert found.control[2].isnan().flatten().tolist() == [False] * 3 + [True] * 6
    assert float(found.cost[1]) == 0.0
    assert float(found.cost[2]) == pytest.approx(0.5 * (3 + 2 * (0 + 1 + 4)))


class Growing(Noisy):
    """Its memory becomes infinite in the second step of the first row."""

    def step(self, x: Tensor, carried: Tensor, uniform: Tensor, dt: float) -> tuple[Tensor, Tensor]:
        u, after = super().step(x, carried, uniform, dt)
        late = (after[:, :1] == 2) & (x[:, :1] > 0.5)
        return u, torch.where(late, torch.inf, after)


def test_a_memory_that_is_lost_freezes_its_row_alone() -> None:
    found = run(Growing(), steps=5, dt=0.02)
    assert found.frozen_at.tolist() == [0.02, math.inf, math.inf]
    assert bool(torch.isfinite(found.state).all())


def test_a_control_that_is_renewed_follows_the_state_within_its_bounds() -> None:
    cost = adp.QuadraticCost(2.0, 0.5, dim=2, inputs=1, low=-0.3, high=0.2)

    def policy(x: Tensor) -> Tensor:
        return -2 * x[..., 1:]

    found = run(policy, cost=cost, dt=0.2, steps=3, substeps=4, renew=True)
    fine = run(policy, cost=cost, dt=0.05, steps=12, every=4)
    torch.testing.assert_close(found.state, fine.state, rtol=1e-12, atol=1e-14)
    torch.testing.assert_close(found.cost, fine.cost)
    held = run(policy, cost=cost, dt=0.2, steps=3, substeps=4)
    assert float((held.state - fine.state).abs().max()) > 1e-4
    for controller, plant in ((Noisy(), PLANT), (zero, STEP)):
        with pytest.raises(
            ValueError, match=r"`ClosedLoop\(renew=...\)` needs a feedback law and a plant in"
        ):
            run(controller, plant, dt=0.25, renew=True)


IN_NUMPY = systems.StepPlant(lambda x, u: 0.9 * x + np.asarray(u), dim=2, inputs=1, dt=0.01)


@pytest.mark.needs_compiler
@pytest.mark.compiled
@pytest.mark.parametrize(
    ("costly", "compile", "plant", "compiled"),
    [
        (False, "auto", PLANT, True),
        (True, "auto", PLANT, False),
        (True, True, PLANT, True),
        (False, "auto", IN_NUMPY, False),
    ],
)
def test_a_loop_is_compiled_where_its_work_pays(
    costly: bool, compile: Any, plant: systems.Plant, compiled: bool
) -> None:
    calls = []

    class Busy(adp.Controller):
        work = 1e4

        def init(self, x0: Tensor) -> Tensor:
            return torch.zeros_like(x0[:, 0])

        def step(self, x: Tensor, carried: Tensor, uniform: Tensor, dt: float) -> tuple[Tensor, Tensor]:
            calls.append(len(x))
            return -x[:, 1:], carried

    Busy.costly = costly
    run(Busy(), plant, x0=X0[:2], steps=40, compile=compile)
    assert (len(calls) < 30) is compiled  # else plain torch asks at every step


def test_arguments_of_a_run_are_refused_by_name() -> None:
    with pytest.raises(
        ValueError, match=r"`simulate\(controller=...\)` must be a Controller or a function of x"
    ):
        run(3)
    with pytest.raises(ValueError, match=r"`simulate\(every=...\)` must divide the 6 steps; got 4"):
        run(every=4)

"""Receding-horizon control: exact on linear plants, within bounds, and as good as the memory at its end."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from helpers import tensor
from helpers_plans import BOX, pushed
from helpers_swingup import GRID, RESETS, cost_of, double_integrator, pendulum
from torch import Tensor

from staf_torch import adp, lanes, systems

NONE = torch.empty(0, dtype=torch.float64)


def drive(mpc: adp.RecedingHorizon, x: Tensor, steps: int) -> tuple[Tensor, Tensor]:
    """Controls (B, T, m) and the last state."""
    carried, controls = mpc.init(x), []
    for _ in range(steps):
        u, carried = mpc.step(x, carried, NONE, 0.0)
        x, _ = mpc.problem.advance(x, u)
        controls.append(u)
    return torch.stack(controls, dim=1), x


def test_linear_plant_gets_the_regulator_at_every_horizon() -> None:
    problem = double_integrator()
    x = torch.tensor([[1.0, -0.5]], dtype=torch.float64)
    controls, _ = drive(adp.RecedingHorizon(problem, steps=3, compile=False), x, 5)
    torch.testing.assert_close(controls[:, 0], problem.linear_feedback(x), rtol=1e-8, atol=1e-10)
    torch.testing.assert_close(cost_of(problem, x, controls), problem.terminal(x), rtol=1e-8, atol=1e-10)


@pytest.mark.compiled
def test_with_one_iteration_a_control_the_loop_comes_to_the_optimum_within_bounds() -> None:
    problem, x = double_integrator(-1.0, 1.0), tensor([[3.0, 0.0], [-1.0, 2.0]])
    controls, last = drive(adp.RecedingHorizon(problem, steps=25, iterations=1), x, 60)
    assert bool(problem.bounds.contain(controls).all())
    assert float(controls.abs().max()) == 1.0
    assert float(last.abs().max()) < 0.1
    once = adp.BoxDDP(problem, steps=60).solve(x)
    torch.testing.assert_close(cost_of(problem, x, controls), once.cost, rtol=1e-3, atol=0)


def test_short_plan_that_ends_in_the_memory_swings_up(memory: adp.GlobalValue) -> None:
    mpc, starts = adp.RecedingHorizon(memory.problem, steps=20, memory=memory), [2, 4, 6]
    controls, last = drive(mpc, RESETS[starts], 100)
    assert float(memory.problem.terminal(last).max()) < 1e-2
    assert float(cost_of(memory.problem, RESETS[starts], controls).mean() / GRID[starts].mean()) < 1.01


def test_one_plan_of_the_memory_is_followed_up(memory: adp.GlobalValue) -> None:
    mpc = adp.RecedingHorizon(memory.problem, steps=120, iterations=0, memory=memory)
    controls, last = drive(mpc, RESETS, 120)
    assert float(memory.problem.terminal(last).max()) < 1e-2
    cost = cost_of(memory.problem, RESETS, controls)
    assert bool((cost <= memory.value(RESETS) * (1 + 1e-3)).all())
    assert float(cost.mean() / GRID.mean()) < 1.01


def test_simulation_drives_it_as_a_controller() -> None:
    plant = systems.Pendulum()
    cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1, low=-4.0, high=4.0)
    problem = adp.SampledProblem.of(plant, cost, dt=0.1)
    mpc = adp.RecedingHorizon(problem, steps=6, iterations=2, compile=False)
    x0 = torch.tensor([[0.3, 0.0], [-0.2, 0.1]], dtype=torch.float64)
    run = adp.simulate(mpc, plant, cost, x0, dt=0.1, steps=6, compile=False)
    best = adp.BoxDDP(problem, steps=6, compile=False).solve(x0)
    torch.testing.assert_close(run.cost, best.cost - problem.terminal(best.state[:, -1]), rtol=1e-3, atol=0)


def test_first_plan_that_tries_held_bounds_finds_the_cheaper_way(memory: adp.GlobalValue) -> None:
    x = torch.tensor([[1.1, -2.0], [1.1, 1.0], [0.2, 0.0]], dtype=torch.float64)
    plain, held = (
        drive(adp.RecedingHorizon(memory.problem, steps=60, held=held), x, 80) for held in (False, True)
    )
    costs = [cost_of(memory.problem, x, controls) for controls, _ in (plain, held)]
    assert bool((costs[0][:2] > tensor([1.05, 1.3]) * costs[1][:2]).all())
    torch.testing.assert_close(costs[0][2], costs[1][2])
    assert bool((costs[1] < 1.01 * memory.value(x))[[0, 2]].all())  # one corner, once: no swing-up
    assert float(memory.problem.terminal(held[1]).max()) < 1e-2
    with pytest.raises(ValueError, match="must be False with a memory"):
        adp.RecedingHorizon(memory.problem, steps=5, memory=memory, held=True)


def test_memory_of_another_problem_is_refused(memory: adp.GlobalValue) -> None:
    with pytest.raises(ValueError, match="must be of the same problem"):
        adp.RecedingHorizon(pendulum(), steps=5, memory=memory)


@torch.no_grad()
@pytest.mark.compiled
@pytest.mark.needs_compiler
def test_hastened_control_is_that_of_the_parts(caplog: pytest.LogCaptureFixture) -> None:
    mpc = adp.RecedingHorizon(double_integrator(-1.0, 1.0), steps=9)
    x = torch.tensor([[0.1, 0.0], [3.0, 1.0], [-2.0, 2.0], [math.nan, 0.0]], dtype=torch.float64)
    plan, none = mpc.init(x), x.new_zeros(4, 0)
    parts = mpc.step(x + 0.1, plan, none, 0.1)
    mpc.hasten()
    whole, alone = (mpc.step(x[k] + 0.1, rows_of(plan, k), none[k], 0.1) for k in (slice(4), slice(1, 2)))
    assert not caplog.text
    torch.testing.assert_close(whole[0][:3], parts[0][:3], rtol=0, atol=1e-8)  # of a search of a few rounds
    torch.testing.assert_close(whole[1].plan[:3], parts[1].plan[:3], rtol=0, atol=1e-8)
    assert torch.equal(whole[0][1:2], alone[0])


def rows_of(state: Any, rows: slice) -> Any:
    return type(state)(*(part[rows] for part in state))


@torch.no_grad()
@pytest.mark.compiled
@pytest.mark.needs_compiler
def test_a_plan_that_is_followed_is_its_feedback_and_then_that_of_the_goal_also_compiled() -> None:
    mpc = adp.RecedingHorizon(BOX, steps=3, iterations=0, compile=False)
    x0 = tensor([[2.0, 1.0], [-1.0, 0.5]])
    found, carried, x = adp.BoxDDP(BOX, steps=3, compile=False).solve(x0), mpc.init(x0), x0 + 0.05

    def step(now: tuple[Tensor, Any], _: tuple[()], row: tuple[()]) -> tuple[tuple[Tensor, Any], Tensor]:
        x, plan = now
        u, after = mpc.step(x, plan, x, 0.1)
        return (pushed(x, u)[0], after), u

    program, whole = lanes.Program(step, name="a plan that is followed"), (x, carried)
    assert program.compiles(whole, (), (), steps=5)
    compiled = program(whole, steps=5)[1]
    for k in range(5):  # also behind its end
        u, carried = mpc.step(x, carried, x, 0.1)
        answered = BOX.linear_feedback(x)
        if k < 3:
            away = (found.feedback[:, k] @ (x - found.state[:, k]).unsqueeze(-1)).squeeze(-1)
            answered = BOX.admissible(found.control[:, k] + away)
        torch.testing.assert_close(u, answered)
        torch.testing.assert_close(compiled[:, k], u, rtol=0, atol=1e-12)
        x, _ = pushed(x, u)

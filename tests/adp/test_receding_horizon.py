"""Receding-horizon control: exact on linear plants, within bounds, and as good as the memory at its end."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from helpers_swingup import GRID, RESETS, cost_of, double_integrator, pendulum
from torch import Tensor

from staf_torch import adp, systems
from staf_torch.adp.plans import Reference
from staf_torch.adp.traced_search import TracedSearch

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


def test_bounds_hold_and_the_state_comes_to_rest() -> None:
    problem = double_integrator(-1.0, 1.0)
    x = torch.tensor([[3.0, 0.0], [-1.0, 2.0]], dtype=torch.float64)
    controls, last = drive(adp.RecedingHorizon(problem, steps=25), x, 60)
    assert bool(problem.bounds.contain(controls).all())
    assert float(controls.abs().max()) == 1.0
    assert float(last.abs().max()) < 0.1


def test_short_plan_that_ends_in_the_memory_swings_up(memory: adp.GlobalValue) -> None:
    mpc = adp.RecedingHorizon(memory.problem, steps=20, memory=memory)
    controls, last = drive(mpc, RESETS, 120)
    assert float(memory.problem.terminal(last).max()) < 1e-2
    assert float(cost_of(memory.problem, RESETS, controls).mean() / GRID.mean()) < 1.01


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
    mpc = adp.RecedingHorizon(problem, steps=10, iterations=2, compile=False)
    x0 = torch.tensor([[0.3, 0.0], [-0.2, 0.1]], dtype=torch.float64)
    run = adp.simulate(mpc, plant, cost, x0, dt=0.1, steps=12, compile=False)
    best = adp.BoxDDP(problem, steps=12, compile=False).solve(x0)
    torch.testing.assert_close(run.cost, best.cost - problem.terminal(best.state[:, -1]), rtol=1e-3, atol=0)


def test_first_plan_that_tries_held_bounds_finds_the_cheaper_way(memory: adp.GlobalValue) -> None:
    x = torch.tensor([[1.1, -2.0], [1.1, 1.0], [0.2, 0.0]], dtype=torch.float64)
    plain, held = (
        drive(adp.RecedingHorizon(memory.problem, steps=60, held=held), x, 80) for held in (False, True)
    )
    costs = [cost_of(memory.problem, x, controls) for controls, _ in (plain, held)]
    assert bool((costs[0][:2] > 1.3 * costs[1][:2]).all())
    torch.testing.assert_close(costs[0][2], costs[1][2])
    assert bool((costs[1] < 1.01 * memory.value(x))[[0, 2]].all())  # one corner, once: no swing-up
    assert float(memory.problem.terminal(held[1]).max()) < 1e-2
    with pytest.raises(ValueError, match="must be False with a memory"):
        adp.RecedingHorizon(memory.problem, steps=5, memory=memory, held=True)


def test_memory_of_another_problem_is_refused(memory: adp.GlobalValue) -> None:
    with pytest.raises(ValueError, match="must be of the same problem"):
        adp.RecedingHorizon(pendulum(), steps=5, memory=memory)


@torch.no_grad()
@pytest.mark.parametrize("iterations", [1, 3, 15])
def test_search_as_a_program_finds_the_plan_of_the_search(iterations: int) -> None:
    """Rows that converge, that meet bounds, that begin badly, and one that is no number."""
    problem = double_integrator(-1.0, 1.0)
    search = adp.BoxDDP(problem, steps=9, iterations=iterations, compile=False)
    x = torch.tensor([[0.1, 0.0], [3.0, 1.0], [-2.0, 2.0], [math.nan, 0.0], [0.0, 0.0]], dtype=torch.float64)
    generator = torch.Generator().manual_seed(iterations)
    control = 3 * torch.rand(5, 9, 1, dtype=torch.float64, generator=generator) - 1.5
    around = Reference(torch.zeros(5, 9, 2).double(), -problem.k.expand(5, 9, 1, 2))
    found = search.solve(x, control, around)
    state, u, feedback = TracedSearch(search)(x, control, around)
    fine = torch.isfinite(x).all(-1)
    for traced, plain in ((state, found.state), (u, found.control), (feedback, found.feedback)):
        torch.testing.assert_close(traced[fine], plain[fine], rtol=0, atol=1e-7 if iterations > 3 else 1e-12)


@torch.no_grad()
@pytest.mark.needs_compiler
def test_hastened_control_is_that_of_the_parts(caplog: pytest.LogCaptureFixture) -> None:
    mpc = adp.RecedingHorizon(double_integrator(-1.0, 1.0), steps=9)
    x = torch.tensor([[0.1, 0.0], [3.0, 1.0], [-2.0, 2.0]], dtype=torch.float64)
    plan, none = mpc.init(x), x.new_zeros(3, 0)
    parts = mpc.step(x + 0.1, plan, none, 0.1)
    mpc.hasten()
    whole, alone = (
        mpc.step(x[rows] + 0.1, rows_of(plan, rows), none[rows], 0.1) for rows in (slice(3), slice(1, 2))
    )
    assert not caplog.text
    torch.testing.assert_close(whole[0], parts[0], rtol=0, atol=1e-8)  # of a search of a few rounds
    torch.testing.assert_close(whole[1].identifier, parts[1].identifier, rtol=0, atol=1e-8)
    assert torch.equal(whole[0][1:2], alone[0])


def rows_of(state: Any, rows: slice) -> Any:
    return state._replace(**{name: part[rows] for name, part in state._asdict().items()})


@torch.no_grad()
def test_a_plan_that_is_followed_is_followed_alike_in_a_program(
    memory: adp.GlobalValue, monkeypatch: pytest.MonkeyPatch
) -> None:
    mpc = adp.RecedingHorizon(memory.problem, steps=12, iterations=0, memory=memory)
    carried, x = mpc.init(RESETS[:3]), RESETS[:3]
    for _ in range(14):  # also behind its end
        u, after = mpc._followed(x, carried.identifier)
        with monkeypatch.context() as inside:
            inside.setattr("staf_torch.adp.receding_horizon.tracing_now", lambda: True)
            traced, its = mpc._followed(x, carried.identifier)
        torch.testing.assert_close(traced, u, rtol=0, atol=1e-12)
        assert torch.equal(its.identifier, after.identifier)
        carried = after
        x, _ = memory.problem.advance(x, u)

"""The memory of local models: near the optimum of the pendulum's swing-up, and what it says about itself."""

from __future__ import annotations

import pickle

import pytest
import torch
from helpers_swingup import GRID, REGION, RESETS
from torch import Tensor

from staf_torch import adp


def swing(policy: adp.GlobalValue, x: Tensor) -> tuple[Tensor, Tensor]:
    """The cost of 200 steps, and the last state."""
    spent = torch.zeros_like(x[:, 0])
    for _ in range(200):
        x, paid = policy.problem.advance(x, policy(x))
        spent = spent + paid
    return spent, x


def test_swing_up_costs_what_dynamic_programming_costs(memory: adp.GlobalValue) -> None:
    spent, last = swing(memory, RESETS)
    assert float(spent.mean() / GRID.mean()) < 1.01
    assert float(memory.problem.terminal(last).max()) < 1e-3


def test_value_is_the_cost_that_its_policy_pays(memory: adp.GlobalValue) -> None:
    spent, _ = swing(memory, RESETS)
    found = memory.choose(RESETS)
    assert bool(found.covered.all())
    assert float((found.value / spent).log().abs().median()) < 1e-3
    torch.testing.assert_close(memory.value(RESETS), found.value)


def test_bellman_residual_is_small_where_the_memory_knows_the_optimum(memory: adp.GlobalValue) -> None:
    assert float(memory.bellman_residual(RESETS).abs().median()) < 1e-3


def test_gradient_is_the_slope_of_the_value(memory: adp.GlobalValue) -> None:
    library = memory.library.rows(memory.library.converged & memory.arrives)
    x, h = library.state[library.cost.argsort()[[10, 30]], 3], 1e-5
    for i, e in enumerate(h * torch.eye(2, dtype=torch.float64)):
        rise = (memory.value(x + e) - memory.value(x - e)) / (2 * h)
        torch.testing.assert_close(memory.gradient(x)[:, i], rise, rtol=1e-2, atol=1e-2)


def test_one_state_gets_the_control_of_a_batch(memory: adp.GlobalValue) -> None:
    batch = memory(RESETS)
    single = torch.cat([memory(x.unsqueeze(0)) for x in RESETS])
    torch.testing.assert_close(single, batch, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(memory(RESETS.view(2, 4, 2)), batch.view(2, 4, 1), rtol=1e-12, atol=1e-12)


def test_a_whole_turn_changes_nothing(memory: adp.GlobalValue) -> None:
    turned = RESETS + torch.tensor([2 * torch.pi, 0.0], dtype=torch.float64)
    torch.testing.assert_close(memory(turned), memory(RESETS), rtol=1e-6, atol=1e-6)


def test_a_plan_that_is_followed_from_a_whole_turn_away_is_the_same_plan_there(
    memory: adp.GlobalValue,
) -> None:
    entries = memory.length * torch.arange(len(RESETS))
    turn = torch.tensor([2 * torch.pi, 0.0], dtype=torch.float64)
    here, there = (memory.replay(x, entries, 5) for x in (RESETS, RESETS + turn))
    torch.testing.assert_close(there[0], here[0], rtol=0, atol=0)
    torch.testing.assert_close(there[1].state - turn, here[1].state, rtol=0, atol=1e-12)
    torch.testing.assert_close(there[1].feedback, here[1].feedback, rtol=0, atol=0)
    assert bool(((here[1].state[:, 0] - RESETS)[:, 0].abs() <= torch.pi).all())


def test_candidates_lie_apart_along_a_trajectory_and_leave_no_gap(memory: adp.GlobalValue) -> None:
    state, searched = memory.library.state[:, :-1], set(memory.entries.tolist())
    for row in range(len(state)):
        begin = row * memory.length
        assert (begin in searched) == bool(memory.arrives[row])
        last = state[row, 0]
        for k in range(1, state.shape[1] if memory.arrives[row] else 0):
            gap = float((memory.problem.offset(state[row, k], last) / memory.region).norm())
            assert (begin + k in searched) == (gap >= memory.spacing) or abs(gap - memory.spacing) < 1e-9
            last = state[row, k] if begin + k in searched else last


def test_candidates_are_the_nearest_by_the_mean_curvature_the_shorter_way_around(
    memory: adp.GlobalValue,
) -> None:
    curvature = memory.models[memory.entries, 5:].view(-1, 2, 2) * memory.region * memory.region[:, None]
    size, axes = torch.linalg.eigh(curvature)
    metric = torch.einsum("bij,bj,bkj->ik", axes, size.abs(), axes) / len(size)
    metric = metric + 0.01 * metric.trace() / 2 * torch.eye(2, dtype=torch.float64)
    x = torch.cat((RESETS, torch.tensor([[3.1, 0.5], [-3.1, -0.5]], dtype=torch.float64)))
    d = memory.problem.offset(x.unsqueeze(1), memory.plans[memory.entries, :2]) / memory.region
    far, wanted = (d @ metric * d).sum(-1).topk(memory.candidates, 1, largest=False)
    assert bool((far[:, -1].sqrt() < torch.pi / memory.region[0] * metric[0, 0].sqrt()).all())  # not twice
    found = memory.nearest(x)
    assert torch.equal(found[:, :-1].sort().values, memory.entries[wanted].sort().values)
    assert bool((found[:, -1] == memory.resting).all())


def test_control_at_rest_on_top_is_the_regulator(memory: adp.GlobalValue) -> None:
    x = torch.tensor([[0.01, -0.02]], dtype=torch.float64)
    torch.testing.assert_close(memory(x), memory.problem.linear_feedback(x), rtol=1e-2, atol=1e-3)


def test_memory_survives_a_pickle_and_keeps_to_the_bounds(memory: adp.GlobalValue) -> None:
    problem = memory.problem
    grown = adp.learn_global_value(problem, REGION, steps=60, trajectories=6, rounds=0, candidates=4)
    # A problem made by a function inside a function does not pickle: the module's own does.
    copied = pickle.loads(pickle.dumps(grown.library))
    again = adp.GlobalValue(problem, copied, REGION, candidates=4)
    x = torch.tensor([[2.0, 1.0], [-0.1, 0.0]], dtype=torch.float64)
    assert torch.equal(again(x), grown(x))
    assert bool(problem.bounds.contain(grown(x)).all())


def test_bad_input_is_named(memory: adp.GlobalValue) -> None:
    with pytest.raises(ValueError, match=r"region=....` must be positive"):
        adp.GlobalValue(memory.problem, memory.library, [1.0, 0.0])
    never = memory.library._replace(value=torch.full_like(memory.library.value, torch.inf))
    with pytest.raises(ValueError, match="must have a trajectory that arrives"):
        adp.GlobalValue(memory.problem, never, REGION)
    with pytest.raises(ValueError, match=r"trajectories=....` must be at least 2"):
        adp.learn_global_value(memory.problem, REGION, steps=10, trajectories=1)

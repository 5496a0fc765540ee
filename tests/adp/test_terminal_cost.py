"""A terminal cost: plans, shooting and rollouts end with it; what knows no end refuses it."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from staf_torch import adp, systems

A, B = [[0.0, 1.0], [0.5, -0.1]], [[0.0], [1.0]]
END = torch.tensor([[8.0, 1.0], [1.0, 0.5]], dtype=torch.float64)
X0 = torch.tensor([[1.0, -0.5], [-0.3, 0.8]], dtype=torch.float64)
PLANT = systems.Linear(A, B)
COST = adp.QuadraticCost(1.0, 0.5, 2, 1, terminal=END)


def riccati_recursion(problem: adp.SampledProblem, steps: int) -> tuple[Tensor, Tensor]:
    """P at the start and the gains (T, m, n) of the linear-quadratic problem that ends with x'Sx."""
    at = problem.derivatives(torch.zeros(1, 2).double(), torch.zeros(1, 1).double())
    a, b, w = at.first[0, :, :2], at.first[0, :, 2:], 0.5 * at.cost_second[0]
    p, gains = END, []
    for _ in range(steps):
        inner = w[2:, 2:] + b.mT @ p @ b
        cross = b.mT @ p @ a + w[2:, :2]
        k = torch.linalg.solve(inner, cross)
        p = w[:2, :2] + a.mT @ p @ a - cross.mT @ k
        gains.insert(0, k)
    return p, torch.stack(gains)


def test_plan_of_a_linear_plant_is_the_regulator_of_its_horizon() -> None:
    problem = adp.SampledProblem.of(PLANT, COST, dt=0.1)
    p, gains = riccati_recursion(problem, 12)
    found = adp.BoxDDP(problem, steps=12, compile=False).solve(X0)
    torch.testing.assert_close(found.cost, (X0 @ p * X0).sum(-1), rtol=1e-9, atol=0)
    torch.testing.assert_close(found.feedback, -gains.expand(2, -1, -1, -1), rtol=1e-7, atol=1e-7)
    endless = adp.SampledProblem.of(PLANT, adp.QuadraticCost(1.0, 0.5, 2, 1), dt=0.1)
    torch.testing.assert_close(endless.terminal(X0), (X0 @ endless.p * X0).sum(-1))
    assert float((endless.k - gains[-1]).abs().max()) > 0.1  # the two differ near the end
    follower = adp.RecedingHorizon(problem, steps=12, iterations=0, compile=False)
    x, carried = X0, follower.init(X0)
    for k in gains:
        u, carried = follower.step(x, carried, X0, 0.1)
        torch.testing.assert_close(u, -x @ k.mT, rtol=1e-6, atol=1e-7)
        x, _ = problem.advance(x, u)


def test_shooting_over_a_horizon_pays_the_terminal_cost() -> None:
    horizon = 1.5
    a, b = (torch.tensor(part, dtype=torch.float64) for part in (A, B))
    hamiltonian = torch.cat(
        (torch.cat((a, -b @ b.mT / 0.5), dim=1), torch.cat((-torch.eye(2).double(), -a.mT), dim=1))
    )
    both = torch.linalg.matrix_exp(-hamiltonian * horizon) @ torch.cat((torch.eye(2).double(), END))
    p = both[2:] @ torch.linalg.inv(both[:2])  # of the Riccati differential equation, backward in time
    found = adp.DirectShooting(PLANT, COST, horizon=horizon, intervals=20).solve(X0)
    torch.testing.assert_close(found.value, (X0 @ p * X0).sum(-1), rtol=1e-4, atol=0)
    left = (found.state[:, -1] @ END * found.state[:, -1]).sum(-1) / found.value
    torch.testing.assert_close(found.horizon_error, left, rtol=1e-9, atol=0)


def test_rollouts_end_with_the_terminal_cost_around_the_set_point() -> None:
    cost = adp.QuadraticCost(1.0, 0.5, 2, 1, terminal=END, target=[0.4, 0.0])
    policy = adp.RolloutPolicy.of_lqr(PLANT, cost, horizon=0.5, steps=5)
    away = X0 - torch.tensor([0.4, 0.0], dtype=torch.float64)
    torch.testing.assert_close(policy.terminal(X0), (away @ END * away).sum(-1))
    none = adp.QuadraticCost(1.0, 0.5, 2, 1, terminal=torch.zeros(2, 2).double(), target=[0.4, 0.0])
    cheaper = adp.RolloutPolicy.of_lqr(PLANT, none, horizon=0.5, steps=5)
    assert bool((policy.rollout(X0) > cheaper.rollout(X0)).all())


def test_what_knows_no_end_refuses_a_terminal_cost() -> None:
    with pytest.raises(ValueError, match=r"terminal=...\)` must be None beside an output or a discount"):
        adp.QuadraticCost(1.0, 1.0, 2, 1, terminal=1.0, discount=0.1)
    with pytest.raises(ValueError, match=r"terminal=...\)` must be .*semidefinite"):
        adp.QuadraticCost(1.0, 1.0, 2, 1, terminal=-END)
    with pytest.raises(ValueError, match=r"near_optimal\(cost=...\)` must have no terminal cost"):
        adp.near_optimal(PLANT, COST, dt=0.1)
    with pytest.raises(ValueError, match=r"DirectShooting\(horizon=...\)` must be given beside a terminal"):
        adp.DirectShooting(PLANT, COST)
    problem = adp.SampledProblem.of(PLANT, COST, dt=0.1)
    library = adp.BoxDDP(problem, steps=3, compile=False).solve(X0)
    with pytest.raises(ValueError, match=r"GlobalValue\(problem=...\)` must have no terminal cost"):
        adp.GlobalValue(problem, library, [1.0, 1.0])

"""Costs beside sums and integrals that are written out: their policies, bounds, set-points and ends."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from helpers import tensor, uniform
from torch import Tensor

from staf_torch import adp, systems

Q = tensor([[2.0, 0.3], [0.3, 1.0]])
R = tensor([[1.0, 0.0], [0.0, 3.0]])
COUPLED = tensor([[1.0, 0.4], [0.4, 3.0]])
X, U = uniform(5, 2, seed=1), uniform(5, 2, seed=2)


def form(matrix: Tensor, x: Tensor) -> Tensor:
    return torch.einsum("...i,ij,...j->...", x, matrix, x)


def crane(high: float) -> systems.RatePlant:
    """Rests at (1, 5) under (0.2, -0.4); the first coordinate is an angle."""
    a, b = tensor([[0.0, 1.0], [-1.0, -0.3]]), tensor([[1.0, 0.0], [0.2, 1.0]])
    rest, held = tensor([1.0, 5.0]), tensor([0.2, -0.4])
    given = {"periodic": [0], "equilibrium": (rest, held), "low": -high, "high": high}
    return systems.RatePlant(lambda x, u: (x - rest) @ a.mT + (u - held) @ b.mT, dim=2, inputs=2, **given)


SAT = {"low": -1.0, "high": [0.5, 2.0], "target_input": [0.1, -0.2]}
COSTS: dict[str, tuple[dict[str, Any], Tensor]] = {
    "plain": ({}, R),
    "coupled": ({}, COUPLED),
    "bounds": ({"low": [-0.4, -math.inf], "high": 0.6}, R),
    "coupled bounds": ({"low": [-0.4, -math.inf], "high": 0.6}, COUPLED),
    "target": ({"target": [0.5, -1.0], "target_input": [0.3, 0.1]}, R),
    "coupled target": ({"target_input": [0.3, 0.1], "low": -0.5, "high": 0.5}, COUPLED),
    "output": ({"output": lambda x: torch.stack((x.sum(-1).sin(), x[..., 0]), -1), "target": [0.5, 1.0]}, R),
}


@pytest.mark.parametrize("name", COSTS)
def test_quadratic_costs_are_their_forms_and_their_policies_the_minimum(name: str) -> None:
    given, r = COSTS[name]
    cost = adp.QuadraticCost(Q, r, 2, 2, **given)
    away = X - tensor(given.get("target", [0.0, 0.0]))
    effort = U - tensor(given.get("target_input", [0.0, 0.0]))
    if "output" in given:
        away = given["output"](X) - given["output"](tensor([[0.5, 1.0]]))
    torch.testing.assert_close(cost.state_rate(X), form(Q, away))
    torch.testing.assert_close(cost.input_rate(U), form(r, effort))
    torch.testing.assert_close(cost.rate(X, U), form(Q, away) + form(r, effort))
    torch.testing.assert_close(cost.effort(U), effort)
    torch.testing.assert_close(cost.input_of(effort), U)
    torch.testing.assert_close(cost.unsaturated(U), U)
    assert cost.plain is (name in ("plain", "coupled"))
    g, p = uniform(5, 2, 2, seed=3), 2 * uniform(5, 2, seed=4)
    u = cost.policy(g, p)
    pull = torch.einsum("bnm,bn->bm", g, p)

    def hamiltonian(v: Tensor) -> Tensor:
        return cost.input_rate(v) + (v * pull).sum(-1)

    if cost.bounds is None:
        rest = tensor(given.get("target_input", [0.0, 0.0]))
        torch.testing.assert_close(u, rest - 0.5 * torch.linalg.solve(r, pull.mT).mT)
        assert torch.equal(cost.saturate(9 * U), 9 * U)
    else:
        assert bool(cost.bounds.contain(u).all())
        assert torch.equal(cost.saturate(9 * U), cost.bounds.clip(9 * U))
        assert float((u == cost.bounds.high).double().mean()) > 0
    for turn in range(12):
        moved = u + 1e-3 * tensor([math.cos(0.5236 * turn), math.sin(0.5236 * turn)])
        moved = moved if cost.bounds is None else cost.bounds.clip(moved)
        assert bool((hamiltonian(moved) >= hamiltonian(u) - 1e-12).all())


def test_slopes_of_an_output_bend_the_cost_at_its_set_point() -> None:
    cost = adp.QuadraticCost(Q, R, 2, 2, **COSTS["output"][0])
    slope = tensor([[math.cos(1.5), math.cos(1.5)], [1.0, 0.0]])
    torch.testing.assert_close(cost.state_curvature(), slope.mT @ Q @ slope)
    narrow = adp.QuadraticCost([[4.0]], R, 2, 2, output=lambda x: x[..., :1] ** 2)
    torch.testing.assert_close(narrow.state_rate(X), 4 * X[:, 0] ** 4)


@pytest.mark.parametrize("given", [{"bound": [0.7, 2.0]}, {"bound": 0.7}, SAT])
def test_smooth_bounds_cost_the_integral_of_the_inverse_of_their_saturation(given: dict[str, Any]) -> None:
    cost = adp.BoundedInputCost(Q, R, 2, 2, **given)
    rest = tensor(given.get("target_input", [0.0, 0.0]))
    low = tensor([-1.0, -1.0]) if "low" in given else -tensor(given["bound"]).expand(2)
    high = tensor([0.5, 2.0]) if "low" in given else tensor(given["bound"]).expand(2)
    v = 3 * uniform(40, 2, seed=6)
    effort = v - rest
    side = torch.where(effort < 0, rest - low, high - rest)
    u = cost.saturate(v)
    torch.testing.assert_close(u, rest + side * (effort / side).tanh())
    torch.testing.assert_close(
        cost.unsaturated(u)[effort.abs() < 2], v[effort.abs() < 2], rtol=1e-6, atol=1e-6
    )
    share = torch.linspace(0, 1, 20001, dtype=torch.float64)
    middle = 0.5 * (share[1:] + share[:-1])
    e = (u - rest)[:10]
    s = torch.where(e < 0, rest - low, high - rest)
    inverse = s.unsqueeze(-1) * (e.unsqueeze(-1) * middle / s.unsqueeze(-1)).atanh()
    paid = 2 * (R.diagonal() * (inverse.mean(-1) * e)).sum(-1)
    torch.testing.assert_close(cost.input_rate(u[:10]), paid, rtol=1e-4, atol=1e-7)
    edges = torch.stack((low, high))
    finite = cost.unsaturated(edges)
    far = torch.stack((rest - low, high - rest)) * math.atanh(1 - 1e-9)
    torch.testing.assert_close((finite - rest).abs(), far)
    torch.testing.assert_close(
        cost.input_rate(edges), 2 * math.log(2) * (R.diagonal() * (edges - rest).square()).sum(-1)
    )
    assert torch.equal(cost.saturate(rest), rest)
    g, p = uniform(5, 2, 2, seed=3), 2 * uniform(5, 2, seed=4)
    pull = torch.einsum("bnm,bn->bm", g, p)
    torch.testing.assert_close(cost.policy(g, p), cost.saturate(rest - 0.5 * pull / R.diagonal()))


# --- what a plant lends -------------------------------------------------------------------------------------


def test_a_cost_takes_from_its_plant_what_it_does_not_state() -> None:
    free = adp.QuadraticCost(Q, R, 2, 2)
    around = free.around(crane(3.0))
    torch.testing.assert_close(around.target, tensor([1.0, 5.0]))
    torch.testing.assert_close(around.target_input, tensor([0.2, -0.4]))
    assert (around.periodic, around.bounds.high.tolist()) == ((0,), [3.0, 3.0])
    assert (free.target, free.target_input, free.bounds, free.periodic) == (None, None, None, ())
    assert around.around(crane(7.0)) is around
    turned = around.deviation(tensor([[1.0 + 6.0, 5.5]]))
    torch.testing.assert_close(turned, tensor([[6.0 - 2 * math.pi, 0.5]]))
    assert around.set_point() is around.target
    own = adp.QuadraticCost(Q, R, 2, 2, low=-9.0, high=8.0)
    assert own.around(crane(3.0)).bounds is own.bounds
    linear = systems.Linear([[0.0, 1.0], [-1.0, 0.0]], [[1.0, 0.0], [0.0, 1.0]])
    assert free.around(linear) is free
    assert adp.QuadraticCost(Q, R, 2, 2, target=[0.0, 0.0]).around(linear).target is None


def test_the_input_of_a_set_point_is_stated_or_found() -> None:
    plant = systems.Linear([[0.0, 1.0], [-1.0, 0.0]], [[1.0, 0.0], [0.0, 1.0]])
    found = adp.QuadraticCost(Q, R, 2, 2, target=[2.0, -3.0]).around(plant)
    torch.testing.assert_close(found.target_input, tensor([3.0, 2.0]))
    stated = adp.QuadraticCost(Q, R, 2, 2, target=[2.0, -3.0], target_input=[3.0, 2.0]).around(plant)
    torch.testing.assert_close(stated.target_input, tensor([3.0, 2.0]))
    with pytest.raises(ValueError, match="does not rest"):
        adp.LQR(plant, adp.QuadraticCost(Q, R, 2, 2, target=[2.0, -3.0], target_input=[3.0, 1.0]))
    with pytest.raises(ValueError, match="does not rest"):
        adp.LQR(plant, adp.QuadraticCost(Q, R, 2, 2, target_input=[0.5, 0.0]))


def test_bounds_are_replaced_in_a_copy_that_is_prepared_anew() -> None:
    cost = adp.QuadraticCost(Q, COUPLED, 2, 2)
    assert cost.bounded(None, None) is cost
    for low, high in ((-0.2, None), (-0.2, 0.3)):
        other = cost.bounded(low, high)
        assert other.bounds is not None
        assert other.bounds.low.tolist() == [-0.2, -0.2]
        assert other.bounds.high.tolist() == [math.inf if high is None else high] * 2
        assert bool(other.bounds.contain(other.policy(uniform(9, 2, 2), 9 * uniform(9, 2))).all())
    assert cost.bounds is None
    smooth = adp.BoundedInputCost(Q, R, 2, 2, bound=1.0)
    wide = smooth.bounded(-2.0, 3.0)
    assert float(wide.saturate(tensor([99.0, -99.0]))[0]) == pytest.approx(3.0)
    assert float(smooth.saturate(tensor([99.0, -99.0]))[0]) == pytest.approx(1.0)


def test_sizes_of_plant_and_cost_must_agree() -> None:
    one = systems.Linear((-torch.eye(2)).tolist(), [[0.0], [1.0]])
    with pytest.raises(ValueError, match="`QuadraticCost` is for 2 states and 2 inputs; Linear has 2 and 1"):
        adp.QuadraticCost(Q, R, 2, 2).around(one)
    none = systems.Linear((-torch.eye(2)).tolist())  # a plant without inputs may be watched
    assert adp.QuadraticCost(Q, R, 2, 2).around(none).dim == 2


LOW, HIGH = [-1.0, -math.inf], [0.5, 2.0]


TWO = systems.Linear([[0.0, 1.0], [0.5, -0.1]], [[0.0, 1.0], [1.0, 1.0]])


@torch.no_grad()
def test_loop_applies_no_control_beyond_the_bounds_whoever_asks_for_it() -> None:
    cost = adp.QuadraticCost(1.0, 1.0, 2, 2, low=LOW, high=HIGH)
    x0 = uniform(5, 2, low=-2, high=2, seed=1)
    greedy = adp.Feedback(lambda x: 9 * torch.ones_like(x))
    run = adp.simulate(greedy, TWO, cost, x0, dt=0.01, steps=2)
    assert torch.equal(run.control[0, 0], torch.tensor(HIGH).double())
    for policy in (adp.LQR(TWO, cost), adp.RolloutPolicy.of_lqr(TWO, cost, steps=3)):
        u = adp.simulate(adp.Feedback(policy), TWO, cost, x0, dt=0.04, steps=8).control[:, :-1]
        assert cost.bounds.contain(u).all()
        assert (u[..., 0] == -1.0).any() or (u[..., 0] == 0.5).any()


# --- a terminal cost ----------------------------------------------------------------------------------------


A, B = [[0.0, 1.0], [0.5, -0.1]], [[0.0], [1.0]]
END, X0 = tensor([[8.0, 1.0], [1.0, 0.5]]), tensor([[1.0, -0.5], [-0.3, 0.8]])
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
    with pytest.raises(ValueError, match=r"near_optimal\(cost=...\)` must have no terminal cost"):
        adp.near_optimal(PLANT, COST, dt=0.1)
    with pytest.raises(ValueError, match=r"DirectShooting\(horizon=...\)` must be given beside a terminal"):
        adp.DirectShooting(PLANT, COST)
    problem = adp.SampledProblem.of(PLANT, COST, dt=0.1)
    library = adp.BoxDDP(problem, steps=3, compile=False).solve(X0)
    with pytest.raises(ValueError, match=r"GlobalValue\(problem=...\)` must have no terminal cost"):
        adp.GlobalValue(problem, library, [1.0, 1.0])


# --- what is stated -----------------------------------------------------------------------------------------


def test_matrices_are_numbers_diagonals_or_matrices_in_double_precision() -> None:
    for given, wanted in (
        (3, [[3.0, 0.0], [0.0, 3.0]]),
        (torch.tensor([0.5, 0.25]), [[0.5, 0.0], [0.0, 0.25]]),
        ([[1.0, 0.5], [0.5, 2.0]], [[1.0, 0.5], [0.5, 2.0]]),
    ):
        cost = adp.QuadraticCost(given, given, 2, 2, terminal=given)  # type: ignore[arg-type]
        for matrix in (cost.q, cost.r, cost.end):
            assert matrix is not None
            assert matrix.dtype == torch.float64
            assert matrix.tolist() == wanted
        torch.testing.assert_close(cost.terminal(X), form(tensor(wanted), X))
    aimed = adp.QuadraticCost(Q, R, 2, 2, terminal=Q, target=torch.tensor([0.5, 0.1]))
    torch.testing.assert_close(aimed.terminal(X), form(Q, X - torch.tensor([0.5, 0.1]).double()))


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"terminal": 1.0, "discount": 0.1}, r"must be None beside an output or a discount"),
        ({"terminal": 1.0, "output": lambda x: x}, r"must be None beside an output or a discount"),
        ({"terminal": -Q}, r"`QuadraticCost\(terminal=...\)` must be positive semidefinite"),
        ({"low": 1.0, "high": 1.0}, "must be below high"),
        ({"control": torch.eye(5) + 0.1, "inputs": 5, "low": -1.0}, "more than 4 bounded inputs"),
        ({"low": [0.0, 1.0, 2.0]}, r"`Bounds\(low=...\)` must be a number or one for each"),
    ],
)
def test_what_is_no_cost_is_refused(given: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        adp.QuadraticCost(**{"state": Q, "control": R, "dim": 2, "inputs": 2} | given)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"bound": 1.0, "high": 1.0}, r"`BoundedInputCost\(bound=...\)` must be None beside low and high"),
        ({"low": -1.0, "high": math.inf}, r"must be finite, with the input \[0.0, 0.0\] of the set-point"),
        ({}, r"`BoundedInputCost\(bound=...\)` must be given, or low and high"),
    ],
)
def test_what_is_no_smooth_bound_is_refused(given: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        adp.BoundedInputCost(**{"state": Q, "control": R, "dim": 2, "inputs": 2} | given)

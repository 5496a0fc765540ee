"""Bounds of the inputs, of each side and input: the cost, the LQR, rollouts, laws and export keep them."""

from __future__ import annotations

import itertools
import math

import pytest
import torch
from helpers_adp import BOX, COST, PLANT, staf_basis, uniform
from torch import Tensor

from staf_torch import adp, deploy, systems
from staf_torch.numerics.box import box_minimum

LOW, HIGH = [-1.0, -math.inf], [0.5, 2.0]
COUPLED = torch.tensor([[1.0, 0.6], [0.6, 2.0]], dtype=torch.float64)


class Two(systems.ControlAffineSystem):
    """A plant of a user: the two-state plant with a second input."""

    dim, inputs = 2, 2

    def drift(self, x: Tensor) -> Tensor:
        return PLANT.drift(x)

    def effectiveness(self, x: Tensor) -> Tensor:
        return torch.cat((PLANT.effectiveness(x), torch.ones_like(x).unsqueeze(-1)), dim=-1)


def grid(cost: adp.Cost, low: list[float], high: list[float]) -> tuple[Tensor, Tensor]:
    """Points of the box, and what an input there costs."""
    axes = [torch.linspace(max(a, -6.0), min(b, 6.0), 801).double() for a, b in zip(low, high, strict=True)]
    points = torch.cartesian_prod(*axes)
    return points, cost.input_rate(points)


@pytest.mark.parametrize("control", [torch.diag(COUPLED.diagonal()), COUPLED], ids=["diagonal", "coupled"])
def test_policy_is_the_minimum_over_the_box(control: Tensor) -> None:
    cost = adp.QuadraticCost(1.0, control, 2, 2, low=LOW, high=HIGH, target_input=[0.2, -0.3])
    g = torch.eye(2, dtype=torch.float64)
    points, paid = grid(cost, LOW, HIGH)
    for pull in uniform(8, 8.0, seed=5):
        u = cost.policy(g, pull)
        found = points[(paid + points @ pull).argmin()]
        assert (u - found).abs().max() < 0.01
        assert cost.bounds.contain(u)
        assert cost.input_rate(u) + u @ pull <= cost.input_rate(found) + found @ pull + 1e-12


@pytest.mark.parametrize("size", [1, 2, 3, 4])
def test_box_minimum_satisfies_its_optimality_conditions(size: int) -> None:
    generator = torch.Generator().manual_seed(size)
    root = torch.randn(40, size, size, dtype=torch.float64, generator=generator)
    H = root @ root.mT + 0.1 * torch.eye(size, dtype=torch.float64)
    c = 3 * torch.randn(40, size, dtype=torch.float64, generator=generator)
    low = -torch.rand(40, size, dtype=torch.float64, generator=generator)
    high = low + 1.0
    high[:, 0] = math.inf
    u = box_minimum(H, c, low, high)
    slope = (H @ u.unsqueeze(-1)).squeeze(-1) + c
    assert ((u >= low) & (u <= high)).all()
    assert (slope[(u > low) & (u < high)].abs() < 1e-9).all()
    assert (slope[u == low] >= -1e-9).all()
    assert (slope[u == high] <= 1e-9).all()
    assert box_minimum(H, torch.nan * c, low, high).isnan().all()


def test_bounds_of_the_plant_serve_where_the_cost_states_none() -> None:
    plant = Two()
    plant.bounds = systems.Bounds(-1.0, [0.5, 2.0], 2)
    free, own = adp.QuadraticCost(1.0, 1.0, 2, 2), adp.QuadraticCost(1.0, 1.0, 2, 2, low=-3.0, high=3.0)
    assert isinstance(plant.bounds, systems.Bounds)
    assert adp.LQR(plant, free).cost.bounds is plant.bounds
    assert adp.LQR(plant, own).cost.bounds is own.bounds
    assert free.bounds is None
    assert free.around(Two()) is free


@torch.no_grad()
def test_loop_applies_no_control_beyond_the_bounds_whoever_asks_for_it() -> None:
    cost = adp.QuadraticCost(1.0, 1.0, 2, 2, low=LOW, high=HIGH)
    x0 = uniform(5, 2.0, seed=1)
    greedy = adp.Feedback(lambda x: 9 * torch.ones_like(x))
    run = adp.simulate(greedy, Two(), cost, x0, dt=0.01, steps=20)
    assert torch.equal(run.control[0, 0], torch.tensor(HIGH).double())
    for policy in (adp.LQR(Two(), cost), adp.RolloutPolicy.of_lqr(Two(), cost, steps=3)):
        u = adp.simulate(adp.Feedback(policy), Two(), cost, x0, dt=0.04, steps=40).control[:, :-1]
        assert cost.bounds.contain(u).all()
        assert (u[..., 0] == -1.0).any() or (u[..., 0] == 0.5).any()


@torch.no_grad()
def test_improved_policy_under_hard_bounds_costs_less_than_the_clipped_lqr() -> None:
    plant = systems.Pendulum()
    cost = adp.QuadraticCost(1.0, 0.1, 2, 1, low=-6.0, high=9.0)
    x0 = uniform(40, 0.5, seed=2)
    paid = {}
    for policy in (adp.LQR(plant, cost), adp.RolloutPolicy.of_lqr(plant, cost)):
        run = adp.simulate(adp.Feedback(policy), plant, cost, x0, dt=0.1, steps=40, every=40, compile=False)
        assert (run.state[:, -1].norm(dim=-1) < 1e-2).all()
        paid[type(policy).__name__] = run.cost
    ratio = paid["RolloutPolicy"] / paid["LQR"]
    assert ratio.mean() < 1.0
    assert ratio.max() < 1.01


@pytest.mark.parametrize("kind", ["hard", "smooth"])
def test_actor_critic_regulates_within_bounds(kind: str) -> None:
    hard = adp.QuadraticCost(1.0, 1.0, 2, 1, low=-1.0, high=1.3)
    smooth = adp.BoundedInputCost(1.0, 1.0, 2, 1, low=-1.0, high=1.3)
    cost = {"hard": hard, "smooth": smooth}[kind]
    learner = adp.ActorCritic(staf_basis(), PLANT, cost, adp.RandomPoints(1, BOX))
    run = adp.simulate(
        learner, PLANT, cost, uniform(6, 0.7, seed=3), dt=0.02, steps=300, every=100, compile=False
    )
    u = run.control[:, :-1]
    assert ((u >= -1.0) & (u <= 1.3)).all()
    assert (run.state[:, -1].norm(dim=-1) < 1e-2).all()


def test_smooth_bounds_of_each_side_are_kept_and_their_cost_is_the_integral() -> None:
    cost = adp.BoundedInputCost(1.0, 2.0, 2, 1, low=-1.0, high=3.0, target_input=[0.5])
    v = torch.linspace(-9, 9, 181, dtype=torch.float64).unsqueeze(-1)
    u = cost.saturate(v)
    assert ((u >= -1.0) & (u <= 3.0)).all()
    inside = (v - 0.5).abs() < 3
    torch.testing.assert_close(cost.unsaturated(u)[inside], v[inside], rtol=1e-9, atol=1e-9)
    at = torch.tensor([[0.7], [-0.4], [2.5]], dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(cost.input_rate(at).sum(), at)  # U' = 2 R sat^-1(u)
    torch.testing.assert_close(slope, 4.0 * (cost.unsaturated(at) - 0.5))
    symmetric = adp.BoundedInputCost(1.0, 2.0, 2, 1, bound=[3.0])
    assert torch.equal(symmetric.saturate(v), adp.BoundedInputCost(1.0, 2.0, 2, 1, bound=3.0).saturate(v))


@pytest.mark.needs_compiler
def test_exported_policy_keeps_asymmetric_bounds(tmp_path: object) -> None:
    from staf_torch.deploy.c_header import runner_c

    cost = adp.QuadraticCost(1.0, COUPLED, 2, 2, low=LOW, high=HIGH)
    policy = deploy.policy_of(adp.RolloutPolicy.of_lqr(Two(), cost, steps=2))
    x = uniform(50, 3.0, seed=4)
    deploy.export_c(policy, x[:1], tmp_path / "staf.h", ["u"])
    (u,) = runner_c(tmp_path / "staf.h", [2], torch.float64)(x)
    torch.testing.assert_close(u, policy(x), rtol=1e-9, atol=1e-9)
    assert cost.bounds.contain(u).all()


def test_bad_bounds_are_refused_by_name() -> None:
    cases = itertools.product([adp.QuadraticCost], [({"low": 1.0, "high": 1.0}, "must be below high")])
    more = [
        (adp.QuadraticCost, ({"low": [0.0, 1.0]}, r"`Bounds\(low=...\)` must be a number or one for each")),
        (adp.QuadraticCost, ({"high": math.nan}, r"`Bounds\(high=...\)` must be finite or inf")),
        (
            adp.BoundedInputCost,
            ({"bound": 1.0, "low": -1.0}, r"`BoundedInputCost\(bound=...\)` must be None"),
        ),
        (
            adp.BoundedInputCost,
            ({"low": 0.0, "high": 2.0}, r"with the input \[0.0\] of the set-point inside"),
        ),
        (adp.BoundedInputCost, ({"low": -1.0}, r"must be finite")),
        (adp.BoundedInputCost, ({}, r"`BoundedInputCost\(bound=...\)` must be given")),
        (adp.BoundedInputCost, ({"bound": -1.0}, r"`BoundedInputCost\(bound=...\)` must be positive")),
    ]
    for kind, (settings, message) in (*cases, *more):
        with pytest.raises(ValueError, match=message):
            kind(1.0, 1.0, 2, 1, **settings)
    with pytest.raises(ValueError, match="diagonal for more than 4 bounded inputs"):
        adp.QuadraticCost(1.0, torch.eye(5).double() + 0.1, 2, 5, low=-1.0)
    assert COST.bounds is None


def test_a_cost_with_bounds_saves_only_what_it_was_given() -> None:
    cost = adp.BoundedInputCost(1.0, 0.1, dim=2, inputs=1, bound=8.0)
    assert not [name for name in cost.state_dict() if name.rpartition(".")[2].startswith("_")]

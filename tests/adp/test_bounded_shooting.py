"""Direct shooting with hard bounds, from several starts, and what it says where it is not sure."""

from __future__ import annotations

import math

import pytest
import torch
from helpers import uniform
from torch import Tensor

from staf_torch import adp, systems
from staf_torch.adp.shooting import starts
from staf_torch.adp.shooting.direct import _cheapest
from staf_torch.adp.shooting.newton import Plan, _boxed_step
from staf_torch.adp.shooting.stage import Stage

DOUBLE = systems.Linear([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])
COST = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)


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
    assert len(repr(convex)) < 120


@torch.no_grad()
def test_plan_is_replayed_at_its_cost(convex: adp.Optimum) -> None:
    dt = 0.02
    run = adp.simulate(
        convex.replay(),
        DOUBLE,
        COST,
        convex.state[:, 0],
        dt=dt,
        steps=round(float(convex.time[-1]) / dt),
        compile=False,
    )
    torch.testing.assert_close(run.cost, convex.value, rtol=3e-3, atol=0)
    assert (run.state[:, -1].norm(dim=-1) < 1e-2).all()


def test_saturated_swing_up_is_not_passed_off_as_an_optimum() -> None:
    hanging = torch.tensor([[0.0, math.pi, 0.0, 0.0]], dtype=torch.float64)
    cost = adp.BoundedInputCost(1.0, 0.1, dim=4, inputs=1, bound=10.0)
    shooting = adp.DirectShooting(systems.CartPole(), cost, horizon=3.0, intervals=8, starts=1, iterations=1)
    best = shooting.solve(hanging)
    assert not best.converged.any()
    assert best.reason[0].startswith("not stationary")
    assert best.reason[0] in repr(best)


def test_row_without_a_finite_start_says_so() -> None:
    class Exploding(systems.Linear):
        def drift(self, x: torch.Tensor) -> torch.Tensor:
            return super().drift(x) + torch.where(x[..., :1] > 2.0, math.inf, 0.0)

    plant = Exploding([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])
    best = adp.DirectShooting(plant, COST, intervals=20).solve(torch.tensor([[3.0, 0.0]]).double())
    assert best.reason == (
        "the cost is not finite from here under any start: give a `base` that does not diverge",
    )


def test_what_cannot_be_shot_is_refused_by_name() -> None:
    step = systems.StepPlant(lambda x, u: 0.5 * x + u, dim=1, inputs=1, dt=0.1)
    with pytest.raises(ValueError, match=r"`DirectShooting\(system=...\)` must be in continuous time"):
        adp.DirectShooting(step, adp.QuadraticCost(1.0, 1.0, dim=1, inputs=1))
    discounted = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1, discount=0.1)
    with pytest.raises(ValueError, match=r"`DirectShooting\(cost=...\)` must have no discount"):
        adp.DirectShooting(DOUBLE, discounted)


def test_a_start_and_its_mirror_image_do_not_agree_with_each_other() -> None:
    def plan(*costs: float) -> Plan:
        cost = torch.tensor(costs, dtype=torch.float64)
        return Plan(cost[:, None, None], cost[:, None, None], cost)

    # In the first row the base costs 9 and is found again, and 5 has a mirror image; the second has none.
    several = [plan(9.0, 8.0), plan(5.0, 4.0), plan(5.0 + 1e-12, 6.0), plan(7.0, math.inf)]
    costs = torch.stack([each.cost for each in _cheapest(several, 3, torch.tensor([9.0, 9.0]).double())])
    assert costs.T.tolist() == [[5.0, 7.0, math.inf], [4.0, 6.0, 8.0]]


@pytest.mark.parametrize("bounded", [True, False])
def test_guesses_hold_each_input_at_each_end_and_then_wander_between_them(bounded: bool) -> None:
    limits = {"low": [-1.0, -2.0], "high": [1.5, 3.0]} if bounded else {}
    cost = adp.QuadraticCost(1.0, 1.0, 2, 2, target_input=[0.5, 0.25], target=[0.0, 0.0], **limits)
    base = lambda x: 2 * x + torch.tensor([0.5, 0.25]).to(x)  # noqa: E731
    x0 = torch.tensor([[0.1, -0.2], [-0.3, 0.1]], dtype=torch.float64)
    found = starts.guesses(cost, base, x0, 10.0, 5, seed=3)
    low, high = ([-1.0, -2.0], [1.5, 3.0]) if bounded else ([0.5 - 1.8, 0.25 - 1.2], [0.5 + 1.8, 0.25 + 1.2])
    constant, wandering = found[:-5], found[-5:]
    assert [each.until for each in constant] == [
        3.0,
        *(10 * s for s in (0.02, 0.04, 0.08, 0.14, 0.22, 0.32) for _ in range(4)),
    ]
    rest = torch.tensor([0.5, 0.25], dtype=torch.float64)
    torch.testing.assert_close(constant[0].knots, rest.expand(2, 2))
    for k, guess in enumerate(constant[1:]):
        level = rest.clone()
        level[k % 4 // 2] = (low, high)[k % 2][k % 4 // 2]
        torch.testing.assert_close(guess.knots, level.expand(2, 2))
    knots = torch.stack([each.knots for each in wandering])
    assert knots.shape == (5, 6, 2)
    ends = torch.tensor([low, high], dtype=torch.float64)
    assert bool(((knots >= ends[0] - 1e-12) & (knots <= ends[1] + 1e-12)).all())
    for end in ends:  # a sixth of them, at each
        assert 0.05 < float((knots - end).abs().lt(1e-12).double().mean()) < 0.4
    assert all(0 < each.until < 6 for each in wandering)
    again = starts.guesses(cost, base, x0, 10.0, 5, seed=4)
    assert not torch.equal(again[-1].knots, found[-1].knots)


def test_a_guess_is_followed_along_its_knots_until_the_base_takes_over() -> None:
    guess = starts.Guess(torch.tensor([[0.0], [1.0], [5.0]], dtype=torch.float64), 2.0)
    control = starts.guided(guess, lambda x: x.new_full((*x.shape[:-1], 1), 9.0))
    assert control(torch.zeros(4, 5, 2), 0.0).shape == (4, 5, 1)
    x = torch.zeros(3, 2, dtype=torch.float64)
    said = {0.0: 0.0, 0.5: 0.5, 1.0: 1.0, 1.5: 3.0, 1.75: 4.0, 2.0: 9.0, 3.0: 9.0}
    for time, want in said.items():
        torch.testing.assert_close(control(x, time), torch.full((3, 1), want, dtype=torch.float64))


@pytest.mark.parametrize("affine", [True, False])
def test_the_gap_of_a_control_is_what_its_hamiltonian_exceeds_the_least_by(affine: bool) -> None:
    def cubic(x: Tensor, u: Tensor) -> Tensor:
        return torch.cat((x[..., 1:], u + 0.1 * u**3 - x[..., :1]), -1)

    if affine:
        plant: systems.Plant = systems.TwoState()
    else:
        plant = systems.RatePlant(cubic, dim=2, inputs=1)
    cost = adp.QuadraticCost(1.0, 0.5, dim=2, inputs=1, low=-0.8, high=0.8)
    x, costate, v = uniform(50, 2, seed=1), 2 * uniform(50, 2, seed=2), 0.8 * uniform(50, 1, seed=3)
    gap = Stage(plant, cost).gap(x, v, costate)
    slope = torch.func.vmap(torch.func.jacrev(lambda x, u: plant.motion(x[None], u[None])[0], argnums=1))(
        x, v
    )
    pull = (slope * costate.unsqueeze(-1)).sum(-2)  # p' df/du, (B, m)

    def hamiltonian(u: Tensor) -> Tensor:
        return 0.5 * u.square().sum(-1) + (pull * u).sum(-1)

    tried = torch.stack(
        [hamiltonian(torch.full((50, 1), u).double()) for u in torch.linspace(-0.8, 0.8, 2001)]
    )
    torch.testing.assert_close(gap, hamiltonian(v) - tried.amin(0), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("inputs", [1, 2, 3])
def test_a_boxed_step_has_the_least_model_of_all_in_the_box(inputs: int, seed: int) -> None:
    size, rows = 2, 40
    root = uniform(rows, size + inputs, size + inputs, seed=seed)
    curvature = root @ root.mT + 0.1 * torch.eye(size + inputs)
    slope = 2 * uniform(rows, size + inputs, seed=seed + 10)
    low, high = -uniform(rows, inputs, seed=seed + 20).abs(), uniform(rows, inputs, seed=seed + 30).abs()
    offset, _, definite = _boxed_step(slope, curvature, size, low, high)
    assert bool(definite.all())
    assert bool(((offset >= low) & (offset <= high)).all())

    def model(v: Tensor) -> Tensor:
        bent = (curvature[:, size:, size:] @ v.unsqueeze(-1)).squeeze(-1)
        return ((slope[:, size:] + 0.5 * bent) * v).sum(-1)

    for turn in range(300):
        other = low + (high - low) * (0.5 + 0.5 * uniform(rows, inputs, seed=1000 + turn))
        assert bool((model(offset) <= model(other) + 1e-12).all())


def test_guesses_are_those_of_their_seed_and_of_nobodys_else() -> None:
    cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=2, low=-1.0, high=0.5)
    x0, base = torch.zeros(3, 2).double(), adp.Feedback(lambda x: -x).policy
    before = torch.get_rng_state()
    first = starts.guesses(cost, base, x0, 2.0, 12, seed=3)
    assert torch.equal(before, torch.get_rng_state())
    torch.rand(5)
    again, other = (
        starts.guesses(cost, base, x0, 2.0, 12, seed=3),
        starts.guesses(cost, base, x0, 2.0, 12, seed=4),
    )
    assert all(
        torch.equal(a.knots, b.knots) and a.until == b.until for a, b in zip(first, again, strict=True)
    )
    assert any(not torch.equal(a.knots, b.knots) for a, b in zip(first, other, strict=True))
    assert all(bool(((g.knots >= -1) & (g.knots <= 0.5)).all()) for g in first)

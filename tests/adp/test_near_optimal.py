"""One call for a plant of a user: a held policy, improved where rollouts say so, never worse."""

from __future__ import annotations

import copy
import math
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch

from staf_torch import adp, deploy, lanes, systems
from staf_torch.deploy.c_header import runner_c


def turn(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """A step of Gymnasium's Pendulum-v1, as a simulator."""
    rate = np.clip(x[:, 1] + 0.05 * (15.0 * np.sin(x[:, 0]) + 3.0 * u[:, 0]), -8.0, 8.0)
    return np.stack((x[:, 0] + 0.05 * rate, rate), axis=1)


def drawn(dim: int, width: float, rows: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(3)
    return width * (2 * torch.rand(rows, dim, dtype=torch.float64, generator=generator) - 1)


COST = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
SIMULATOR = systems.StepPlant(turn, dim=2, inputs=1, dt=0.05, periodic=[0], low=-2.0, high=2.0)
DOUBLE = systems.Linear([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])


@pytest.fixture(scope="module")
def two_states() -> adp.NearOptimal:
    """A policy that several tests ask, compiled once."""
    policy = adp.near_optimal(systems.TwoState(), COST, dt=0.1, horizon=0.8)
    lanes.ready(policy, torch.zeros(1, 2).double())
    return policy


@pytest.fixture(scope="module")
def limited() -> dict[bool, adp.NearOptimal]:
    """Of the mass with |u| <= 1, by whether it plans: what plans is traced once."""
    return {
        plan: adp.near_optimal(DOUBLE, COST, dt=0.25, low=-1.0, high=1.0, plan=plan) for plan in (False, True)
    }


@torch.no_grad()
@pytest.mark.parametrize(
    ("plant", "cost", "dt", "width", "gain"),
    [
        (systems.TwoState(), COST, 0.1, 2.0, 0.95),
        (SIMULATOR, adp.QuadraticCost([[20.0, 0.0], [0.0, 2.0]], 0.02, dim=2, inputs=1), None, 0.6, 1.0),
    ],
    ids=["two states", "simulator"],
)
def test_improved_policy_is_never_worse_than_its_base(
    plant: systems.Plant,
    cost: adp.Cost,
    dt: float | None,
    width: float,
    gain: float,
    two_states: adp.NearOptimal,
) -> None:
    policy = two_states if cost is COST else adp.near_optimal(plant, cost, dt=dt, horizon=0.8)
    x0 = drawn(cost.dim, width, 24)
    steps = round(4.0 / policy.period)
    base, ours = (
        adp.simulate(adp.Feedback(u), plant, cost, x0, dt=policy.period, steps=steps)
        for u in (policy.lqr, policy)
    )
    ratio = ours.cost / base.cost
    assert float(ratio.max()) <= 1.01
    assert float(ratio.mean()) < gain
    bounds = policy.cost.bounds
    assert bounds is None or bool(bounds.contain(ours.control[:, :-1]).all())


@torch.no_grad()
def test_where_a_bound_holds_the_base_at_the_end_its_own_control_is_kept() -> None:
    cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1, low=-2.0, high=2.0)
    policy = adp.near_optimal(systems.Pendulum(), cost, dt=0.05, horizon=0.3)
    lost = torch.tensor([[1.2, 1.0], [0.01, 0.0]], dtype=torch.float64)  # it falls; it stands
    promise = policy.rollout(lost)
    assert promise.free.tolist() == [False, True]
    assert torch.equal(policy(lost)[0], policy.lqr(lost)[0])


@torch.no_grad()
def test_report_says_what_was_chosen_and_how_good_it_is(two_states: adp.NearOptimal) -> None:
    policy = two_states
    report = policy.report(states=3, spread=0.5)
    with pytest.raises(ValueError, match="must be of the states"):
        policy.gradient(torch.zeros(2).double())
    assert report["dt"] == 0.1
    assert report["centers"] == 3
    assert report["spectral_radius"] < 1 < report["largest_period"] / 0.1
    assert report["regulated"] == 1.0
    assert 1.0 - 1e-3 <= report["over_optimum_median"] < 1.05
    assert report["over_base_max"] <= 1.01
    assert report["good_spread"] in (0.5, 1.0, 2.0)  # times 1, 2 and 4 of half a unit
    assert report["microseconds"] > 0


@pytest.mark.needs_compiler
@torch.no_grad()
def test_exported_policy_is_the_policy(tmp_path: Path) -> None:
    cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1, low=-2.0, high=1.5)
    with pytest.raises(ValueError, match=r"`policy_of\(controller=...\)` must not plan anew in every state"):
        deploy.policy_of(adp.near_optimal(systems.Pendulum(), cost, dt=0.05, horizon=0.4, plan=True))
    policy = deploy.policy_of(adp.near_optimal(systems.Pendulum(), cost, dt=0.05, horizon=0.4))
    x = drawn(2, 0.5, 40)
    deploy.export_c(policy, x[:1], tmp_path / "staf.h", ["u"])
    (u,) = runner_c(tmp_path / "staf.h", [1], torch.float64)(x)
    torch.testing.assert_close(u, policy(x), rtol=1e-9, atol=1e-9)


def test_bad_arguments_are_refused_by_name() -> None:
    with pytest.raises(ValueError, match=r"`near_optimal\(dt=...\)` must be a number; got None"):
        adp.near_optimal(systems.Pendulum(), COST)
    with pytest.raises(ValueError, match=r"`near_optimal\(horizon=...\)` must be positive"):
        adp.near_optimal(systems.Pendulum(), COST, dt=0.1, horizon=-1.0)
    with pytest.raises(ValueError, match=r"`SampledRollout\(steps=...\)` must be at least 4"):
        adp.near_optimal(systems.Pendulum(), COST, dt=0.1, horizon=0.2)


def test_plan_takes_over_where_the_lqr_would_meet_a_bound(limited: dict[bool, adp.NearOptimal]) -> None:
    """A mass at 2 m with |u| <= 1: the LQR's rollouts overshoot; the plan is the optimum of its horizon."""
    plant, policy = DOUBLE, limited[True]
    x = torch.tensor([[2.0, 0.5], [0.05, 0.0], [-2.0, -0.5]], dtype=torch.float64)
    assert policy.planner is not None
    assert policy.planner.strained(x).tolist() == [True, False, True]
    u = policy(x)
    search = adp.BoxDDP(policy.planner.problem, steps=policy.steps)
    best = search.solve(x[::2])
    torch.testing.assert_close(u[::2], best.control[:, 0], rtol=0, atol=1e-3)
    torch.testing.assert_close(u[0], -u[2])
    torch.testing.assert_close(u[1], policy.control(x[1]), rtol=0, atol=1e-9)
    assert torch.equal(policy(x[1]), u[1])
    loop = policy.controller()  # carries its plan
    run = adp.simulate(loop, plant, policy.cost, x, dt=0.25, steps=40, compile=False)
    search.steps = 40  # by the same programs
    whole = search.solve(x)
    torch.testing.assert_close(run.cost, whole.cost, rtol=1e-4, atol=1e-6)
    assert isinstance(adp.near_optimal(plant, COST, dt=0.25, plan=True).controller(), adp.Feedback)
    again = pickle.loads(pickle.dumps(policy))
    torch.testing.assert_close(again(x), u)
    assert adp.near_optimal(plant, COST, dt=0.25, plan=True).planner is None
    assert limited[False].planner is None


@torch.no_grad()
def test_loop_carries_a_plan_only_where_the_lqr_would_meet_a_bound(
    limited: dict[bool, adp.NearOptimal],
) -> None:
    """The same mass without `plan`: from afar the optimum, also where it is only pushed there in the loop."""
    plant, policy = DOUBLE, limited[False]
    loop, planner = policy.controller(), policy.plans()
    assert planner is not None
    x = torch.tensor([[3.0, 1.0], [0.05, 0.0], [-3.0, -1.0]], dtype=torch.float64)
    run, alone = (
        adp.simulate(loop, plant, policy.cost, rows, dt=0.25, steps=10, compile=False) for rows in (x, x[:1])
    )
    assert torch.equal(alone.state[0], run.state[0])
    assert planner.strained(run.state[0]).tolist() == [True] * 8 + [False] * 3
    best = adp.BoxDDP(planner.problem, steps=60).solve(x)
    torch.testing.assert_close(run.control[:, :10], best.control[:, :10], rtol=0, atol=1e-2)
    near, none = x[1:2], x.new_zeros(1, 0)
    u, carried = loop.step(near, loop.init(near), none, 0.25)
    assert torch.equal(u, policy(near))
    pushed, _ = loop.step(x[:1], carried, none, 0.25)
    torch.testing.assert_close(pushed, best.control[:1, 0], rtol=0, atol=1e-2)
    lost, _ = loop.step(near / 0.0, carried, none, 0.25)  # nothing is planned from there
    assert bool(lost.isnan().all())
    assert isinstance(adp.near_optimal(plant, COST, dt=0.25).controller(), adp.Feedback)


@torch.no_grad()
def test_another_control_than_the_bases_promises_less_over_both_horizons(two_states: adp.NearOptimal) -> None:
    policy = two_states
    x, discount = drawn(2, 2.0, 300), math.exp(-COST.discount * 0.1)

    def promised(u: torch.Tensor) -> torch.Tensor:
        after, paid = policy.holding(x, u)
        promise = policy.rollout(after)
        return torch.stack((paid + discount * promise.whole, paid + discount * promise.part))

    base, chosen = policy.lqr(x), policy.control(x)
    other = (chosen != base).any(-1)
    gain = promised(base) - promised(chosen)
    assert float(other.double().mean()) > 0.3
    assert bool((gain[:, other] > 0).all())
    step = policy.proposal(x, base)  # where none is chosen, none of those that are tried is better in both
    for share in (1.0, 0.3):
        tried = base + share * step
        better = (promised(base) - promised(tried) > 1e-6 * promised(base)).all(0)
        assert not bool((better & policy.rollout(policy.holding(x, tried)[0]).free & ~other).any())


class Gap(systems.ControlAffineSystem):
    """x' = x + 1e4 x^3 + u: some centimetres from rest nothing holds it."""

    dim, inputs = 1, 1

    def drift(self, x: torch.Tensor) -> torch.Tensor:
        return x + 1e4 * x**3

    def effectiveness(self, x: torch.Tensor) -> torch.Tensor:
        return torch.ones(1, 1, dtype=x.dtype).expand(*x.shape, 1)


def test_report_finds_the_region_of_a_plant_in_small_units() -> None:
    policy = adp.near_optimal(Gap(), adp.QuadraticCost(25.0, 1.0, dim=1, inputs=1), dt=0.05, horizon=0.2)
    report = policy.report(states=8, optimum=False)
    assert report["regulated"] == 0  # in the box of 1
    assert 1 / 256 <= report["good_spread"] <= 1 / 32
    near = policy.report(states=8, spread=0.01, optimum=False)
    assert 1 / 512 <= near["good_spread"] <= 1 / 25  # the same region, asked for by another box


def torch_turn(x: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
    """`turn` in torch."""
    rate = (x[:, 1] + 0.05 * (15.0 * x[:, 0].sin() + 3.0 * u[:, 0])).clamp(-8.0, 8.0)
    return torch.stack((x[:, 0] + 0.05 * rate, rate), dim=1)


@torch.no_grad()
@pytest.mark.parametrize("target", [None, (2 * math.pi, 0.0)])
@pytest.mark.parametrize("smooth", [False, True])
def test_simulator_is_followed_in_numpy_to_the_same_promise(
    target: tuple[float, float] | None, smooth: bool
) -> None:
    kind = adp.BoundedInputCost if smooth else adp.QuadraticCost
    cost = kind(1.0, 0.1, dim=2, inputs=1, low=-2.0, high=1.5, target=target, discount=0.1)
    seen, hidden = (
        adp.near_optimal(systems.StepPlant(step, dim=2, inputs=1, dt=0.05, periodic=[0]), cost, horizon=0.4)
        for step in (torch_turn, turn)
    )
    x = drawn(2, 1.0, 6).view(2, 3, 2)
    for one, other in zip(seen.rollout(x), hidden.rollout(x), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-7, atol=0)  # slopes by differences
    assert torch.equal(hidden.rollout(x[1, 2]).whole, hidden.rollout(x).whole[1, 2])
    assert seen.basis.count == hidden.basis.count == 3  # along the only input
    near = x[0] * 0.05 if target is None else x[0] * 0.05 + torch.tensor(target, dtype=torch.float64)
    if not smooth:  # the LQR is the optimum, wherever the set-point is
        for policy in (seen, hidden):
            assert float(policy.proposal(near, policy.base(near)).abs().max()) < 1e-3
    torch.testing.assert_close(pickle.loads(pickle.dumps(hidden))(x), hidden(x), rtol=0, atol=0)


@torch.no_grad()
def test_controllers_of_a_policy_share_programs_and_no_plan(limited: dict[bool, adp.NearOptimal]) -> None:
    policy = limited[False]
    one, other = policy.controller(), policy.controller()
    assert one._begun is other._begun
    assert next(iter(policy._loops.values())).held  # begins with the best of several
    dearer = copy.copy(policy)
    dearer._modules = dict(policy._modules)  # torch lets copies share them: the cost of both would change
    dearer.cost = adp.QuadraticCost(1.0, 9.0, dim=2, inputs=1, low=-1.0, high=1.0)
    assert dearer.controller()._begun is not one._begun  # plans of another cost are others
    far, near = torch.tensor([[3.0, 1.0]]).double(), torch.tensor([[0.05, 0.0]]).double()
    none = far.new_zeros(1, 0)
    plan, idle = one.init(far), other.init(near)
    u, after = one.step(far, plan, none, 0.25)
    again, same = other.step(near, idle, none, 0.25)
    assert same is idle  # nothing to carry: nothing is made
    assert torch.equal(again, policy(near))
    assert torch.equal(one.step(far, plan, none, 0.25)[0], u)  # nor is a plan changed by those who follow it
    _, ended = one.step(near, after, none, 0.25)
    assert bool((ended.identifier[:, 0] < 0).all())
    copied = pickle.loads(pickle.dumps(policy)).controller()
    assert copied._begun is not one._begun
    torch.testing.assert_close(copied.step(far, copied.init(far), none, 0.25)[0], u, rtol=0, atol=1e-6)


@torch.no_grad()
@pytest.mark.parametrize("plan", [True, False])
def test_states_are_told_from_which_the_lqr_would_meet_a_bound(
    plan: bool, limited: dict[bool, adp.NearOptimal]
) -> None:
    policy = limited[plan]
    for spread, share in ((1e-3, 0.0), (1e3, 1.0)):
        far = policy._drawn(4, spread, 0)
        planner = policy.plans()
        assert planner is not None
        assert float(planner.strained(far).double().mean()) == share


@torch.no_grad()
def test_report_says_the_share_of_its_states_from_which_the_lqr_would_meet_a_bound() -> None:
    plant, cost = systems.Linear([[0.0]], [[1.0]]), adp.QuadraticCost(1.0, 1.0, dim=1, inputs=1)
    policy = adp.near_optimal(plant, cost, dt=1.0, horizon=4.0, low=-1.0, high=1.0)
    assert policy.report(states=2, spread=1e-3, optimum=False)["strained"] == 0.0

"""One call for a plant of a user: a held policy, improved where rollouts say so, never worse."""

from __future__ import annotations

import math
import pickle
from typing import Any

import numpy as np
import pytest
import torch
from helpers import tensor, uniform
from torch import Tensor

import staf_torch as st
from staf_torch import adp, deploy, lanes, systems
from staf_torch.adp.near_optimal_policy import NearOptimal
from staf_torch.adp.policies.sampled_rollout import SampledRollout


def turn(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """A step of Gymnasium's Pendulum-v1, as a simulator."""
    rate = np.clip(x[:, 1] + 0.05 * (15.0 * np.sin(x[:, 0]) + 3.0 * u[:, 0]), -8.0, 8.0)
    return np.stack((x[:, 0] + 0.05 * rate, rate), axis=1)


def drawn(dim: int, width: float, rows: int) -> Tensor:
    generator = torch.Generator().manual_seed(3)
    return width * (2 * torch.rand(rows, dim, dtype=torch.float64, generator=generator) - 1)


COST = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
SIMULATOR = systems.StepPlant(turn, dim=2, inputs=1, dt=0.05, periodic=[0], low=-2.0, high=2.0)
DOUBLE = systems.Linear([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])


@pytest.fixture(scope="module")
def two_states() -> NearOptimal:
    """A policy that several tests ask, compiled once."""
    policy = adp.near_optimal(systems.TwoState(), COST, dt=0.1, horizon=0.8)
    lanes.ready(policy, torch.zeros(1, 2).double())
    return policy


@pytest.fixture(scope="module")
def limited() -> dict[bool, NearOptimal]:
    """Of the mass with |u| <= 1, by whether it plans: what plans is traced once."""
    return {
        plan: adp.near_optimal(DOUBLE, COST, dt=0.25, horizon=horizon, low=-1.0, high=1.0, plan=plan)
        for plan, horizon in ((False, 4.0), (True, 3.0))
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
    two_states: NearOptimal,
) -> None:
    policy = two_states if cost is COST else adp.near_optimal(plant, cost, dt=dt, horizon=0.8, reach="local")
    rows, seconds = (12, 4.0) if dt is not None else (6, 2.0)  # a simulator in NumPy is not compiled
    x0 = drawn(cost.dim, width, rows)
    steps = round(seconds / policy.period)
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
    policy = adp.near_optimal(systems.Pendulum(), cost, dt=0.05, horizon=0.3, reach="local")
    lost = torch.tensor([[1.2, 1.0], [0.01, 0.0]], dtype=torch.float64)  # it falls; it stands
    promise = policy.rollout(lost)
    assert promise.free.tolist() == [False, True]
    assert torch.equal(policy(lost)[0], policy.lqr(lost)[0])


@torch.no_grad()
def test_report_says_what_was_chosen_and_how_good_it_is(two_states: NearOptimal) -> None:
    policy = two_states
    report = policy.report(states=2, spread=0.5, full=True, optimum=True)
    assert report["dt"] == 0.1
    assert report["centers"] == 3
    assert report["spectral_radius"] < 1 < report["largest_period"] / 0.1
    assert report["regulated"] == 1.0
    assert 1.0 - 1e-3 <= report["over_optimum_median"] < 1.05
    assert report["over_base_max"] <= 1.01
    assert report["good_spread"] in (0.5, 1.0, 2.0)  # times 1, 2 and 4 of half a unit
    assert report["microseconds"] > 0
    assert report["strained"] is None
    assert report["left_out"] == ""
    short = policy.report(states=2, spread=0.5)
    assert short["left_out"] == (
        "good_spread, microseconds: report(full=True); over_optimum: report(optimum=True)"
    )
    assert (short["good_spread"], short["over_optimum_max"]) == (None, None)
    assert short["over_base_max"] == pytest.approx(report["over_base_max"], rel=1e-9)


def test_bad_arguments_are_refused_by_name() -> None:
    with pytest.raises(ValueError, match=r"`near_optimal\(dt=...\)` must be given, s.*no period of its own"):
        adp.near_optimal(systems.Pendulum(), COST)
    with pytest.raises(ValueError, match=r"`SampledRollout\(steps=...\)` must be at least 4"):
        adp.near_optimal(systems.Pendulum(), COST, dt=0.1, horizon=0.2)
    with pytest.raises(ValueError, match=r"`policy_of\(controller=...\)` must not plan anew in every state"):
        deploy.policy_of(adp.near_optimal(DOUBLE, COST, dt=0.25, low=-1.0, high=1.0, plan=True))


def test_plan_takes_over_where_the_lqr_would_meet_a_bound(limited: dict[bool, NearOptimal]) -> None:
    """A mass at 2 m with |u| <= 1: the LQR's rollouts overshoot; the plan is the optimum of its horizon."""
    policy = limited[True]
    x = torch.tensor([[2.0, 0.5], [0.05, 0.0], [-2.0, -0.5]], dtype=torch.float64)
    assert policy.planner is not None
    assert policy.planner.strained(x).tolist() == [True, False, True]
    u = policy(x)
    best = adp.BoxDDP(policy.planner.problem, steps=policy.steps, compile=False).solve(x[::2])
    torch.testing.assert_close(u[::2], best.control[:, 0], rtol=0, atol=1e-3)
    torch.testing.assert_close(u[0], -u[2])
    torch.testing.assert_close(u[1], policy.control(x[1]), rtol=0, atol=1e-9)
    assert torch.equal(policy(x[1]), u[1])
    free = adp.near_optimal(DOUBLE, COST, dt=0.25, plan=True)
    assert isinstance(free.controller(), adp.Feedback)
    assert free.planner is None
    assert limited[False].planner is None
    torch.testing.assert_close(pickle.loads(pickle.dumps(policy))(x), u)


@torch.no_grad()
def test_loop_carries_a_plan_only_where_the_lqr_would_meet_a_bound(
    limited: dict[bool, NearOptimal],
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
    best = adp.BoxDDP(planner.problem, steps=40).solve(x)
    torch.testing.assert_close(run.control[:, :10], best.control[:, :10], rtol=0, atol=1e-2)
    near, none = x[1:2], x.new_zeros(1, 0)
    u, carried = loop.step(near, loop.init(near), none, 0.25)
    assert torch.equal(u, policy(near))
    pushed, _ = loop.step(x[:1], carried, none, 0.25)
    torch.testing.assert_close(pushed, best.control[:1, 0], rtol=0, atol=1e-2)
    lost, _ = loop.step(near / 0.0, carried, none, 0.25)  # nothing is planned from there
    assert bool(lost.isnan().all())
    other, far = policy.controller(), x[:1]  # shares no plan with the first, and holds the same programs
    assert torch.equal(
        other.step(far, other.init(far), none, 0.25)[0], loop.step(far, loop.init(far), none, 0.25)[0]
    )
    assert policy.plans() is planner


@torch.no_grad()
def test_another_control_than_the_bases_promises_less_over_both_horizons(two_states: NearOptimal) -> None:
    policy = two_states
    x, discount = drawn(2, 2.0, 300), math.exp(-COST.discount * 0.1)

    def promised(u: Tensor) -> Tensor:
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
    """x' = x (1 + 20 x^2 / (x^2 + 0.2^2)) + u: some decimetres from rest the LQR holds it no more."""

    dim, inputs = 1, 1

    def drift(self, x: Tensor) -> Tensor:
        return x * (1 + 20 * x**2 / (x**2 + 0.2**2))

    def effectiveness(self, x: Tensor) -> Tensor:
        return torch.ones(1, 1, dtype=x.dtype).expand(*x.shape, 1)


def test_report_finds_the_region_of_a_plant_in_small_units() -> None:
    policy = adp.near_optimal(
        Gap(), adp.QuadraticCost(25.0, 1.0, dim=1, inputs=1), dt=0.05, horizon=0.2, reach="local", substeps=1
    )
    with lanes.compiling("always"):
        report = policy.report(states=2, full=True)
    assert report["regulated"] == 0  # in the box of 1
    assert 1 / 64 <= report["good_spread"] <= 1 / 8


def torch_turn(x: Tensor, u: Tensor) -> Tensor:
    """`turn` in torch."""
    rate = (x[:, 1] + 0.05 * (15.0 * x[:, 0].sin() + 3.0 * u[:, 0])).clamp(-8.0, 8.0)
    return torch.stack((x[:, 0] + 0.05 * rate, rate), dim=1)


@torch.no_grad()
@pytest.mark.parametrize(("target", "smooth"), [(None, True), ((2 * math.pi, 0.0), False)])
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


def made(decay: float = 2.0, dt: float = 0.1, **given: Any) -> NearOptimal:
    """Of a mode that the feedback hardly moves."""
    cost = adp.QuadraticCost(1e-9, 1.0, dim=1, inputs=1, **given)
    return adp.near_optimal(systems.Linear([[-decay]], [[1.0]]), cost, dt=dt)


def test_plans_are_made_where_there_are_bounds_a_plant_in_torch_and_no_discount() -> None:
    assert made().plans() is None
    assert isinstance(made().controller(), adp.Feedback)
    assert made(low=-1.0, discount=0.1).plans() is None
    for inside in (torch.sin, np.sin):
        plant = systems.StepPlant(lambda x, u, f=inside: 0.8 * f(x) + 0.1 * u, dim=1, inputs=1, dt=0.1)
        policy = adp.near_optimal(plant, adp.QuadraticCost(1.0, 1.0, dim=1, inputs=1, low=-1.0))
        assert (policy.plans() is not None) is (inside is torch.sin)
    limited = made(low=-1.0)
    for constants, steps in ((None, 12), (3.0, 16), (0.1, 12)):  # of half a second, in periods of .1 s
        planner = limited.plans(constants)
        assert planner is not None
        assert planner.steps == steps


@pytest.mark.parametrize(("seconds", "steps"), [(1.21, 12), (1.26, 16), (60.0, 60)])
def test_a_horizon_is_two_time_constants_in_four_quarters_of_whole_periods(
    seconds: float, steps: int
) -> None:
    policy = made(2 / seconds)
    assert policy.steps == steps
    assert policy.substeps == math.ceil(0.1 * 2 / seconds / 0.2)


# --- rollouts of a base that is held ------------------------------------------------------------------------


PLANT = systems.Linear(
    [[0.0, 1.0, 0.0], [0.4, -0.3, 0.5], [0.0, 0.2, -0.6]], [[0.0, 0.3], [1.0, 0.2], [0.1, 0.8]]
)
GAIN = tensor([[1.0, 0.8, 0.1], [0.2, 0.1, 0.5]])
METRIC = tensor([[2.0, 0.5, 0.1], [0.5, 1.0, 0.2], [0.1, 0.2, 1.5]])
HEAVY = tensor([[0.6, 0.2], [0.2, 0.9]])


def base(x: Tensor) -> Tensor:
    return -x @ GAIN.mT


def end(x: Tensor) -> Tensor:
    return (x * (x @ METRIC)).sum(-1) + x[..., 0].sin()


def sampled(cost: adp.Cost, policy: Any = base, terminal: Any = end, steps: int = 8) -> SampledRollout:
    around = torch.cat((st.cross_polytope(2), torch.zeros(1, 2).double()))
    basis = st.StaFBasis(st.ExponentialKernel(), st.StateFollowingCenters(around, 0.1))
    return SampledRollout(basis, PLANT, cost, policy, terminal, METRIC, period=0.2, steps=steps)


def bounded(discount: float) -> adp.QuadraticCost:
    limits = {"low": [-1.0, -math.inf], "high": [0.5, 2.0]}
    return adp.QuadraticCost(1.0, HEAVY, dim=3, inputs=2, discount=discount, **limits)


@torch.no_grad()
@pytest.mark.parametrize(("steps", "part", "discount"), [(4, 3, 0.0), (5, 4, 0.5)])
def test_a_promise_is_the_sum_over_the_horizon_and_over_three_quarters_of_it(
    steps: int, part: int, discount: float
) -> None:
    held = sampled(bounded(discount), steps=steps)
    start = uniform(2, 3, 3, seed=1)
    x, spent, wanted = start, torch.zeros(2, 3, dtype=torch.float64), []
    for k in range(steps):
        u = base(x).clamp(held.bounds.low, held.bounds.high)
        x, paid = held.holding(x, u)
        spent = spent + math.exp(-discount * 0.2 * k) * paid
        wanted.append(spent + math.exp(-discount * 0.2 * (k + 1)) * end(x))
    found = held.rollout(start)
    torch.testing.assert_close(found.whole, wanted[-1])
    torch.testing.assert_close(found.part, wanted[part - 1])
    last = base(x)
    assert torch.equal(found.free, ((last > held.bounds.low) & (last < held.bounds.high)).all(-1))
    for mine, of_all in zip(held.rollout(start[0, 2]), found, strict=True):
        torch.testing.assert_close(mine, of_all[0, 2])
    after, paid = held.holding(start, held.control(start))
    ahead = held.rollout(after).whole
    torch.testing.assert_close(held.value(start), paid + math.exp(-discount * 0.2) * ahead)


@pytest.mark.parametrize("limits", [(None, None), (-0.05, 0.02)])
def test_a_proposal_is_the_newton_step_of_what_follows(limits: tuple[float | None, float | None]) -> None:
    """Nothing is paid but at the end, slope'x, where a resting base drifts to: grad V is e^(A'T) slope."""
    slope, h, steps = tensor([0.6, -0.9, 0.4]), 0.2, 8
    cost = adp.QuadraticCost(
        torch.zeros(3, 3).double(), HEAVY, dim=3, inputs=2, low=limits[0], high=limits[1]
    )
    held = sampled(cost, lambda x: 0 * x[..., :2], lambda x: x @ slope, steps=steps)
    flow = torch.linalg.matrix_exp(
        h * torch.cat((torch.cat((PLANT.matrix, PLANT.input_matrix), 1), torch.zeros(2, 5)), 0)
    )
    a, b = flow[:3, :3], flow[:3, 3:]
    pull = b.mT @ torch.linalg.matrix_power(a, steps).mT @ slope
    curved = 2 * (h * HEAVY + b.mT @ METRIC @ b)
    x = 0.3 * uniform(4, 3, seed=3)
    for d in held.proposal(x, torch.zeros(4, 2).double()):
        rise = pull + curved @ d  # of the model: 0 inside, outward at a bound
        for change, along in zip(d.tolist(), rise.tolist(), strict=True):
            if limits[0] is not None and change in limits:
                assert along * change < 0
            else:
                assert abs(along) < 2e-3


@torch.no_grad()
def test_an_input_that_moves_nothing_is_left_as_it_is() -> None:
    chain = [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]]
    plant = systems.Linear(chain, [[0.0, 0.0], [0.0, 0.0], [1.0, 0.0]])
    policy = adp.near_optimal(plant, adp.QuadraticCost(1.0, 1.0, dim=3, inputs=2), dt=0.1)
    x = uniform(4, 3, seed=1)
    assert bool(policy(x).isfinite().all())
    torch.testing.assert_close(policy(x)[:, 1], torch.zeros(4).double(), rtol=0, atol=1e-8)


def test_a_bound_is_met_where_the_base_reaches_it_within_the_horizon() -> None:
    line, cost = systems.Linear([[0.0]], [[1.0]]), adp.QuadraticCost(1.0, 1.0, 1, 1, low=-1.0, high=2.0)
    basis = st.StaFBasis(st.ExponentialKernel(), st.StateFollowingCenters(tensor([[1.0], [-1.0]]), 0.1))

    def meets(gain: float, *x: float, steps: int = 4) -> list[float]:
        held = SampledRollout(
            basis, line, cost, lambda x: gain * x, lambda x: x[..., 0], torch.eye(1), period=0.5, steps=steps
        )
        found = held.meets_bound(tensor([[one] for one in x]))
        assert found.shape == (len(x), 1)
        return found[:, 0].tolist()

    assert meets(-1.0, 1.0, 0.99, -2.0, -1.99, 5.0, 0.0) == [1.0, 0.0, 1.0, 0.0, 1.0, 0.0]
    # It grows by a half a period: 0.4, 0.6, 0.9, 1.35, 2.025 in the fifth.
    assert meets(1.0, 0.4) == [0.0]
    assert meets(1.0, 0.4, steps=5) == [1.0]

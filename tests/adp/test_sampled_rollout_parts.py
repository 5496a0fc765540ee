"""A held policy and its rollouts by parts: promises written out, the choice among three, its report."""

from __future__ import annotations

import importlib
import math
from typing import Any

import pytest
import torch
from helpers import tensor, uniform
from recorded import Record
from torch import Tensor

import staf_torch as st
from staf_torch import adp, systems
from staf_torch.adp.sampled_rollout import Promise, SampledRollout

module: Any = importlib.import_module("staf_torch.adp.near_optimal")  # the name is the function's, too
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


def policy(dim: int = 2, discount: float = 0.3, steps: int = 8, **more: Any) -> SampledRollout:
    limits = {"low": [-1.0, -math.inf], "high": [0.5, 2.0]}
    cost = adp.QuadraticCost(1.0, HEAVY, dim=3, inputs=2, discount=discount, **{**limits, **more})
    around = torch.cat((st.cross_polytope(dim), torch.zeros(1, dim).double()))
    basis = st.StaFBasis(st.ExponentialKernel(), st.StateFollowingCenters(around, 0.1))
    return SampledRollout(basis, PLANT, cost, base, end, METRIC, period=0.2, steps=steps)


@torch.no_grad()
@pytest.mark.parametrize("discount", [0.0, 0.5])
@pytest.mark.parametrize(("steps", "part"), [(4, 3), (5, 4), (6, 4), (8, 6), (10, 8), (12, 9)])
def test_a_promise_is_the_sum_over_the_horizon_and_over_three_quarters_of_it(
    steps: int, part: int, discount: float
) -> None:
    held = policy(discount=discount, steps=steps)
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
    for one, some in ((start[1], (1,)), (start[0, 2], (0, 2))):
        for mine, of_all in zip(held.rollout(one), found, strict=True):
            torch.testing.assert_close(mine, of_all[some])
    after, paid = held.holding(start, held.control(start))
    ahead = held.rollout(after).whole
    torch.testing.assert_close(held.value(start), paid + math.exp(-discount * 0.2) * ahead)


def test_a_control_at_either_bound_is_not_free() -> None:
    for level, free in ((0.5, False), (0.499, True), (-1.0, False), (-0.999, True), (0.7, False)):
        held = policy(steps=4)
        held.base = lambda x, level=level: x.new_tensor([level, 0.1]).expand(*x.shape[:-1], 2)
        assert held.rollout(torch.zeros(1, 3).double()).free.tolist() == [free]


BASE = (1.0, 1.0, True)
TABLE: list[tuple[list[tuple[float, float, bool]], int]] = [
    ([BASE, (0.9, 0.9, True), (2.0, 2.0, True)], 1),
    ([BASE, (2.0, 2.0, True), (0.9, 0.9, True)], 2),
    ([BASE, (0.9, 1.1, True), (0.95, 0.9, True)], 2),
    ([BASE, (0.9, 0.9, True), (0.8, 0.9, True)], 2),
    ([BASE, (0.8, 0.9, True), (0.9, 0.8, True)], 1),
    ([BASE, (0.8, 0.9, True), (0.8, 0.8, True)], 1),
    ([BASE, (0.8, 0.8, False), (0.9, 0.9, True)], 2),
    ([BASE, (0.8, 0.8, False), (0.9, 1.0, True)], 0),
    ([BASE, (1.0 - 0.7e-9, 0.9, True), (1.1, 0.9, True)], 0),
    ([BASE, (1.0 - 1.5e-9, 0.9, True), (1.1, 0.9, True)], 1),
    ([(-1.0, 1.0, True), (-1.0 - 0.7e-9, 0.9, True), (1.1, 0.9, True)], 0),
    ([(-1.0, 1.0, True), (-1.0 - 1.5e-9, 0.9, True), (1.1, 0.9, True)], 1),
    ([(1.0, 1.0, False), (0.9, 0.9, True), (1.1, 1.1, False)], 1),
    ([(8.0, 8.0, True), (8.0 - 4e-9, 7.0, True), (9.0, 9.0, True)], 0),
]


@pytest.mark.parametrize("discounted", [False, True])
def test_of_three_controls_the_one_that_promises_least_in_both_is_taken(
    discounted: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    held = policy(discount=0.5 if discounted else 0.0)
    rows, share = len(TABLE), math.exp(-0.1) if discounted else 1.0
    x, step = 0.1 * uniform(rows, 3, seed=1), uniform(rows, 2, seed=2)
    table = tensor([[[one[0], one[1], float(one[2])] for one in row[0]] for row in TABLE])
    due = tensor([0.25, -0.5, 0.75]) if discounted else torch.zeros(3).double()
    promise = Promise((table[..., 0] - due) / share, (table[..., 1] - due) / share, table[..., 2] > 0)
    tried = []

    def holding(x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        tried.append((x, u))
        return x, due.expand(rows, 3)

    monkeypatch.setattr(held, "holding", holding)
    monkeypatch.setattr(held, "_proposed", lambda x, base: (step, None))
    monkeypatch.setattr(held, "_promise", lambda after, known: promise)
    chosen = held.control(x)
    low, high = held.bounds.low, held.bounds.high
    first = base(x).clamp(low, high)
    wanted = torch.stack([first, *((first + part * step).clamp(low, high) for part in (1.0, 0.3))], dim=1)
    torch.testing.assert_close(tried[0][1], wanted)
    assert torch.equal(tried[0][0], x.unsqueeze(1).expand(-1, 3, -1))
    which = [row[1] for row in TABLE]
    if discounted:  # differences of 1e-9 are lost in the sums
        some = [k for k in range(rows) if k not in (8, 9, 10, 11, 13)]
        torch.testing.assert_close(chosen[some], wanted[some, [which[k] for k in some]])
    else:
        torch.testing.assert_close(chosen, wanted[torch.arange(rows), which])


@pytest.mark.parametrize("dim", [2, 3])
def test_a_proposal_is_the_newton_step_of_what_follows(dim: int, monkeypatch: pytest.MonkeyPatch) -> None:
    held = policy(dim, low=[-3.0, -0.3], high=[3.0, 0.2], target=[0.0, 0.0, 0.0])
    slope, x = tensor([0.6, -0.9, 0.4]), uniform(4, 3, seed=3)
    near = base(x).clamp(held.bounds.low, held.bounds.high)

    def rollout(x: Tensor) -> Promise:
        whole = (x * slope).sum(-1)
        return Promise(whole, whole, whole > 0)

    monkeypatch.setattr(held, "rollout", rollout)
    found = held.proposal(x, near)
    for row in range(4):

        def both(u: Tensor, row: int = row) -> tuple[Tensor, Tensor]:
            after, paid = held.holding(x[row], u)
            return after, paid

        b, rise = torch.func.jacrev(both)(near[row])
        pull = rise + math.exp(-0.06) * b.mT @ slope
        curved = 2 * (0.2 * HEAVY + b.mT @ METRIC @ b)
        low, high = held.bounds.low - near[row], held.bounds.high - near[row]
        grid = torch.cartesian_prod(*(torch.linspace(0, 1, 401).double() for _ in range(2)))
        several = low + (high - low) * grid
        model = several @ pull + 0.5 * ((several @ curved) * several).sum(-1)
        at, best = found[row], several[model.argmin()]
        torch.testing.assert_close(at, best, rtol=0, atol=2e-2)
        gradient = pull + curved @ at
        inside = (at > low + 1e-9) & (at < high - 1e-9)
        assert bool((gradient[inside].abs() < 2e-2 * pull.abs().max()).all())


def test_probes_are_a_thousandth_of_the_range_or_of_one() -> None:
    assert policy().probe.tolist() == pytest.approx([1.5e-3, 1e-3])
    assert policy(low=None, high=None).probe.tolist() == pytest.approx([1e-3, 1e-3])


def test_of_rollouts_from_the_center_none_is_made_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def rollout(x: Tensor) -> Promise:
        asked.append(tuple(x.shape))
        return Promise(x.sum(-1), 2 * x.sum(-1), x.sum(-1) > 0)

    known = Promise(*(torch.arange(10.0).view(2, 5).double() + k for k in range(2)), torch.ones(2, 5) > 0)
    after = uniform(2, 3, 3, seed=1)
    held = policy()
    assert held.along is not None
    assert held.along.middle == 4
    monkeypatch.setattr(held, "rollout", rollout)
    found = held._promise(after, known)
    assert asked == [(2, 2, 3)]
    torch.testing.assert_close(found.whole, torch.cat((tensor([[4.0], [9.0]]), after[:, 1:].sum(-1)), 1))
    torch.testing.assert_close(found.part, torch.cat((tensor([[5.0], [10.0]]), 2 * after[:, 1:].sum(-1)), 1))
    assert found.free[:, 0].tolist() == [True, True]
    whole = policy(3)
    assert whole.along is None
    monkeypatch.setattr(whole, "rollout", rollout)
    torch.testing.assert_close(whole._promise(after, known).whole, after.sum(-1))


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


PLANTS: dict[str, tuple[systems.Plant, int, int, dict[str, Any]]] = {
    "two states": (systems.TwoState(), 2, 1, {"dt": 0.1}),
    "pendulum": (systems.Pendulum(), 2, 1, {"dt": 0.05}),
    "pendulum, long": (systems.Pendulum(), 2, 1, {"dt": 0.3}),
    "pendulum that plans": (systems.Pendulum(), 2, 1, {"dt": 0.05, "plan": True}),
    "pendulum, stated": (systems.Pendulum(), 2, 1, {"dt": 0.05, "horizon": 0.62, "radius": 0.3}),
    "quadrotor": (systems.PlanarQuadrotor(), 6, 2, {"dt": 0.02}),
    "cart-pole": (systems.CartPole(), 4, 1, {"dt": 0.02}),
    "more inputs than states": (
        systems.Linear([[0.3]], [[1.0, 0.5, -0.2]]),
        *(1, 3),
        {"dt": 0.1, "low": -1.0, "high": 1.0},
    ),
}


def test_horizon_substeps_and_centers_of_a_policy_are_the_recorded(record: Record) -> None:
    found: dict[str, Any] = {}
    for name, (plant, dim, inputs, given) in PLANTS.items():
        made = adp.near_optimal(plant, adp.QuadraticCost(1.0, 1.0, dim=dim, inputs=inputs), **given)
        numbers = {
            "steps": made.steps, "substeps": made.substeps, "period": made.period, "radius": made.radius,
            "held": made.holding.steps, "directions": made.basis.centers.directions, "probe": made.probe,
            "plans": made.planner is not None, "slowest": module._slowest(made.lqr, plant),
            "around": made.basis.centers(torch.zeros(made.basis.dim).double()),
        }  # fmt: skip
        found[name] = numbers
    record(found, rtol=1e-5)


def test_a_horizon_has_four_quarters_of_whole_periods() -> None:
    asked = [
        (1.0, 0.1),
        (1.21, 0.1),
        (1.26, 0.1),
        (1.64, 0.1),
        (5.9, 0.1),
        (6.0, 0.1),
        (60.0, 0.1),
        (1.6, 0.1),
    ]
    assert [module._periods(*one) for one in asked] == [12, 12, 16, 16, 60, 60, 60, 16]
    slow = systems.Linear([[-2.0]], [[1.0]])
    lqr = adp.LQR(slow, adp.QuadraticCost(1e-9, 1.0, dim=1, inputs=1), period=0.1)
    assert module._slowest(lqr, slow) == pytest.approx(2.0, rel=1e-6)


def made(**given: Any) -> adp.NearOptimal:
    return adp.near_optimal(
        systems.Linear([[-2.0]], [[1.0]]), adp.QuadraticCost(1e-9, 1.0, dim=1, inputs=1, **given), dt=0.1
    )


def test_states_of_a_report_fill_the_box_around_the_set_point() -> None:
    plain, drawn = made(), made()._drawn(4000, 0.5, 3)
    assert float(drawn.abs().max()) <= 0.5
    assert abs(float(drawn.mean())) < 0.02
    assert float(drawn.std()) == pytest.approx(0.5 / math.sqrt(3), rel=0.03)
    assert torch.equal(plain._drawn(3, 0.5, 3), drawn[:3])
    assert not torch.equal(plain._drawn(3, 0.5, 4), drawn[:3])
    aside = made(target=[2.0], target_input=[4.0])._drawn(3, 0.5, 3)
    torch.testing.assert_close(aside, drawn[:3] + 2.0)


def test_a_row_is_regulated_where_a_hundredth_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = {}

    def simulate(controller: Any, plant: Any, cost: Any, x0: Tensor, **given: Any) -> Any:
        asked.update(given)
        state = torch.stack((x0, tensor([[0.0099], [0.0101], [0.02], [0.0]])), dim=1)
        diverged = torch.tensor([False, False, False, True])
        return type("Run", (), {"state": state, "cost": x0[:, 0] * 3, "diverged": diverged})

    monkeypatch.setattr(module, "simulate", simulate)
    cost, fine = made()._run(adp.Feedback(base), tensor([[1.0], [1.0], [-2.0], [1.0]]))
    assert fine.tolist() == [True, False, True, False]
    assert cost.tolist() == [3.0, 3.0, -6.0, 3.0]
    assert asked == {"dt": 0.1, "steps": 46, "substeps": 1}  # of 4.6 s


@pytest.mark.parametrize(
    ("largest", "found"), [(9.0, 2.0), (1.0, 1.0), (0.2, 0.125), (1e-3, 2.0**-10), (0.0, 0.0)]
)
def test_the_good_box_is_the_largest_from_which_all_come_home(
    largest: float, found: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = made()

    def run(controller: Any, x0: Tensor) -> tuple[Tensor, Tensor]:
        return x0[:, 0], x0[:, 0].abs() <= largest

    monkeypatch.setattr(one, "_run", run)
    monkeypatch.setattr(one, "_drawn", lambda states, width, seed: tensor([[0.0], [width]]))
    tried = torch.tensor([[True, 0.5 * share <= largest] for share in module._SHARES])
    assert one._good(tried, 2, 0.5, 0) == found


def test_the_cost_is_compared_with_an_optimum_where_one_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    class Shooting:
        def __init__(self, plant: Any, cost: Any) -> None:
            assert (plant, cost) == (one.plant, one.cost)

        def solve(self, x0: Tensor) -> Any:
            return type("Best", (), {"value": tensor([2.0, math.nan, 4.0, 5.0])})

    monkeypatch.setattr(module, "DirectShooting", Shooting)
    one, cost, fine = made(), tensor([3.0, 3.0, 5.0, 5.0]), torch.tensor([True, True, True, False])
    assert one._over_optimum(cost, cost, fine).tolist() == [1.5, 1.25]
    one.cost = adp.QuadraticCost(1.0, 1.0, dim=1, inputs=1, discount=0.1)
    assert len(one._over_optimum(cost, cost, fine)) == 0
    assert module._median(cost[:0]) is None
    assert module._median(tensor([3.0, 1.0, 2.0])) == 2.0


def test_the_time_of_a_control_is_the_median_of_the_later_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    """Call k takes k units: of the last two hundred the middle one is the 300th; slow ones are fewer."""
    monkeypatch.setattr(module, "ready", lambda policy, x: None)
    one = made()
    monkeypatch.setattr(one, "controller", lambda: adp.Feedback(lambda x: -x))

    def found(unit: int) -> tuple[float, int]:
        ticks = [tick for k in range(400) for tick in (10**9 * k, 10**9 * k + unit * k)]
        now = iter(ticks)
        monkeypatch.setattr(module.time, "perf_counter_ns", lambda: next(now))
        return one._microseconds(tensor([[0.1]])), 400 - len(list(now)) // 2

    assert found(1000) == (300.0, 400)  # 80 ms in all
    assert found(100_000) == (100 * 34.0, 46)  # 0 to 45 are .104 s
    assert found(10**7) == (10**4 * 15.0, 20)  # 1.9 s

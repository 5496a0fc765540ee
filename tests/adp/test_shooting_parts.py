"""Direct shooting around its iteration: defaults, pieces, the choice among starts, what a result says."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from helpers import tensor, uniform
from recorded import Record
from torch import Tensor

from staf_torch import adp, systems
from staf_torch.adp.shooting import direct, starts
from staf_torch.adp.shooting.mesh import graded
from staf_torch.adp.shooting.newton import Plan, Solution

LINE = systems.Linear([[0.0, 1.0], [2.0, -1.0]], [[0.0], [1.0]])
COST = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
INF = math.inf


def shooting(plant: systems.Plant = LINE, cost: adp.Cost = COST, **given: Any) -> adp.DirectShooting:
    return adp.DirectShooting(plant, cost, **given)


def optimum(*values: float, last: float = 4.0, **given: Any) -> adp.Optimum:
    """A result of a row each value, over five times, with numbers that tell the rows apart."""
    rows, value = len(values), tensor(values)
    fields = {
        "value": value,
        "gradient": value[:, None] + tensor([0.1, 0.2]),
        "control": value[:, None] + 0.3,
        "state": value[:, None, None] + torch.arange(10.0).double().view(5, 2),
        "time": last * torch.linspace(0, 1, 5, dtype=torch.float64) ** 2,
        "mesh_error": value + 0.4,
        "horizon_error": value + 0.5,
        "iterations": torch.arange(rows) + 3,
        "converged": torch.isfinite(value),
        "plan": value[:, None, None, None] + torch.arange(8.0).double().view(4, 2, 1),
        "optimality": value + 0.6,
        "reason": tuple("" if math.isfinite(one) else "none" for one in values),
    }
    return adp.Optimum(**{**fields, **given})


FAST = systems.Linear([[-40.0]], [[1.0]])
SLOW = systems.Linear([[0.0, 1.0], [-2.0, -3.0]], [[0.0], [1.0]])
LIGHT = adp.QuadraticCost(1e-6, 1.0, dim=2, inputs=1)  # the feedback hardly moves the modes


@pytest.mark.parametrize("bounded", [False, True])
def test_horizon_and_intervals_follow_the_modes_of_the_loop(bounded: bool) -> None:
    limits = {"low": -1.0, "high": 1.0} if bounded else {}
    found = shooting(SLOW, LIGHT, **limits)  # modes of -1 and -2 in 1/s
    assert found.horizon == pytest.approx(9.2, rel=1e-5)
    assert found.intervals == 80  # 37 would resolve them
    assert found.iterations == (120 if bounded else 50)
    long = shooting(SLOW, LIGHT, horizon=60.0, **limits)
    assert (long.horizon, long.intervals) == (60.0, 120 if bounded else 240)
    less = shooting(SLOW, LIGHT, horizon=26.0, **limits)
    assert less.intervals == 104
    assert shooting(SLOW, LIGHT, horizon=26.4, **limits).intervals == 106
    given = shooting(SLOW, LIGHT, intervals=4, iterations=1, starts=1, seed=0, **limits)
    assert (given.intervals, given.iterations, given.starts, given.seed) == (4, 1, 1, 0)
    fast = shooting(FAST, adp.QuadraticCost(1e-6, 1.0, dim=1, inputs=1), horizon=1.0, **limits)
    assert fast.intervals == 80


def test_bases_are_those_that_are_given_and_the_lqr_where_there_is_need() -> None:
    one, other = (lambda x: -x[..., :1]), (lambda x: -2 * x[..., :1])
    value, whole = (lambda x: x.square().sum(-1)), {"horizon": 2.0, "intervals": 8}
    assert [type(base).__name__ for base in shooting().bases] == ["LQR"]
    assert shooting(base=one).bases == (one,)
    assert shooting(base=[one]).bases == (one,)
    several = shooting(base=[one, other])
    assert several.bases == (one, other, several.lqr)
    stated = shooting(base=[one, other], terminal=value, **whole)
    assert stated.bases == (one, other)
    assert stated.lqr is None
    assert stated.terminal is value
    assert shooting(base=one, terminal=value, horizon=2.0).lqr is not None
    assert shooting(base=one, terminal=value, intervals=8).lqr is not None
    assert shooting(base=one, **whole).lqr is not None
    assert shooting(terminal=value, **whole).lqr is not None


def test_the_horizon_is_doubled_up_to_three_times_while_much_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    left = [INF]

    def over(self: Any, x0: Tensor, horizon: float, intervals: int, warm: Any) -> adp.Optimum:
        asked.append((horizon, intervals))
        return optimum(1.0, 2.0, horizon_error=tensor([math.nan, left[min(len(asked), len(left)) - 1]]))

    monkeypatch.setattr(adp.DirectShooting, "_over", over)
    x = torch.zeros(2, 2).double()
    for given, errors, wanted in (
        ({}, [1e-3], [(1, 80)]),
        ({}, [1.1e-3, 9e-4], [(1, 80), (2, 120)]),
        ({}, [1.0], [(1, 80), (2, 120), (4, 120), (8, 120)]),
        ({"intervals": 20}, [1.0], [(1, 20), (2, 20), (4, 20), (8, 20)]),
        ({"horizon": 2.0}, [1.0], [(1, 80)]),
    ):
        asked: list[tuple[float, int]] = []
        left = errors
        search = shooting(**given)
        search.solve(x)
        assert asked == [(times * search.horizon, count) for times, count in wanted]
        assert search.horizon == shooting(**given).horizon


def test_many_states_are_solved_in_pieces_each_with_its_own_earlier_plans(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    seen = []

    def solve(self: Any, x0: Tensor, warm: adp.Optimum | None) -> adp.Optimum:
        seen.append(None if warm is None else warm.value.tolist())
        return optimum(*x0[:, 0].tolist())

    monkeypatch.setattr(adp.DirectShooting, "_solve", solve)
    monkeypatch.setattr(direct, "_ROWS", 2)
    x = tensor([[5.0, 0.0], [6.0, 0.0], [INF, 0.0], [8.0, 0.0], [9.0, 0.0]])
    found = shooting().solve(x, warm=optimum(1.0, 2.0, 3.0, 4.0, 5.0))
    assert seen == [[1.0, 2.0], [3.0, 4.0], [5.0]]
    whole = optimum(*x[:, 0].tolist())
    assert found.reason == ("", "", "none", "", "")
    for name, part in whole._asdict().items():
        if isinstance(part, Tensor) and name != "iterations":
            torch.testing.assert_close(getattr(found, name), part)
    assert found.iterations.tolist() == [3, 4, 3, 4, 3]
    shooting().solve(x[:2])
    assert seen[3:] == [None]
    with pytest.raises(ValueError, match=r"state a `horizon` of 8 s, or solve at most 2 states at once"):
        direct._joined([optimum(1.0), optimum(1.0, last=8.0), optimum(2.0)])
    early, late = tensor([0.0, 3.0, 6.0, 7.0]), tensor([0.0, 1.0, 2.0, 9.0])  # the end of one tells
    with pytest.raises(ValueError, match="state a `horizon` of 9 s"):
        direct._joined([optimum(1.0)._replace(time=early), optimum(1.0)._replace(time=late)])


def test_one_start_is_believed_near_the_lqr_where_following_it_is_not_dear() -> None:
    search = shooting(systems.Pendulum(), COST)
    assert search.lqr is not None
    search.lqr.value = lambda x: torch.ones(len(x)).double()  # type: ignore[method-assign]
    values = (0.49, 0.51, 1.99, 2.01, 1.0, 1.0, 9.0, 1.0)
    followed = tensor([0.5, 0.6, 2.0, 2.2, 1.5, 1.51, 9.0, 1.0])
    x = torch.ones(8, 2).double()
    x[6] = 0.0  # at the set-point anything is
    found = optimum(*values, converged=torch.tensor([True] * 7 + [False]))
    wanted = [False, True, True, False, True, False, True, False]
    assert search._believed(found, x, followed).tolist() == wanted
    x[6, 1] = 1.0
    assert not bool(search._believed(found, x, followed)[6])
    stated = shooting(base=search.bases[0], terminal=COST.state_rate, horizon=1.0, intervals=4)
    for sure in (shooting(), stated):
        assert sure._believed(found, x, followed).tolist() == [True] * 7 + [False]  # linear, or no LQR known


def test_of_several_starts_the_cheapest_is_kept_and_two_that_agree_are_an_optimum() -> None:
    found = optimum(7.0, 5.0, math.nan, 2.0, 3.0)
    rows = torch.tensor([1, 2, 3, 4])
    several = [
        optimum(5.0 * (1 + 0.9e-4), math.nan, 4.0, 2.0),
        optimum(6.0, math.nan, 1.0, 2.0 * (1 + 1.2e-4)),
    ]
    merged = direct._merged(found, rows, several)
    assert merged.value[[0, 1, 3, 4]].tolist() == [7.0, 5.0, 1.0, 2.0]
    assert math.isnan(float(merged.value[2]))
    assert merged.converged.tolist() == [True, True, False, False, False]
    assert merged.reason == (
        "",
        "",
        "none",
        "local: one start alone found it, others up to 4 times as much",
        "local: one start alone found it, others up to 1.5 times as much",
    )
    wanted = optimum(7.0, 5.0, math.nan, 1.0, 2.0)
    for name in ("gradient", "control", "state", "mesh_error", "horizon_error", "plan", "optimality"):
        torch.testing.assert_close(getattr(merged, name), getattr(wanted, name), equal_nan=True)
    assert merged.iterations.tolist() == [3, 4 + 3 + 3, 5 + 4 + 4, 6 + 5 + 5, 7 + 6 + 6]
    assert torch.equal(merged.time, found.time)
    some = direct.selected(found, torch.tensor([4, 2]))
    assert some.value[:1].tolist() == [3.0]
    assert some.reason == ("", "none")


def test_values_agree_to_a_ten_thousandth_of_the_lowest() -> None:
    values = tensor([[1.0, INF, 2.0], [1.0001, INF, 2.1], [1.00011, INF, 3.0]])
    assert starts.agreement(values, 1e-4).tolist() == [2, 3, 1]
    assert starts.said([2.0, 2.0001, 3.0, 5.0], 2.0).endswith("others up to 2.5 times as much")
    assert starts.said([2.0, 2.0001], 2.0).endswith("others up to 1 times as much")
    assert starts.said([2.0, INF], 2.0).endswith("others up to inf times as much")
    assert starts.said([2.0, math.nan], 2.0).endswith("others up to 1 times as much")


def solution(cost: float, converged: bool, promise: float) -> Solution:
    none = torch.zeros(1, 1, 1)
    plan = Plan(none, none, tensor([cost]))
    return Solution(plan, none, none, torch.tensor([converged]), none, tensor([promise]), torch.zeros(1))


@pytest.mark.parametrize(
    ("known", "cost", "converged", "promise", "said"),
    [
        (True, INF, False, INF, ""),
        (False, INF, False, INF, "the cost is not finite from here under any start: give a `base` that"),
        (False, 1.0, False, INF, "not stationary: the expansion around the last trajectory is not finite"),
        (False, 1.0, False, 0.0123, "not stationary: the last model promised 0.012 of the value"),
        (False, 1.0, True, 0.0123, "the control misses the minimum of the Hamiltonian by 0.25 of the value"),
    ],
)
def test_a_row_says_why_it_has_no_optimum(
    known: bool, cost: float, converged: bool, promise: float, said: str
) -> None:
    why = direct._why(known, solution(cost, converged, promise), 0.25, 0)
    assert why.startswith(said)
    assert bool(why) is not known


def test_a_result_says_itself_in_one_line() -> None:
    assert repr(optimum(1.23456789, 2.0)) == (
        "Optimum(2 states, value 1.23457 to 2, 2 converged, 4 intervals over 4 s)"
    )
    assert repr(optimum(math.nan)).startswith("Optimum(1 states, value none found, 0 converged, 4 intervals")
    assert repr(optimum(1.0, math.nan)).endswith("over 4 s; none)")
    several = optimum(1.0, 2.0, 3.0, reason=("b", "a", "b"))
    assert repr(several).endswith("over 4 s; a (and 1 more reasons))")


def test_a_plan_that_is_replayed_holds_the_mean_of_each_period_and_stays_at_its_end() -> None:
    found = optimum(1.0, -2.0)
    runner = found.replay()

    def u(t: float, row: int) -> float:
        if t >= 4.0:
            return float(found.plan[row, -1, 1, 0])
        k = int((found.time <= t).sum()) - 1
        share = (t - float(found.time[k])) / float(found.time[k + 1] - found.time[k])
        first, last = found.plan[row, k, :, 0].tolist()
        return first + share * (last - first)

    x = torch.zeros(2, 2).double()
    carried = runner.init(x)
    for period in range(5):
        got, carried = runner.step(x, carried, x, 0.9)
        times = 0.9 * (period + (torch.arange(400) + 0.5) / 400)
        for row in range(2):
            mean = sum(u(float(t), row) for t in times) / 400
            assert float(got[row, 0]) == pytest.approx(mean, abs=8e-3)
    torch.testing.assert_close(carried.identifier, torch.full((2, 1), 4.5).double())
    assert [tuple(part.shape) for part in runner.init(x)] == [(2, 0), (2, 0), (2, 0, 0), (2, 1)]
    with pytest.raises(ValueError, match=r"This plan is for 2 initial states; got 3\."):
        runner.init(torch.zeros(3, 2).double())


def test_an_earlier_plan_is_held_on_another_mesh_and_stays_at_its_end() -> None:
    found, search = optimum(0.1, -0.2, 0.3), shooting(horizon=5.0, intervals=8)
    time = graded(5.0, 4)  # beyond the four seconds of the plan
    rows = torch.tensor([2, 0])
    start = search._warm(found, torch.zeros(2, 2).double(), rows, time)
    asked = torch.stack((time[:-1], time[1:]), dim=1).clamp(max=4.0)
    for place, row in enumerate((2, 0)):
        for k in range(4):
            for half in range(2):
                t = float(asked[k, half]) * (1 - 1e-9)
                at = min(int((found.time <= t).sum()) - 1, 3)
                share = (t - float(found.time[at])) / float(found.time[at + 1] - found.time[at])
                first, last = found.plan[row, at, :, 0].tolist()
                wanted = first + share * (last - first)
                assert float(start.control[place, k, half]) == pytest.approx(wanted, abs=1e-5)


def test_what_is_left_of_the_hamiltonian_is_a_trapezoid(monkeypatch: pytest.MonkeyPatch) -> None:
    search = shooting()

    def gap(x: Tensor, v: Tensor, costate: Tensor) -> Tensor:
        return x[..., 0] + 10 * v[..., 0] + 100 * costate[..., 1]

    monkeypatch.setattr(search.stage, "gap", gap)
    state, control, costates = uniform(2, 4, 2, seed=1), uniform(2, 3, 2, seed=2), uniform(2, 4, 2, seed=3)
    time = tensor([0.0, 0.1, 0.4, 1.0])
    none: Any = None
    made = Solution(Plan(state, control, none), none, none, none, costates, none, none)
    wanted = torch.zeros(2).double()
    for k, length in enumerate((0.1, 0.3, 0.6)):
        for end in range(2):
            wanted += length / 2 * gap(state[:, k + end], control[:, k, end : end + 1], costates[:, k + end])
    torch.testing.assert_close(search._left(made, time), wanted)


def test_random_guesses_are_the_recorded(record: Record) -> None:
    limited = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=2, low=[-1.0, -INF], high=[INF, 3.0])
    x0 = tensor([[0.3, -0.2], [-0.1, 0.4]])
    several = {"some bounds": limited, "none": adp.QuadraticCost(1.0, 1.0, dim=2, inputs=2)}
    for base in (lambda x: 2 * x, lambda x: 0 * x):
        several_found = {
            f"{name}, {k}": (each.knots, each.until)
            for name, cost in several.items()
            for k, each in enumerate(starts.guesses(cost, base, x0, 10.0, 3, seed=5))
        }
        if base(x0).any():
            record(several_found)
    # A base that asks for nothing: at least a thousandth times three to either side.
    free = starts.guesses(several["none"], lambda x: 0 * x, x0, 10.0, 0, seed=5)
    assert sorted({float(each.knots.min()) for each in free}) == pytest.approx([-3e-3, 0.0])
    assert [tuple(each.knots.shape) for each in free] == [(2, 2)] * 25

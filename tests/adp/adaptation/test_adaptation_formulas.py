"""Windows, stacks and least squares beside loops and sums that are written out."""

from __future__ import annotations

import math

import pytest
import torch
from helpers import tensor, uniform
from helpers_adaptation import PENDULUM
from torch import Tensor

from staf_torch import adp

TURNING = adp.ParametricPlant(
    lambda x, u: torch.stack((torch.zeros_like(x), torch.cat((x[..., :1].sin(), u), -1)), dim=-2),
    lambda x, u: torch.stack((x[..., 1], -0.5 * x[..., 1] + x[..., 0].cos()), dim=-1),
    dim=2,
    inputs=1,
    theta=[1.0, 2.0],
    rows=[1],
    periodic=(0,),
)
DT = 0.125  # exact in binary, as are the lengths: edges are edges


def swept(count: int) -> tuple[Tensor, Tensor]:
    """States and inputs of so many times, (T, 2) and (T, 1)."""
    k = torch.arange(count, dtype=torch.float64)
    return torch.stack((3.0 + 0.1 * k, (0.7 * k).sin()), -1), (1.3 * k).cos().unsqueeze(-1)


@pytest.mark.parametrize(
    ("length", "first", "ends"),
    [
        (0.5, None, [(0, 4), (4, 8), (8, 12)]),
        (0.3125, None, [(0, 3), (3, 6), (6, 9)]),  # two periods and a half: the third ends it
        (0.25, None, [(0, 2), (2, 4), (4, 6)]),
        (0.5, 0.125, [(0, 1), (1, 3), (3, 7), (7, 11)]),
        (0.75, 0.25, [(0, 2), (2, 6), (6, 12)]),
        (0.125, None, [(0, 1), (1, 2), (2, 3)]),
    ],
)
@pytest.mark.parametrize("shape", ["box", "smooth"])
@pytest.mark.parametrize("model", [TURNING, PENDULUM])
def test_a_window_is_the_sum_over_its_steps(
    model: adp.ParametricPlant, length: float, first: float | None, ends: list[tuple[int, int]], shape: str
) -> None:
    x, u = swept(13)
    windows = adp.IntegralWindows(model, length, shape=shape, first=first, noise=0.3)
    now, found = windows.init(x[0]), []
    assert float(now.elapsed) == -1
    for k in range(13):
        now, equation = windows.step(now, x[k], DT)
        now = windows.holding(now, u[k])
        assert torch.equal(now.x, x[k])
        if bool(equation.ready):
            found.append((k, equation))
            assert float(now.elapsed) == 0
            assert not bool(now.s.any() or now.z.any())
    assert [k for k, _ in found[: len(ends)]] == [end for _, end in ends]
    size = length if first is None else first
    for (begin, end), (_, equation) in zip(ends, found, strict=False):
        s, z = torch.zeros(2, model.parameters_count).double(), torch.zeros(2).double()
        for k in range(begin, end):
            t = (k - begin + 0.5) * DT
            phi = math.sin(math.pi * t / size) ** 2 if shape == "smooth" else 1.0
            moved = model.difference(x[k + 1], x[k])
            s += phi * DT * 0.5 * (model.regressor(x[k], u[k]) + model.regressor(x[k + 1], u[k]))
            z += phi * (moved - DT * 0.5 * (model.rest_of(x[k], u[k]) + model.rest_of(x[k + 1], u[k])))
        torch.testing.assert_close(equation.s, s[model.rows], rtol=1e-12, atol=1e-13)
        torch.testing.assert_close(equation.z, z[model.rows], rtol=1e-12, atol=1e-13)
        noise = math.pi**2 * DT / (2 * size) if shape == "smooth" else 2.0
        assert float(equation.variance) == pytest.approx(0.09 * noise)
        size = min(2 * size, length)


@pytest.mark.parametrize(
    ("length", "middle", "end"), [(0.5, 2, 4), (0.25, 1, 2), (0.375, 2, 3), (0.3125, 1, 3)]
)
def test_a_slope_is_the_difference_over_a_window_and_y_that_of_its_middle(
    length: float, middle: int, end: int
) -> None:
    x, u = swept(9)
    windows = adp.SlopeWindows(TURNING, length)
    now, begin, found = windows.init(x[0]), 0, 0
    assert float(now.elapsed) == -1
    for k in range(9):
        before = now
        now, equation = windows.step(now, x[k], DT)
        now = windows.holding(now, u[k])
        at = k - begin
        if k and at == middle:
            torch.testing.assert_close(now.s, TURNING.regressor(x[k], u[k - 1])[[1]])
            torch.testing.assert_close(now.h, TURNING.rest_of(x[k], u[k - 1])[[1]])
        elif at != middle:
            assert torch.equal(now.s, before.s)
            assert torch.equal(now.h, before.h)
        assert bool(equation.ready) == (k > 0 and at == end)
        if bool(equation.ready):
            rate = TURNING.difference(x[k], x[begin])[1] / (end * DT)
            torch.testing.assert_close(equation.z, (rate - now.h[0]).reshape(1))
            torch.testing.assert_close(equation.s, now.s)
            begin, found = k, found + 1
        assert float(now.elapsed) == (k - begin) * DT
        assert torch.equal(now.x, x[begin])
        assert float(equation.variance) == 0
    assert found >= 2


def test_rows_may_have_windows_of_their_own_lengths() -> None:
    lengths = tensor([0.25, 0.5, 1.0])
    for windows in (adp.IntegralWindows(PENDULUM, 2.0), adp.SlopeWindows(PENDULUM, 2.0)):
        now, ready = windows.init(torch.zeros(3, 2).double(), lengths), []
        for _ in range(9):
            now, equation = windows.step(now, torch.zeros(3, 2).double(), DT)  # type: ignore[arg-type]
            ready.append(equation.ready)
        assert torch.equal(torch.stack(ready).sum(0), torch.tensor([4, 2, 1]))
    assert adp.IntegralWindows(PENDULUM, 2.0).init(torch.zeros(3, 2)).length.tolist() == [2.0] * 3
    assert adp.IntegralWindows(PENDULUM, 2.0, first=0.5).init(torch.zeros(1, 2)).longest.tolist() == [2.0]


def test_equations_may_be_of_what_is_seen_in_other_coordinates() -> None:
    seen, states = uniform(6, 4, 2, seed=1), lambda y: 2 * y + 1
    inside, outside = adp.IntegralWindows(PENDULUM, 0.25), adp.IntegralWindows(PENDULUM, 0.25, states=states)
    a, b = inside.init(seen[0]), outside.init(seen[0])
    for y in seen:
        (a, one), (b, other) = inside.step(a, states(y), DT), outside.step(b, y, DT)
        for part, its in zip((*one, *a), (*other, *b), strict=True):
            assert torch.equal(part, its)


def test_a_first_window_as_long_as_any_is_taken_and_a_longer_one_refused() -> None:
    assert adp.IntegralWindows(PENDULUM, 0.5, first=0.5).first == 0.5
    with pytest.raises(
        ValueError, match=r"`IntegralWindows\(first=...\)` must be at most the length of 0.5 s"
    ):
        adp.IntegralWindows(PENDULUM, 0.5, first=0.6)
    for given, rule in (({"shape": "round"}, "shape"), ({"noise": -0.1}, "noise"), ({"first": 0.0}, "first")):
        with pytest.raises(ValueError, match=rf"`IntegralWindows\({rule}=...\)`"):
            adp.IntegralWindows(PENDULUM, 0.5, **given)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"`SlopeWindows\(length=...\)`"):
        adp.SlopeWindows(PENDULUM, 0.0)


def said(*s: list[float], ready: bool = True) -> adp.Equation:
    """One equation s'theta = sum s, of one row."""
    given = tensor([list(s)])
    return adp.Equation(given, given.sum(-1), torch.zeros(1).double(), torch.tensor([ready]))


def test_an_equation_that_differs_by_exactly_the_novelty_is_not_new() -> None:
    stack = adp.HistoryStack(1, 2, size=3, novelty=0.5)
    now = stack.step(stack.init(torch.zeros(1, 2).double()), said([1.0, 0.0]))
    assert stack.step(now, said([2.0, 0.0])).filled.tolist() == [1.0]
    assert stack.step(now, said([2.001, 0.0])).filled.tolist() == [2.0]
    assert stack.step(now, said([2.001, 0.0], ready=False)).filled.tolist() == [1.0]
    first = stack.step(stack.init(torch.zeros(1, 2).double()), said([0.0, 0.0]))
    assert first.filled.tolist() == [1.0]  # the first fills a place whatever it is


@pytest.mark.parametrize(("share", "taken"), [(1.0008, False), (1.0012, True)])
def test_an_equation_is_taken_where_the_least_eigenvalue_grows_by_a_thousandth(
    share: float, taken: bool
) -> None:
    stack = adp.HistoryStack(1, 1, size=1)
    now = stack.step(stack.init(torch.zeros(1, 1).double()), said([1.0]))
    other = share**0.5
    for k in range(3):
        now = stack.step(now, said([other], ready=k == 0))
    assert float(now.s) == (other if taken else 1.0)
    assert float(now.gram) == pytest.approx(share if taken else 1.0)
    assert float(now.moment) == pytest.approx(share if taken else 1.0)
    assert float(now.turn) == -1


def test_a_trial_goes_through_the_places_and_looks_at_nothing_else_meanwhile() -> None:
    stack = adp.HistoryStack(1, 2, size=3, novelty=0.0)
    now = stack.init(torch.zeros(1, 2).double())
    assert (float(now.turn), float(now.place), float(now.filled)) == (-1, -1, 0)
    for s in ([1.0, 0.0], [1.0, 0.1], [1.0, 0.2]):
        now = stack.step(now, said(s))
        assert float(now.turn) == -1
    full = now
    turns, places = [], []
    for k in range(5):
        now = stack.step(now, said([0.0, 1.0] if k == 0 else [0.0, 9.0 + k], ready=k < 4))
        turns.append(float(now.turn))
        places.append(float(now.place))
        assert torch.equal(now.s, full.s) == (k < 3)
    assert turns == [1, 2, 3, -1, -1]
    best = max(range(3), key=lambda k: least(full, k, tensor([0.0, 1.0])))
    assert places[-1] == best
    assert now.s[0, best, 0].tolist() == [0.0, 1.0]
    idle = stack.step(now, said([5.0, 5.0], ready=False))
    for part, its in zip(idle, now, strict=True):
        assert torch.equal(part, its)


def least(stack: adp.Stack, place: int, s: Tensor) -> float:
    """The least eigenvalue with an equation in a place."""
    rows = stack.s[0, :, 0].clone()
    rows[place] = s
    return float(torch.linalg.eigvalsh(rows.mT @ rows)[0])


def test_a_row_that_went_wrong_does_not_end_the_others() -> None:
    stack = adp.HistoryStack(1, 2, size=2, novelty=0.0)
    now, alone = stack.init(torch.zeros(2, 2).double()), stack.init(torch.zeros(1, 2).double())
    for k in range(6):
        s = uniform(2, 1, 2, seed=k)
        bad = s.clone()
        bad[1] = torch.nan
        z, ready = torch.zeros(2, 1).double(), torch.ones(2).bool()
        now = stack.step(now, adp.Equation(bad, z, z[:, 0], ready))
        alone = stack.step(alone, adp.Equation(s[:1], z[:1], z[:1, 0], ready[:1]))
    for both, one in zip(now, alone, strict=True):
        assert torch.equal(both[:1], one)


@pytest.mark.parametrize("forgetting", [0.0, 0.7])
@pytest.mark.parametrize("alarm", [None, 1.5])
def test_least_squares_are_the_loop_over_their_rows(forgetting: float, alarm: float | None) -> None:
    law = adp.LeastSquares([0.3, -0.2], deviation=[0.5, 2.0], floor=0.1, forgetting=forgetting, alarm=alarm)
    now = law.init(torch.zeros(1, 2).double())
    theta, p, resets, surprise = tensor([0.3, -0.2]), torch.diag(tensor([0.25, 4.0])), 0, 0.0
    for k in range(12):
        s, z, ready = uniform(3, 2, seed=k), uniform(3, seed=50 + k), k % 3 != 1
        now = law.step(now, adp.Equation(s[None], z[None], tensor([0.04]), torch.tensor([ready])), 0.2)
        if forgetting and float(p.trace()) * (1 + 0.2 * forgetting) <= 4.25:
            p = p * (1 + 0.2 * forgetting)
        r = 0.04 + 0.01
        if ready:
            sigmas = max(
                abs(float(z[i] - s[i] @ theta)) / math.sqrt(float(s[i] @ p @ s[i]) + r) for i in range(3)
            )
            if alarm is not None:
                surprise = sigmas
                if sigmas > alarm:
                    p, resets = torch.diag(tensor([0.25, 4.0])), resets + 1
            for i in range(3):
                gain = p @ s[i] / (float(s[i] @ p @ s[i]) + r)
                theta = theta + gain * float(z[i] - s[i] @ theta)
                p = p - torch.outer(gain, p @ s[i])
        torch.testing.assert_close(now.theta[0], theta, rtol=1e-9, atol=1e-10)
        torch.testing.assert_close(now.covariance[0], p, rtol=1e-9, atol=1e-10)
        assert float(now.resets) == resets
        assert float(now.surprise) == pytest.approx(surprise)
    assert (alarm is None) == (resets == 0)


def test_a_covariance_may_grow_to_its_first_trace_exactly() -> None:
    law = adp.LeastSquares([0.0, 0.0], deviation=2.0, forgetting=1.0)
    start, quiet = law.init(torch.zeros(1, 2).double()), said([1.0, 1.0], ready=False)
    for share, factor in ((0.5, 2.0), (0.51, 1.0), (0.25, 2.0)):
        after = law.step(start._replace(covariance=share * start.covariance), quiet, 1.0)
        torch.testing.assert_close(after.covariance, factor * share * start.covariance, rtol=0, atol=0)
    own = tensor([[5.0, 6.0]])
    assert torch.equal(law.init(torch.zeros(1, 2).double(), own).theta, own)


def test_an_alarm_needs_more_than_its_deviations() -> None:
    law = adp.LeastSquares([0.0], deviation=1.0, floor=math.sqrt(3.0), alarm=2.0)
    state = law.init(torch.zeros(1, 1).double())
    for z, resets in ((4 * (1 - 1e-9), 0.0), (4 * (1 + 1e-9), 1.0)):  # of an equation s = 1: spread 2
        equation = adp.Equation(tensor([[[1.0]]]), tensor([[z]]), tensor([0.0]), torch.tensor([True]))
        after = law.step(state, equation, 0.1)
        assert float(after.resets) == resets
        assert float(after.surprise) == pytest.approx(2.0)

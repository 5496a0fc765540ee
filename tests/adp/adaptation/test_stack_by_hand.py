"""What a history stack remembers of its trials, place by place, and where least squares draw their lines."""

from __future__ import annotations

import pytest
import torch
from helpers import tensor
from torch import Tensor

from staf_torch import adp

READY, WAITING = torch.tensor([True]), torch.tensor([False])


def given(s: list[float], z: float, ready: Tensor = READY) -> adp.Equation:
    return adp.Equation(tensor([[s]]), tensor([[z]]), torch.zeros(1).double(), ready)


def least(rows: list[list[float]]) -> float:
    s = tensor(rows)
    return float(torch.linalg.eigvalsh(s.mT @ s)[0])


def test_a_trial_goes_through_the_places_and_says_which_is_best_so_far() -> None:
    stack = adp.HistoryStack(rows=1, parameters=2, size=3)
    now = stack.init(torch.zeros(1, 4).double())
    assert (float(now.filled), float(now.turn), float(now.best), float(now.place)) == (0, -1, 0, -1)
    kept = [[1.0, -0.1], [1.0, 0.2], [1.0, 0.5]]
    for k, s in enumerate(kept):
        now = stack.step(now, given(s, k + 1.0))
        assert (float(now.filled), float(now.turn), float(now.place)) == (k + 1, -1, -1)
        assert now.s[0, :, 0].tolist() == kept[: k + 1] + [[0.0, 0.0]] * (2 - k)
        assert now.z[0, :, 0].tolist() == [1.0, 2.0, 3.0][: k + 1] + [0.0] * (2 - k)
        assert now.tried_s.tolist() == [[s]]
        assert now.tried_z.tolist() == [[k + 1.0]]
    new = [0.0, 1.0]
    values = [least(kept), *(least([*kept[:k], new, *kept[k + 1 :]]) for k in range(3))]
    assert values[2] > values[3] > values[1] > values[0]  # the middle is best, the first better than none
    places, best = [-1.0, 0.0, 1.0, 1.0], [values[0], values[1], values[2], values[2]]
    for trial in range(4):
        # Meanwhile another equation comes, which is not looked at.
        now = stack.step(now, given(new, 9.0) if trial == 0 else given([5.0, 5.0], 7.0))
        assert float(now.place) == places[trial]
        assert float(now.best) == pytest.approx(best[trial], rel=1e-12)
        assert float(now.turn) == (trial + 1 if trial < 3 else -1)
        assert now.tried_s.tolist() == [[new]]
        assert now.tried_z.tolist() == [[9.0]]
        assert now.s[0, :, 0].tolist() == (kept if trial < 3 else [kept[0], new, kept[2]])
    assert now.z[0, :, 0].tolist() == [1.0, 9.0, 3.0]
    torch.testing.assert_close(now.gram[0], (now.s[0].mT @ now.s[0]).sum(0))
    torch.testing.assert_close(now.moment[0], tensor([4.0, 10.4]))
    assert float(now.filled) == 3


def test_an_equation_that_helps_nowhere_leaves_the_stack_as_it_was() -> None:
    stack = adp.HistoryStack(rows=1, parameters=2, size=2)
    now = stack.init(torch.zeros(1, 4).double())
    for s in ([1.0, 0.0], [0.0, 1.0]):
        now = stack.step(now, given(s, 1.0))
    full = now
    for growth in (1.00001, 1.01):
        now = stack.step(full, given([growth, 0.0], 2.0))
        assert float(now.turn) == 1
        for _ in range(2):
            now = stack.step(now, given([0.0, 0.0], 0.0, WAITING))
        assert float(now.turn) == -1
        assert torch.equal(now.s, full.s)
        assert float(now.place) == -1  # the least eigenvalue is that of the other row: it does not grow
    now = stack.step(full, given([1.0, 0.0], 2.0, WAITING))
    assert all(torch.equal(a, b) for a, b in zip(now, full, strict=True))


def test_the_first_place_is_taken_where_it_is_the_best() -> None:
    stack = adp.HistoryStack(rows=1, parameters=1, size=2, novelty=0.0)
    now = stack.init(torch.zeros(1, 1).double())
    for s in ([1.0], [2.0]):
        now = stack.step(now, given(s, s[0]))
    # S'S of one parameter is the eigenvalue: 5 with both, so that the factor 1.001 is 5.005.
    for new, place in ((1.0024, -1.0), (1.0026, 0.0)):
        after = stack.step(now, given([new], 3.0))
        for _ in range(2):
            after = stack.step(after, given([0.0], 0.0, WAITING))
        assert float(after.place) == place
        assert after.s.flatten().tolist() == ([1.0, 2.0] if place < 0 else [new, 2.0])
        assert after.z.flatten().tolist() == ([1.0, 2.0] if place < 0 else [3.0, 2.0])
        squares = after.s.square().sum()
        torch.testing.assert_close(after.gram.flatten(), squares.reshape(1))
        torch.testing.assert_close(
            after.moment.flatten(), (after.s.flatten() * after.z.flatten()).sum(0, True)
        )


@pytest.mark.parametrize(
    ("kept", "place"),
    [
        ([1.0005, 1.0], 1.0),  # the second is better by less than the factor that the first must be
        ([1.0, 1.0005], 0.0),
        ([1.0, -1.0], 0.0),  # of two that are as good the first
    ],
)
def test_later_places_must_be_better_than_the_first_and_by_no_factor(kept: list[float], place: float) -> None:
    stack = adp.HistoryStack(rows=1, parameters=1, size=2, novelty=0.0)
    now = stack.init(torch.zeros(1, 1).double())
    for s in (*kept, 2.0):
        now = stack.step(now, given([s], 1.0))
    for _ in range(2):
        now = stack.step(now, given([0.0], 0.0, WAITING))
    assert float(now.place) == place
    assert now.s.flatten().tolist() == ([2.0, kept[1]] if place == 0 else [kept[0], 2.0])


@pytest.mark.parametrize("size", [0.1, 1.0, 7.0])
def test_what_is_new_is_measured_by_the_size_of_an_equation(size: float) -> None:
    stack = adp.HistoryStack(rows=1, parameters=2, size=2, novelty=0.5)
    for along, filled in ((0.4, 1), (0.7, 2)):  # beside sqrt(1 + along^2), of which the half counts
        now = stack.init(torch.zeros(1, 1).double())
        for s in ([size, 0.0], [size, along * size]):
            now = stack.step(now, given(s, 1.0))
        assert float(now.filled) == filled


def test_a_row_that_is_not_a_number_does_not_stop_the_others() -> None:
    stack = adp.HistoryStack(rows=1, parameters=2, size=1)
    now = stack.init(torch.zeros(2, 1).double())
    both = torch.tensor([True, True])
    for s in ([[1.0, 0.0], [1.0, 0.0]], [[float("nan"), 1.0], [2.0, 1.0]]):
        one = tensor(s).unsqueeze(1)
        now = stack.step(now, adp.Equation(one, one.sum(-1), torch.zeros(2).double(), both))
    assert now.turn.tolist() == [1.0, 1.0]
    assert now.best.tolist() == [0.0, 0.0]


def test_without_a_novelty_all_that_differs_is_new_and_what_is_alike_is_not() -> None:
    stack = adp.HistoryStack(rows=1, parameters=2, size=3, novelty=0.0)
    now = stack.init(torch.zeros(1, 1).double())
    for s, filled in (([1.0, 0.0], 1), ([1.0, 0.0], 1), ([1.0, 1e-9], 2), ([1.0, 1e-9], 2)):
        now = stack.step(now, given(s, 1.0))
        assert float(now.filled) == filled
    with pytest.raises(ValueError, match="novelty"):
        adp.HistoryStack(rows=1, parameters=2, novelty=-0.1)


@pytest.mark.parametrize(("z", "alarms"), [(9.99, 0.0), (10.0, 0.0), (10.01, 1.0), (-10.01, 1.0)])
def test_an_alarm_goes_off_beyond_its_deviations_and_not_at_them(z: float, alarms: float) -> None:
    law = adp.LeastSquares([0.0], deviation=4.0, floor=3.0, alarm=2.0)  # sqrt(16 + 9) = 5
    now = law.step(law.init(torch.zeros(1, 1).double()), given([1.0], z), 0.1)
    assert now.resets.tolist() == [alarms]
    assert now.surprise.tolist() == pytest.approx([abs(z) / 5])


def test_the_covariance_grows_back_to_its_first_size_and_no_further() -> None:
    law = adp.LeastSquares([0.0], deviation=2.0, floor=2.0, forgetting=4.0)
    now = law.step(law.init(torch.zeros(1, 1).double()), given([1.0], 1.0), 0.0)
    assert now.covariance.tolist() == [[[2.0]]]  # 4 - 16 / 8
    quiet = given([1.0], 0.0, WAITING)
    assert law.step(now, quiet, 0.125).covariance.tolist() == [[[3.0]]]
    assert law.step(now, quiet, 0.25).covariance.tolist() == [[[4.0]]]
    assert law.step(now, quiet, 0.375).covariance.tolist() == [[[2.0]]]  # not half of a step either

"""How a step is tried before it is written down: with which rows, how often, what counts as a difference."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from staf_torch import lanes
from staf_torch.lanes import Shared
from staf_torch.lanes.alone import _called, _farthest, _leaves_are_close, doubt
from staf_torch.lanes.given import Given

EPS = torch.finfo(torch.float64).eps


def given(carry: Any, now: Any = (), row: Any = (), steps: int | None = 1) -> Given:
    return Given.of(carry, now, row, steps)


def test_a_step_is_tried_with_copies_of_a_row_of_another_and_of_both() -> None:
    x = torch.tensor([[0.0, 1.0], [1.0, 1.0], [-9.0, 0.0], [5.0, 5.0]])
    u = torch.arange(24.0).view(4, 3, 2)
    seen: list[tuple[Any, ...]] = []

    def step(carry: Tensor, now: Any, row: Any) -> tuple[Tensor, Any]:
        seen.append((carry.tolist(), now[0].tolist(), now[1].tolist(), row[0].tolist(), row[1].tolist()))
        for part in (carry, *now, *row):
            part.zero_()
        return carry, ()

    shared, whole = torch.tensor([7.0, 8.0, 9.0]), torch.tensor([2.0, 4.0])
    inputs = given(x, (u, Shared(shared)), (torch.tensor([3, 4, 5, 6]), Shared(whole)))
    assert doubt(step, inputs) is None
    one = ([[0.0, 1.0]], [[0.0, 1.0]], 7.0, [3], [2.0, 4.0])
    last = ([[5.0, 5.0]], [[18.0, 19.0]], 7.0, [6], [2.0, 4.0])
    both = ([[0.0, 1.0], [5.0, 5.0]], [[0.0, 1.0], [18.0, 19.0]], 7.0, [3, 6], [2.0, 4.0])
    assert seen == [one, one, both, one, last]
    assert x[3, 0] == 5
    assert u[3, 0, 0] == 18
    assert shared.tolist() == [7.0, 8.0, 9.0]
    assert whole.tolist() == [2.0, 4.0]


def test_of_a_single_row_only_its_repetition_is_asked() -> None:
    seen: list[int] = []

    def step(carry: Tensor, now: Any, row: Any) -> tuple[Tensor, Any]:
        seen.append(len(carry))
        return carry, ()

    assert doubt(step, given(torch.ones(1, 2))) is None
    assert seen == [1, 1]


def test_the_row_that_differs_most_in_all_its_numbers_stands_beside_the_first() -> None:
    x = torch.zeros(4, 3)
    assert _farthest(given(x)) == 0
    assert _farthest(given(x[:1])) == 0
    for shift, place in ((1.0, 2), (-1.0, 1)):
        moved = x.clone()
        moved[place, 1], moved[3, 0] = 2 * shift, shift
        assert _farthest(given(moved)) == place
        assert _farthest(given(x, (), moved)) == place
        assert _farthest(given(x, moved.unsqueeze(1).expand(4, 2, 3))) == place
        late = torch.stack((x, moved), dim=1)  # the first time is what is tried
        assert _farthest(given(x, late)) == 0
    spread = torch.zeros(3, 4)
    spread[1, 0], spread[2] = 3.0, torch.tensor([1.0, -1.0, 1.0, -1.0])
    assert _farthest(given(spread)) == 2  # four differences of one make more than one of three
    lost = torch.tensor([[1.0], [torch.nan], [torch.inf], [-torch.inf], [2.5]])
    assert _farthest(given(lost)) == 4  # what is no number counts as 0
    assert _farthest(given(torch.tensor([[0.0], [torch.nan], [torch.inf], [-torch.inf], [0.5]]))) == 4
    assert _farthest(given((x, torch.zeros(4, 0)), (), Shared(torch.arange(5.0)))) == 0
    far = torch.tensor([5.0, 5.0, 4.0, 5.0])
    assert _farthest(given(far)) == 2
    both = given(torch.tensor([0.0, 3.0, 0.0]), (), torch.tensor([0.0, 0.0, 2.0]))
    assert _farthest(both) == 1
    fine = torch.tensor([1.0, 1.0 + 4 * EPS, 1.0 + 8 * EPS], dtype=torch.float64)
    assert _farthest(given(fine)) == 2


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_inputs_are_moved_by_units_in_their_last_place(dtype: torch.dtype) -> None:
    x = torch.tensor([[1.0, -2.0]], dtype=dtype)
    inputs = given(x, (), (torch.tensor([[3]]), Shared(torch.tensor(4.0, dtype=dtype))))
    step = lambda carry, now, row: (carry, row)  # noqa: E731
    for bits in (0, 1, -3):
        found = _called(step, inputs, [0], bits)
        eps = torch.finfo(dtype).eps
        assert found[0].tolist() == [[1.0 + bits * eps, -2.0 - 2 * bits * eps]]
        assert found[1].tolist() == [[3]]
        assert float(found[2]) == 4.0 + 4 * bits * eps


def test_leaves_are_close_by_their_largest_entry() -> None:
    x = torch.tensor([100.0, 1.0])
    assert _leaves_are_close(x, x.clone())
    assert not _leaves_are_close(x, x + 1e-5)
    assert _leaves_are_close(x, torch.tensor([100.0, 2.0]), 0.01)
    assert not _leaves_are_close(x, torch.tensor([100.0, 2.1]), 0.01)
    assert _leaves_are_close(torch.tensor([1.0, 1.0]), torch.tensor([1.0, 100.0]), 0.99)  # of either
    assert _leaves_are_close(torch.tensor([1.0, 100.0]), torch.tensor([1.0, 1.0]), 0.99)
    assert not _leaves_are_close(x, x[:1], 1.0)
    assert not _leaves_are_close(x, x.view(2, 1), 1.0)
    lost = torch.tensor([torch.nan, torch.inf, 1.0])
    assert _leaves_are_close(lost, torch.tensor([torch.inf, torch.nan, 1.0]))  # neither is a number
    assert not _leaves_are_close(lost, torch.tensor([0.0, torch.inf, 1.0]), 1.0)
    assert _leaves_are_close(lost[:2], lost[:2])
    assert _leaves_are_close(torch.zeros(0), torch.zeros(0))
    assert _leaves_are_close(torch.zeros(2), torch.zeros(2))
    assert not _leaves_are_close(torch.tensor([True]), torch.tensor([False]))


Step = Callable[[Tensor, Any, Any], tuple[Any, Any]]


def mixed(share: float) -> Step:
    """A step in which a row among others differs by a share of its size."""
    return lambda carry, now, row: (carry * (1.0 + share * (len(carry) > 1)), ())


@pytest.mark.parametrize(("share", "said"), [(0.0, False), (0.009, False), (0.011, True), (0.5, True)])
def test_a_hundredth_of_the_largest_entry_is_rounding(share: float, said: bool) -> None:
    x = torch.tensor([[1.0, 2.0], [3.0, 4.0]], dtype=torch.float64)
    assert (doubt(mixed(share), given(x)) is not None) is said


@pytest.mark.parametrize("row", [0, 1])
def test_either_row_may_give_a_step_away(row: int) -> None:
    def step(carry: Tensor, now: Any, other: Any) -> tuple[Tensor, Any]:
        after = carry.clone()
        after[row if len(carry) > 1 else 0] *= 2 if len(carry) > 1 else 1
        return after, ()

    found = doubt(step, given(torch.tensor([1.0, 2.0])))
    assert found is not None
    assert "beside another row" in found


def test_a_step_that_gives_more_or_other_shapes_among_others_is_none_of_a_row() -> None:
    x = torch.tensor([[1.0, 2.0], [3.0, 4.0]])
    more = doubt(lambda c, n, r: (c, (c,) * len(c)), given(x))
    assert more is not None
    assert "beside another row" in more
    shapes = doubt(lambda c, n, r: (c, c.repeat(1, len(c))), given(x))
    assert shapes is not None
    count = iter(range(9))
    again = doubt(lambda c, n, r: (c, (c,) * (1 + next(count))), given(x))
    assert again is not None
    assert "called again" in again
    assert doubt(lambda c, n, r: (c, (c[:, :1], c)), given(x)) is None


def test_an_error_with_two_rows_is_told_by_its_kind_and_words() -> None:
    def step(carry: Tensor, now: Any, row: Any) -> tuple[Tensor, Any]:
        if len(carry) > 1:
            raise KeyError("no room")
        return carry, ()

    assert doubt(step, given(torch.ones(2))) == "takes one row but not two: KeyError: 'no room'"


@pytest.mark.parametrize("bits", [1, -1, 3, -5, 17])
def test_what_changes_with_any_of_the_last_bits_says_nothing(bits: int) -> None:
    """Numbers that jump only where inputs are moved by so many units."""

    def step(carry: Tensor, now: Any, row: Any) -> tuple[Tensor, Any]:
        jumps = (carry == 1 + bits * EPS) | (torch.tensor(len(carry) > 1))
        return torch.where(jumps, 2.0, 1.0) * torch.ones_like(carry), ()

    x = torch.ones(2, dtype=torch.float64)
    assert doubt(step, given(x)) is None
    for other in (2, -2, 4, 5, -6, 18, 16):
        found = doubt(lambda c, n, r, k=other: step(c + (bits - k) * EPS * (c != 1), n, r), given(x))
        assert found is not None


def test_loops_are_left_after_four_passes_where_a_step_is_tried() -> None:
    passes: list[int] = []

    def body(x: Tensor) -> Tensor:
        passes.append(1)
        return x + 1

    def step(carry: Tensor, now: Any, row: Any) -> tuple[Tensor, Any]:
        return lanes.repeat(50, body, carry), lanes.scan(lambda s, p: (s + p, s), carry, torch.ones(1, 50))[1]

    found = _called(step, given(torch.zeros(1)), [0])
    assert len(passes) == 4
    assert found[0].tolist() == [4.0]
    assert found[1].shape == (1, 50)
    assert found[1][0].tolist() == [0.0, 1.0, 2.0, 3.0, *[3.0] * 46]
    passes.clear()
    assert step(torch.zeros(1), (), ())[0].tolist() == [50.0]
    assert len(passes) == 50

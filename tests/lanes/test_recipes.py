"""What of a program follows from tensors that a step finds outside, and which steps have no program."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from staf_torch.lanes.given import Given
from staf_torch.lanes.one_row import trace
from staf_torch.lanes.tracer import NotLoweredError


def recipe(step: Callable[[Tensor], Any], rows: int = 2) -> Any:
    x = torch.linspace(0, 1, 3 * rows, dtype=torch.float64).view(rows, 3)
    return trace(lambda carry, now, row: (carry, step(row)), Given.of(x[:, 0], (), x, 1)).recipe


A, B = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64), torch.tensor([5.0, 6.0, 7.0], dtype=torch.float64)


def test_numbers_follow_from_what_was_found_and_from_nothing_else() -> None:
    found = recipe(lambda x: x * (2 * A + 1) + A)
    assert found.values.tolist() == [3.0, 5.0, 7.0, 1.0, 2.0, 3.0]
    assert found.values.dtype == torch.float64
    assert len(found.operations) == 2
    assert [id(t) for t in found.found] == [id(A)]
    assert found.again({id(A): B}).tolist() == [11.0, 13.0, 15.0, 5.0, 6.0, 7.0]
    assert found.again({id(B): A}) is None
    assert recipe(lambda x: x * 2).values.shape == (0,)
    assert recipe(lambda x: x * 2).again({}).dtype == torch.float64
    unused = recipe(lambda x: (x * A, [A.exp(), B.sin()])[0])
    assert unused.operations == []
    assert [id(t) for t in unused.found] == [id(A)]
    some = recipe(lambda x: x[:, :2] * A[1:] + x[:, :1] * A.view(1, 3)[:, ::2])
    assert some.values.tolist() == [2.0, 3.0, 1.0]  # the place that both read once
    assert some.again({id(A): B}).tolist() == [6.0, 7.0, 5.0]
    single = torch.tensor([0.5], dtype=torch.float32)
    assert recipe(lambda x: x * single.double()).again({id(single): 2 * single}).tolist() == [1.0]
    both = recipe(lambda x: torch.cat((x, A.view(1, 3), B.view(1, 3)), 1))
    assert both.again({id(A): B, id(B): A}).tolist() == [5.0, 6.0, 7.0, 1.0, 2.0, 3.0]
    kept = recipe(lambda x: x * torch.add(A, B, alpha=2))
    assert kept.again({id(A): A, id(B): B}).tolist() == (A + 2 * B).tolist()


def test_what_the_code_states_itself_is_no_number_of_the_table() -> None:
    for step in (
        lambda x: x * torch.tensor([1.0, 2.0, 4.0], dtype=torch.float64),
        lambda x: x * torch.arange(3),
        lambda x: x @ torch.eye(3, dtype=torch.float64) + torch.ones(3),
        lambda x: x[:, torch.tensor([1, 0])] * 2,
        lambda x: x * torch.zeros_like(A) + torch.full_like(A, 0.5) + A.new_ones(3),
    ):
        found = recipe(step)
        assert found.values.tolist() == []
        assert found.found == []
    mask = torch.tensor([True, False, True])
    assert recipe(lambda x: torch.where(mask, x, -x)).values.tolist() == []


def test_a_number_that_was_read_must_be_the_same_again() -> None:
    gain = torch.tensor(2.0, dtype=torch.float64)
    found = recipe(lambda x: x * A if bool(gain > 1) else x)
    assert len(found.checks) == 1
    assert {id(t) for t in found.found} == {id(A), id(gain)}
    assert found.again({id(A): B, id(gain): gain + 1}).tolist() == B.tolist()
    assert found.again({id(A): B, id(gain): gain - 2}) is None


def test_memory_that_was_written_to_is_not_written_again() -> None:
    def step(x: Tensor) -> Tensor:
        own = A.clone()
        own += 1
        return x * own

    found = recipe(step)
    assert found.values.tolist() == [2.0, 3.0, 4.0]
    assert found.again({id(A): B}) is None


def test_what_was_equal_is_told_apart_once_one_of_both_is_written_to() -> None:
    def one(x: Tensor) -> Tensor:
        first, second = 2 * A, 2 * A
        x = x * first
        first += 1
        return x * first + x * second

    def other(x: Tensor) -> Tensor:
        first, second = 2 * A, 2 * A
        second += 1
        return x * first + x * second + x * (2 * A)

    assert recipe(one).values.tolist() == [2.0, 4.0, 6.0, 3.0, 5.0, 7.0, 2.0, 4.0, 6.0]
    assert recipe(other).values.tolist() == [2.0, 4.0, 6.0, 3.0, 5.0, 7.0]
    assert recipe(one).again({id(A): B}) is None


def test_memory_of_the_step_holds_what_was_written_into_it() -> None:
    def step(x: Tensor) -> Tensor:
        own = torch.zeros(3, dtype=torch.float64)
        x = x + own  # stated by the code until then
        own[1] = A[2]
        return x * own

    assert recipe(step).values.tolist() == [0.0, 3.0, 0.0]
    plain = recipe(lambda x: x * torch.zeros(3, dtype=torch.float64).add_(2.0))
    assert plain.values.tolist() == []
    assert plain.again({}) is not None


def test_arrays_of_numpy_are_found_and_numbers_of_python_are_stated() -> None:
    table = A.numpy()
    found = recipe(lambda x: x * torch.as_tensor(table))
    assert found.values.tolist() == A.tolist()
    assert len(found.found) == 1
    assert recipe(lambda x: x * torch.tensor(table.tolist(), dtype=torch.float64)).found == []
    flags = recipe(lambda x: torch.where(A > 1.5, x, -x))  # made of numbers, and so of the table
    assert flags.values.tolist() == [0.0, 1.0, 1.0]
    assert flags.again({id(A): B}).tolist() == [1.0, 1.0, 1.0]


def test_views_share_the_places_of_their_memory() -> None:
    found = recipe(lambda x: x * A.view(3, 1)[:, 0] + x.flip(1) * A.flip(0) + (x * A[1]) * A[1:2].expand(3))
    assert found.values.tolist() == [1.0, 2.0, 3.0, 3.0, 2.0, 1.0]  # `flip` makes others
    table = torch.arange(6, dtype=torch.float64).view(2, 3)
    found = recipe(lambda x: x[:, :2] @ table.mT[1:].mT * 2 + (x * table[1]).sum(-1, keepdim=True))
    assert sorted(found.values.tolist()) == [1.0, 2.0, 3.0, 4.0, 5.0]


def test_what_is_computed_twice_is_read_once() -> None:
    assert len(recipe(lambda x: x * (A * 2) + (A * 2)).values) == 3
    assert len(recipe(lambda x: x * (A * 2) + (A * 3)).values) == 6
    assert len(recipe(lambda x: x * (A * 2.0) + (A * 2)).values) == 6  # to torch these are two
    assert len(recipe(lambda x: x * A.exp() + A.sin()).values) == 6
    assert len(recipe(lambda x: x * (A[:2] * 2).sum() + (A[1:] * 2).sum()).values) == 2
    assert len(recipe(lambda x: x * (A + 1).mul(2) + (A + 1).mul(2)).values) == 3


def test_an_order_of_captured_numbers_is_no_structure_of_the_text() -> None:
    turned = A.flip(0)
    for step, few in (
        (lambda x: x[:, A.argsort()], [0.0, 1.0, 2.0]),
        (lambda x: x.index_select(1, A.argsort()), [0.0, 1.0, 2.0]),
        (lambda x: x.gather(1, A.argsort().expand(1, 3)), [0.0, 1.0, 2.0]),
        (lambda x: x.gather(1, A.argsort().repeat(50).view(1, -1)), [0.0, 1.0, 2.0] * 50),  # by a loop
        (lambda x: x.scatter(1, A.argsort().expand(1, 3), 2 * x), [0.0, 1.0, 2.0]),
    ):
        found = recipe(step)
        assert found.values.tolist() == few
        assert found.again({id(A): turned}).tolist() == few[::-1]


def test_whole_powers_up_to_sixty_four_are_products() -> None:
    x = torch.ones(2, 3, dtype=torch.float64)
    for power in (2, 3, 63, 64, 65, -64, -65, 0.5, 2.5):
        graph = trace(lambda c, n, r, p=power: (c, r**p), Given.of(x, (), x, 1)).program[0]
        assert ("pow" in graph.op) == (power in (65, -65, 2.5))


REFUSED: dict[str, tuple[Callable[[Tensor], Any], str]] = {
    "a value of a row": (lambda x: x if bool(x.sum() > 0) else -x, "reads a value of a row"),
    "an index of a row": (lambda x: x.nonzero(), "reads a value of a row"),
    "NumPy": (lambda x: torch.as_tensor(x.numpy()), "`Tensor.numpy` takes numbers of a row out of torch"),
    "a list": (lambda x: x + x.tolist()[0][0], "`Tensor.tolist` takes numbers of a row out of torch"),
    "another dtype": (lambda x: x.to(torch.complex128), "has no lanes here"),
    "bits": (lambda x: x.long() & 1, "logic on the bits of integers"),
    "random": (lambda x: x + torch.rand(3), "draws random numbers"),
    "no rows": (lambda x: x.sum(), "an output of the step has no dimension of rows"),
    "more rows": (lambda x: torch.cat((x, x)), "an output of the step has no dimension of rows"),
    "an error": (lambda x: x[:, 7], "IndexError"),
    "a norm": (lambda x: torch.linalg.vector_norm(x, 3, -1), "a norm of order 3"),
    "an unknown": (lambda x: torch.special.i0(x), "i0"),
    "a scaled product": (lambda x: torch.addmm(x, x[:, :1], x, beta=2), "a scaled product"),
    "added at an index of a row": (
        lambda x: x.index_put((torch.tensor([0]), x.argmax(-1)), x[:, 0], accumulate=True),
        "`aten.index_put` at an index that the row computes",
    ),
    "added at an index that was captured": (
        lambda x: x.index_put((torch.tensor([0]), A.argsort()[:1]), x[:, 0], accumulate=True),
        "`aten.index_put` at an index that the row computes",
    ),
    "written at an index of a row": (
        lambda x: x.index_put((torch.tensor([0]), x.argmax(-1)), x[:, 0]),
        "`aten.index_put` at an index that the row computes",
    ),
    "two indices": (
        lambda x: x[torch.tensor([0]), x.argmax(-1)],
        "`aten.index` at an index that the row computes",
    ),
    "rsub with alpha": (lambda x: torch.rsub(x, x, alpha=2), "has no scalar form here"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_no_function_of_a_row_is_refused_with_its_line(name: str) -> None:
    step, why = REFUSED[name]
    with pytest.raises(NotLoweredError) as error:
        recipe(step)
    assert why in str(error.value)
    assert name == "no rows" or name == "more rows" or " at " in str(error.value)


def test_a_carry_keeps_its_shapes_its_kinds_and_its_tree() -> None:
    x = torch.ones(2, 3)
    for after in (lambda c: c[:, :2], lambda c: c.double(), lambda c: (c,), lambda c: {"c": c}):
        with pytest.raises(NotLoweredError, match="a carry of other shapes or dtypes than it was given"):
            trace(lambda c, n, r, f=after: (f(c), ()), Given.of(x, (), (), 1))
    trace(lambda c, n, r: (c + 1, c), Given.of(x, (), (), 1))

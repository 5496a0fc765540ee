"""Captured tensors are numbers of a table: the text of a program knows none of them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from staf_torch import lanes
from staf_torch.lanes import compiler
from staf_torch.lanes.captured import _same

pytestmark = pytest.mark.needs_compiler

NUMBERS = (torch.tensor([0.3, -1.7, 0.9]), torch.tensor([1.0, 1.0, 0.0]), torch.tensor([-0.0, 0.5, 1 / 64]))


class Step:
    """Everything that a step may do with captured numbers: masks, indices, powers, matrices."""

    def __init__(self, numbers: Tensor) -> None:
        self.numbers = numbers

    def __call__(self, x: Tensor, u: Tensor, row: Tensor) -> tuple[Tensor, Tensor]:
        a = self.numbers.to(x)
        matrix = torch.eye(3).to(x) + a[:, None] * a.exp()
        order = a.argsort()
        factor = torch.linalg.cholesky_ex(matrix.mT @ matrix + torch.eye(3).to(x)).L
        x = 0.5 * x + torch.linalg.solve_triangular(factor, x[:, order].mT, upper=False).mT
        x = torch.where(a > 0, x * a, x - a) + (a[0] ** 2) * u[:, None]
        return x, (x @ a).sin() + x.abs().pow(a.abs()).sum(-1)


def inputs(dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(1)
    return torch.rand(5, 3, generator=generator, dtype=dtype), torch.rand(
        5, 7, generator=generator, dtype=dtype
    )


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_other_numbers_are_the_same_text_and_the_right_result(
    dtype: torch.dtype, monkeypatch: pytest.MonkeyPatch
) -> None:
    x, u = inputs(dtype)
    texts = {lanes.Program(Step(a)).text(x, u) for a in NUMBERS}
    assert len(texts) == 1
    first = lanes.Program(Step(NUMBERS[0]))
    assert first.compiles(x, u)
    monkeypatch.setattr(compiler, "_run", None)  # nothing is compiled from here on
    tolerance = 1e-12 if dtype == torch.float64 else 1e-4
    for a in NUMBERS:
        for program in (lanes.Program(Step(a)), first.with_others(Step(a), [(NUMBERS[0], a)])):
            assert program.compiles(x, u)
            for found, expected in zip(program(x, u), program.definition(x, u), strict=True):
                torch.testing.assert_close(found, expected, rtol=tolerance, atol=tolerance)


def test_with_others_traces_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    x, u = inputs(torch.float64)
    first = lanes.Program(Step(NUMBERS[0]))
    first(x, u)
    second = first.with_others(Step(NUMBERS[1]), [(NUMBERS[0], NUMBERS[1])])
    expected = second.definition(x, u)
    monkeypatch.setattr(second, "_build", None)
    torch.testing.assert_close(second(x, u), expected, rtol=1e-12, atol=1e-12)


def test_a_number_that_the_step_read_makes_another_program() -> None:
    def step_of(a: Tensor) -> lanes.program.Step:
        return lambda x, now, row: (x * (a + 1) if bool(a > 0) else -x, ())

    x = torch.rand(4, dtype=torch.float64)
    old, new = torch.tensor(2.0), torch.tensor(-2.0)
    first = lanes.Program(step_of(old))
    torch.testing.assert_close(first(x, steps=1)[0], 3 * x)
    for other, factor in ((new, -1.0), (torch.tensor(4.0), 5.0)):
        again = first.with_others(step_of(other), [(old, other)])
        torch.testing.assert_close(again(x, steps=1)[0], factor * x)


def test_a_tensor_that_is_not_named_is_not_taken_for_the_old_one() -> None:
    def step_of(a: Tensor, b: Tensor) -> lanes.program.Step:
        return lambda x, now, row: (x * a + b, ())

    x, one, two, three = torch.rand(4), torch.tensor(1.0), torch.tensor(2.0), torch.tensor(3.0)
    first = lanes.Program(step_of(one, two))
    first(x, steps=1)
    again = first.with_others(step_of(three, one), [(one, three)])
    torch.testing.assert_close(again(x, steps=1)[0], 3 * x + 1)


@pytest.mark.parametrize("shared", [False, True])
def test_tables_that_a_step_writes_are_its_text_and_arrays_of_numpy_are_not(shared: bool) -> None:
    table = np.array([[1.0, 0.3], [0.7, 2.0]])

    def step_of(a: Tensor) -> lanes.program.Step:
        def step(x: Tensor, now: Tensor, row: Tensor) -> tuple[Tensor, tuple[()]]:
            rows = torch.as_tensor(table) if shared else torch.tensor(((1.0, 0.3), (0.7, 2.0)))
            return lanes.scan(lambda c, r: (c * r[0] + a * r[1], ()), x, rows.to(x), dim=0)[0], ()

        return step

    x, one, two = torch.rand(4, dtype=torch.float64), torch.tensor(1.0), torch.tensor(2.0)
    first = lanes.Program(step_of(one))
    first(x, steps=1)
    second = first.with_others(step_of(two), [(one, two)])
    if shared:
        table[0, 0] = 5.0
    expected = second.definition(x, steps=1)
    traced = second._known
    second._known = traced if shared else None  # type: ignore[assignment,method-assign]
    torch.testing.assert_close(second(x, steps=1), expected, rtol=1e-12, atol=1e-12)


def test_what_a_step_writes_into_its_own_memory_is_followed() -> None:
    def step_of(a: Tensor) -> lanes.program.Step:
        def step(x: Tensor, now: Tensor, row: Tensor) -> tuple[Tensor, tuple[()]]:
            own = torch.zeros(3)
            before = own + x
            own[1] = a
            own.mul_(2)
            return before + own * x, ()

        return step

    x = torch.rand(4, 3)
    for a in (torch.tensor(0.5), torch.tensor(0.0)):
        program = lanes.Program(step_of(a))
        assert program.compiles(x, steps=1)
        torch.testing.assert_close(program(x, steps=1), program.definition(x, steps=1))
    first = lanes.Program(step_of(torch.tensor(1.0)))
    first(x, steps=1)
    again = first.with_others(step_of(torch.tensor(3.0)), [])
    torch.testing.assert_close(again(x, steps=1), again.definition(x, steps=1))


def test_what_is_computed_twice_of_captured_numbers_is_read_once_unless_it_was_written_to() -> None:
    a, x = NUMBERS[0].double(), torch.rand(4, 3, dtype=torch.float64)

    def twice(x: Tensor, now: Any, row: Any) -> tuple[Tensor, Any]:
        return (x * (2 * a).sum()).exp() + (x * (2 * a).sum()).exp(), ()

    def written(x: Tensor, now: Any, row: Any) -> tuple[Tensor, Any]:
        first, second = 2 * a, 2 * a
        second += 1
        return (x * first.sum()).exp() + (x * second.sum()).exp() + (x * (2 * a).sum()).exp(), ()

    for step, exponentials in ((twice, 3), (written, 6)):  # three entries of x
        program = lanes.Program(step, copies=1)
        assert program.text(x, steps=1).count("= exp(") == exponentials
        assert program.compiles(x, steps=1)
        found, wanted = program(x, steps=1)[0], program.definition(x, steps=1)[0]
        torch.testing.assert_close(found, wanted, rtol=1e-12, atol=0)


def test_only_one_number_is_the_same_as_a_number() -> None:
    assert _same(torch.tensor(2.0), 2.0)
    assert _same(torch.tensor([[2.0]]), 2.0)
    assert not _same(torch.tensor(2.0), 3.0)
    assert not _same(torch.tensor([2.0, 2.0]), 2.0)

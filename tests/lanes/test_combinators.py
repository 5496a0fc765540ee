"""Loops of which each row takes as many passes as it asks for."""

from __future__ import annotations

import itertools
import shutil

import pytest
import torch
from torch import Tensor
from torch.fx.experimental.proxy_tensor import make_fx

from staf_torch import lanes

pytestmark = pytest.mark.needs_compiler

EPS = torch.finfo(torch.float64).eps
Pair = tuple[Tensor, Tensor]


def grown(x: Tensor, u: Tensor) -> Pair:
    """x times 1.5 plus |u| until it is 5 or more, at most seven times; and how often."""

    def going(now: Pair) -> Tensor:
        return now[0] < 5

    def grow(now: Pair) -> Pair:
        return 1.5 * now[0] + u.abs(), now[1] + 1

    found: Pair = lanes.repeat(7, grow, (x, torch.zeros_like(x)), where=going)
    return found


def step(x: Tensor, u: Tensor, row: tuple[()]) -> tuple[Tensor, Pair]:
    found = grown(x, u)
    return torch.where(found[0] > 20, 0.1 * found[0], 0.5 * found[0]), found


def given(rows: int) -> Pair:
    torch.manual_seed(0)
    x, u = 3 * torch.rand(100, dtype=torch.float64), torch.randn(100, 40, dtype=torch.float64)
    x[3], x[7], x[11] = torch.nan, torch.inf, -torch.inf
    return x[:rows], u[:rows]


@pytest.mark.parametrize("rows", [1, 100])
def test_passes_a_row_are_those_of_the_row_alone(rows: int) -> None:
    x, u = given(rows)
    program = lanes.Program(step)
    assert program.compiles(x, u)
    (end, (value, count)), (ended, (wanted, passes)) = program(x, u), program.definition(x, u)
    torch.testing.assert_close(count, passes, rtol=0, atol=0)
    torch.testing.assert_close(value, wanted, rtol=1000 * EPS, atol=0, equal_nan=True)
    torch.testing.assert_close(end, ended, rtol=1000 * EPS, atol=0, equal_nan=True)
    if rows > 1:
        assert {0.0, 1.0, 2.0, 7.0} <= set(count.flatten().tolist())
        assert bool((count[3] == 0).all())  # a comparison with NaN holds for nobody
        assert torch.equal(program(x[4:5], u[4:5])[1][0], value[4:5])


def test_nothing_is_computed_once_no_row_goes_on() -> None:
    asked = list[int]()

    def double(x: Tensor) -> Tensor:
        asked.append(1)
        return 2 * x

    found = lanes.repeat(9, double, torch.tensor([1.0, 3.0, 70.0]), where=lambda x: x < 50)
    assert found.tolist() == [64.0, 96.0, 70.0]
    assert len(asked) == 6
    lanes.repeat(9, double, torch.tensor([60.0]), where=lambda x: x < 50)
    assert len(asked) == 6


def test_a_tracer_of_torch_sees_all_passes() -> None:
    x, u = given(5)
    graph = make_fx(grown)(x, u[:, 0])
    other = torch.tensor([0.1, 4.0, 6.0, -1.0, 0.0], dtype=torch.float64)
    for one, wanted in zip(graph(other, u[:, 0]), grown(other, u[:, 0]), strict=True):
        torch.testing.assert_close(one, wanted, rtol=0, atol=0)


def test_a_mask_of_rows_goes_with_matrices_and_flags() -> None:
    def turn(x: Tensor, now: tuple[()], row: tuple[()]) -> tuple[Tensor, Tensor]:
        large = (x, x > 0, x[:, 0, 0])
        after = lanes.repeat(2, lambda c: (c[0] @ c[0], ~c[1], c[2] - 1), large, where=lambda c: c[2] > 0)
        return 0.3 * torch.where(after[1], after[0], -x), after[2]

    torch.manual_seed(1)
    x = torch.randn(9, 9, 9, dtype=torch.float64)  # more entries than stay in registers
    program = lanes.Program(turn)
    assert program.compiles(x, steps=3)
    for one, wanted in zip(program(x, steps=3), program.definition(x, steps=3), strict=True):
        torch.testing.assert_close(one, wanted, rtol=1e-11, atol=1e-12)


@pytest.mark.skipif(shutil.which("gcc") is None, reason="needs a compiler")
def test_c_leaves_a_loop_when_the_row_is_done() -> None:
    source = lanes.Program(step).c_source("grow", *given(1))
    assert "break;" in source


@pytest.mark.needs_compiler
def test_passes_over_numbers_of_no_row_are_numbers_of_the_program(caplog: pytest.LogCaptureFixture) -> None:
    table = torch.linspace(0.5, 2.0, 12, dtype=torch.float64)

    def products() -> Tensor:  # of numbers without a dimension, as of one matrix for all rows
        def body(done: Tensor, factor: Tensor) -> tuple[Tensor, Tensor]:
            return done * factor, torch.stack([done, factor]).sum()

        return lanes.scan(body, torch.ones((), dtype=torch.float64), table, dim=0)[1]

    program = lanes.Program(
        lambda carry, now, row: (carry + products().sum(), products() * carry.unsqueeze(-1))
    )
    start, now = torch.rand(3, dtype=torch.float64), torch.zeros(3, 4, dtype=torch.float64)
    found, expected = program(start, now, ()), program.definition(start, now, ())
    assert "plain torch" not in caplog.text
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-15, atol=0)
    assert "for (int i" not in program.c_source("fixed", start, now, ())


@pytest.mark.needs_compiler
def test_passes_that_meet_a_row_first_in_their_body_are_a_loop() -> None:
    def step(carry: Tensor, now: Tensor, row: Tensor) -> tuple[Tensor, Tensor]:
        steps = torch.arange(1.0, 6.0, dtype=torch.float64)
        total, parts = lanes.scan(
            lambda s, k: (s + k * row, s * row), torch.zeros(1, dtype=torch.float64), steps, dim=0
        )
        return carry + total, parts.movedim(0, -1)

    program = lanes.Program(step)
    start, now, row = (torch.rand(*shape, dtype=torch.float64) for shape in ((3,), (3, 2), (3,)))
    for one, other in zip(program(start, now, row), program.definition(start, now, row), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-15, atol=1e-16)


@pytest.mark.parametrize("together", [1, 2])
def test_points_from_uneven_places_are_each_met(together: int) -> None:
    places = [0, 1, 3, 7, 8]

    def step(x: Tensor, now: Tensor, row: Tensor) -> Pair:
        all_of_them = lanes.each(lambda point: point.square() - point, row, together=together)
        some = all_of_them[:, places]
        return x, lanes.each(lambda point: point.sin() - 2 * point, some, together=together)

    program, row = lanes.Program(step), torch.arange(18.0, dtype=torch.float64).view(2, 9)
    start, now = torch.zeros(2).double(), torch.zeros(2, 1).double()
    assert program.compiles(start, now, row)
    torch.testing.assert_close(program(start, now, row)[1], program.definition(start, now, row)[1])


def test_points_of_any_number_are_reduced_alike_in_a_program() -> None:
    draw = torch.Generator().manual_seed(1)
    rows = tuple(torch.randn(6, k, 2, dtype=torch.float64, generator=draw) for k in (1, 2, 3, 5))
    cases = list(itertools.product(range(len(rows)), ("sum", "max", "min")))

    def step(carry: Tensor, now: Tensor, row: tuple[Tensor, ...]) -> tuple[Tensor, tuple[Tensor, ...]]:
        def reduced(points: Tensor, operation: str) -> Tensor:
            return lanes.reduce(lambda x: (x - 0.3) * x, points, operation)  # type: ignore[arg-type]

        return carry, tuple(reduced(row[k], operation) for k, operation in cases)

    program = lanes.Program(step)
    start, now = torch.zeros(6).double(), torch.zeros(6, 1).double()
    assert program.compiles(start, now, rows)
    both = program(start, now, rows)[1], program.definition(start, now, rows)[1]
    for case, found, wanted in zip(cases, *both, strict=True):
        torch.testing.assert_close(found, wanted, rtol=1e-14, atol=1e-14, msg=lambda m, c=case: f"{c}: {m}")

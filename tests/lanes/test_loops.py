"""Loops, choices of entries and maps over memory, written out or kept as loops, are what torch computes."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from staf_torch import lanes

pytestmark = pytest.mark.needs_compiler

EPS = torch.finfo(torch.float64).eps
SIZE = 67  # odd, and more entries than stay in registers
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


GROWING = lanes.Program(step)


@pytest.mark.parametrize("rows", [1, 100])
def test_passes_a_row_are_those_of_the_row_alone(rows: int) -> None:
    x, u = given(rows)
    assert GROWING.compiles(x, u)
    (end, (value, count)), (ended, (wanted, passes)) = GROWING(x, u), GROWING.definition(x, u)
    torch.testing.assert_close(count, passes, rtol=0, atol=0)
    torch.testing.assert_close(value, wanted, rtol=1000 * EPS, atol=0, equal_nan=True)
    torch.testing.assert_close(end, ended, rtol=1000 * EPS, atol=0, equal_nan=True)
    if rows > 1:
        assert {0.0, 1.0, 2.0, 7.0} <= set(count.flatten().tolist())
        assert bool((count[3] == 0).all())  # a comparison with NaN holds for nobody
        assert torch.equal(GROWING(x[4:5], u[4:5])[1][0], value[4:5])


def test_a_branch_of_some_rows_is_called_with_these_alone_also_compiled() -> None:
    x, seen = torch.linspace(-1, 1, 10, dtype=torch.float64).view(5, 2), list[int]()

    def body(now: tuple[Tensor, Tensor]) -> Tensor:
        seen.append(len(now[0]))
        return now[0].exp() + now[1]

    def branched(x: Tensor, above: float = 0.0) -> Tensor:
        found: Tensor = lanes.where_rows(x[:, 0] > above, body, (x, x), -x)
        return found

    expected = torch.where(x[:, :1] > 0, x.exp() + x, -x)
    for found in (branched(x), torch.func.vmap(lambda row: branched(row[None])[0])(x)):
        torch.testing.assert_close(found, expected)
    assert seen[0] == 2
    seen.clear()
    assert torch.equal(branched(x, above=9.0), -x)
    assert not seen
    program = lanes.Program(lambda x, _, __: (branched(x), ()))
    assert program.compiles(x, steps=1)
    torch.testing.assert_close(program(x, steps=1)[0], expected)


def masked(x: Tensor, _: Any, __: Any) -> Any:
    """Of (B, 9, 9): a mask of rows goes with matrices and flags."""
    large = (x, x > 0, x[:, 0, 0])
    after = lanes.repeat(2, lambda c: (c[0] @ c[0], ~c[1], c[2] - 1), large, where=lambda c: c[2] > 0)
    return torch.where(after[1], after[0], -x), after[2]


def of_no_row(x: Tensor, _: Any, __: Any) -> Any:
    """Passes over numbers that no row has its own of."""
    table = torch.linspace(0.5, 2.0, 12, dtype=torch.float64)

    def body(done: Tensor, factor: Tensor) -> tuple[Tensor, Tensor]:
        return done * factor, torch.stack([done, factor]).sum()

    products = lanes.scan(body, torch.ones((), dtype=torch.float64), table, dim=0)[1]
    return products.sum() + x, products * x[:, 0, 0].unsqueeze(-1)


def late(x: Tensor, _: Any, row: Tensor) -> Any:
    """A row that comes into a loop in its body first."""
    steps = torch.arange(1.0, 6.0, dtype=torch.float64)
    zero, own = torch.zeros(1, dtype=torch.float64), row[:, 0, 0]
    total, parts = lanes.scan(lambda s, k: (s + k * own, s * own), zero, steps, dim=0)
    return total, parts.movedim(0, -1)


def nested(x: Tensor, u: Tensor, _: Any) -> Any:
    def inner(y: Tensor, v: Tensor) -> Pair:
        y = lanes.repeat(3, lambda z: z * 0.5 + v, y)
        return y, y * v

    end, products = lanes.scan(inner, x[:, 0, 0], u)
    points = end.unsqueeze(-1) + torch.linspace(-1, 1, 7, dtype=x.dtype)
    return end, products, lanes.reduce(torch.sin, points, "max"), lanes.reduce(lambda p: p * p, points, "sum")


def alike(x: Tensor, u: Tensor, _: Any) -> Any:
    """What all passes of a loop find alike."""
    return lanes.repeat(3, lambda at: (2 * u, at[0] + at[1]), (u, u + 1))


def uneven(x: Tensor, _: Any, row: Tensor) -> Any:
    """Points from uneven places, one by one and two at once."""
    found = []
    for together in (1, 2):
        squares = lanes.each(lambda point: point.square() - point, row[:, 0], together=together)
        some = squares[:, [0, 1, 3, 7, 8]]
        found.append(lanes.each(lambda point: point.sin() - 2 * point, some, together=together))
    return tuple(found)


def reduced(x: Tensor, _: Any, row: Tensor) -> Any:
    """Any number of points."""
    cases = itertools.product((1, 2, 3, 5), ("sum", "max", "min"))
    return tuple(lanes.reduce(lambda p: (p - 0.3) * p, row[:, :k, :2], operation) for k, operation in cases)  # type: ignore[arg-type]


LOOPS: dict[str, Callable[[Tensor, Tensor, Tensor], Any]] = {
    each.__name__: each for each in (masked, of_no_row, late, nested, alike, uneven, reduced)
}


def test_loops_of_every_kind_are_the_definition() -> None:
    torch.manual_seed(1)
    x, u, row = torch.randn(9, 9, 9), torch.randn(9, 3, 4), torch.randn(9, 9, 9)
    program = lanes.Program(lambda c, now, r: (0.3 * c, {n: f(c, now, r) for n, f in LOOPS.items()}))
    inputs = x.double(), u.double(), row.double()
    assert program.compiles(*inputs)
    found, wanted = program(*inputs), program.definition(*inputs)
    torch.testing.assert_close(found, wanted, rtol=1e-11, atol=1e-12)


# Entries at places that a row computes.

Choice = Callable[[Tensor, Tensor], Tensor]
CHOICES: dict[str, Choice] = {
    "columns": lambda x, i: x.gather(-1, i.unsqueeze(-2).expand_as(x)),
    "rows": lambda x, i: x.gather(-2, i.unsqueeze(-1).expand_as(x)),
    "one": lambda x, i: x.gather(-1, i[:, :1, None].expand(-1, x.shape[-1], 1)),
    "fewer rows of a part": lambda x, i: x.gather(1, i[:, :2, None].expand(-1, -1, x.shape[-1] - 1)),
    "flags": lambda x, i: (x > 0).gather(1, i.unsqueeze(-1).expand_as(x)).to(x),
    "a table": lambda x, i: torch.linspace(-1.0, 1.0, x.shape[-1]).to(x)[i].unsqueeze(-2) * x,
    "written": lambda x, i: torch.zeros_like(x[:, 0]).scatter(-1, i, x[:, 1]),
    "written in part": lambda x, i: x.scatter(1, i[:, :, None].expand(-1, -1, x.shape[-1] - 1), 2 * x),
    "one number": lambda x, i: x.scatter(1, i.unsqueeze(-1).expand_as(x), 3.5),
    "added": lambda x, i: x.scatter_add(1, i.unsqueeze(-1).expand_as(x), x.sin()),
    "added in part": lambda x, i: x.scatter_add(1, i[:, :2, None].expand(-1, -1, 2), x),
    "slope": lambda x, i: torch.func.grad(lambda y: y.gather(-1, i.unsqueeze(-2).expand_as(y)).sin().sum())(
        x
    ),
}


def test_every_choice_is_that_of_torch() -> None:
    size = 9  # few are written out: `test_operations.py`
    generator = torch.Generator().manual_seed(size)
    x = torch.randn(9, size, size, generator=generator, dtype=torch.float64)
    x[0, 0], x[1, :, 0], x[2, -1] = torch.nan, torch.inf, -0.0
    i = torch.randint(size, (9, size), generator=generator)  # places repeat
    program = lanes.Program(lambda c, now, row: (c, {name: f(*row) for name, f in CHOICES.items()}))
    inputs = torch.zeros(9).to(x), torch.zeros(9, 1).to(x), (x, i)
    assert program.compiles(*inputs)
    found, expected = program(*inputs)[1], program.definition(*inputs)[1]
    torch.testing.assert_close(found, expected, rtol=1e-15, atol=1e-14, equal_nan=True)


def test_many_choices_and_many_passes_are_a_short_text() -> None:
    def lines(size: int) -> int:
        x, i = torch.randn(1, size, size), torch.randint(size, (1, size))
        program = lanes.Program(lambda carry, now, row: (carry + CHOICES["rows"](*row).sum(), ()))
        return len(program.c_source("chosen", torch.zeros(1), torch.zeros(1, 1), (x, i)).splitlines())

    assert lines(24) < 2.5 * lines(12)  # eight times the choices, twice the entries of a place
    text = GROWING.c_source("grow", *given(1))
    assert text.count("break;") == 1  # a row that is done leaves the loop
    assert len(text.splitlines()) < 60


# Maps over memory, and carries that are written where they were.


def kept(x: Tensor, u: Tensor, row: Any) -> tuple[Tensor, Any]:
    """A step that stays where it would leave the finite numbers."""
    after = (x.abs() + u.unsqueeze(-1)).exp() - 3 * x.roll(1, -1) * u.unsqueeze(-1)
    fine = torch.isfinite(after).all(-1) & ~(after > 1e3).any(-1)
    return torch.where(fine.unsqueeze(-1), 0.4 * after, x), fine


def chain(x: Tensor, count: int) -> Tensor:
    for k in range(count):
        x = (x * 0.9 + 0.1 * k).sin()
    return x


SHARED, UNEVEN = torch.arange(65) % 52, torch.tensor([(k * k) % SIZE for k in range(SIZE)])
STEPS: dict[str, Callable[[Tensor, Tensor, Tensor], tuple[Any, Any]]] = {
    "stays behind": kept,
    "where it was": lambda x, u, r: (0.5 * x + u.unsqueeze(-1), x[:, :3]),
    "reads other entries first": lambda x, u, r: (
        torch.where((u > 0).unsqueeze(-1), x.roll(1, -1) + 1, x),
        x[:, 0],
    ),
    "turned over": lambda x, u, r: (x.flip(-1) * 0.5 + r, (x * r).sum(-1)),
    "moved on": lambda x, u, r: (torch.cat((x[:, 1:], u.unsqueeze(-1)), -1), x[:, 0]),
    "in part": lambda x, u, r: (torch.cat((x[:, :60] * 0.5, x[:, 60:]), -1), x.exp().sum(-1)),
    "read often": lambda x, u, r: (torch.cat((x.sin()[:, SHARED], x[:, 65:]), -1), ()),
    "at uneven places": lambda x, u, r: (x.sin()[:, UNEVEN] + r, (x.exp() + r).amax(-1)),
    "a short chain": lambda x, u, r: (chain(x, 6), chain(x, 6)[:, 0] + u),
    "a long chain": lambda x, u, r: (chain(x, 30), ()),
    "a product": lambda x, u, r: (0.1 * (x.unsqueeze(-1) * r.unsqueeze(-2)).sum(-1).sin(), ()),
    "in a loop": lambda x, u, r: (
        lanes.repeat(3, lambda y: (y + u.unsqueeze(-1)).sin() + 0.1 * x.cos(), x),
        (),
    ),
    "flags": lambda x, u, r: (
        torch.where(x > r, -x, 0.5 * x),
        ((x > 0.1).sum(-1), (x > 2.5).any(-1), (x > -2.5).all(-1), (x != x).any(-1)),
    ),
}


def test_carries_and_maps_of_many_entries_are_the_definition() -> None:
    torch.manual_seed(2)
    x, u, r = torch.randn(20, SIZE).double(), torch.randn(20, 6).double(), torch.randn(20, SIZE).double()
    u[:, 2] = torch.where(
        torch.arange(20) % 3 == 0, 800.0, u[:, 2]
    )  # beyond e^709, for those that stay behind
    u[4, 3], x[5, -1], x[6, 0] = torch.nan, torch.inf, torch.nan

    def every(carry: Any, now: Tensor, row: Tensor) -> Any:
        ends, outs = zip(*[f(carry[name], now, row) for name, f in STEPS.items()], strict=True)
        return dict(zip(STEPS, ends, strict=True)), dict(zip(STEPS, outs, strict=True))

    def swapped(carry: Any, now: Tensor, row: Any) -> Any:
        a, b = carry["a"], carry["b"]  # which read each other, and change at once
        return {"a": b.abs() + now.unsqueeze(-1), "b": a - b}, a[:, 3]

    for program, start in (
        (lanes.Program(every), dict.fromkeys(STEPS, x)),
        (lanes.Program(swapped), {"a": x, "b": r}),
    ):
        assert program.compiles(start, u, r)
        found, wanted = program(start, u, r), program.definition(start, u, r)
        torch.testing.assert_close(found, wanted, rtol=1e-11, atol=1e-12, equal_nan=True)
        if "stays behind" in start:
            fine = found[1]["stays behind"]
            assert 0 < int(fine.sum()) < fine.numel()
            assert not bool(fine[5:7].any())

"""The texts of carries and maps, recorded: which are written where they were, which go through memory."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from helpers import uniform
from lanes.test_recorded_texts import VERSION, said
from recorded import Record
from torch import Tensor

from staf_torch import lanes
from staf_torch.lanes.given import Given
from staf_torch.lanes.one_row import trace
from staf_torch.lanes.scalar_text import cuda_text

SIZE = 67
Step = Callable[[Any, Tensor, Tensor], tuple[Any, Any]]
SHARED = torch.arange(65) % 52  # every place 1.25 times: just few enough to be computed where it is read
MORE = torch.arange(66) % 52
UNEVEN = torch.tensor([(k * k) % SIZE for k in range(SIZE)]).unique().repeat(3)[:SIZE]


def chain(x: Tensor, count: int) -> Tensor:
    for k in range(count):
        x = (x + k).sin()
    return x


def held(x: Tensor, new: Tensor) -> tuple[Tensor, Tensor]:
    fine = torch.isfinite(new).all(-1)
    return torch.where(fine.unsqueeze(-1), new, x), fine


ONE: dict[str, Callable[[Tensor, Tensor, Tensor], tuple[Any, Any]]] = {  # x (B, 67), u (B, 1), row (B, 67)
    "where it was": lambda x, u, r: (0.5 * x + u, ()),
    "of a row alone": lambda x, u, r: (r * u, x[:, :2]),
    "read by an output": lambda x, u, r: (x * u, (x * u)[:, :3]),
    "summed by an output": lambda x, u, r: (x * u, (x * u).sum(-1)),
    "what it was is put out": lambda x, u, r: (x * u, x.exp()),
    "rolled": lambda x, u, r: (x.roll(1, -1) * u, ()),
    "flipped": lambda x, u, r: (x.flip(-1) + r, ()),
    "in part": lambda x, u, r: (torch.cat((x[:, :60] * u, x[:, 60:]), -1), ()),
    "moved on": lambda x, u, r: (torch.cat((x[:, 1:], u), -1), x[:, 0]),
    "a copy with another number": lambda x, u, r: (torch.cat((u, x[:, 1:]), -1) * 2, ()),
    "nothing new": lambda x, u, r: (x, x * u),
    "held": lambda x, u, r: held(x, 0.4 * x + u * r),
    "held of another place": lambda x, u, r: held(x, x.roll(2, -1) * u),
    "one product of all": lambda x, u, r: (x * (x * r).sum(-1, keepdim=True), ()),
    "few read often": lambda x, u, r: ((x.sin()[:, :1] + x) * u, ()),
    "as often as pays": lambda x, u, r: (torch.cat((x.exp()[:, SHARED] * u, x[:, 65:]), -1), ()),
    "more often": lambda x, u, r: (torch.cat((x.exp()[:, MORE] * u, x[:, 66:]), -1), ()),
    "at uneven places": lambda x, u, r: (x.exp()[:, UNEVEN] * u, ()),
    "even steps": lambda x, u, r: (torch.cat((x.exp()[:, ::2], r.cos()[:, 1::2]), -1) * u, ()),
    "twice in one": lambda x, u, r: (x.exp() * u + x.exp() * r, ()),
    "by two": lambda x, u, r: (x.exp() * u, x.exp() - r),
    **{f"a chain of {n}": lambda x, u, r, n=n: (chain(x, n) * u, ()) for n in (5, 11, 12, 13, 20)},  # type: ignore[misc]
    "a product": lambda x, u, r: ((x.unsqueeze(-1) * r.unsqueeze(-2)).sum(-1) * u, ()),
    "mapped in a product": lambda x, u, r: (x * u, ((x.exp() + r) * x).sum(-1)),
    "mapped in a loop": lambda x, u, r: (lanes.repeat(3, lambda y: (y * u).sin() + r.exp(), x), ()),
    "mapped before a loop": lambda x, u, r: (lanes.repeat(3, lambda y: y + x.exp() * u, x), ()),
    "a loop over its own": lambda x, u, r: (x, lanes.scan(lambda s, z: (s + z, s), u[:, 0], x)[1]),
    "flags": lambda x, u, r: (torch.where(x > r, x, u), ((x > 0).sum(-1), (x > r).any(-1), (x != x).all(-1))),
}  # fmt: skip
TWO: dict[str, Callable[[Tensor, Tensor, Tensor], tuple[Any, Any]]] = {  # of two of (B, 67)
    "swapped": lambda a, b, u: ((b * u, a * u), ()),
    "crossed": lambda a, b, u: ((a + b, b * u), ()),
    "alike": lambda a, b, u: ((a * u, a * u), ()),
    "one from both": lambda a, b, u: ((a * b + u, b), ()),
    "moved": lambda a, b, u: ((b, a), a[:, :9]),
    "each its own": lambda a, b, u: ((a * u, b.sin()), (a[:, 0], b.sum(-1))),
}


def text(name: str, copies: int) -> str:
    x, u, r = uniform(2, SIZE, seed=1), uniform(2, 4, 1, seed=2), uniform(2, SIZE, seed=3)
    if name in ONE:
        return lanes.Program(lambda c, now, row: ONE[name](c, now, row), copies=copies).text(x, u, r)
    return lanes.Program(lambda c, now, row: TWO[name](*c, now), copies=copies).text((x, r), u, ())


@pytest.mark.parametrize("name", [*ONE, *TWO])
def test_the_text_of_a_carry_is_the_recorded(name: str, record: Record) -> None:
    if record.known().get("torch", VERSION) == VERSION:
        record({"torch": VERSION, "text": [said(text(name, copies)) for copies in (1, 2)]})


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_the_text_for_another_processor_is_the_recorded(dtype: torch.dtype, record: Record) -> None:
    """A thread a row: of a carry of numbers and flags, inputs of every time and of none, some shared."""

    def step(carry: Any, now: Any, row: Any) -> tuple[Any, Any]:
        x, flag = carry
        y = lanes.repeat(3, lambda z: z * row[0] + now[1].sum(-1, keepdim=True), x)
        x = torch.where(flag.unsqueeze(-1), y.exp() * now[0], x - row[1][:2])
        return (x.flip(-1), x[:, 0] > 0), (x, flag, (x.unsqueeze(-1) * row[1]).sum(-1))

    x, u, r = (uniform(*shape, seed=1).to(dtype) for shape in ((2, 2), (2, 4, 1), (3,)))
    shared = torch.arange(12).view(4, 3).to(dtype)
    given = Given.of((x, x[:, 0] > 0), (u, lanes.Shared(shared)), (x, lanes.Shared(r)), None)
    if record.known().get("torch", VERSION) == VERSION:
        text = cuda_text(*trace(step, given).program, name="go", shared=["now1", "row1"])
        record({"torch": VERSION, "text": said(text)})


def test_carries_that_no_other_reads_are_written_where_they_were() -> None:
    """`next` is the array through which a carry goes else."""
    through = {name for name in (*ONE, *TWO) if "next" in text(name, 1)}
    assert not through & {
        "where it was",
        "of a row alone",
        "held",
        "a copy with another number",
        "each its own",
    }
    assert {"rolled", "flipped", "moved on", "swapped", "crossed", "moved"} <= through

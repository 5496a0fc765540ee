"""Maps that another map takes over, flags of many entries, a carry that is written where it was."""

from __future__ import annotations

import re

import pytest
import torch
from torch import Tensor

from staf_torch import lanes
from staf_torch.lanes.fusion import evenly

pytestmark = pytest.mark.needs_compiler

SIZE = 67  # odd, and more entries than stay in registers
EPS = torch.finfo(torch.float64).eps


def kept(x: Tensor, u: Tensor, row: tuple[()]) -> tuple[Tensor, Tensor]:
    """A step that stays where it would leave the finite numbers."""
    after = (x.abs() + u.unsqueeze(-1)).exp() - 3 * x.roll(1, -1) * u.unsqueeze(-1)
    fine = torch.isfinite(after).all(-1) & ~(after > 1e3).any(-1)
    return torch.where(fine.unsqueeze(-1), 0.4 * after, x), fine


def given() -> tuple[Tensor, Tensor]:
    torch.manual_seed(0)
    x, u = torch.randn(20, SIZE, dtype=torch.float64), torch.randn(20, 6, dtype=torch.float64)
    u[:, 2] = torch.where(torch.arange(20) % 3 == 0, 800.0, u[:, 2])  # beyond e^709
    u[4, 3], x[5, -1], x[6, 0] = torch.nan, torch.inf, torch.nan
    return x, u


def test_a_carry_in_memory_is_written_where_it_was_and_keeps_what_does_not_go_on() -> None:
    x, u = given()
    program = lanes.Program(kept)
    assert program.compiles(x, u)
    (end, fine), (wanted, flags) = program(x, u), program.definition(x, u)
    assert torch.equal(fine, flags)
    assert 0 < int(fine.sum()) < fine.numel()
    assert not bool(fine[4, 3])
    assert not bool(fine[5:7].any())
    torch.testing.assert_close(end, wanted, rtol=1e3 * EPS, atol=1e3 * EPS, equal_nan=True)
    text = program.text(x, u)
    assert "next0" not in text
    assert len(re.findall(rf"V a\d+\[{SIZE}\]", text)) <= 2  # what is new, and perhaps a sum of it


@pytest.mark.parametrize("shift", [0, 1])
def test_what_reads_other_entries_of_the_carry_is_finished_first(shift: int) -> None:
    def turned(x: Tensor, now: Tensor, row: tuple[()]) -> tuple[Tensor, Tensor]:
        return torch.where((now > 0).unsqueeze(-1), x.roll(shift, -1) + 1, x), x[:, 0]

    x, u = given()
    x, u = x.nan_to_num(posinf=1.0), u.nan_to_num()
    program = lanes.Program(turned)
    assert program.compiles(x, u)
    assert torch.equal(program(x, u)[0], program.definition(x, u)[0])


def test_slots_that_read_each_other_change_at_once() -> None:
    def swapped(carry: tuple[Tensor, Tensor], now: Tensor, row: tuple[()]) -> tuple[object, Tensor]:
        a, b = carry
        return (b + now.unsqueeze(-1), a.abs() - b), a[:, 3]

    x, u = given()
    x, u = x.nan_to_num(posinf=1.0), u.nan_to_num()
    program = lanes.Program(swapped)
    assert program.compiles((x, 2 * x), u)
    (a, b), (one, other) = program((x, 2 * x), u)[0], program.definition((x, 2 * x), u)[0]
    assert torch.equal(a, one)
    assert torch.equal(b, other)


def test_flags_of_many_entries_are_one() -> None:
    def flags(x: Tensor, now: tuple[()], row: tuple[()]) -> tuple[Tensor, tuple[Tensor, ...]]:
        table = (x > 0.7).reshape(-1, 13, 5)
        return x, ((table.sum(-1) > 3).any(-1), table.any(-1).all(-1), (x > -2.5).all(-1), (x > 2.5).any(-1))

    torch.manual_seed(2)
    x = torch.randn(200, 65, dtype=torch.float64)
    program = lanes.Program(flags)
    assert program.compiles(x, steps=1)
    for one, wanted in zip(program(x, steps=1)[1], program.definition(x, steps=1)[1], strict=True):
        assert torch.equal(one, wanted)
        assert 0 < int(wanted.sum()) < 200


def test_places_that_nested_loops_reach() -> None:
    assert evenly((3, 5, 7, 13, 15, 17), [2, 3]) == ([10, 2], 3)
    assert evenly((3, 5, 7, 13, 15, 18), [2, 3]) is None
    assert evenly(None, [2, 3]) == ([0, 0], 0)


def test_a_chain_of_maps_needs_no_memory_between_its_links() -> None:
    def chain(x: Tensor, now: Tensor, row: tuple[()]) -> tuple[Tensor, Tensor]:
        y = x
        for k in range(6):
            y = (y * 0.9 + 0.1 * k).sin()
        return y, y[:, 0] + now

    x, u = given()
    program = lanes.Program(chain)
    text = program.text(x, u[:, :1])
    assert len(re.findall(rf"V a\d+\[{SIZE}\]", text)) <= 1

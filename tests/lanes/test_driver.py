"""Inputs on their way into lanes, rows that stay behind, and what is found once for all passes."""

from __future__ import annotations

import mmap
import os

import pytest
import torch
from torch import Tensor

from staf_torch import lanes
from staf_torch.lanes.pages import LARGE, fresh

pytestmark = pytest.mark.needs_compiler

Pair = tuple[Tensor, Tensor]


def same_bits(a: Tensor, b: Tensor) -> bool:
    kind = torch.int64 if a.dtype == torch.float64 else torch.int32
    return torch.equal(a.contiguous().view(kind), b.contiguous().view(kind))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_every_number_of_an_input_reaches_its_row_and_time(dtype: torch.dtype) -> None:
    def step(carry: Tensor, now: tuple[Tensor, ...], row: object) -> tuple[Tensor, tuple[Tensor, ...]]:
        return carry, now

    program = lanes.Program(step)
    for rows in (1, 9, 65) if dtype == torch.float64 else (65,):
        for times in (1, 20, 70):
            given = [torch.rand(rows, times, *shape, dtype=dtype) for shape in ((), (1,), (2,), (3,), (2, 5))]
            given.append(torch.rand(rows, times, 4, dtype=dtype)[..., ::2])  # neither dense nor alone
            given.append(torch.rand(times, 3, rows, dtype=dtype).movedim(-1, 0))  # rows last
            carry = torch.zeros(rows, dtype=dtype)
            assert program.compiles(carry, tuple(given))
            _, out = program(carry, tuple(given))
            assert all(same_bits(a, b) for a, b in zip(out, given, strict=True))


def held(carry: tuple[Tensor, Tensor, Tensor], now: Tensor, row: object) -> tuple[object, Tensor]:
    """A row of which a number is not finite stays behind, as the rows of a chase do."""
    x, gain, lost_at = carry
    new = x * (now - gain).exp()
    fine = torch.isfinite(new) & (lost_at < 0)
    lost_at = torch.where(fine | (lost_at >= 0), lost_at, now)
    x, gain = torch.where(fine, new, x), torch.where(fine, now, gain)
    return (x, gain, lost_at), x * gain - now


@pytest.mark.parametrize("rows", [1, 5, 40])
def test_rows_that_stay_behind_keep_their_numbers_and_no_other_row_sees_them(rows: int) -> None:
    torch.manual_seed(0)
    now = torch.rand(rows, 50).double()
    now[::3, 20] = torch.nan
    carry = torch.ones(rows).double(), torch.zeros(rows).double(), -torch.ones(rows).double()
    program = lanes.Program(held)
    assert "__builtin_expect(any(" in program.text(carry, now)
    (x, gain, lost_at), out = program(carry, now)
    (wanted, wanted_gain, wanted_lost), history = program.definition(carry, now)
    torch.testing.assert_close(x, wanted, rtol=1e-13, atol=0)
    torch.testing.assert_close(out, history, rtol=1e-12, atol=1e-15, equal_nan=True)
    torch.testing.assert_close(lost_at, wanted_lost, equal_nan=True, rtol=0, atol=0)
    assert torch.equal(gain, wanted_gain)
    for row in range(rows):
        alone = tuple(part[row : row + 1] for part in carry)
        found = program(alone, now[row : row + 1])[1]
        assert same_bits(found.nan_to_num(), out[row : row + 1].nan_to_num())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_exponential_of_minus_x_has_the_bits_of_its_own(dtype: torch.dtype) -> None:
    def step(carry: tuple[()], now: tuple[()], row: Pair) -> tuple[tuple[()], Tensor]:
        x, minus = row
        return carry, torch.stack((x.exp(), (-x).exp(), minus.exp()), dim=-1)

    x = torch.cat((torch.linspace(-760, 760, 4001), torch.linspace(-1, 1, 999), torch.tensor([0.0, -0.0])))
    x = torch.cat((x, torch.tensor([torch.inf, -torch.inf, torch.nan, 1e-310]))).to(dtype)
    up, down, wanted = lanes.Program(step)((), (), (x, -x), steps=1)[1].unbind(-1)
    there = ~torch.isnan(x)  # NaN has a sign, which nobody asks for
    assert same_bits(down.squeeze()[there], wanted.squeeze()[there])
    bound, last = 4 * torch.finfo(dtype).eps, torch.finfo(dtype).smallest_normal * torch.finfo(dtype).eps
    torch.testing.assert_close(up.squeeze(), x.exp(), rtol=bound, atol=last, equal_nan=True)


def test_what_all_passes_of_a_loop_find_alike_is_found_once() -> None:
    def step(carry: Pair, now: Tensor, row: object) -> tuple[Pair, Tensor]:
        def body(at: Pair) -> Pair:
            return 2 * now, at[0] + at[1]

        carry = lanes.repeat(3, body, carry)
        return carry, carry[1]

    carry, now = (torch.ones(3).double(), torch.rand(3).double()), torch.rand(3, 4).double()
    program = lanes.Program(step)
    end, out = program(carry, now)
    wanted, history = program.definition(carry, now)
    assert torch.equal(out, history)
    assert torch.equal(end[0], wanted[0])


def test_costly_functions_of_the_time_alone_are_found_ahead_and_cheap_ones_are_not() -> None:
    carry, now = torch.ones(3).double(), torch.ones(3, 4).double()
    for function, ahead in ((lambda t: t + 1, 0), (lambda t: t.exp().sin(), 1)):
        program = lanes.Program(lambda c, t, row, f=function: (c * f(t), ()))
        assert f" AHEAD = {ahead}," in program.text(carry, now)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("rows", [1024, 1001])
def test_a_long_history_that_bypasses_the_caches_is_that_of_its_pieces(rows: int, dtype: torch.dtype) -> None:
    """Lines that begin where a vector does, and lines that do not."""
    now = torch.rand(rows, 320, 4, dtype=dtype)

    def step(carry: Tensor, now: Tensor, row: object) -> tuple[Tensor, Tensor]:
        carry = 0.5 * carry + now
        return carry, carry

    program, carry = lanes.Program(step), torch.zeros(rows, 4, dtype=dtype)
    after, whole = program(carry, now)
    assert whole.numel() * whole.element_size() > 2**22
    pieces = []
    for piece in now.split(40, dim=1):
        carry, found = program(carry, piece)
        pieces.append(found)
    assert same_bits(whole, torch.cat(pieces, dim=1))
    assert same_bits(after, carry)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_child_process_writes_to_a_large_result_of_its_own() -> None:
    given = fresh(torch.zeros(1, dtype=torch.float64), LARGE // 8)
    given.zero_()
    child = os.fork()
    if not child:
        given.numpy()[:] = 1.0
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 0
    assert not bool(given.any())


@pytest.mark.skipif(not hasattr(mmap, "MADV_HUGEPAGE"), reason="needs huge pages")
def test_large_results_are_mappings_of_their_own() -> None:
    like = torch.zeros(1, dtype=torch.float64)
    for shape in ((LARGE // 8,), (3, LARGE // 8 + 1), (7, LARGE // 16)):
        large = fresh(like, *shape)
        assert large.shape == shape
        assert large.is_contiguous()
        assert large.data_ptr() % mmap.PAGESIZE == 0  # what `malloc` returns begins after its own notes
    small = [fresh(like, LARGE // 64) for _ in range(9)]
    assert any(each.data_ptr() % mmap.PAGESIZE for each in small)

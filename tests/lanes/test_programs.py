"""A compiled program computes what plain torch computes; a row has the same bits in every batch."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import pytest
import torch
from torch import Tensor, nn

from staf_torch import lanes, systems
from staf_torch.lanes import Shared
from staf_torch.lanes.calls.planned_call import LARGE, fresh

pytestmark = pytest.mark.needs_compiler


def pendulum(x: Tensor, u: Tensor, row: tuple[Tensor, Tensor]) -> tuple[Tensor, tuple[Tensor, Tensor]]:
    gain, mass = row

    def rate(at: Tensor) -> Tensor:
        angle, speed = at.unbind(-1)
        return torch.stack((speed, (u - gain * angle.sin()) / mass), dim=-1)

    x = systems.runge_kutta_step(rate, x, 0.01)
    return x, (x, x[..., 0] > 0)


PENDULUM = lanes.Program(pendulum)
"""For all tests of this file: built once."""


def inputs(batch: int, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor, tuple[Tensor, Shared]]:
    torch.manual_seed(0)
    x, u = torch.randn(1000, 2, dtype=dtype), torch.randn(1000, 30, dtype=dtype)
    gain = torch.rand(1000, dtype=dtype)
    return x[:batch], u[:batch], (gain[:batch], Shared(torch.tensor(2.0, dtype=dtype)))


def same_bits(a: Tensor, b: Tensor) -> bool:
    kind = torch.int64 if a.dtype == torch.float64 else torch.int32
    return torch.equal(a.contiguous().view(kind), b.contiguous().view(kind))


@pytest.mark.parametrize(("dtype", "every"), [(torch.float32, 7), (torch.float64, 1)])
def test_compiled_is_the_definition(dtype: torch.dtype, every: int) -> None:
    given = inputs(11, dtype)
    assert PENDULUM.compiles(*given)
    end, (states, right) = PENDULUM(*given, every=every)
    wanted, (history, flags) = PENDULUM.definition(*given, every=every)
    assert states.shape == history.shape == (11, -(-30 // every), 2)
    assert right.dtype == torch.bool
    assert torch.equal(right, flags)
    bound = 64 * torch.finfo(dtype).eps
    torch.testing.assert_close(end, wanted, rtol=bound, atol=bound)
    torch.testing.assert_close(states, history, rtol=bound, atol=bound)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_row_has_the_same_bits_in_every_batch_and_beside_every_neighbour(dtype: torch.dtype) -> None:
    x, u, (gain, mass) = inputs(1000, dtype)
    x = x.clone()
    x[1::5, 0] = torch.nan
    x[3::7, 1] = torch.inf
    whole = PENDULUM(x, u, (gain, mass))[1][0]
    for batch in (1, 7, 64, 1000):
        part = PENDULUM(x[:batch], u[:batch], (gain[:batch], mass))[1][0]
        assert same_bits(part, whole[:batch])
    lonely = PENDULUM(x[4:5], u[4:5], (gain[4:5], mass))[1][0]
    assert same_bits(lonely, whole[4:5])


def test_threads_do_not_change_bits() -> None:
    """Nor do threads of the caller that ask at once; a fork has helpers of its own (torch's are gone)."""
    x, u, row = inputs(1000)
    given = x, u.repeat(1, 30), row  # some milliseconds: enough for a second thread
    threads, helping = torch.get_num_threads(), len(os.listdir("/proc/self/task"))
    try:
        torch.set_num_threads(1)
        one = PENDULUM(*given)[1][0]
        torch.set_num_threads(2)
        PENDULUM(*inputs(20))
        assert len(os.listdir("/proc/self/task")) <= helping  # 20 rows take one
        with ThreadPoolExecutor(4) as pool:
            for found in pool.map(lambda _: PENDULUM(*given)[1][0], range(4)):
                assert same_bits(found, one)
        child = multiprocessing.get_context("fork").Process(target=lambda: PENDULUM(*given, every=900))
        child.start()
        child.join(60)
        assert child.exitcode == 0
    finally:
        torch.set_num_threads(threads)


def test_a_prepared_call_is_the_program_for_all_inputs() -> None:
    x, u, (gain, mass) = inputs(5)
    prepared = PENDULUM.prepare(x, u, (gain, mass))
    for given in (
        (x + 1, u, (gain, mass)),
        (x[:2], u[:2], (gain[:2], mass)),
        (x.mT.contiguous().mT, u, (gain, mass)),
    ):
        found, wanted = prepared(*given), PENDULUM.definition(*given)
        torch.testing.assert_close(found[1][0], wanted[1][0], rtol=1e-13, atol=1e-13)
        assert found[1][0].shape == wanted[1][0].shape
    assert prepared(x.clone().requires_grad_(), u, (gain, mass))[0].requires_grad


class Own(Tensor):
    """A tensor of a user, of which nobody knows what its operations do."""


def test_what_is_no_ordinary_tensor_runs_the_definition() -> None:
    x, u, row = inputs(3)
    wanted = PENDULUM.definition(x, u, row)[0]
    learned = nn.Parameter(x.clone())
    assert PENDULUM.compiles(learned, u, row)  # its gradient is compiled, too
    PENDULUM(learned, u, row)[0].sum().backward()
    assert learned.grad is not None
    with torch.no_grad():
        assert PENDULUM.compiles(learned, u, row)
    assert not PENDULUM.compiles(x.as_subclass(Own), u, row)
    assert PENDULUM(x.to("meta"), u.to("meta"), lanes.tree.moved(row, "meta"))[0].is_meta
    alone = lambda at, by: PENDULUM(at[None], by[None], (row[0][:1], row[1]))[0][0]  # noqa: E731
    torch.testing.assert_close(torch.func.vmap(alone)(x[:1], u[:1]), wanted[:1])
    slope = torch.func.grad(lambda at: PENDULUM(at, u, row)[0].sum())(x)
    torch.testing.assert_close(slope, learned.grad)


# Inputs.

ROWS, TIMES = 3, 5
TIMED: dict[str, Callable[[], Any]] = {
    "numbers": lambda: drawn(ROWS, TIMES),
    "vectors": lambda: drawn(ROWS, TIMES, 4),
    "times first": lambda: drawn(TIMES, ROWS, 4).movedim(0, 1),
    "rows last": lambda: drawn(TIMES, 3, ROWS).movedim(-1, 0),
    "every second": lambda: drawn(ROWS, TIMES, 4)[..., ::2],
    "turned over": lambda: drawn(ROWS, TIMES, 3, 2).mT,
    "of one time": lambda: drawn(ROWS, 1, 3).expand(-1, TIMES, -1),
    "shared": lambda: Shared(drawn(TIMES, 2, 3)),
    "shared numbers": lambda: Shared(drawn(2 * TIMES)[::2]),
}
ONCE: dict[str, Callable[[], Any]] = {
    "numbers": lambda: drawn(ROWS),
    "every second": lambda: drawn(ROWS, 8)[:, ::2],
    "rows last": lambda: drawn(4, ROWS).mT,
    "turned over": lambda: drawn(ROWS, 3, 2).mT,
    "of one column": lambda: drawn(ROWS, 2, 3)[:, :, :1],
    "integers": lambda: torch.arange(12).view(ROWS, 4) - 5,
    "flags": lambda: drawn(ROWS, 4) > 0,
    "one row for all": lambda: drawn(1, 4).expand(ROWS, 4),
    "shared": lambda: Shared(drawn(4)),
    "a shared number": lambda: Shared(drawn(1)[0]),
    "shared and turned over": lambda: Shared(drawn(3, 2).mT),
}


def drawn(*shape: int) -> Tensor:
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(sum(shape)))


def handed_through(carry: Any, now: Any, row: Any) -> tuple[Any, Any]:
    """All that a step is given, of every row, as its outputs."""
    held, given = carry["x"], [*now.items(), *row.items()]
    parts = [part.expand(len(held), *part.shape) if "shared" in name else part for name, part in given]
    return carry, [*parts, held, *carry["more"]]


def test_every_number_of_an_input_in_any_layout_reaches_its_row_and_time() -> None:
    every = 2
    now, row = ({name: make() for name, make in kinds.items()} for kinds in (TIMED, ONCE))
    carry = {"x": drawn(ROWS, 2, 3).mT, "more": (torch.arange(ROWS), drawn(2, ROWS)[1] > 0)}
    program = lanes.Program(handed_through)
    assert program.compiles(carry, now, row)
    found, wanted = program(carry, now, row, every=every), program.definition(carry, now, row, every=every)
    assert list(found[0]) == ["x", "more"]
    for one, other in zip(
        (*found[1], found[0]["x"], *found[0]["more"]), (*wanted[1], carry["x"], *carry["more"]), strict=True
    ):
        assert one.dtype == other.dtype
        assert torch.equal(one, other)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_every_number_reaches_its_row_and_time_in_batches_and_times_of_any_size(dtype: torch.dtype) -> None:
    """On both sides of a vector of rows, and of the pieces in which times are read ahead."""
    program = lanes.Program(lambda carry, now, row: (carry, now))
    for rows, times in ((1, 1), (9, 20), (65, 70), (65, 1)):
        given = tuple(torch.rand(rows, times, *shape, dtype=dtype) for shape in ((), (1,), (3,), (2, 5)))
        assert program.compiles(torch.zeros(rows, dtype=dtype), given)
        _, out = program(torch.zeros(rows, dtype=dtype), given)
        assert all(same_bits(a, b) for a, b in zip(out, given, strict=True))


class Pair(NamedTuple):
    a: Any
    b: Any


def test_trees_of_any_kind_come_back_as_they_were_given() -> None:
    def step(carry: Any, now: Any, row: Any) -> tuple[Any, Any]:
        (x,), pair = carry["x"], carry["y"]
        changed = {"x": [x + 1], "y": Pair(2 * pair.a, ()), "z": None}
        return changed, {"p": Pair(x, (row["gain"], [x])), "none": None, "empty": ()}

    carry = {"x": [torch.rand(3)], "y": Pair(torch.rand(3, 2), ()), "z": None}
    program = lanes.Program(step)
    given = carry, (), {"gain": torch.rand(3)}
    assert program.compiles(*given, steps=2)
    found, wanted = program(*given, steps=2), program.definition(*given, steps=2)
    assert repr(found) == repr(wanted)  # types, order and numbers: 2 x and x + 1 are exact
    assert type(found[0]["y"]) is type(found[1]["p"]) is Pair


@pytest.mark.parametrize("every", [2, 7])
def test_every_time_is_taken_and_some_are_recorded(every: int) -> None:
    def step(carry: Tensor, now: Tensor, row: tuple[Tensor, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        return carry + row[1], {"now": now * row[0], "carry": carry}

    u = torch.arange(5.0).repeat(2, 1)
    given = torch.zeros(2), u, (torch.ones(2), Shared(torch.tensor(2.0)))
    for compile in (True, False):
        program = lanes.Program(step, compile=compile)
        assert program.compiles(*given) is compile
        for run in (program.definition, program):
            end, out = run(*given, every=every)
            assert end.tolist() == [10.0, 10.0]
            assert out["now"].tolist() == [list(range(0, 5, every))] * 2
            assert out["carry"].tolist() == [list(range(0, 10, 2 * every))] * 2
        assert torch.equal(program.prepare(*given, every=every)(*given)[1]["now"], out["now"])


def test_no_row_and_no_time_are_no_error_and_neither_is_a_step_without_outputs() -> None:
    program = lanes.Program(lambda x, u, row: (x + 1, ()))
    assert program(torch.zeros(0, 2), steps=3)[0].shape == (0, 2)
    assert program(torch.zeros(4, 2), steps=3)[1] == ()
    assert torch.equal(program(torch.ones(4, 2), torch.zeros(4, 0))[0], torch.ones(4, 2))


@pytest.mark.parametrize(
    ("given", "options", "message"),
    [
        ((torch.zeros(2),), {}, r"`Program\(steps=\.\.\.\)` must be given"),
        (((), Shared(torch.zeros(2))), {}, "at least one tensor with a dimension of rows; got none"),
        ((), {"steps": 2}, "at least one tensor"),
    ],
)
def test_a_call_that_does_not_say_its_rows_or_times_is_refused(
    given: tuple[Any, ...], options: dict[str, int], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        lanes.Program(lambda x, u, row: (x, ()))(*given or ((),), **options)


# Dtypes.


def test_the_precision_of_a_program_is_the_highest_of_its_inputs() -> None:
    single, double, whole = torch.full((2,), 0.3), torch.full((2,), 0.7).double(), torch.tensor([2, 3])
    program = lanes.Program(lambda x, u, row: (x, x * row / 3))
    for x, row in ((single, whole), (single, double), (whole, double), (double, single)):
        assert program.compiles(x, (), row, steps=1)
        found, wanted = (run(x, (), row, steps=1)[1] for run in (program, program.definition))
        assert found.dtype == wanted.dtype
        torch.testing.assert_close(found, wanted)


@pytest.mark.parametrize(("kind", "given"), [(torch.bfloat16, torch.float32), (torch.float16, torch.float64)])
def test_half_precision_runs_by_its_definition(kind: torch.dtype, given: torch.dtype) -> None:
    program = lanes.Program(lambda x, u, row: ((x.to(kind) / 3).to(given) + u, x))
    x, u = drawn(5, 2).to(given), drawn(5, 3, 2).to(given)
    assert not program.compiles(x, u)
    for found, right in zip(program(x, u), program.definition(x, u), strict=True):
        assert torch.equal(found, right)


# Carries and histories.


def test_a_long_history_that_bypasses_the_caches_is_that_of_its_pieces() -> None:
    """Lines that begin where a vector does, and lines that do not."""
    program = lanes.Program(lambda carry, now, row: (0.5 * carry + now, 0.5 * carry + now))
    for rows in (1024, 1001):
        now, carry = torch.rand(rows, 160, 4).double(), torch.zeros(rows, 4).double()
        after, whole = program(carry, now)
        assert whole.numel() * whole.element_size() > 2**22
        pieces = []
        for piece in now.split(40, dim=1):
            carry, found = program(carry, piece)
            pieces.append(found)
        assert same_bits(whole, torch.cat(pieces, dim=1))
        assert same_bits(after, carry)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of a fork beside threads
@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_child_process_writes_to_a_large_result_of_its_own() -> None:
    given = fresh(torch.zeros(1, dtype=torch.float64), LARGE // 8)
    child = multiprocessing.get_context("fork").Process(target=given.numpy().fill, args=(1.0,))
    given.zero_()
    child.start()
    child.join(60)
    assert child.exitcode == 0
    assert not bool(given.any())

"""A compiled program computes what plain torch computes; a row has the same bits in every batch."""

from __future__ import annotations

import logging
import multiprocessing
from typing import Any

import pytest
import torch
from torch import Tensor

from staf_torch import lanes, optim, systems
from staf_torch.lanes import compiler
from staf_torch.lanes.runs import Run, runs
from staf_torch.optim.objective import NativeError, Precomputed

pytestmark = pytest.mark.needs_compiler

EPS = torch.finfo(torch.float64).eps
SPECIAL = torch.tensor([0.0, -0.0, 1.0, -1.0, torch.inf, -torch.inf, torch.nan, 5e-324, -1e-310, 1e300, 0.5])


def pendulum(x: Tensor, u: Tensor, row: tuple[Tensor, Tensor]) -> tuple[Tensor, tuple[Tensor, Tensor]]:
    gain, mass = row

    def rate(at: Tensor) -> Tensor:
        angle, speed = at.unbind(-1)
        return torch.stack((speed, (u - gain * angle.sin()) / mass), dim=-1)

    x = systems.integrators.runge_kutta_step(rate, x, 0.01)
    return x, (x, x[..., 0] > 0)


def inputs(
    batch: int, dtype: torch.dtype = torch.float64
) -> tuple[Tensor, Tensor, tuple[Tensor, lanes.Shared]]:
    torch.manual_seed(0)
    x, u = torch.randn(1000, 2, dtype=dtype), torch.randn(1000, 30, dtype=dtype)
    gain = torch.rand(1000, dtype=dtype)
    return x[:batch], u[:batch], (gain[:batch], lanes.Shared(torch.tensor(2.0, dtype=dtype)))


def same_bits(a: Tensor, b: Tensor) -> bool:
    kind = torch.int64 if a.dtype == torch.float64 else torch.int32
    return torch.equal(a.contiguous().view(kind), b.contiguous().view(kind))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("every", [1, 7])
def test_compiled_is_the_definition(dtype: torch.dtype, every: int) -> None:
    program = lanes.Program(pendulum)
    given = inputs(11, dtype)
    assert program.compiles(*given)
    end, (states, right) = program(*given, every=every)
    wanted, (history, flags) = program.definition(*given, every=every)
    assert states.shape == history.shape == (11, -(-30 // every), 2)
    assert right.dtype == torch.bool
    assert torch.equal(right, flags)
    bound = 64 * torch.finfo(dtype).eps
    torch.testing.assert_close(end, wanted, rtol=bound, atol=bound)
    torch.testing.assert_close(states, history, rtol=bound, atol=bound)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_row_has_the_same_bits_in_every_batch_and_beside_every_neighbour(dtype: torch.dtype) -> None:
    program = lanes.Program(pendulum)
    x, u, (gain, mass) = inputs(1000, dtype)
    x = x.clone()
    x[1::5, 0] = torch.nan
    x[3::7, 1] = torch.inf
    whole = program(x, u, (gain, mass))[1][0]
    for batch in (1, 7, 64, 1000):
        part = program(x[:batch], u[:batch], (gain[:batch], mass))[1][0]
        assert same_bits(part, whole[:batch])
    lonely = program(x[4:5], u[4:5], (gain[4:5], mass))[1][0]
    assert same_bits(lonely, whole[4:5])


def test_a_prepared_call_is_the_program_for_all_inputs() -> None:
    program, (x, u, (gain, mass)) = lanes.Program(pendulum), inputs(5)
    prepared = program.prepare(x, u, (gain, mass))
    for given in (
        (x + 1, u, (gain, mass)),
        (x[:2], u[:2], (gain[:2], mass)),
        (x.mT.contiguous().mT, u, (gain, mass)),
    ):
        found, wanted = prepared(*given), program.definition(*given)
        torch.testing.assert_close(found[1][0], wanted[1][0], rtol=1e-13, atol=1e-13)
        assert found[1][0].shape == wanted[1][0].shape
    wanted = x.clone().requires_grad_()
    assert prepared(wanted, u, (gain, mass))[0].requires_grad


def test_entries_in_any_order_and_integers_are_read_as_they_stand() -> None:
    def step(x: Tensor, u: Tensor, row: Tensor) -> tuple[Tensor, Tensor]:
        return x + u.sum(-1), (x.unsqueeze(-1) * u[..., :2] + row).floor().long()

    x, u = torch.randn(3, 4, dtype=torch.float64), torch.randn(3, 6, 4, 3, dtype=torch.float64)
    program, row = lanes.Program(step), torch.arange(24).reshape(2, 4, 3).permute(2, 1, 0)
    for inputs in (u, u.mT.contiguous().mT, u[:, :1].expand_as(u), u.flip(-1)):
        found, wanted = program(x, inputs, row), program.definition(x, inputs, row)
        torch.testing.assert_close(found[0], wanted[0])
        assert torch.equal(found[1], wanted[1])
        assert found[1].dtype == torch.int64


def test_threads_do_not_change_bits() -> None:
    program, given, threads = lanes.Program(pendulum), inputs(1000), torch.get_num_threads()
    one = program(*given)[1][0]
    try:
        torch.set_num_threads(2)
        assert same_bits(program(*given)[1][0], one)
    finally:
        torch.set_num_threads(threads)


def test_a_law_repeated_is_the_definition() -> None:
    """M = 15 keeps its products as loops over memory; few centers and other laws: `engine`."""
    law, count = optim.SteepestDescent(), 15
    factor = torch.randn(9, 5, count, count, dtype=torch.float64)
    gram = factor @ factor.mT + 5 * torch.eye(count, dtype=torch.float64)
    values, weights = (
        torch.randn(9, 5, count, dtype=torch.float64),
        torch.zeros(9, count, dtype=torch.float64),
    )
    extremes = torch.linalg.eigvalsh(gram)[..., [0, -1]]

    def step(carry: Any, now: Any, _: Any) -> Any:
        gram, values, extremes = now
        objective = NativeError(gram, values, Precomputed(extremes=extremes))
        carry = carry[0], law.begin(objective, *carry)
        carry = lanes.repeat(2, lambda c: law.step(objective, *c), carry)
        return carry, carry[0]

    program = lanes.Program(step)
    given = (weights, law.init(weights)), (gram, values, extremes)
    assert program.compiles(*given)
    torch.testing.assert_close(program(*given)[1], program.definition(*given)[1], rtol=1e-12, atol=1e-13)


def test_scan_and_reduce_nest() -> None:
    def step(x: Tensor, u: Tensor, _: Any) -> tuple[Tensor, tuple[Tensor, ...]]:
        def inner(y: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
            y = lanes.repeat(3, lambda z: z * 0.5 + v, y)
            return y, y * v

        x, products = lanes.scan(inner, x, u)
        points = x.unsqueeze(-1) + torch.linspace(-1, 1, 7, dtype=x.dtype)
        high = lanes.reduce(torch.sin, points, "max")
        total = lanes.reduce(lambda p: p * p, points, "sum")
        return x, (products, high, total)

    program = lanes.Program(step)
    given = torch.randn(5, dtype=torch.float64), torch.randn(5, 6, 4, dtype=torch.float64)
    assert program.compiles(*given)
    assert "i0 < 4" in program.text(*given)
    for found, wanted in zip(program(*given)[1], program.definition(*given)[1], strict=True):
        torch.testing.assert_close(found, wanted, rtol=1e-13, atol=1e-13)


@pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated")
def test_derivatives_inside_a_step_are_ordinary_operations() -> None:
    def value(x: Tensor) -> Tensor:
        return ((x**3).sum(-1).tanh() + x[..., 0].exp() * x[..., 1].abs()).sum()

    def step(x: Tensor, _: Any, __: Any) -> tuple[Tensor, Tensor]:
        slope = torch.func.grad(value)(x)
        return x - 0.01 * slope, torch.func.jvp(lambda at: at.sin().log1p(), (x.square(),), (slope,))[1]

    program, x = lanes.Program(step), torch.randn(6, 2, dtype=torch.float64)
    assert program.compiles(x, steps=4)
    found, wanted = program(x, steps=4)[1], program.definition(x, steps=4)[1]
    torch.testing.assert_close(found, wanted, rtol=1e-12, atol=1e-12)


def test_writes_into_a_tensor_are_followed() -> None:
    def step(x: Tensor, _: Any, __: Any) -> tuple[Tensor, Tensor]:
        room = torch.zeros(len(x), 3, dtype=x.dtype)
        room[:, 1] = x * 2
        room[:, 2:] += x.unsqueeze(-1)
        return x + 1, room.flip(-1)

    program, x = lanes.Program(step), torch.randn(6, dtype=torch.float64)
    assert program.compiles(x, steps=2)
    assert torch.equal(program(x, steps=2)[1], program.definition(x, steps=2)[1])


def test_other_constants_need_no_other_program() -> None:
    def program(gain: float) -> str:
        return lanes.Program(lambda x, _, __: (x * gain, x)).text(torch.ones(1), steps=1)

    assert program(1.1) == program(2.3)


def test_what_cannot_be_compiled_is_named_with_its_line_and_runs(caplog: pytest.LogCaptureFixture) -> None:
    def step(x: Tensor, _: Any, __: Any) -> tuple[Tensor, Tensor]:
        return torch.special.i0(x), x  # no such function on lanes

    program, x = lanes.Program(step, name="the odd one"), torch.rand(3, dtype=torch.float64)
    with caplog.at_level(logging.WARNING):
        found = program(x, steps=2)[0]
        program(x, steps=2)
    (record,) = caplog.records
    assert "the odd one" in record.message
    assert "i0" in record.message
    assert "test_program.py" in record.message
    assert torch.equal(found, torch.special.i0(torch.special.i0(x)))


def test_a_value_that_decides_what_is_computed_is_refused(caplog: pytest.LogCaptureFixture) -> None:
    program = lanes.Program(lambda x, _, __: (x if bool((x > 0).all()) else -x, ()))
    with caplog.at_level(logging.WARNING):
        assert not program.compiles(torch.ones(3), steps=1)
    assert "reads a value of a row" in caplog.text


def test_a_wanted_derivative_runs_the_definition() -> None:
    program, (x, u, row) = lanes.Program(pendulum), inputs(3)
    x.requires_grad_()
    assert not program.compiles(x, u, row)
    end = program(x, u, row)[0]
    end.sum().backward()
    assert x.grad is not None


def test_without_a_compiler_the_definition_runs(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Any, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setattr(compiler, "_loaded", {})
    given = inputs(3)
    program = lanes.Program(pendulum)
    with caplog.at_level(logging.WARNING):
        found = program(*given)[0]
    assert "runs in plain torch" in caplog.text
    assert torch.equal(found, program.definition(*given)[0])


def halved(x: Tensor, _: object, __: object) -> tuple[Tensor, Tensor]:
    return x * 0.5, x


def test_a_damaged_cache_is_built_again(monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> None:
    whole, built = b"", tmp_path
    for name, kept in (("whole", None), ("empty", 0), ("cut", 5000)):  # a process opens one path once
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / name))
        monkeypatch.setattr(compiler, "_loaded", {})
        folder = tmp_path / name / "staf_torch"
        if kept is not None:
            folder.mkdir(parents=True)
            (folder / built.name).write_bytes(whole[:kept])
        assert lanes.Program(halved).compiles(torch.ones(1), steps=1)
        (built,) = folder.glob("lanes-*.so")
        whole = whole or built.read_bytes()
        assert built.stat().st_size == len(whole) > 5000


def test_a_cache_that_cannot_be_written_is_replaced(monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> None:
    (tmp_path / "file").write_text("no folder")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    monkeypatch.setattr(compiler, "_loaded", {})
    assert lanes.Program(halved).compiles(torch.ones(1), steps=1)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_two_processes_may_build_the_same(monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(compiler, "_loaded", {})
    text = lanes.Program(halved).text(torch.ones(1), steps=1)
    context = multiprocessing.get_context("fork")
    both = [context.Process(target=compiler.function, args=(text,)) for _ in range(2)]
    for process in both:
        process.start()
    for process in both:
        process.join(60)
        assert process.exitcode == 0
    (built,) = (tmp_path / "staf_torch").iterdir()
    assert built.suffix == ".so"


def test_float64_inside_a_program_of_float32_is_carried_in_double_throughout() -> None:
    def step(x: Tensor, u: Tensor, row: Any) -> tuple[Tensor, Tensor]:
        inner = x.double()
        x = (0.5 * inner.sin() + inner.cos().square()).float() + u
        return x, x

    program = lanes.Program(step)
    generator = torch.Generator().manual_seed(3)
    x, u = torch.randn(5, 2, generator=generator), torch.randn(5, 20, 2, generator=generator)
    assert program.compiles(x, u)
    end, history = program(x, u)
    want_end, want = program.definition(x, u)
    assert end.dtype == history.dtype == torch.float32
    torch.testing.assert_close(history, want, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(end, want_end, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("kind", [torch.float32, torch.float16])
def test_numbers_of_a_lesser_dtype_inside_a_program_are_rounded_as_they_are(kind: torch.dtype) -> None:
    """float32 of a program of float64, half precision of one of float32: no lanes have them."""
    given = torch.float64 if kind == torch.float32 else torch.float32

    def step(x: Tensor, u: Tensor, row: Any) -> tuple[Tensor, Tensor]:
        x = (x.to(kind) / 3).to(given) + u
        return x, x

    program = lanes.Program(step)
    generator = torch.Generator().manual_seed(4)
    x, u = (torch.randn(5, *shape, dtype=given, generator=generator) for shape in ((2,), (3, 2)))
    assert not program.compiles(x, u)
    for found, right in zip(program(x, u), program.definition(x, u), strict=True):
        assert torch.equal(found, right)


@pytest.mark.parametrize("rows", [1, 5, 21])
def test_a_carry_of_many_entries_stays_in_memory(rows: int) -> None:
    """Matrices that change places, a part of one that moves on, flags, and numbers beside them."""
    torch.manual_seed(rows)
    a, b = torch.randn(2, rows, 9, 9).double().unbind()

    def step(carry: Any, u: Tensor, _: object) -> tuple[Any, Any]:
        one, other, some, last = carry
        moved = torch.cat((one[:, 1:], 0.5 * one[:, :1] + u[:, None, None]), dim=1)
        moved = torch.where(some, moved, -moved).roll(1, -1)
        return (other, moved, other > one, one[:, 3, 4]), (one.sum((-2, -1)), last)

    start = a, b, a > b, a[:, 0, 0]
    program, u = lanes.Program(step), torch.randn(rows, 6).double()
    assert program.compiles(start, u)
    (after, out), (wanted, known) = program(start, u), program.definition(start, u)
    for found, right in zip((*after, *out), (*wanted, *known), strict=True):
        torch.testing.assert_close(found, right, rtol=1e-13, atol=1e-13)


def test_entries_that_lie_evenly_are_runs() -> None:
    places = [
        ("a", 5),
        ("a", 7),
        ("a", 9),
        ("a", 11),
        ("b", 0),
        ("a", 12),
        ("c", 1),
        ("c", 1),
        ("c", 1),
        ("c", 1),
    ]
    assert runs(places) == [Run(0, 4, 5, 2), Run(4, 2), Run(6, 4, 1, 0)]
    assert runs([]) == []

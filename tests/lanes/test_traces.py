"""Captured tensors are numbers of a table: steps that differ in them share a trace and a library, within a
process and through the user's cache, from which nothing is run and nothing old comes back."""

from __future__ import annotations

import hashlib
import multiprocessing
import os
import pickle
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from staf_torch import StaFBasis, StateFollowingCenters, chase_weights, kernels, lanes, optim, rings, targets
from staf_torch.lanes.program import Program, Step
from staf_torch.lanes.shared_programs import SharedPrograms
from staf_torch.lanes.texts import unpatched

pytestmark = pytest.mark.needs_compiler

X = torch.linspace(-1, 1, 10, dtype=torch.float64).view(5, 2)
NUMBERS = (torch.tensor([0.3, -1.7, 0.9]), torch.tensor([1.0, 1.0, 0.0]), torch.tensor([-0.0, 0.5, 1 / 64]))


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "staf_torch"


def traces(cache: Path) -> list[Path]:
    return list(cache.glob("trace-*"))


# Numbers of a table.


class Everything:
    """All that a step may do with captured numbers: masks, indices, powers, matrices, memory of its own."""

    def __init__(self, numbers: Tensor) -> None:
        self.numbers, self.calls = numbers, 0

    def __call__(self, x: Tensor, u: Tensor, row: Tensor) -> tuple[Tensor, tuple[Tensor, ...]]:
        self.calls += 1
        a = self.numbers.to(x)
        matrix = torch.eye(3).to(x) + a[:, None] * a.exp()
        factor = torch.linalg.cholesky_ex(matrix.mT @ matrix + torch.eye(3).to(x)).L
        x = 0.5 * x + torch.linalg.solve_triangular(factor, x[:, a.argsort()].mT, upper=False).mT
        x = torch.where(a > 0, x * a, x - a) + (a[0] ** 2) * u[:, None]
        own = torch.zeros(3).to(x)
        before = own + x  # the step's own memory until here
        own[1] = a[2]
        own.mul_(2)
        rows = lanes.scan(
            lambda c, r: (c * r[0] + a * r[1], ()), x, torch.tensor(((1.0, 0.3), (0.7, 2.0))).to(x), dim=0
        )
        several = a.view(3, 1)[:, 0] * x + a.flip(0) * x + a[1:2].expand(3) * x + a[::2].sum() * a.max()
        return x, ((x @ a).sin() + x.abs().pow(a.abs()).sum(-1), before + own * x, rows[0], several)


def test_other_numbers_are_the_same_text_and_the_right_result() -> None:
    x, u = torch.rand(5, 3, dtype=torch.float64), torch.rand(5, 3, dtype=torch.float64)
    first = Program(Everything(NUMBERS[0]))
    assert first.compiles(x, u)
    assert Program(Everything(NUMBERS[1])).text(x, u) == first.text(x, u)
    for a in NUMBERS:
        program = first.with_others(Everything(a), [(NUMBERS[0], a)])
        assert program.compiles(x, u)
        torch.testing.assert_close(program(x, u), program.definition(x, u), rtol=1e-12, atol=1e-12)


class Made:
    """A step that counts how often it is called."""

    def __init__(self, function: Callable[[Tensor], Tensor]) -> None:
        self.function, self.calls = function, 0

    def __call__(self, x: Tensor, now: Any, row: Any) -> tuple[Tensor, Tensor]:
        self.calls += 1
        return x + 0.1 * self.function(x), x


def test_a_program_with_other_tensors_traces_nothing_unless_more_than_they_decide() -> None:
    old, new, hidden = torch.tensor(2.0), torch.tensor(-2.0), torch.tensor(1.0)
    functions: dict[str, Callable[[Tensor], Callable[[Tensor], Tensor]]] = {
        "made of it": lambda a: lambda x: x * (2 * a + 1).exp(),
        "a number that it reads": lambda a: lambda x: x * (a + 1) if bool(a > 0) else -x,
        "a tensor that nobody named": lambda a: lambda x: x * a + hidden,
    }
    for name, function in functions.items():
        first = Program(Made(function(old)))
        first(X, steps=1)
        step = Made(function(new))
        again = first.with_others(step, [(old, new)])
        if name == "a tensor that nobody named":
            hidden = torch.tensor(3.0)
        found = again(X, steps=1)[0]
        assert (step.calls == 0) is (name == "made of it")
        torch.testing.assert_close(found, again.definition(X, steps=1)[0], rtol=1e-14, atol=0)


def test_memory_that_a_step_writes_to_is_not_written_twice() -> None:
    def step_of(a: Tensor) -> Step:
        def step(x: Tensor, now: Any, row: Any) -> tuple[Tensor, Any]:
            first, second = 2 * a, 2 * a
            second += 1  # what was equal before is told apart
            return (x * first.sum()).sin() + (x * second.sum()).sin() + (x * (2 * a).sum()).sin(), ()

        return step

    first = Program(step_of(NUMBERS[0]))
    first(X.float(), steps=1)
    for program in (Program(step_of(NUMBERS[2])), first.with_others(step_of(NUMBERS[2]), [NUMBERS[::2]])):
        for _ in range(2):
            found, wanted = program(X.float(), steps=1)[0], program.definition(X.float(), steps=1)[0]
            torch.testing.assert_close(found, wanted, rtol=1e-6, atol=1e-6)


def test_arrays_of_numpy_are_numbers_too_and_what_the_code_states_is_text() -> None:
    table = np.array([1.0, 0.5])
    program = Program(lambda x, now, row: (x * torch.as_tensor(table), ()))
    texts = {program.text(X, steps=1)}
    table[0] = 5.0
    assert {program.text(X, steps=1)} == texts
    torch.testing.assert_close(program(X, steps=1)[0], X * torch.tensor([5.0, 0.5]))
    other = Program(lambda x, now, row: (x[:, torch.tensor([1, 0])] * torch.tensor([1.0, 2.0]).to(x), ()))
    assert torch.equal(other(X, steps=1)[0], X.flip(1) * torch.tensor([1.0, 2.0]))


# Programs that are kept, and traces in the cache.


def layer(seed: int) -> nn.Module:
    torch.manual_seed(seed)
    return nn.Sequential(nn.Linear(2, 3), nn.Tanh(), nn.Linear(3, 2)).double().requires_grad_(False)


def of(kept: SharedPrograms, module: nn.Module, *settings: Any) -> tuple[Program, Made]:
    step = Made(module)
    return kept.of(step, module, *settings), step


def right(program: Program, x: Tensor = X) -> Tensor:
    assert program.compiles(x, steps=3)
    found, expected = program(x, steps=3)[1], program.definition(x, steps=3)[1]
    torch.testing.assert_close(found, expected, rtol=1e-6 if x.dtype == torch.float32 else 1e-13, atol=1e-13)
    return found


def served(kept: SharedPrograms, module: nn.Module, *settings: Any) -> tuple[Tensor, bool]:
    """What the program of a module computes, and whether it had to be traced."""
    program, step = of(kept, module, *settings)
    assert program.compiles(X, steps=3)
    traced = step.calls > 0
    return right(program), traced


def test_other_tensors_are_the_same_program_with_other_numbers(cache: Path) -> None:
    kept = SharedPrograms("a test")
    first, traced = served(kept, layer(0))
    other, again = served(kept, layer(1))
    assert (traced, again) == (True, False)
    assert not torch.equal(other, first)
    same = layer(2)
    before = of(kept, same)[0]
    assert of(kept, same)[0] is before
    same[0].bias.add_(1.0)  # type: ignore[operator]
    assert of(kept, same)[0] is not before


def test_a_trace_comes_from_the_cache_to_the_bit_and_with_other_numbers(cache: Path) -> None:
    first, traced = served(SharedPrograms("a test"), layer(0))
    assert traced
    (path,) = traces(cache)
    os.utime(path, (1e9, 1e9))
    again, traced = served(SharedPrograms("a test"), layer(0))  # as another process would
    assert torch.equal(again, first)
    other, traced_too = served(SharedPrograms("a test"), layer(1))
    assert not torch.equal(other, first)
    assert not traced
    assert not traced_too
    assert path.stat().st_mtime > 1e9 + 1  # in use
    assert not [each for each in cache.iterdir() if each.name.startswith("tmp")]
    content = path.read_bytes()  # in which no number of a tensor is
    path.unlink()
    served(SharedPrograms("a test"), layer(1))
    assert path.read_bytes() == content


class Harm:
    def __init__(self, place: Path) -> None:
        self.place = place

    def __reduce__(self) -> Any:
        return os.mkdir, (str(self.place),)


def sealed(value: object) -> bytes:
    packed = zlib.compress(pickle.dumps(value))
    return packed + hashlib.sha256(packed).digest()


DAMAGES: dict[str, Callable[[bytes, Path], bytes]] = {
    "cut": lambda content, _: content[:100],
    "a byte changed": lambda content, _: content[:40] + bytes([content[40] ^ 1]) + content[41:],
    "something else": lambda content, _: sealed((1, 2)),
    "code": lambda content, place: sealed(Harm(place)),
    "code inside": lambda content, place: sealed((Harm(place), 1, 2, 3, 4)),
    "a class of this package": lambda content, _: sealed((SharedPrograms("a test"),)),
}


def test_a_trace_that_is_none_is_written_again_and_nothing_in_it_is_run(cache: Path, tmp_path: Path) -> None:
    first, _ = served(SharedPrograms("a test"), layer(0))
    (path,) = traces(cache)
    content = path.read_bytes()
    for name, damage in DAMAGES.items():
        path.write_bytes(damage(content, tmp_path / "harm"))
        again, traced = served(SharedPrograms("a test"), layer(0))
        assert traced, name
        assert torch.equal(again, first)
        assert path.read_bytes() == content, name
        assert not (tmp_path / "harm").exists(), name


def test_another_setting_or_dtype_is_another_trace(cache: Path) -> None:
    served(SharedPrograms("a test"), layer(0))
    served(SharedPrograms("a test"), layer(0), "another setting")
    right(of(SharedPrograms("a test"), layer(0).float())[0], X.float())
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64 if before == torch.float32 else torch.float32)
    try:
        served(SharedPrograms("a test"), layer(0))
    finally:
        torch.set_default_dtype(before)
    assert len(traces(cache)) == 4


class Mine(nn.Linear):
    """Of a user: its code may change from process to process."""


def test_code_of_a_user_and_tensors_that_nobody_named_keep_a_trace_out_of_the_cache(cache: Path) -> None:
    served(SharedPrograms("a test"), nn.Sequential(Mine(2, 2)).double().requires_grad_(False))
    hidden = torch.tensor(2.0, dtype=torch.float64)
    program = SharedPrograms("a test").of(lambda x, _, __: (x * hidden, x), "named")
    right(program)
    assert not traces(cache)


def test_a_number_that_the_step_reads_decides_whether_a_trace_serves(cache: Path) -> None:
    for number in (2.0, -1.0):
        scale = torch.tensor(number, dtype=torch.float64)
        program = SharedPrograms("a test").of(
            lambda x, _, __, scale=scale: (x * scale if bool(scale > 0) else -x, x), scale
        )
        right(program)


def twice(self: nn.Module, x1: Tensor, x2: Tensor) -> Tensor:
    return 2 * (x1 @ x2.mT)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of a fork beside threads
@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_method_of_the_library_that_a_user_replaces_meets_no_old_trace_and_leaves_none(cache: Path) -> None:
    """In a process of its own, which ends with the method that it has put there."""

    def step_of(kernel: nn.Module) -> nn.Module:
        return lambda x: kernel(x.unsqueeze(-2), torch.ones(1, 2).double()).squeeze(-2)  # type: ignore[return-value]

    def program(kept: SharedPrograms, kernel: nn.Module) -> Program:
        return kept.of(Made(step_of(kernel)), kernel, owners=(kernel,))

    def replaced() -> None:
        kernel, kept = kernels.ExponentialKernel(), SharedPrograms("a test")
        for _ in range(3):  # from the second on a watch says whether something has changed
            before = right(program(kept, kernel))
        assert unpatched()
        assert len(traces(cache)) == 1
        assert kept.unchanged(kernel) is not None
        kernels.ExponentialKernel.forward = twice  # type: ignore[method-assign]
        assert not unpatched()
        assert kept.unchanged(kernel) is None
        for other in (kept, SharedPrograms("a test")):
            assert not torch.allclose(right(program(other, kernel)), before)
        assert len(traces(cache)) == 1

    process = multiprocessing.get_context("fork").Process(target=replaced)
    process.start()
    process.join(120)
    assert process.exitcode == 0
    assert unpatched()


@pytest.mark.compiled
def test_what_was_traced_of_a_chase_is_there_for_the_next_process(cache: Path) -> None:
    basis = StaFBasis(kernels.ExponentialKernel(), StateFollowingCenters(rings(3), 0.3))
    x = 0.01 * torch.arange(32).double().view(1, 16, 2)
    with lanes.compiling("always"):
        chase_weights(x, basis, targets.Quadratic(2.0), optim.SteepestDescent(), inner_steps=1)
    assert len(traces(cache)) == 1

"""Programs that differ in tensors alone share a trace, within a process and through the user's cache."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from staf_torch.lanes import program as programs
from staf_torch.lanes.function import RowFunction, ready
from staf_torch.lanes.kept import Kept
from staf_torch.lanes.program import Program

pytestmark = pytest.mark.needs_compiler

X = torch.linspace(-1, 1, 10, dtype=torch.float64).view(5, 2)


def layer(seed: int) -> nn.Module:
    torch.manual_seed(seed)
    return nn.Sequential(nn.Linear(2, 3), nn.Tanh(), nn.Linear(3, 2)).double().requires_grad_(False)


def of(kept: Kept, module: nn.Module, *settings: Any) -> Program:
    def step(x: Tensor, now: Any, row: Any) -> tuple[Tensor, Tensor]:
        x = x + 0.1 * module(x)
        return x, x.sum(-1)

    found = kept.of(step, module, *settings)
    assert found is not None
    return found


def right(program: Program) -> Tensor:
    assert program.compiles(X, steps=3)
    found, expected = program(X, steps=3)[1], program.definition(X, steps=3)[1]
    torch.testing.assert_close(found, expected, rtol=1e-13, atol=1e-13)
    return found


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache for traces; what is compiled stays where it is."""
    monkeypatch.setattr("staf_torch.lanes.trace_cache._cache", lambda: tmp_path)
    return tmp_path


@pytest.fixture
def no_tracing(monkeypatch: pytest.MonkeyPatch) -> Any:
    def refuse(*_: Any, **__: Any) -> None:
        raise AssertionError("traced")

    return lambda: monkeypatch.setattr(programs, "trace", refuse)


def test_other_tensors_are_the_same_program_with_other_numbers(cache: Path, no_tracing) -> None:
    kept = Kept("a test")
    first = right(of(kept, layer(0)))
    no_tracing()
    assert not torch.equal(right(of(kept, layer(1))), first)
    same = layer(2)
    assert of(kept, same) is of(kept, same)
    before = of(kept, same)
    same[0].bias.add_(1.0)  # type: ignore[operator]
    assert of(kept, same) is not before


def test_a_trace_comes_from_the_cache_to_the_bit_and_with_other_numbers(cache: Path, no_tracing) -> None:
    first = right(of(Kept("a test"), layer(0)))
    assert len(list(cache.iterdir())) == 1
    no_tracing()
    assert torch.equal(right(of(Kept("a test"), layer(0))), first)  # as another process would
    assert not torch.equal(right(of(Kept("a test"), layer(1))), first)


@pytest.mark.parametrize("left", [0, 100, -1])
def test_a_damaged_trace_is_written_again(left: int, cache: Path) -> None:
    first = right(of(Kept("a test"), layer(0)))
    (path,) = cache.iterdir()
    content = path.read_bytes()
    path.write_bytes(content[:left])
    assert torch.equal(right(of(Kept("a test"), layer(0))), first)
    assert path.read_bytes() == content


def test_another_setting_shape_or_kind_of_number_is_another_trace(cache: Path) -> None:
    right(of(Kept("a test"), layer(0)))
    right(of(Kept("a test"), layer(0), "another setting"))
    program = of(Kept("a test"), layer(0))
    assert program.compiles(X[:, None], steps=1)
    assert of(Kept("a test"), layer(0).float()).compiles(X.float(), steps=1)
    assert len(list(cache.iterdir())) == 4


class Mine(nn.Linear):
    """Of a user: its code may change from process to process."""


def test_code_of_a_user_is_traced_in_every_process(cache: Path) -> None:
    right(of(Kept("a test"), nn.Sequential(Mine(2, 2)).double().requires_grad_(False)))
    assert not list(cache.iterdir())


def test_a_number_that_the_step_reads_decides_whether_the_trace_serves(cache: Path) -> None:
    def positive(scale: Tensor) -> Program:
        program = Kept("a test").of(lambda x, _, __: (x * scale if bool(scale > 0) else -x, x), scale)
        assert program is not None
        return program

    for scale in (2.0, 3.0, -1.0):
        right(positive(torch.tensor(scale, dtype=torch.float64)))


def test_a_tensor_that_nobody_named_keeps_the_trace_out_of_the_cache(cache: Path) -> None:
    hidden = torch.tensor(2.0, dtype=torch.float64)
    program = Kept("a test").of(lambda x, _, __: (x * hidden, x), "named")
    assert program is not None
    right(program)
    assert not list(cache.iterdir())


def test_where_a_derivative_may_be_wanted_there_is_no_program(cache: Path) -> None:
    module = layer(0).requires_grad_(True)
    assert Kept("a test").of(lambda x, _, __: (module(x), x), module) is None


CHANGES: dict[str, Any] = {
    "nothing": lambda m: None,
    "a tensor in place": lambda m: m[0].bias.add_(1),
    "another tensor": lambda m: setattr(m[0], "bias", nn.Parameter(m[0].bias.clone(), requires_grad=False)),
    "another part": lambda m: m.__setitem__(1, nn.Sigmoid()),
    "an attribute": lambda m: setattr(m[1], "mine", 3.0),
    "an entry of a list": lambda m: m.notes.append(1),
    "a hook": lambda m: m[0].register_forward_hook(lambda *_: None),
    "a derivative": lambda m: m.requires_grad_(True),
}


@pytest.mark.parametrize("change", CHANGES)
def test_the_same_objects_are_read_again_once_something_inside_has_changed(change: str, cache: Path) -> None:
    kept, module = Kept("a test"), layer(0)
    module.notes = []  # type: ignore[assignment]
    for _ in range(2):  # the second call is the first from which a watch pays
        assert kept.unchanged(module, 3) is None
        program = kept.of(lambda x, _, __: (module(x), x), module, owners=(module, 3))
    assert kept.unchanged(module, 3) is program
    assert kept.unchanged(module, 4) is None
    CHANGES[change](module)
    assert (kept.unchanged(module, 3) is program) == (change == "nothing")


class Slots:
    __slots__ = ("number",)


def test_what_cannot_be_watched_is_read_every_time(cache: Path) -> None:
    kept, part = Kept("a test"), Slots()
    part.number = 1.0
    for _ in range(3):
        kept.of(lambda x, _, __: (x * part.number, x), part, owners=(part,))
        assert kept.unchanged(part) is None


def test_a_policy_is_ready_before_its_loop_begins(caplog: pytest.LogCaptureFixture) -> None:
    module = layer(0)
    row = RowFunction(module.forward, module, "a test")
    holder = nn.Module()
    holder.row, holder.forward = row, row.__call__
    assert not row.compiled
    assert ready(holder, X[0])
    assert row.compiled
    torch.testing.assert_close(row(X[0]), module(X[0]), rtol=1e-13, atol=1e-13)
    assert not ready(nn.Linear(2, 2).double(), X)
    refused = RowFunction(lambda x: module(x) + torch.randn(x.shape), module, "a noisy test")
    holder.row, holder.forward = refused, refused.__call__
    assert not ready(holder, X[0])
    assert "draws random numbers" in caplog.text

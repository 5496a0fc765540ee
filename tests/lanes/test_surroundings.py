"""A program knows what functions of a user read beside their arguments, which a notebook changes."""

from __future__ import annotations

import ctypes
import itertools
import math
import sys
import threading
from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from staf_torch.lanes.content import reads_users_code, skeleton
from staf_torch.lanes.function import RowFunction
from staf_torch.lanes.kept import Kept
from staf_torch.lanes.program import Program
from staf_torch.lanes.watch import Watch
from staf_torch.systems import simulate

pytestmark = pytest.mark.needs_compiler
SOURCE = """
import math, numpy as np, torch
gain, unread, notes, table = 2.0, 1.0, [1.0, 2.0], {"gain": 2.0}
names, other = {"a"}, 1.0
array, tensor = np.array([1.0, 2.0]), torch.tensor(2.0, dtype=torch.float64)
helpers = ModuleType("helpers")
helpers.gain, helpers.twice = 2.0, lambda x: 2 * x

def inner(x): return x * gain
def outer(x): return inner(x)
def default(x, by=2.0): return x * by
def closing(by): return lambda x: x * by
def recursive(x, times=2): return x if times == 0 else recursive(x * gain, times - 1)
def nested(x): return [by * gain * x for by in (1.0, 2.0)][0]
def local(x):
    from math import tau
    return x * tau

class Settings:
    gain = 2.0
    numbers = [1.0, 2.0]

class Base:
    def scaled(self, x): return inner(x)

class Held(Base):
    by = 2.0
    @property
    def half(self): return gain / 2
    @staticmethod
    def twice(x): return x * gain
    def __call__(self, x): return super().scaled(x) * self.by

held = Held()
FUNCTIONS = dict(
    number=lambda x: x * gain,
    call=outer,
    entry=lambda x: x * notes[0],
    key=lambda x: x * table["gain"],
    member=lambda x: x * (2.0 if "a" in names else 3.0),
    array=lambda x: x * float(array[0]),
    tensor=lambda x: x * tensor,
    module=lambda x: x * helpers.gain,
    function_of_a_module=lambda x: helpers.twice(x),
    constant_of_a_class=lambda x: x * Settings.gain,
    list_of_a_class=lambda x: x * Settings.numbers[0],
    base=held, static=Held.twice, property=lambda x: x * held.half,
    python=lambda x: x * math.tau, torch=lambda x: torch.tanh(x),
    default=default, recursive=recursive, nested=nested, local=local,
)
"""
CHANGES: dict[str, Callable[[Any], Any]] = {
    "number": lambda m: setattr(m, "gain", 3.0),
    "call": lambda m: setattr(m, "inner", lambda x: 5 * x),
    "entry": lambda m: m.notes.__setitem__(0, 3.0),
    "key": lambda m: m.table.update(gain=3.0),
    "member": lambda m: m.names.clear(),
    "array": lambda m: m.array.__setitem__(0, 3.0),
    "tensor": lambda m: m.tensor.fill_(3.0),
    "module": lambda m: setattr(m.helpers, "gain", 3.0),
    "function_of_a_module": lambda m: setattr(m.helpers, "twice", lambda x: 3 * x),
    "constant_of_a_class": lambda m: setattr(m.Settings, "gain", 3.0),
    "list_of_a_class": lambda m: m.Settings.numbers.__setitem__(0, 3.0),
    "base": lambda m: setattr(m, "gain", 3.0),
    "static": lambda m: setattr(m, "gain", 3.0),
    "property": lambda m: setattr(m, "gain", 3.0),
    "python": lambda m: setattr(math, "tau", 7.0),
    "torch": lambda m: setattr(torch, "tanh", torch.sin),
    "default": lambda m: setattr(m.default, "__defaults__", (3.0,)),
    "recursive": lambda m: setattr(m, "gain", 3.0),
    "nested": lambda m: setattr(m, "gain", 3.0),
    "local": lambda m: setattr(math, "tau", 7.0),
}
X = torch.linspace(-1, 1, 10, dtype=torch.float64).view(5, 2)


@pytest.fixture
def notebook(monkeypatch: pytest.MonkeyPatch) -> Any:
    """A module that lies in no folder of packages."""
    module = ModuleType("notebook")
    module.ModuleType = ModuleType  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "notebook", module)
    monkeypatch.setattr(math, "tau", math.tau)  # each is put back at the end
    monkeypatch.setattr(torch, "tanh", torch.tanh)
    exec(compile(SOURCE, "notebook", "exec"), vars(module))
    return module


def of(kept: Kept, function: Callable[[Tensor], Tensor]) -> Any:
    """The program of a function, as those ask for it who ask often."""
    program = kept.unchanged(function)
    if program is None:
        program = kept.of(lambda x, _, __: (x, function(x)), function, owners=(function,))
    return program


@pytest.mark.parametrize("name", CHANGES)
def test_what_a_function_reads_is_part_of_its_program(name: str, notebook: Any) -> None:
    kept, function = Kept("a test"), notebook.FUNCTIONS[name]
    before = [of(kept, function) for _ in range(4)]  # the last by what is watched
    assert all(program is before[0] for program in before)
    assert kept.unchanged(function) is before[0]
    notebook.unread = 2.0
    assert kept.unchanged(function) is before[0]
    CHANGES[name](notebook)
    after = of(kept, function)
    assert after is not before[0]
    for program in (after, of(kept, function)):
        _, found = program.definition(X, steps=1)
        torch.testing.assert_close(found[:, 0], function(X))
    compiled = after.definition if name == "torch" else after  # a patched torch has no scalar form of its own
    torch.testing.assert_close(compiled(X, steps=1)[1][:, 0], function(X), rtol=1e-14, atol=1e-14)


def test_closures_of_equal_content_share_a_program(notebook: Any) -> None:
    kept = Kept("a test")
    first = of(kept, notebook.closing(2.0))
    assert of(kept, notebook.closing(2.0)) is first
    assert of(kept, notebook.closing(3.0)) is not first
    one, other = torch.tensor([2.0, 3.0], dtype=torch.float64)
    several = [of(kept, notebook.closing(by)) for by in (one, other)]
    for program, by in zip(several, (one, other), strict=True):
        torch.testing.assert_close(program(X, steps=1)[1][:, 0], X * by)


def test_a_function_that_an_editor_reloads_in_place_is_another(notebook: Any) -> None:
    kept = Kept("a test")
    before = of(kept, notebook.outer), of(kept, notebook.outer)
    notebook.inner.__code__ = (lambda x: 7 * x).__code__
    assert of(kept, notebook.outer) is not before[0]


def test_where_a_derivative_of_a_global_may_be_wanted_there_is_no_program(notebook: Any) -> None:
    kept, function = Kept("a test"), notebook.FUNCTIONS["tensor"]
    assert of(kept, function) is not None
    notebook.tensor.requires_grad_()
    assert of(kept, function) is None


def test_what_cannot_be_written_down_is_said_once_and_traced_at_every_call(
    notebook: Any, caplog: pytest.LogCaptureFixture
) -> None:
    kept, notebook.gain = Kept("a test"), (number for number in (2.0,))
    programs = [of(kept, notebook.FUNCTIONS["call"]) for _ in range(2)]
    assert programs[0] is not programs[1]
    (line,) = caplog.messages
    assert line.startswith("a test is traced again at every call")
    assert "generator" in line


class Module(nn.Module):
    """Of a user: what it computes is written elsewhere."""

    def __init__(self, function: Callable[[Tensor], Tensor]) -> None:
        super().__init__()
        self.function = function

    def forward(self, x: Tensor) -> Tensor:
        return self.function(x)


def test_a_function_of_rows_is_compiled_again(notebook: Any) -> None:
    module = Module(notebook.outer)
    row = RowFunction(module.forward, module, "a test")
    for _ in range(200):
        row(X)
    assert row.compiled
    notebook.gain = 5.0
    assert torch.equal(row(X), 5 * X)


def test_a_watch_of_surroundings_sees_what_lies_around_alone(notebook: Any) -> None:
    module = Module(notebook.FUNCTIONS["array"])
    module.note = []  # type: ignore[assignment]
    watch, whole = Watch(module, surroundings=True), Watch(module)
    module.note.append(1)  # type: ignore[union-attr, operator]
    assert watch.unchanged()
    assert not whole.unchanged()
    notebook.array[0] = 3.0
    assert not watch.unchanged()


def test_a_plant_that_reads_a_global_moves_by_its_number_of_the_moment(notebook: Any) -> None:
    class Plant(nn.Module):
        dim = 2

        def drift(self, x: Tensor) -> Tensor:
            return -notebook.inner(x)

    def states() -> Tensor:
        return simulate(Plant(), X, dt=0.01, steps=10_000)[:, 100]  # so many are compiled

    for gain in (2.0, 3.0, 2.0):
        notebook.gain = gain
        torch.testing.assert_close(states(), X * math.exp(-gain), rtol=1e-7, atol=0)


def test_large_arrays_are_read_again_and_small_ones_watched() -> None:
    small, large = np.zeros(10), np.zeros(100_000)
    assert Watch(lambda x: x * small[0]).unchanged()
    assert Watch(lambda x: x * large[0]).blind


def test_a_program_of_ones_own_step_reads_again_what_has_changed(notebook: Any) -> None:
    notebook.step = eval("lambda x, now, row: (inner(x), x * tensor)", vars(notebook))
    program = Program(notebook.step)
    for change in (lambda: None, lambda: setattr(notebook, "gain", 3.0), lambda: notebook.tensor.fill_(5.0)):
        change()
        assert program.compiles(X, steps=2)
        found, expected = program(X, steps=2), program.definition(X, steps=2)
        for one, other in zip(found, expected, strict=True):
            torch.testing.assert_close(one, other)


def test_a_pointer_cannot_be_written_down_and_is_a_users() -> None:
    pointer = ctypes.pointer(ctypes.c_double(1.0))
    assert skeleton(pointer) is None
    assert reads_users_code(pointer)


class Refusing:
    def __reduce__(self) -> Any:
        raise RuntimeError("not this one")


def deep() -> list[Any]:
    inner: list[Any] = []
    for _ in range(100_000):
        inner = [inner]
    return inner


@pytest.mark.parametrize("make", [Refusing, deep, itertools.count, threading.Lock])
def test_whatever_a_function_names_a_call_goes_on(make: Callable[[], Any], notebook: Any) -> None:
    notebook.step = eval("lambda x, now, row: (x if other is None else 2 * x, x)", vars(notebook))
    notebook.other = make()
    torch.testing.assert_close(Program(notebook.step)(X, steps=3)[0], 8 * X)
    assert of(Kept("a test"), notebook.step) is not None

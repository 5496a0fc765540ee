"""A step that reads something else than before (a global, a closure, an attribute, a tensor, a method) is not
served by what was compiled of it."""

from __future__ import annotations

import math
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from staf_torch import lanes
from staf_torch.lanes import compiled, ready
from staf_torch.lanes.compiled_methods import CompiledMethod
from staf_torch.lanes.dependencies.contents import Contents
from staf_torch.lanes.program import Program
from staf_torch.lanes.shared_programs import SharedPrograms

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


def of(kept: SharedPrograms, function: Callable[[Tensor], Tensor]) -> Program:
    """The program of a function, as chases, loops and simulations ask for it."""
    made = kept.unchanged(function)
    return made or kept.of(lambda x, _, __: (x, function(x)), function, owners=(function,))


def right(program: Any, function: Callable[[Tensor], Tensor]) -> None:
    """Fail where a program gives anything but what the function gives now."""
    torch.testing.assert_close(program(X, steps=1)[1][:, 0], function(X), rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize("name", CHANGES)
def test_a_function_is_computed_with_what_it_reads_at_the_moment(name: str, notebook: Any) -> None:
    kept, function = SharedPrograms("a test"), notebook.FUNCTIONS[name]
    own = Program(eval("lambda x, now, row: (x, f(x))", vars(notebook) | {"f": function}))
    before = [of(kept, function) for _ in range(4)]  # the last by what is watched
    assert all(program is before[0] for program in before)
    notebook.unread = 2.0
    assert kept.unchanged(function) is before[0]
    for program in (before[0], own):
        right(program, function)
    CHANGES[name](notebook)
    if name == "torch":  # one that somebody has replaced has no scalar form
        assert torch.equal(of(kept, function).definition(X, steps=1)[1][:, 0], X.sin())
        return
    for program in (of(kept, function), of(kept, function), own):
        right(program, function)


@pytest.mark.parametrize("name", ["__main__", "this", None])
def test_a_script_is_a_users_under_any_name_and_program_that_runs_it(
    name: str | None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """`python -m cProfile script.py` runs it as ``__main__``, which is the profiler; a file may hide one of
    Python's; text is run in a namespace without a name."""
    space: dict[str, Any] = {} if name is None else {"__name__": name}
    if name is not None:
        module = ModuleType(name)
        module.__file__ = pytest.__file__ if name == "__main__" else str(tmp_path / f"{name}.py")
        monkeypatch.setitem(sys.modules, name, module)
    space["gain"] = torch.tensor(2.0, dtype=torch.float64)
    exec("class Own:\n    def __call__(self, x):\n        return x * gain", space)
    exec("f = lambda x: x * gain", space)
    kept, functions = SharedPrograms("a test"), (space["f"], space["Own"]())
    for gain in (2.0, 3.0):
        space["gain"] = torch.tensor(gain, dtype=torch.float64)
        for function in functions:
            right(of(kept, function), function)
    space["gain"].requires_grad_()
    for function in functions:
        assert of(kept, function)(X, steps=1)[1].requires_grad


def test_a_tensor_that_is_given_other_memory_is_read_there() -> None:
    """Torch counts no write then: `vector_to_parameters` does so, and memory is soon used again."""
    net, kept = nn.Linear(2, 2, bias=False).double(), SharedPrograms("a test")
    own = Program(lambda x, _, __: (x, net(x)))
    for k in range(3):
        for _ in range(1 + k):
            nn.utils.vector_to_parameters(torch.randn(4, dtype=torch.float64), net.parameters())
        for program in (own, of(kept, net)):
            right(program, net)
    whole = torch.arange(2)
    picked = Program(lambda x, _, __: (x, x[:, whole]))
    for order in ([0, 1], [1, 0]):
        whole.data = torch.tensor(order)
        right(picked, lambda x: x[:, whole])


class ReadsMatrix(nn.Module):
    """x sum(A)."""

    def __init__(self, held: nn.Parameter) -> None:
        super().__init__()
        self.held = held

    @compiled("a matrix's sum")
    def forward(self, x: Tensor) -> Tensor:
        return x * self.held.sum()


UNCOUNTED: dict[str, Callable[[Tensor], object]] = {
    "a target network's copy": lambda held: held.data.copy_(0.9 * held.data + 0.1),
    "an entry of `.data`": lambda held: held.data.view(-1)[0].add_(1.0),
    "NumPy": lambda held: np.multiply(held.detach().numpy(), 1.5, out=held.detach().numpy()),
}
"""Writes that torch does not count."""


@pytest.mark.parametrize("how", UNCOUNTED)
@pytest.mark.parametrize("learned", [True, False])
def test_a_write_that_torch_does_not_count_is_seen(how: str, learned: bool) -> None:
    """Of a tensor of more than 64 kB (200 x 200) where it changes more than 64 numbers."""
    size = 90 if "entry" in how else 200 if learned else 1
    held = nn.Parameter(torch.rand(size, size, dtype=torch.float64), requires_grad=learned)
    policy, x = ReadsMatrix(held), torch.rand(3, 2, dtype=torch.float64)
    ready(policy, x)
    program = lanes.Program(lambda carry, now, row: (carry * held.sum(), carry))
    for _ in range(2):
        program(x, steps=2)
        policy(x)
    UNCOUNTED[how](held)
    torch.testing.assert_close(program(x, steps=2), program.definition(x, steps=2))
    torch.testing.assert_close(policy(x), x * held.sum())
    if learned:
        slopes = [torch.autograd.grad(f(x, steps=2)[0].sum(), held)[0] for f in (program, program.definition)]
        torch.testing.assert_close(*slopes)


@pytest.mark.parametrize("shape", [(2, 2), (2, 1)])
def test_a_matrix_that_is_turned_in_place_is_seen(shape: tuple[int, int]) -> None:
    """No number of its memory moves."""
    matrix, x = torch.rand(shape, dtype=torch.float64), torch.rand(3, 2, dtype=torch.float64)
    program = lanes.Program(lambda carry, now, row: (carry + (carry.unsqueeze(-1) * matrix).sum(1), carry))
    program(x, steps=2)
    for _ in range(2):
        matrix.t_()
        torch.testing.assert_close(program(x, steps=2), program.definition(x, steps=2))


def test_another_default_dtype_is_that_of_the_numbers_that_a_step_makes() -> None:
    x, before = torch.rand(3, 2, dtype=torch.float64), torch.get_default_dtype()

    program = lanes.Program(lambda x, now, row: (x * torch.full((2,), 0.1), x))
    try:
        for dtype in (torch.float32, torch.float64, torch.float32):
            torch.set_default_dtype(dtype)
            wanted = x * torch.tensor(0.1, dtype=dtype).double()
            assert torch.equal(program(x, steps=1)[0], wanted)
            assert program.compiles(x, steps=1)
    finally:
        torch.set_default_dtype(before)


def test_closures_of_equal_content_share_a_program_and_others_do_not(notebook: Any) -> None:
    kept = SharedPrograms("a test")
    first = of(kept, notebook.closing(2.0))
    assert of(kept, notebook.closing(2.0)) is first
    assert of(kept, notebook.closing(3.0)) is not first
    for by in torch.tensor([2.0, 3.0], dtype=torch.float64):
        right(of(kept, notebook.closing(by)), lambda x, by=by: x * by)


class Held(nn.Module):
    """Of a user: it computes with numbers of every kind, some of them inside of others."""

    def __init__(self, function: Callable[[Tensor], Tensor] = torch.sin) -> None:
        super().__init__()
        self.register_buffer("gain", torch.full((2,), 2.0).double())
        self.inner = nn.Sequential(nn.Linear(2, 2), nn.Tanh()).double().requires_grad_(False)
        self.setting, self.function, self.notes, self.table = 1.0, function, [1.0], np.ones(2)

    def forward(self, x: Tensor) -> Tensor:
        noted = self.setting * self.notes[0] * float(self.table[0])
        return noted * self.gain * self.function(self.inner(x)) * (2 if self.training else 1)


class Policy(nn.Module):
    """Of a user, compiled by a line."""

    def __init__(self) -> None:
        super().__init__()
        self.inner, self.scale = Held(), 1.0

    @compiled("a policy of a test")
    def forward(self, x: Tensor) -> Tensor:
        return self.scale * self.inner(x)

    @compiled("another method")
    def other(self, x: Tensor) -> Tensor:
        return self.inner(x)


class Noisy(nn.Module):
    @compiled("a noisy test")
    def forward(self, x: Tensor) -> Tensor:
        return x + torch.randn(x.shape)


PARTS: dict[str, Callable[[Held], Any]] = {
    "a number": lambda m: setattr(m, "setting", 2.0),
    "an entry of a list": lambda m: m.notes.__setitem__(0, 3.0),
    "an array": lambda m: m.table.__setitem__(0, 2.0),
    "another buffer": lambda m: setattr(m, "gain", torch.ones(2).double()),
    "a buffer in place": lambda m: m.gain.zero_(),
    "a weight in place": lambda m: m.inner[0].weight.mul_(2),
    "another weight": lambda m: setattr(
        m.inner[0], "bias", nn.Parameter(torch.ones(2).double(), requires_grad=False)
    ),
    "another part": lambda m: m.inner.__setitem__(1, nn.Sigmoid()),
    "another function": lambda m: setattr(m, "function", torch.cos),
    "a mode": lambda m: m.eval(),
    "a hook": lambda m: m.inner.register_forward_hook(lambda *given: given[2] + 1),
}


@pytest.mark.parametrize("part", PARTS)
def test_a_module_is_computed_as_it_is_at_the_moment(part: str) -> None:
    module = Held()
    row, kept = CompiledMethod(module.forward, module, compiled("a test")), SharedPrograms("a test")
    row.hasten()
    for _ in range(3):
        torch.testing.assert_close(row(X), module(X), rtol=1e-13, atol=1e-14)
        right(of(kept, module), module)
    assert row.compiled
    unchanged = kept.unchanged(module)
    assert unchanged is not None
    before = module(X)
    PARTS[part](module)
    assert not torch.allclose(module(X), before)
    assert kept.unchanged(module) is None
    torch.testing.assert_close(row(X), module(X), rtol=1e-13, atol=1e-14)
    right(of(kept, module), module)
    for _ in range(2):  # the second time it is known again
        again = of(kept, module)
    assert kept.unchanged(module) is again


class Slots:
    __slots__ = ("number",)


def test_what_cannot_be_watched_is_read_at_every_call() -> None:
    small, large, part = np.zeros(10), np.zeros(100_000), Slots()
    part.number = 1.0
    assert Contents(lambda x: x * small[0]).reason is None
    for value in (lambda x: x * large[0], part, (x for x in ())):
        assert Contents(value).reason is not None
    kept = SharedPrograms("a test")
    for number in (1.0, 1.0, 2.0):
        part.number = number
        program = kept.of(lambda x, _, __: (x, x * part.number), part, owners=(part,))
        assert kept.unchanged(part) is None
        right(program, lambda x, number=number: x * number)


class Refusing:
    def __reduce__(self) -> Any:
        raise RuntimeError("not this one")


def deep() -> list[Any]:
    inner: list[Any] = []
    for _ in range(100_000):
        inner = [inner]
    return inner


UNWRITTEN = (
    Refusing,
    deep,
    threading.Lock,
)


@pytest.mark.parametrize("make", UNWRITTEN)
def test_whatever_a_function_names_a_call_goes_on_and_the_log_says_what_it_costs(
    make: Callable[[], Any], notebook: Any, caplog: pytest.LogCaptureFixture
) -> None:
    notebook.step = eval("lambda x, now, row: (x if other is None else 2 * x, 2 * x)", vars(notebook))
    notebook.other = make()
    torch.testing.assert_close(Program(notebook.step)(X, steps=3)[0], 8 * X)
    caplog.clear()
    kept = SharedPrograms("a test")
    for _ in range(2):
        program = kept.of(notebook.step, notebook.step)
        right(program, lambda x: 2 * x)
    assert [line.startswith("a test is traced again at every call") for line in caplog.messages] == [True]


def test_a_policy_is_ready_before_its_loop_begins_or_says_that_it_cannot_be(
    caplog: pytest.LogCaptureFixture,
) -> None:
    module, policy = Held(), Policy()
    assert not policy.forward.compiled
    assert ready(policy, X[0])
    assert policy.forward.compiled
    torch.testing.assert_close(policy(X[0]), policy.inner(X[0]), rtol=1e-13, atol=1e-13)
    assert not ready(nn.Linear(2, 2).double(), X)
    assert ready(nn.Sequential(policy, module), X[0])  # none of its other methods is asked
    assert not ready(nn.Sequential(policy, Noisy()), X[0])
    assert "draws random numbers" in caplog.text


def test_what_cannot_be_watched_is_said_once_and_taken_as_it_stands(caplog: pytest.LogCaptureFixture) -> None:
    policy = Policy()
    policy.table = np.zeros(100_000)
    for _ in range(2):
        assert ready(policy, X)
    (line,) = caplog.messages
    assert "are not noticed: an array of 800000 bytes" in line


@pytest.mark.parametrize("shape", [(2,), (5, 2), (2, 1, 3, 2), (0, 2)])
def test_a_function_of_rows_takes_states_of_any_leading_dimensions(shape: tuple[int, ...]) -> None:
    x = torch.randn(shape, dtype=torch.float64)
    for _ in range(2):
        torch.testing.assert_close(ANY(x), MODULE(x), rtol=1e-13, atol=1e-14)
    learned = x.clone().requires_grad_()
    assert ANY(learned).requires_grad
    if x.dim() == 2 and len(x):
        torch.testing.assert_close(torch.func.vmap(ANY)(x), MODULE(x))


MODULE = Held()
ANY = CompiledMethod(MODULE.forward, MODULE, compiled("a test"))
ANY.hasten()


@pytest.mark.parametrize(("rows", "most"), [(1, 101), (1000, 17), (20_000, 0)])
def test_a_function_is_compiled_once_its_calls_would_have_paid_for_it(rows: int, most: int) -> None:
    """A long batch pays for itself; a hundred calls of a single row do."""
    module = Held()
    row, x = CompiledMethod(module.forward, module, compiled("a test")), torch.ones(rows, 2).double()
    calls = 0
    while not row.compiled:
        row(x)
        calls += 1
    assert most // 2 <= calls - 1 <= most


@pytest.mark.parametrize("outside", [False, True])
def test_what_a_step_writes_between_two_uses_is_read_as_it_was_then(outside: bool) -> None:
    """Also where the numbers beside it change afterwards."""
    weights, held = torch.tensor([2.0, 3.0]).double(), torch.zeros(2).double()

    def step(x: Tensor, u: Tensor, row: object) -> tuple[Tensor, Tensor]:
        buffer = held.zero_() if outside else torch.zeros(2).double()
        buffer[0] = 1.0
        first = (weights * buffer).sum()
        buffer[1] = 2.0
        return 0.1 * first * x + (weights * buffer).sum() + u, x

    program, given = lanes.Program(step), (torch.ones(3).double(), torch.ones(3, 4).double())
    for weight in (2.0, 5.0):
        weights[0] = weight
        with lanes.compiling("always"):
            torch.testing.assert_close(program(*given)[0], program.definition(*given)[0])

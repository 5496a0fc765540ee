"""When a function of rows is compiled, how often, for which shapes; which program serves which rows."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from staf_torch import lanes
from staf_torch.lanes import function as functions
from staf_torch.lanes import program as programs
from staf_torch.lanes.function import RowFunction, Rows, ready
from staf_torch.lanes.kept import Kept, _identities, number
from staf_torch.lanes.program import Program
from staf_torch.lanes.tracer import NotLoweredError


class Served:
    """In the place of a compiled function: y = 2 x, and what it was called with."""

    compiled = True

    def __init__(self) -> None:
        self.shapes: list[tuple[int, ...]] = []

    def __call__(self, x: Tensor) -> Tensor:
        self.shapes.append(tuple(x.shape))
        return (2 * x).reshape(-1, 1, x.shape[-1])


class Held(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("gain", torch.ones(2))
        self.inner = nn.Sequential(nn.Linear(2, 2)).requires_grad_(False)
        self.setting = 1.0

    def forward(self, x: Tensor) -> Tensor:
        return 3 * x


def function_of(module: nn.Module) -> tuple[RowFunction, list[Served]]:
    made: list[Served] = []

    def compile() -> Served:
        made.append(Served())
        return made[-1]

    return RowFunction(module.forward, module, "a test", compile), made


def calls_until(row: RowFunction, made: list[Served], x: Tensor) -> int:
    """Calls in plain torch before the first that is served."""
    for count in range(200):
        row(x)
        if made:
            return count
    raise AssertionError("never")


@pytest.mark.parametrize(
    ("rows", "calls"), [(1, 100), (200, 50), (1000, 16), (10_000, 1), (19_999, 1), (20_000, 0)]
)
def test_a_function_is_compiled_where_its_calls_would_have_paid_for_it(rows: int, calls: int) -> None:
    """A call is worth 1, and a two hundredth for every row: a hundred pay."""
    row, made = function_of(Held())
    assert not row.compiled
    assert calls_until(row, made, torch.ones(rows, 2)) == calls
    assert row.compiled
    assert len(made) == 1


def test_a_function_that_is_hastened_is_compiled_at_once_and_asked_for_states_of_any_shape() -> None:
    row, made = function_of(Held())
    row.hasten()
    for shape in ((2,), (5, 2), (1, 2), (3, 4, 2), (2, 1, 3, 2)):
        x = torch.randn(shape)
        assert torch.equal(row(x), 2 * x)
        assert row(x).shape == x.shape
    assert made[0].shapes[::2] == [(2,), (5, 2), (1, 2), (12, 2), (6, 2)]
    served = len(made[0].shapes)
    assert torch.equal(row(torch.ones(2, requires_grad=True)), 3 * torch.ones(2))
    assert row(torch.ones(0, 2)).shape == (0, 2)
    assert torch.equal(torch.func.vmap(row)(torch.ones(3, 2)), 3 * torch.ones(3, 2))
    with lanes.combinators.tracing(None):  # type: ignore[arg-type]
        pass
    assert len(made[0].shapes) == served
    assert len(made) == 1


CHANGES: dict[str, Callable[[Held], Any]] = {
    "a number": lambda m: setattr(m, "setting", 2.0),
    "another attribute": lambda m: setattr(m, "more", 2.0),
    "one less": lambda m: delattr(m, "setting"),
    "a buffer": lambda m: setattr(m, "gain", torch.zeros(2)),
    "a buffer in place": lambda m: m.gain.zero_(),
    "a weight in place": lambda m: m.inner[0].weight.zero_(),
    "a part": lambda m: m.inner.__setitem__(0, nn.Tanh()),
    "a mode": lambda m: m.eval(),
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_function_is_compiled_again_once_its_module_is_another(change: str) -> None:
    module = Held()
    row, made = function_of(module)
    row.hasten()
    for _ in range(3):
        row(torch.ones(2))
    assert len(made) == 1
    CHANGES[change](module)
    for _ in range(3):
        row(torch.ones(2))
    assert len(made) == 2


def test_a_module_is_ready_where_all_its_functions_are() -> None:
    holder, calls = nn.Module(), []
    one, made = function_of(Held())
    two, others = function_of(Held())
    holder.one, holder.two, holder.inner = one, two, nn.Module()
    holder.forward = lambda x: (calls.append(torch.is_grad_enabled()), one(x), two(x))
    assert ready(holder, torch.ones(2))
    assert calls == [False]
    assert len(made) == len(others) == 1
    Served.compiled = False
    try:
        assert not ready(holder, torch.ones(2))
    finally:
        Served.compiled = True
    holder.forward = lambda x: one(x)
    third, _ = function_of(Held())
    holder.inner.third = third
    assert not ready(holder, torch.ones(2))
    assert not ready(nn.Linear(2, 2), torch.ones(1, 2))


class Planned:
    """In the place of a program's prepared call."""

    def __init__(self, seen: list[Any]) -> None:
        self.seen, self.plan = seen, lambda given: ["again", tuple(x.shape for x in given)]

    def __call__(self, carry: Any, now: Any, row: tuple[Tensor, ...]) -> tuple[Any, str]:
        self.seen.append(tuple(tuple(x.shape) for x in row))
        return (), "first"


def test_rows_find_a_plan_once_for_a_form_and_forget_all_beyond_many(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[Any] = []
    rows = Rows(lambda x: x, "a test")
    steps: list[int | None] = []

    def prepare(carry: Any, now: Any, given: Any, *, steps: int | None = None) -> Planned:
        asked.append(steps)
        return Planned(seen)

    asked = steps
    monkeypatch.setattr(rows._program, "prepare", prepare)
    assert not rows.compiled
    assert rows(torch.ones(3)) == "first"
    assert seen == [((1, 3),)]
    assert asked == [1]
    assert rows.compiled
    assert rows(torch.ones(3)) == "again"
    forms = [torch.ones(2, 3), torch.ones(3, 2).mT, torch.ones(2, 3).double(), torch.ones(3, 3)]
    assert [rows(x) for x in forms] == ["first"] * 4
    assert [rows(x) for x in forms] == ["again"] * 4
    assert rows(torch.ones(2, 3), torch.ones(3)) == "first"
    assert seen[-1] == ((2, 3), (1, 3))
    monkeypatch.setattr(functions, "_KEPT", 6)
    assert len(rows._plans) == 6
    rows(torch.ones(7, 1))
    assert len(rows._plans) == 1
    assert functions._KEPT == 6


def test_rows_of_no_plan_are_not_remembered(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = Rows(lambda x: 2 * x, "a test")
    monkeypatch.setattr(rows._program, "compile", False)
    for _ in range(2):
        assert torch.equal(rows(torch.ones(2, 3)), 2 * torch.ones(2, 1, 3))
    assert not rows.compiled
    assert rows._program.copies == 1
    kept = Rows(torch.sin, "another test", torch.sin)
    assert kept._program.copies == 1
    assert Rows(torch.sin, "another test", torch.sin)._program is kept._program


# Programs.


@pytest.fixture
def sources(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The texts that a compiler would be given; what it makes does nothing."""
    seen: list[str] = []

    def function(source: str) -> Callable[..., None]:
        seen.append(source)
        return lambda *_: None

    monkeypatch.setattr(programs.compiler, "function", function)
    monkeypatch.setattr(programs, "_said", set())
    return seen


def step(carry: Tensor, now: Any, row: Any) -> tuple[Tensor, Tensor]:
    return 0.5 * carry, carry.sin()


def test_up_to_eight_rows_advance_one_vector_at_a_time(sources: list[str]) -> None:
    for rows, copies in ((1, 1), (8, 1), (9, 2)):
        assert Program(step).compiles(torch.zeros(rows, 2), steps=3)
        assert f"COPIES = {copies}," in sources[-1]
    assert Program(step, copies=3).compiles(torch.zeros(1, 2), steps=3)
    assert "COPIES = 3," in sources[-1]
    program = Program(step)
    for rows in (1, 5, 8, 30, 40):
        assert program.compiles(torch.zeros(rows, 2), steps=3)
    assert len(sources) == 6  # two for the last


def test_what_a_compiler_would_take_minutes_for_is_not_given_to_it(
    sources: list[str], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    x = torch.zeros(2, 2)
    lines = Program(step, copies=1).text(x, steps=3).count("\n")
    assert programs._LONGEST == 20_000
    for most, compiles in ((lines, True), (lines - 1, False)):
        monkeypatch.setattr(programs, "_LONGEST", most)
        assert Program(step, name="a test").compiles(x, steps=3) is compiles
    (line,) = caplog.messages
    told = f"the program is {lines} lines long, which take a compiler minutes"
    assert line.startswith(f"a test runs in plain torch, slower: {told} at ")


def test_a_reason_is_said_once_and_in_four_hundred_letters_and_a_missing_compiler_once_for_all_reasons(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(programs, "_said", set())
    for name, reason, kind in (
        *(("one", "a  b\nc" + "x" * 500, None), ("one", "a b c" + "x" * 500, None), ("one", "other", None)),
        *(("two", "other", None), ("two", "no compiler", "no build"), ("two", "no room", "no build")),
    ):
        programs._say(name, reason, kind)
    told = [line.partition(" runs in plain torch, slower: ")[::2] for line in caplog.messages]
    assert told == [("one", "a b c" + "x" * 395), ("one", "other"), ("two", "other"), ("two", "no compiler")]


def test_calls_of_sixty_four_forms_are_remembered(monkeypatch: pytest.MonkeyPatch) -> None:
    program, asked = Program(step, compile=False), []
    prepare = program.prepare
    monkeypatch.setattr(program, "prepare", lambda *a, **k: (asked.append(k), prepare(*a, **k))[1])
    for rows in range(1, 65):
        program(torch.zeros(rows, 1), steps=1)
    program(torch.zeros(1, 1), steps=1)
    assert len(asked) == len(program._prepared) == 64
    for k, options in enumerate(({"steps": 2}, {"steps": 1, "every": 2}, {"steps": 1}), start=65):
        program(torch.zeros(1, 1), **options)
        assert len(asked) == k
    assert len(program._prepared) == 3
    assert asked[-2] == {"steps": 1, "every": 2}


def test_a_program_with_other_tensors_keeps_its_name_its_copies_and_what_is_known_of_its_rows() -> None:
    first = Program(step, name="mine", compile=False, copies=3)
    first._of_users, first._asked, first._refused = False, 2, "why"
    other = first.with_others(step, [])
    assert (other.name, other.compile, other.copies) == ("mine", False, 3)
    assert (other._of_users, other._asked, other._refused) == (False, 2, "why")
    program = Program(step)
    assert (program.name, program.compile, program.copies) == ("program", True, 0)
    program.described(b"x", [])
    assert program._described == (b"x", [])
    assert program._of_users is False
    program.described(None, [])
    assert program._described is None
    assert program._of_users is None


def test_a_step_is_asked_for_one_row_and_once_more_for_more(
    sources: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[int] = []
    monkeypatch.setattr(programs, "doubt", lambda step, given: asked.append(given.rows))
    program = Program(step)
    for rows in (1, 1, 3, 2, 5):
        assert program.compiles(torch.zeros(rows, 2), steps=1)
    assert asked == [1, 3]
    program.described(b"x", [])  # nothing of a user
    program._asked = 0
    assert program.compiles(torch.zeros(2, 2), steps=1)
    assert asked == [1, 3]


def test_a_header_starts_with_the_first_row_and_has_the_names_of_its_trees() -> None:
    def moved(carry: Any, now: Any, row: Any) -> tuple[Any, Any]:
        return {"x": carry["x"] + now * row["gain"]}, (carry["x"], now)

    carry = {"x": torch.tensor([[0.5, 2.0], [7.0, 9.0]], dtype=torch.float64)}
    given = carry, torch.ones(2, 4, 2).double(), {"gain": torch.ones(2, 1).double()}
    text = Program(moved).c_source("go", *given, note="a word")
    assert " * a word\n" in text
    for part in ("state->x[0] = 0.5;", "state->x[1] = 2.0;", "const double now[2]", "const double gain[1]"):
        assert part in text
    assert "double out0[2], double out1[2])" in text
    assert "/*" not in Program(moved).c_source("go", *given, outputs=["a", "b"])
    assert "double a[2], double b[2])" in Program(moved).c_source("go", *given, outputs=["a", "b"])
    count = iter(range(99))
    other = Program(lambda c, n, r: (c, n * next(count)))
    with pytest.raises(NotLoweredError, match="its step gives other numbers when it is called again"):
        other.c_source("go", torch.zeros(1), torch.ones(1, 1))


# What is kept.


def test_numbers_of_a_name_are_one_tensor_of_double() -> None:
    assert number("a", 0.1) is number("a", 0.1)
    assert number("a", 0.1) is not number("b", 0.1)
    assert number("a", 0.2) is not number("a", 0.1)
    assert number("a", 0.1).dtype == torch.float64
    assert float(number("a", 0.1)) == 0.1


def test_the_latest_programs_are_kept_and_no_more() -> None:
    kept = Kept("a test", most=2)
    programs = [kept.of(step, k, copies=k) for k in (1, 2)]
    assert [p.copies for p in programs if p is not None] == [1, 2]
    assert kept.of(step, 1, copies=1) is programs[0]  # which is now the latest
    third = kept.of(step, 3)
    assert third is not None
    assert third.copies == 0
    assert third.name == "a test"
    assert kept.of(step, 1, copies=1) is programs[0]
    assert kept.of(step, 2, copies=2) is not programs[1]
    for owner in ("a", "b"):
        for _ in range(2):
            kept.of(step, owner, owners=(owner,))
    assert kept.unchanged("b") is not None
    assert kept.unchanged("a") is not None
    for _ in range(2):
        kept.of(step, "c", owners=("c",))
    assert kept.unchanged("a") is None
    assert kept.unchanged("b") is not None
    assert Kept("x")._most == 64


def test_owners_are_known_by_themselves_and_settings_by_their_value() -> None:
    one, other = [1], [1]
    assert _identities((one, 3, "x")) == _identities((one, 3, "x"))
    assert _identities((one,)) != _identities((other,))
    assert _identities((one, 3)) != _identities((one, 4))
    assert _identities((10**9, "long " * 2)) == (10**9, "long long ")


def test_a_derivative_that_nobody_can_want_keeps_no_program_away() -> None:
    learned = torch.ones(2, requires_grad=True)
    kept = Kept("a test")
    assert kept.of(step, learned, owners=(learned,)) is None
    with torch.no_grad():
        for _ in range(2):
            program = kept.of(step, learned, owners=(learned,))
        assert program is not None
        assert kept.unchanged(learned) is program
    assert kept.unchanged(learned) is None


def test_what_cannot_be_written_down_has_a_program_of_its_own_with_its_copies(
    caplog: pytest.LogCaptureFixture,
) -> None:
    kept = Kept("odd")
    made = [kept.of(step, (k for k in ()), copies=2) for _ in range(2)]
    assert [p.copies for p in made if p is not None] == [2, 2]
    assert [p._described for p in made if p is not None] == [None, None]
    assert made[0] is not made[1]
    (line,) = caplog.messages
    assert line.startswith("odd is traced again at every call: what it reads cannot be written down: ")

"""What has no compiled form runs as it was written, and one line of the log says why and where."""

from __future__ import annotations

import random
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import staf_torch as st
from staf_torch import lanes
from staf_torch.lanes import Program, Shared
from staf_torch.lanes.dependencies.contents import Contents
from staf_torch.lanes.shared_programs import Rows
from staf_torch.lanes.trace.tracer import NotLoweredError

pytestmark = pytest.mark.needs_compiler

X = torch.linspace(-1, 1, 10, dtype=torch.float64).view(5, 2)


def mean(x: Tensor) -> Tensor:
    return x - x.mean(0)


def of_the_size(x: Tensor) -> Tensor:
    return x if len(x) > 1 else 2 * x


def of_the_first(x: Tensor) -> Tensor:
    return x * x[0].sum()


def of_the_clock(x: Tensor) -> Tensor:
    return x * time.perf_counter()


OTHERS: dict[str, tuple[Callable[[Tensor], Tensor], str]] = {
    "torch": (lambda x: x + torch.randn(x.shape), "draws random numbers"),
    "torch, in place": (lambda x: x + torch.empty_like(x).normal_(), "draws random numbers"),
    "dropout": (lambda x: torch.nn.functional.dropout(x), "draws random numbers"),
    "NumPy": (lambda x: x + np.random.randn(), "called again"),  # noqa: NPY002
    "Python": (lambda x: x + random.random(), "called again"),
    "a clock": (of_the_clock, "called again"),
    "a mean over the batch": (mean, "beside another row"),
    "the size of the batch": (of_the_size, "beside another row"),
    "the first row": (of_the_first, "beside another row"),
    "one row alone": (lambda x: x.view(1, 2) * 1.0, "one row but not two"),
}


@pytest.mark.parametrize("name", OTHERS)
def test_what_is_no_function_of_a_row_is_not_compiled(name: str, caplog: pytest.LogCaptureFixture) -> None:
    function, reason = OTHERS[name]
    program = Program(lambda x, _, __: (x, function(x)), name=f"{name}, refused")
    assert not program.compiles(X, steps=3)
    (line,) = caplog.messages
    assert line.startswith(f"{name}, refused runs in plain torch, slower: ")
    assert reason in line


def test_to_compile_draws_no_random_number() -> None:
    torch.manual_seed(3), random.seed(3), np.random.seed(3)  # noqa: NPY002
    expected = torch.rand(1).item(), random.random(), np.random.rand()  # noqa: NPY002
    torch.manual_seed(3), random.seed(3), np.random.seed(3)  # noqa: NPY002
    for name in ("NumPy", "Python", "torch"):
        assert not Program(lambda x, _, __, name=name: (x, OTHERS[name][0](x))).compiles(X, steps=3)
    assert (torch.rand(1).item(), random.random(), np.random.rand()) == expected  # noqa: NPY002


def test_a_mean_is_seen_once_there_is_more_than_a_row() -> None:
    program = Program(lambda x, _, __: (x, x - x.mean(0)))
    assert program.compiles(X[:1], steps=3)  # of a single row it is a function of the row
    assert not program.compiles(X, steps=3)
    same = X[:1].expand(3, 2).contiguous()
    assert Program(lambda x, _, __: (x, x - x.mean(0))).compiles(same, steps=3)  # nothing tells here
    mixed = torch.cat((same, X[-1:]))
    assert not Program(lambda x, _, __: (x, x - x.mean(0))).compiles(mixed, steps=3)


def test_a_generator_that_a_step_seeds_itself_repeats_its_numbers() -> None:
    def step(x: Tensor, now: object, row: object) -> tuple[Tensor, Tensor]:
        return x, x + torch.randn(2, generator=torch.Generator().manual_seed(0), dtype=x.dtype)

    program = Program(step)
    assert program.compiles(X, steps=2)
    torch.testing.assert_close(program(X, steps=2)[1], program.definition(X, steps=2)[1])


@pytest.mark.compiled
def test_a_chase_of_noisy_values_has_new_noise_at_every_time(caplog: pytest.LogCaptureFixture) -> None:
    states = X[None, 2:3].expand(1, 200, 2).contiguous()
    basis = st.StaFBasis(st.GaussianKernel(), st.StateFollowingCenters(st.rings(3), 0.3))

    def noisy(x: Tensor) -> Tensor:
        return x.square().sum(-1) + 0.1 * torch.randn(x.shape[:-1], dtype=x.dtype)

    found = st.chase_weights(states, basis, noisy, st.optim.Exact(), inner_steps=1).weights
    assert len(found[0, :, 0].unique()) == 200
    (line,) = caplog.messages
    assert "a chase runs in plain torch, slower" in line


class Noisy(torch.nn.Module):
    """Of a user, inside of a step that this library wrote."""

    def forward(self, x: Tensor) -> Tensor:
        return x + random.random()


def test_code_of_a_user_is_found_inside_of_the_librarys(caplog: pytest.LogCaptureFixture) -> None:
    rows = Rows(Noisy(), "a test")
    assert len({float(rows(X)[0, 0, 0]) for _ in range(5)}) == 5
    assert "called again" in caplog.text
    assert Contents(Noisy().forward).of_users
    assert not Contents(torch.nn.Linear(2, 2), st.GaussianKernel(), torch.tanh).of_users


def test_what_a_step_reads_now_is_asked_anew_of_a_single_row_too() -> None:
    held = torch.nn.Sequential(torch.nn.Identity())
    program = Program(lambda carry, now, row: (carry, held(row)))
    x, none = X[:1], torch.zeros(1, 1).double()
    assert torch.equal(program(none, none, x)[1][0, 0], x[0])
    held[0] = Noisy()
    assert len({float(program(none, none, x)[1][0, 0, 0]) for _ in range(5)}) == 5


@pytest.mark.parametrize("mixed", [False, True])
def test_what_rounding_decides_says_nothing_of_a_row(mixed: bool) -> None:
    def step(x: Tensor, now: object, row: object) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        rounded = x.sin() * (1 + 3e-16 * len(x))  # as another order of sums does
        other = x - x.mean(0) if mixed else x
        return 0.5 * x, ((1e18 * rounded).remainder(2.0), other)

    x = torch.linspace(0.1, 0.9, 6, dtype=torch.float64)
    assert Program(step).compiles(x, steps=2) is not mixed


def test_what_is_zero_but_for_rounding_at_a_point_is_tried_beside_it(
    caplog: pytest.LogCaptureFixture,
) -> None:
    known = torch.cat(
        (torch.zeros(1, 2).double(), torch.linspace(-1, 2, 48, dtype=torch.float64).view(24, 2).sin())
    )
    known[:, 1] += torch.arange(25) / 9
    gram = (-0.5 * torch.cdist(known, known).square()).exp() + 1e-10 * torch.eye(25).double()
    inverse, x0 = torch.linalg.inv(gram), torch.zeros(3, 2, dtype=torch.float64)

    def variance(x: Tensor) -> Tensor:
        k = (-0.5 * (x.unsqueeze(-2) - known).square().sum(-1)).exp()
        return 1 - (k @ inverse * k).sum(-1)  # at x = 0 two rows are summed in another order than one

    x1 = torch.cat((x0[:1], 0.1 * torch.eye(2, dtype=torch.float64)))
    for name, function, x, compiles in (
        ("a variance", variance, x0, True),
        ("a variance", variance, x1, True),
        ("beside a mean", lambda x: variance(x) + x.mean(), x1, False),
    ):
        assert Program(lambda c, _, __, f=function: (c, f(c)), name=name).compiles(x, steps=1) is compiles
        assert ("beside another row" in caplog.text) is not compiles


def test_loops_are_tried_by_a_few_passes_and_all_calls_are_seen(caplog: pytest.LogCaptureFixture) -> None:
    """What a user's function does with its rows, every pass does."""
    calls = list[int]()
    rows = torch.linspace(0.0, 1.0, 6, dtype=torch.float64)[:, None]
    for mixed in (False, True):

        def halved(x: Tensor, mixed: bool = mixed) -> Tensor:
            calls.append(len(x))
            return 0.5 * x + 0.1 * (x.mean(0) if mixed else 1.0)

        calls.clear(), caplog.clear()
        program = Program(lambda carry, _, __, f=halved: (lanes.repeat(100, f, carry), ()), name="many")
        assert program.compiles(rows, (), (), steps=1) is not mixed
        assert len(calls) < 60
        assert ("beside another row" in caplog.text) is mixed
        if not mixed:
            torch.testing.assert_close(program(rows, (), (), steps=1)[0], torch.full_like(rows, 0.2))


def test_a_step_that_writes_into_its_inputs_is_tried_with_copies() -> None:
    def step(carry: Tensor, now: Any, row: Any) -> tuple[Tensor, Any]:
        for part in (carry, *now):
            part.zero_()
        return carry + 1, ()

    inputs = torch.rand(4, 2), (torch.rand(4, 3, 2), Shared(torch.rand(3)))
    before = inputs[0].clone(), inputs[1][0].clone(), inputs[1][1].tensor.clone()
    assert Program(step).compiles(*inputs)
    assert torch.equal(Program(step)(*inputs)[0], torch.ones(4, 2))
    for one, other in zip((inputs[0], inputs[1][0], inputs[1][1].tensor), before, strict=True):
        assert torch.equal(one, other)


# What has no scalar form.

A = torch.tensor([1.0, 2.0], dtype=torch.float64)
REFUSED: dict[str, tuple[Callable[[Tensor], Any], str]] = {
    "a value of a row": (lambda x: x if bool(x.sum() > 0) else -x, "reads a value of a row"),
    "what to write": (lambda x: x * x[0, 0].item(), "; write `torch.where(condition, a, b)`"),
    "entries of a mask": (lambda x: x[x > 0], "at a mask that the row computes"),
    "singular values": (
        lambda x: torch.linalg.svdvals(x.unsqueeze(-1)),
        "write `torch.linalg.eigh(A.mT @ A)`",
    ),
    "half": (lambda x: x.half(), "compute in float32 or float64"),
    "an index of a row": (lambda x: x.nonzero(), "reads a value of a row"),
    "NumPy": (lambda x: torch.as_tensor(x.numpy()), "`Tensor.numpy` takes numbers of a row out of torch"),
    "another dtype": (lambda x: x.to(torch.complex128), "is not supported in compiled programs"),
    "bits": (lambda x: x.long() & 1, "logic on the bits of integers"),
    "no rows": (lambda x: x.sum(), "an output of the step has no dimension of rows"),
    "an error": (lambda x: x[:, 7], "IndexError"),
    "an unknown": (lambda x: torch.special.i0(x), "i0"),
    "a scatter that multiplies": (
        lambda x: x.scatter(1, x.argsort(), x, reduce="multiply"),
        "`scatter` with reduce=",
    ),
    "written at an index that was captured": (
        lambda x: x.index_put((torch.tensor([0]), A.argsort()[:1]), x[:, 0]),
        "`aten.index_put` at an index that the row computes",
    ),
    "two indices": (
        lambda x: x[torch.tensor([0]), x.argmax(-1)],
        "`aten.index` at an index that the row computes",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_an_operation_without_a_scalar_form_is_named_with_its_line(name: str) -> None:
    function, why = REFUSED[name]
    program = Program(lambda carry, now, row: (carry, function(row)))
    with pytest.raises(NotLoweredError) as error:
        program.text(X[:, 0], (), X, steps=1)
    assert why in str(error.value)
    assert name == "no rows" or f"{__name__.rpartition('.')[2]}.py" in str(error.value)


def test_a_carry_keeps_its_shapes_its_kinds_and_its_tree() -> None:
    x = torch.ones(2, 3)
    changes: tuple[Callable[[Tensor], Any], ...] = (
        *(lambda c: c[:, :2], lambda c: c.double(), lambda c: (c,), lambda c: {"c": c}),
    )
    for after in changes:
        with pytest.raises(NotLoweredError, match="a carry of other shapes or dtypes than it was given"):
            Program(lambda c, n, r, f=after: (f(c), ())).text(x, steps=1)
    with pytest.raises(NotLoweredError, match=r": \(1, 3\) torch.float32 became \(1, 3\) torch.float64"):
        Program(lambda c, n, r: (c.double(), ())).text(x, steps=1)


@pytest.mark.parametrize("kind", [torch.float32, torch.float16])
def test_a_network_of_another_precision_is_named_with_what_to_write(kind: torch.dtype) -> None:
    net = torch.nn.Linear(2, 2, dtype=kind)

    class Own(torch.nn.Module):
        @lanes.compiled("one of mine")
        def forward(self, x: Tensor) -> Tensor:
            return net(x)  # type: ignore[no-any-return]

    program = Program(lambda x, _, __: (net(x), ()), name="one of mine")
    plain = Program(program.step, name="one of mine", compile=False)
    calls = (lambda: program.c_source("f", X), lambda: program(X, steps=3), lambda: plain(X, steps=3))
    for call in (*calls, lambda: Own()(X)):
        with pytest.raises(
            ValueError, match=r"^one of mine: its inputs are torch.float64, .* `net.to\(torch"
        ):
            call()


def test_a_text_that_would_take_a_compiler_minutes_is_not_given_to_it(
    caplog: pytest.LogCaptureFixture,
) -> None:
    def step(x: Tensor, now: Any, row: Any) -> tuple[Tensor, Any]:
        for _ in range(700):
            x = x.sin()
        return x, ()

    assert not Program(step, name="a long one").compiles(torch.zeros(1, 32), steps=1)
    assert "lines long, which take a compiler minutes" in caplog.text

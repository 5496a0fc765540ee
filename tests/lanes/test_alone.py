"""A step that is more than a function of its row runs as it was written, and the log says why."""

from __future__ import annotations

import itertools
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
from staf_torch.lanes import Program, compiler
from staf_torch.lanes import program as programs
from staf_torch.lanes.alone import undrawn
from staf_torch.lanes.content import reads_users_code
from staf_torch.lanes.function import Rows
from staf_torch.lanes.tracer import NotLoweredError

pytestmark = pytest.mark.needs_compiler

X = torch.linspace(-1, 1, 10, dtype=torch.float64).view(5, 2)
COUNT = itertools.count()
DRAW = np.random.default_rng(0)


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
    "torch, like": (lambda x: x + torch.rand_like(x), "draws random numbers"),
    "torch, in place": (lambda x: x + torch.empty_like(x).normal_(), "draws random numbers"),
    "dropout": (lambda x: torch.nn.functional.dropout(x), "draws random numbers"),
    "NumPy": (lambda x: x + np.random.randn(), "called again"),  # noqa: NPY002
    "a generator": (lambda x: x + DRAW.normal(), "called again"),
    "Python": (lambda x: x + random.random(), "called again"),
    "a counter": (lambda x: x * (1 + next(COUNT)), "called again"),
    "a clock": (of_the_clock, "called again"),
    "a mean over the batch": (mean, "beside another row"),
    "the size of the batch": (of_the_size, "beside another row"),
    "the first row": (of_the_first, "beside another row"),
    "one row alone": (lambda x: x.view(1, 2) * 1.0, "one row but not two"),
}


@pytest.fixture(autouse=True)
def _nothing_was_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(programs, "_said", set())


@pytest.mark.parametrize("name", OTHERS)
def test_what_is_no_function_of_a_row_is_not_compiled(
    name: str, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    function, reason = OTHERS[name]
    monkeypatch.setattr(compiler, "function", None)  # which nobody asks in vain
    program = Program(lambda x, _, __: (x, function(x)))
    assert not program.compiles(X, steps=3)
    (line,) = caplog.messages
    assert reason in line


@pytest.mark.parametrize("name", ["torch", "NumPy", "Python", "a generator"])
def test_noise_is_drawn_at_every_time(name: str) -> None:
    function, _ = OTHERS[name]
    _, found = Program(lambda x, _, __: (x, function(x)))(X, steps=50)
    noise = (found - X[:, None]).flatten(1)
    assert len(noise.unique()) >= 50


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
    assert reads_users_code(Noisy().forward)
    assert not reads_users_code(torch.nn.Linear(2, 2), st.GaussianKernel(), torch.tanh)


def test_what_a_step_reads_now_is_asked_anew_of_a_single_row_too() -> None:
    held = torch.nn.Sequential(torch.nn.Identity())
    program = Program(lambda carry, now, row: (carry, held(row)))
    x, none = X[:1], torch.zeros(1, 1).double()
    assert torch.equal(program(none, none, x)[1][0, 0], x[0])
    held[0] = Noisy()
    assert len({float(program(none, none, x)[1][0, 0, 0]) for _ in range(5)}) == 5


def test_a_header_of_a_noisy_function_is_refused() -> None:
    program = Program(lambda carry, now, row: (carry, (Noisy()(row["x"]),)), name="the header")
    with pytest.raises(NotLoweredError, match="called again"):
        program.c_source("noisy", row={"x": X[:1]})


@pytest.mark.parametrize("mixed", [False, True])
def test_what_rounding_decides_says_nothing_of_a_row(mixed: bool) -> None:
    def step(x: Tensor, now: object, row: object) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        rounded = x.sin() * (1 + 3e-16 * len(x))  # as another order of sums does
        other = x - x.mean(0) if mixed else x
        return 0.5 * x, ((1e18 * rounded).remainder(2.0), other)

    x = torch.linspace(0.1, 0.9, 6, dtype=torch.float64)
    assert Program(step).compiles(x, steps=2) is not mixed


def test_loops_are_tried_by_a_few_passes_and_what_they_call_is_still_seen(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """What a user's function does with its rows, every pass does."""
    calls = []

    def mixed(x: Tensor) -> Tensor:
        calls.append(len(x))
        return 0.5 * x + 0.1 * x.mean(0)

    def own(x: Tensor) -> Tensor:
        calls.append(len(x))
        return 0.5 * x + 0.1

    rows = torch.linspace(0.0, 1.0, 6, dtype=torch.float64)[:, None]
    for function in (own, mixed):
        calls.clear()
        caplog.clear()
        program = lanes.Program(
            lambda carry, now, row, f=function: (lanes.repeat(100, f, carry), ()), name="many"
        )
        assert program.compiles(rows, (), (), steps=1) is (function is own)
        assert len(calls) < 60
        assert ("beside another row" in caplog.text) is (function is mixed)
    found = lanes.Program(lambda carry, now, row: (lanes.repeat(100, own, carry), ()))(rows, (), (), steps=1)[
        0
    ]
    torch.testing.assert_close(found, torch.full_like(rows, 0.2))


def test_who_tries_a_program_draws_no_random_numbers() -> None:
    def states() -> tuple[Tensor, Any, Any]:
        return torch.get_rng_state(), np.random.get_state()[1].tolist(), random.getstate()  # noqa: NPY002

    before = states()
    with undrawn():
        torch.rand(3), np.random.rand(3), random.random()  # noqa: NPY002
    after = states()
    assert torch.equal(before[0], after[0])
    assert before[1:] == after[1:]

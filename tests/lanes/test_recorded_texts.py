"""The C++ and C that are written for programs, recorded: none becomes longer, or another, unseen.

What torch makes of a function before it is lowered is its own: texts are compared under the version with
which they were recorded.
"""

from __future__ import annotations

import collections
import re
import zlib
from collections.abc import Callable
from typing import Any

import pytest
import torch
from helpers import basis_of, uniform
from lanes.test_eliminations import solve, solve_definite
from lanes.test_operations import OPERATIONS
from recorded import Record
from torch import Tensor
from variants import LAWS, PAIRS, PREDICTORS, RATED

from staf_torch import adp, lanes, systems
from staf_torch.adp.closed_loop import ClosedLoop, recorded
from staf_torch.engine import recursion, row_program
from staf_torch.engine.problem import Problem
from staf_torch.lanes import eliminations
from staf_torch.targets import Paper

LARGE = ("none", "tangent, order 2")
VERSION = ".".join(torch.__version__.split(".")[:2])


def said(text: str) -> dict[str, Any]:
    """What is recorded of a text: its length, what it calls and how often, and a sum over it all."""
    calls = collections.Counter(re.findall(r"\b([a-z_]+) ?\(", text))
    return {"lines": text.count("\n"), "sum": zlib.crc32(text.encode()), "calls": dict(sorted(calls.items()))}


def of_a_row(function: Callable[[Tensor], Any], x: Tensor) -> Any:
    program = lanes.Program(lambda carry, now, row: (carry, function(row)))
    c = lanes.Program(lambda carry, now, row: ((), function(row["x"]))).c_source("f", row={"x": x[:1]})
    return said(program.text(x, x.unsqueeze(1), x)), said(c)


def of_a_matrix(function: Callable[[Tensor], Any], size: int) -> Any:
    square = uniform(2, size, size, seed=1)
    return of_a_row(lambda x: function(x @ x.mT + torch.eye(size).to(x)), square)


def of_loops() -> Any:
    def repeated(x: Tensor, u: Tensor, row: Tensor) -> Any:
        count = row.abs().sum(-1)
        far = lanes.repeat(20, lambda y: 0.5 * (y + row / y), x.abs() + 1, where=lambda y: y.sum(-1) > count)
        points = u.unsqueeze(1) * torch.arange(5).to(u)[:, None]
        return far, lanes.reduce(lambda p: p.square().sum(-1), points, "max")

    def scanned(x: Tensor, u: Tensor, row: Tensor) -> Any:
        points = row.unsqueeze(-2) * u.unsqueeze(-1)
        after, kept = lanes.scan(lambda y, p: (y + 0.1 * p.sin(), y * p), x, points)
        return after, (kept, lanes.each(lambda p: p.square().exp(), points))

    x, u = uniform(2, 3, seed=1), uniform(2, 4, 3, seed=2)
    texts = [lanes.Program(repeated, copies=copies).text(x, u, x) for copies in (0, 1, 4)]
    texts.append(lanes.Program(scanned).text(x, u, x))
    return [said(text) for text in texts], said(
        lanes.Program(scanned).c_source("scanned", x[:1], u[:1], x[:1])
    )


def of_a_chase(law: str, predictor: str, count: int) -> Any:
    basis, states = basis_of("gaussian", count), uniform(2, 3, 2, seed=2)
    problem = Problem("chase", basis, Paper(), LAWS[law], 3, PREDICTORS[predictor], law in RATED)
    carry = row_program.first_carry(problem, recursion.start(problem, states, None))
    steps = (row_program.Step(problem, everything) for everything in (True, False))
    return [said(lanes.Program(step).text(carry, states)) for step in steps]


def of_a_loop(controller: Any, dim: int, cost: adp.Cost, plant: Any) -> Any:
    loop = ClosedLoop(controller, plant, cost, dt=0.1)
    x = uniform(2, dim, seed=1)
    step = lambda state, u, row: recorded(loop, state, u, row)  # noqa: E731
    return said(lanes.Program(step).text(loop.init(x), uniform(2, 3, 1, dim), {}))


COST = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
CASES: dict[str, Callable[[], Any]] = {
    **{name: lambda f=f: of_a_row(f, uniform(2, 3, seed=1)) for name, f in OPERATIONS.items()},  # type: ignore[misc]
    **{
        f"{f.__name__} of {size}": lambda f=f, size=size: of_a_matrix(f, size)  # type: ignore[misc]
        for size in (2, 4, 12)
        for f in (eliminations.inverse, eliminations.determinant, eliminations.eigen, eliminations.orthogonal)
    },
    **{
        f"{f.__name__} of {size}": lambda f=f, size=size: of_a_matrix(lambda a: f(a, a[..., :1]), size)  # type: ignore[misc]
        for size in (2, 4, 12)
        for f in (solve, solve_definite)
    },
    **{
        f"a chase by {law}, {predictor}, {count}": lambda law=law, predictor=predictor, count=count: (
            of_a_chase(  # type: ignore[misc]
                law, predictor, count
            )
        )
        for law, predictor in PAIRS
        if law == "steepest descent" or predictor in LARGE  # what a predictor predicts knows no law
        for count in ((3, 10) if law == "steepest descent" and predictor in LARGE else (3,))
    },
    "cholesky": lambda: of_a_matrix(torch.linalg.cholesky, 5),
    "loops": of_loops,
    "lqr": lambda: of_a_loop(adp.Feedback(adp.LQR(systems.TwoState(), COST)), 2, COST, systems.TwoState()),
}


@pytest.mark.parametrize("name", CASES)
def test_a_text_is_the_recorded(name: str, record: Record) -> None:
    if record.known().get("torch", VERSION) == VERSION:
        record({"torch": VERSION, "text": CASES[name]()})

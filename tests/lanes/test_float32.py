"""float32 inside a float64 program (constants of torch's default dtype) is rounded as torch rounds it."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from test_c_and_cuda import STRICT, built, needs_gcc, pointer
from torch import Tensor, nn

import staf_torch as st
from staf_torch import lanes

pytestmark = pytest.mark.needs_compiler


def buffer(x: Tensor) -> Tensor:
    out = torch.zeros(len(x), 2)  # float32: what is written there is rounded
    out[:, 0], out[:, 1] = x[:, 0] * 0.1, x[:, 1]
    return out * x


CONSTANTS: dict[str, Callable[[Tensor], Tensor]] = {
    "a choice": lambda x: x * torch.where(x > 0, 1.0, 0.1),
    "a list": lambda x: x * torch.tensor([1.0, 0.3]),
    "a product with a Python number": lambda x: x + torch.ones(2) * 0.1,
    "a range": lambda x: x * (torch.arange(2) * 0.1),
    "zeros beside an entry": lambda x: torch.stack((x[:, 0], torch.zeros(len(x))), dim=-1),
    "a number without a dimension": lambda x: x * (1 / torch.tensor(3.0)),
    "full": lambda x: x + torch.full((2,), 0.1),
    "linspace": lambda x: x * torch.linspace(0, 1, 2),
    "a mask times a number": lambda x: x * ((x > 0) * 0.1),
    "an integer times a number": lambda x: x * ((x > 0).long() * 0.1),
    "the mean of a mask": lambda x: x * (x > 0).float().mean(-1, keepdim=True),
    "a count over three": lambda x: x * ((x > 0).sum(-1, keepdim=True) / 3),
    "compared as float32": lambda x: torch.where((x > 0) * 0.1 < 0.1, x, -x),
    "a buffer": buffer,
    "a half": lambda x: x * torch.tensor([1.0, 0.3]).half(),
    "a quotient": lambda x: (x.float() / 3 - 0.1).abs() * x,
    # One product a sum: how a processor's library rounds between two is its own.
    "a matrix": lambda x: (x.float() @ torch.tensor([[0.0, 0.2], [0.3, 0.0]])).double(),
    "a long sum": lambda x: x.float().unsqueeze(-1).expand(-1, -1, 60).cumsum(-1).double().sum(-1),
    "a slope": lambda x: torch.func.grad(lambda z: (z * torch.where(z > 0, 1.0, 0.1) * z).sum())(x),
    "rows by vmap": lambda x: torch.func.vmap(lambda z: z * torch.where(z > 0, 1.0, 0.1))(x),
}
X = torch.linspace(-1.5, 1.7, 18, dtype=torch.float64).view(9, 2)


def test_constants_of_the_default_dtype_have_lanes() -> None:
    """Case 12 of FIELD.md, in all spellings: float64 results have the constants' float32 values."""
    program = lanes.Program(lambda x, _, __: (x, {name: f(x) for name, f in CONSTANTS.items()}))
    assert program.compiles(X, steps=1)
    found, wanted = (run(X, steps=1)[1] for run in (program, program.definition))
    for name in CONSTANTS:
        torch.testing.assert_close(found[name], wanted[name], rtol=1e-15, atol=1e-15, msg=name)


Operation = Callable[[Tensor, Tensor], Tensor]
ROUNDED: dict[str, Operation] = {
    "+": torch.add,
    "-": torch.sub,
    "*": torch.mul,
    "/": lambda a, b: a / (1 + b.abs()),
    "number": lambda a, b: 0.1 * a + 0.3,
    "float": lambda a, b: a.float() * 1.1 - b.float(),
    "double": lambda a, b: a.double() * 1.1 - b.double(),
    "choice": lambda a, b: torch.where(a > b, a, b),
    "constant": lambda a, b: torch.where(a > b, 0.7, -0.2),
    "scaled": lambda a, b: a * torch.tensor([0.1, 0.2]),
    "of a scalar": lambda a, b: a * torch.tensor(0.1, dtype=torch.float64) + torch.tensor(0.1),
    "mask": lambda a, b: (a > 0.1) * 0.3,
    "count": lambda a, b: (a < b).sum(-1, keepdim=True) / 3 + a,
    "extreme": lambda a, b: torch.maximum(a, b).clamp(-1.1, 1.3),
    "stack": lambda a, b: torch.cat((a[:, :1], b[:, 1:].float()), dim=-1),
    "matrix": lambda a, b: a @ torch.tensor([[0.0, -0.7], [0.9, 0.0]], dtype=a.dtype),
    "square": lambda a, b: a**2 - b.square(),
    "floor": lambda a, b: (3 * a).floor() / 7,
    "remainder": lambda a, b: torch.fmod(5 * a, 0.3),
}
BOUNDED = {"floor", "remainder"}  # a rounding of float64 more or less may step over a whole number


def drawn(seed: int) -> Callable[..., Any]:
    """A step of operations drawn at random on values of both dtypes."""
    draw = random.Random(seed)
    names = draw.choices(sorted(set(ROUNDED) - BOUNDED) if seed % 2 else sorted(ROUNDED), k=30)
    places = [(draw.random(), draw.random()) for _ in names]

    def step(carry: Tensor, now: Tensor, row: Tensor) -> tuple[Tensor, list[Tensor]]:
        values = [carry, now, row]
        for name, (i, j) in zip(names, places, strict=True):
            x, y = values[int(i * len(values))], values[int(j * len(values))]
            if name in BOUNDED:
                x = x.float()
            values.append(ROUNDED[name](x, y).clamp(-50, 50))
        return (carry + 0.1 * values[-1]).to(carry.dtype), values[3:]

    return step


def given(seed: int, rows: int) -> tuple[Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    numbers = torch.randn(3, rows, 2, generator=generator, dtype=torch.float64)
    return numbers[0], numbers[1].unsqueeze(1), numbers[2].float()  # a float32 input among others


def check(found: Any, wanted: Any) -> None:
    for k, (one, other) in enumerate(zip([found[0], *found[1]], [wanted[0], *wanted[1]], strict=True)):
        assert one.dtype == other.dtype, k
        bound = 0.0 if one.dtype == torch.float32 else 1e-13
        torch.testing.assert_close(
            one, other, rtol=bound, atol=bound, equal_nan=True, msg=lambda m, k=k: f"{k}: {m}"
        )


@pytest.mark.parametrize("seed", range(3))
def test_a_program_of_both_dtypes_rounds_as_its_definition(seed: int) -> None:
    """float32 results to the bit, float64 ones to rounding."""
    program = lanes.Program(drawn(seed), copies=1)
    inputs = given(seed, 9)
    for k, special in enumerate((torch.nan, torch.inf, -0.0, 5e-324, 1e300)):
        inputs[0][k, 0] = special
    assert program.compiles(*inputs)
    check(program(*inputs), program.definition(*inputs))


def test_a_kernel_of_both_dtypes_rounds_as_its_definition() -> None:
    program, inputs = lanes.Program(drawn(5)), given(5, 9)
    with lanes.device.host():
        assert program.compiles(*inputs)
        check(program(*inputs), program.definition(*inputs))


@needs_gcc
def test_c_of_both_dtypes_rounds_as_its_definition(tmp_path: Path) -> None:
    program, (carry, now, row) = lanes.Program(lambda c, n, r: (drawn(7)(c, n, r)[0], ())), given(7, 1)
    text = program.c_source("mixed", carry, now, row)
    text += "void call(double *x, const double *u, const double *r) {\n"
    text += "mixed_state s; s.carry[0] = x[0]; s.carry[1] = x[1];\n"
    text += "mixed(&s, u, r); x[0] = s.carry[0]; x[1] = s.carry[1]; }\n"
    library, inputs = built(text, tmp_path, "mixed.c", ("gcc", *STRICT)), (carry.clone(), now, row.double())
    library.call(*map(pointer, inputs))
    torch.testing.assert_close(inputs[0], program.definition(carry, now, row)[0], rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize("when", ["always", "never"])
def test_autocast_reaches_no_program_no_gradient_and_no_chase(when: str) -> None:
    """Whether code is built would decide on the digits, and a fit in bfloat16 has none."""
    net, x, u = nn.Linear(3, 3), torch.randn(4, 3), torch.randn(4, 5, 3)

    def step(x: Tensor, u: Tensor, _: object) -> tuple[Tensor, Tensor]:
        x = net(x).tanh() + 0.1 * u
        return x, x

    def chased() -> Tensor:
        basis = st.StaFBasis(st.GaussianKernel(0.7), st.StateFollowingCenters(st.rings(3), radius=0.1))
        return st.chase(u[..., :2], basis.float(), st.targets.Paper(), st.optim.Exact()).weights

    def computed(program: lanes.Program) -> tuple[Tensor, ...]:
        loss = program(x, u)[1].square().sum()
        return loss.detach(), *torch.autograd.grad(loss, tuple(net.parameters()))

    with lanes.compiling(when):
        plain = computed(lanes.Program(step)), chased()
        with torch.autocast("cpu", torch.bfloat16):
            cast = computed(lanes.Program(step)), chased()
    torch.testing.assert_close(cast, plain, rtol=1e-5, atol=1e-6)

"""Programs drawn at random, compiled, are their definitions, also with NaN, inf, -0 and subnormals."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import hypothesis
import hypothesis.strategies as st
import pytest
import torch
from torch import Tensor

from staf_torch import lanes

pytestmark = pytest.mark.needs_compiler

Operation = Callable[..., Tensor]
ONE: dict[str, Operation] = {
    "neg": torch.neg,
    "abs": torch.abs,
    "sin": torch.sin,
    "tanh": torch.tanh,
    "floor": torch.floor,
    "sign": torch.sign,
    "relu": torch.relu,
    "isnan": lambda x: x.isnan().to(x),
    "isfinite": lambda x: torch.isfinite(x).to(x),
    "exp": lambda x: x.clamp(max=3.0).exp(),
    "log1p": lambda x: x.abs().log1p(),
    "root": lambda x: x.abs().sqrt(),
    "cube": lambda x: x.clamp(-2, 2) ** 3,
    "flip": lambda x: x.flip(-1),
    "total": lambda x: x.sum(-1, keepdim=True).expand_as(x),
    "highest": lambda x: x.amax(-1, keepdim=True) + torch.zeros_like(x),
    "where": lambda x: torch.where(x > 0.3, x, -x),
    "first": lambda x: torch.cat((x[..., :1], x[..., :-1]), dim=-1),
    "write": lambda x: x.clone().index_fill_(-1, torch.tensor([0]), 0.5),
    "cumulated": lambda x: x.cumsum(-1),
    "chosen": lambda x: x.gather(-1, x.argmin(-1, keepdim=True)).expand_as(x),
    "matrix": lambda x: x @ torch.linspace(-1, 1, x.shape[-1] ** 2, dtype=x.dtype).reshape(x.shape[-1], -1),
    "outer": lambda x: (x.unsqueeze(-1) * x.unsqueeze(-2)).mean(-1),
    "slope": lambda x: torch.func.grad(lambda z: (z.sin() * z).sum())(x),
    "repeat": lambda x: lanes.repeat(3, lambda z: z * 0.5 + x, x),
    "reduce": lambda x: lanes.reduce(lambda z: z.unsqueeze(-1) * x.unsqueeze(1), x, "max"),
}
TWO: dict[str, Operation] = {
    "add": torch.add,
    "sub": torch.sub,
    "mul": torch.mul,
    "div": lambda x, y: x / (1 + y.abs()),
    "max": torch.maximum,
    "min": torch.minimum,
    "fused": lambda x, y: x * y - y,
    "picked": lambda x, y: torch.where((x < y) | (y != y), x, y),
    "atan2": torch.atan2,
    "scan": lambda x, y: lanes.scan(lambda c, z: (c + z * 0.5, c * z), x[..., 0], y)[1],
}
SPECIAL = (0.0, -0.0, 1.0, -1.0, torch.inf, -torch.inf, torch.nan, 5e-324, -1e-310, 1e300, 0.5)
Drawn = list[tuple[str, int, int]]
drawn = st.lists(
    st.tuples(st.sampled_from(sorted(ONE | TWO)), st.integers(0, 50), st.integers(0, 50)),
    min_size=18,
    max_size=25,
)


def step_of(program: Drawn) -> lanes.program.Step:
    """The operations one after the other, each on some of what came before; a fourth of them last long."""

    def step(carry: Tensor, now: Tensor, row: Tensor) -> tuple[Tensor, list[Tensor]]:
        values = [carry, now, row]
        for name, i, j in program:
            x, y = values[i % len(values)], values[j % len(values)]
            values.append(ONE[name](x) if name in ONE else TWO[name](x, y))
        bounded = torch.where(values[-1].abs() < 2, values[-1], carry * 0.5)
        return bounded, values[3:]

    return step


@hypothesis.settings(max_examples=1, derandomize=True, deadline=None, phases=[hypothesis.Phase.generate])
@hypothesis.given(program=drawn, size=st.sampled_from([1, 3]), double=st.booleans())
def test_a_random_program_is_its_definition(program: Drawn, size: int, double: bool) -> None:
    """One step, from equal states. No shrinking, which would compile for minutes."""
    dtype = torch.float64 if double else torch.float32
    generator = torch.Generator().manual_seed(len(program))
    given: list[Any] = [
        torch.randn(11, size, generator=generator, dtype=torch.float64).to(dtype) for _ in range(3)
    ]
    given[1] = given[1].unsqueeze(1)
    compiled = lanes.Program(step_of(program))
    assert compiled.compiles(*given)
    check(compiled, given, program, 2**8 * torch.finfo(dtype).eps)
    special = torch.tensor(SPECIAL, dtype=torch.float64).to(dtype).unsqueeze(-1).expand(-1, size)
    check(compiled, [special, given[1], given[2]], program, None)


def check(compiled: lanes.Program, given: list[Any], program: Drawn, bound: float | None) -> None:
    found, wanted = compiled(*given), compiled.definition(*given)
    steps = zip([("carry", 0, 0), *program], [found[0], *found[1]], [wanted[0], *wanted[1]], strict=True)
    for (name, _, _), one, other in steps:
        if bound is None:  # roundings are amplified beyond any bound here: what is no number must agree
            assert torch.equal(one.isnan(), other.isnan()), name
        else:
            torch.testing.assert_close(one, other, rtol=bound, atol=bound, msg=lambda m, n=name: f"{n}: {m}")

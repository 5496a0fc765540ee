"""Entries at places that a row computes, compiled, are those of torch: many by a loop.

Few are written out: `test_interpreted.py` computes them.
"""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from staf_torch import lanes

pytestmark = pytest.mark.needs_compiler

Choice = Callable[[Tensor, Tensor], Tensor]
CHOICES: dict[str, Choice] = {
    "columns": lambda x, i: x.gather(-1, i.unsqueeze(-2).expand_as(x)),
    "rows": lambda x, i: x.gather(-2, i.unsqueeze(-1).expand_as(x)),
    "one": lambda x, i: x.gather(-1, i[:, :1, None].expand(-1, x.shape[-1], 1)),
    "fewer rows of a part": lambda x, i: x.gather(1, i[:, :2, None].expand(-1, -1, x.shape[-1] - 1)),
    "flags": lambda x, i: (x > 0).gather(1, i.unsqueeze(-1).expand_as(x)).to(x),
    "a table": lambda x, i: torch.linspace(-1.0, 1.0, x.shape[-1]).to(x)[i].unsqueeze(-2) * x,
    "written": lambda x, i: torch.zeros_like(x[:, 0]).scatter(-1, i, x[:, 1]),
    "written in part": lambda x, i: x.scatter(1, i[:, :, None].expand(-1, -1, x.shape[-1] - 1), 2 * x),
    "one number": lambda x, i: x.scatter(1, i.unsqueeze(-1).expand_as(x), 3.5),
    "added": lambda x, i: x.scatter_add(1, i.unsqueeze(-1).expand_as(x), x.sin()),
    "added in part": lambda x, i: x.scatter_add(1, i[:, :2, None].expand(-1, -1, 2), x),
    "slope": lambda x, i: torch.func.grad(lambda y: y.gather(-1, i.unsqueeze(-2).expand_as(y)).sin().sum())(
        x
    ),
}


def compiled(
    functions: dict[str, Choice], x: Tensor, i: Tensor
) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    def step(carry: Tensor, now: Tensor, row: tuple[Tensor, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        return carry, {name: function(*row) for name, function in functions.items()}

    program = lanes.Program(step)
    start, now = torch.zeros(len(x)).to(x), torch.zeros(len(x), 1).to(x)
    return program(start, now, (x, i))[1], program.definition(start, now, (x, i))[1]


def test_every_choice_is_that_of_torch(caplog: pytest.LogCaptureFixture) -> None:
    size = 9
    generator = torch.Generator().manual_seed(size)
    x = torch.randn(9, size, size, generator=generator, dtype=torch.float64)
    x[0, 0], x[1, :, 0], x[2, -1] = torch.nan, torch.inf, -0.0
    i = torch.randint(size, (9, size), generator=generator)  # places repeat
    found, expected = compiled(CHOICES, x, i)
    assert "plain torch" not in caplog.text
    for name in CHOICES:
        torch.testing.assert_close(
            found[name], expected[name], rtol=1e-15, atol=1e-14, equal_nan=True, msg=name
        )


def test_many_choices_are_a_short_text() -> None:
    def lines(size: int) -> int:
        x, i = torch.randn(1, size, size), torch.randint(size, (1, size))
        program = lanes.Program(lambda carry, now, row: (carry + CHOICES["rows"](*row).sum(), ()))
        return len(program.c_source("chosen", torch.zeros(1), torch.zeros(1, 1), (x, i)).splitlines())

    assert lines(24) < 2.5 * lines(12)  # eight times the choices, twice the entries of a place


def test_a_scatter_that_reduces_is_left_to_torch(caplog: pytest.LogCaptureFixture) -> None:
    x, i = torch.randn(4, 3, 3), torch.randint(3, (4, 3, 3))
    with pytest.warns(UserWarning, match="reduce argument"):
        found, expected = compiled({"sum": lambda x, i: x.scatter(1, i, x, reduce="add")}, x, i)
    assert "reduce=" in caplog.text
    assert torch.equal(found["sum"], expected["sum"])

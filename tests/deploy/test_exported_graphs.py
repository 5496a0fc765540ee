"""Graphs of tensor operations that are exported: for a batch or any, and what cannot be."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor, nn

from staf_torch.deploy.graph import trace

X = torch.tensor([[1.0, -2.0], [0.5, 4.0]], dtype=torch.float64)
TABLE = torch.arange(4, dtype=torch.float64).view(2, 2)


class Slope(nn.Module):
    """A derivative inside, a layer that drops in training, a number and a table."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(2, 2), nn.Dropout(), nn.Tanh()).double()

    def forward(self, x: Tensor) -> Tensor:
        return torch.func.grad(lambda at: (self.layers(at) @ TABLE.exp() * 0.1).sin().sum())(x)


@pytest.mark.parametrize("batch", [None, 5])
def test_a_module_is_traced_for_a_batch_or_for_any(batch: int | None) -> None:
    module = Slope().train()
    program = trace(module, X, batch=batch)
    assert not module.training
    for rows in (batch,) if batch else (1, 2, 7):
        x = torch.randn(rows, 2, dtype=torch.float64)
        torch.testing.assert_close(program.module()(x), module(x), rtol=1e-13, atol=1e-14)


@pytest.mark.parametrize(
    ("example", "options", "message"),
    [
        *((torch.zeros(shape), {}, r"trace\(example=...\)") for shape in ((2,), (0, 2))),
        *((torch.zeros(1, 2), {"batch": batch}, r"trace\(batch=...\)") for batch in (0, 1.5)),
    ],
)
def test_a_bad_argument_is_named(example: Tensor, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        trace(nn.Identity(), example, **options)


def test_what_cannot_be_traced_is_said_in_a_line() -> None:
    class Deciding(nn.Module):
        def forward(self, x: Tensor) -> Tensor:
            raise KeyError("why\nand where")

    with pytest.raises(
        ValueError, match=r"^`Deciding` cannot be exported for a batch of 4: 'why\\nand where'$"
    ):
        trace(Deciding(), torch.zeros(1, 2), batch=4)

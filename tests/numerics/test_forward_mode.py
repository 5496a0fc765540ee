"""Derivatives along coordinates, and backwards where that is cheaper or all there is."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from staf_torch.numerics.forward_mode import jacobian


class Backwards(torch.autograd.Function):
    """x^2 of a user who wrote no derivative in forward mode."""

    generate_vmap_rule = True

    @staticmethod
    def forward(x: Tensor) -> Tensor:
        return x.square()

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor], output: Tensor) -> None:
        ctx.save_for_backward(*inputs)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        result: Tensor = 2 * ctx.saved_tensors[0] * grad
        return result


@pytest.mark.parametrize("own", [False, True])
@pytest.mark.parametrize(("dim", "count"), [(1, 1), (2, 5), (3, 3), (4, 2)])
def test_a_jacobian_is_that_of_autograd(dim: int, count: int, own: bool) -> None:
    generator = torch.Generator().manual_seed(dim + 10 * count)
    matrix = torch.randn(dim, count, dtype=torch.float64, generator=generator)
    y = torch.randn(6, dim, dtype=torch.float64, generator=generator)

    def function(y: Tensor) -> Tensor:
        moved: Tensor = (y @ matrix).sin()
        return Backwards.apply(moved) if own else moved.square()

    each = torch.stack([torch.autograd.functional.jacobian(function, row) for row in y])
    torch.testing.assert_close(jacobian(function, y), each)


def test_what_is_wrong_in_both_ways_is_an_error() -> None:
    with pytest.raises(RuntimeError, match="shapes cannot be multiplied"):
        jacobian(lambda y: y @ torch.ones(3, 3), torch.ones(2, 2))

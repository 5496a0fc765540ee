"""The minimum on a box has no slope that leads down; angles differ by turns; slopes are derivatives."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from helpers import random_positive_definite, tensor, uniform
from torch import Tensor

from staf_torch.numerics.angles import wrap
from staf_torch.numerics.box import LARGEST, box_minimum, face_inverses
from staf_torch.numerics.derivatives import central_slopes, jacobian


@pytest.mark.parametrize("known", [False, True])
@pytest.mark.parametrize("size", range(1, LARGEST + 1))
def test_a_minimum_on_a_box_has_no_slope_that_leads_down(size: int, known: bool) -> None:
    rows = 60
    curvature = random_positive_definite(size, rows, size=size)
    slope = 3 * curvature.diagonal(dim1=-2, dim2=-1) * uniform(rows, size, low=-1.0, high=1.0, seed=size)
    low, high = -uniform(rows, size, low=0.1, seed=7), uniform(rows, size, low=0.1, seed=8)
    slope[::3] *= 0.02
    low[::4], high[1::4] = -torch.inf, torch.inf
    low[2::4, 0], high[2::4, -1] = -torch.inf, torch.inf
    inverses = face_inverses(curvature) if known else None
    u = box_minimum(curvature, slope, low, high, inverses)
    gradient = (curvature @ u.unsqueeze(-1)).squeeze(-1) + slope
    at_low, at_high = u == low, u == high
    assert bool(((u >= low) & (u <= high)).all())
    assert bool((gradient[at_low] >= -1e-9).all())
    assert bool((gradient[at_high] <= 1e-9).all())
    torch.testing.assert_close(
        gradient[~at_low & ~at_high], torch.zeros(int((~at_low & ~at_high).sum())).double()
    )
    assert bool(at_low.any())
    assert bool(at_high.any())
    assert bool((~at_low & ~at_high).all(-1).any())


def test_one_pair_of_bounds_serves_all_rows_and_what_is_nan_stays_so() -> None:
    curvature, slope = random_positive_definite(1, 4, size=2), uniform(4, 2, seed=2)
    low, high = tensor([-0.1, -0.2]), tensor([0.1, torch.inf])
    together = box_minimum(curvature, slope, low, high)
    each = [box_minimum(curvature[k], slope[k], low, high) for k in range(4)]
    torch.testing.assert_close(together, torch.stack(each))
    slope[1, 0] = torch.nan
    spoiled = box_minimum(curvature, slope, low, high)
    assert bool(spoiled[1].isnan().any())
    torch.testing.assert_close(spoiled[[0, 2, 3]], together[[0, 2, 3]])
    curvature[2] = torch.nan
    assert bool(box_minimum(curvature, slope, low, high)[2].isnan().all())


def test_more_than_four_unknowns_are_refused() -> None:
    with pytest.raises(
        ValueError, match=r"`box_minimum\(slope=\.\.\.\)` must have at most 4 unknowns; got 5\."
    ):
        box_minimum(torch.eye(5), torch.zeros(5), torch.zeros(5), torch.ones(5))


@pytest.mark.parametrize("periodic", [(), (0,), (-1,), (0, 2), (2, -3), (0, 1, 2), (-1, -2, -3)])
def test_angles_are_between_minus_pi_and_pi_and_other_coordinates_as_they_were(
    periodic: tuple[int, ...],
) -> None:
    given = 20 * uniform(50, 3, low=-1.0, seed=4)
    found = wrap(given, periodic)
    angles = {index % 3 for index in periodic}
    for k in range(3):
        if k not in angles:
            assert torch.equal(found[:, k], given[:, k])
            continue
        assert float(found[:, k].abs().max()) <= math.pi + 1e-12
        turns = (given[:, k] - found[:, k]) / (2 * math.pi)
        torch.testing.assert_close(turns, turns.round(), rtol=0, atol=1e-12)
        assert float(turns.abs().max()) >= 2
    assert torch.equal(wrap(found, periodic), found)


@pytest.mark.parametrize("scale", [None, 1.0, 100.0])
def test_slopes_are_found_in_one_call_with_steps_of_the_scale(scale: float | None) -> None:
    at = tensor([0.5, -300.0, 2.0])

    def function(x: torch.Tensor) -> torch.Tensor:
        return torch.stack((x[:, 0] ** 2 + 3 * x[:, 2], (0.01 * x[:, 1]).sin() * x[:, 0]), dim=-1)

    size = None if scale is None else torch.full((3,), scale).double()
    found = central_slopes(function, at, size)
    want = tensor([[1.0, 0.0, 3.0], [math.sin(-3.0), 0.005 * math.cos(-3.0), 0.0]])
    torch.testing.assert_close(found, want, rtol=0, atol=1e-7)


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

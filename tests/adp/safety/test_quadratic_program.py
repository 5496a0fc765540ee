"""The nearest point of a box within half-spaces: its cases, edges and scales, and where there is none."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import torch
from helpers import tensor, uniform
from torch import Tensor

from staf_torch.adp.safety.quadratic_program import Nearest, cases, nearest_admissible

INF = math.inf


def found(
    wanted: Tensor, normals: Tensor, least: Tensor, low: Tensor | None = None, high: Tensor | None = None
) -> Nearest:
    """Without bounds where none are given."""
    none = torch.full((wanted.shape[-1],), INF, dtype=wanted.dtype)
    low, high = (-none if low is None else low), (none if high is None else high)
    table = cases(least.shape[-1], low.tolist(), high.tolist())
    return nearest_admissible(wanted, normals, least, low, high, table)


def feasible(m: int, k: int, rows: int = 40) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Problems that have a point inside, of which many are not met by what is wanted."""
    normals, inside = uniform(rows, k, m, seed=10 * m + k), 0.5 * uniform(rows, m, seed=m)
    least = (normals * inside.unsqueeze(-2)).sum(-1) - 0.05 * uniform(rows, k, low=0.0, seed=k)
    return (
        3 * uniform(rows, m, seed=7 + m),
        normals,
        least,
        torch.full((m,), -0.8).double(),
        tensor([0.9] * m),
    )


def test_as_many_cases_as_fit_are_compared_and_more_are_refused() -> None:
    assert len(cases(5, [0.0] * 5, [INF] * 5)) == 993
    assert len(cases(9, [-INF] * 3, [INF] * 3)) == 512
    with pytest.raises(
        ValueError, match="6 inequalities of 4 bounded unknowns have 1009 cases, more than 1000"
    ):
        cases(6, [0.0] * 4, [INF] * 4)


@pytest.mark.parametrize(("m", "k", "size"), [(1, 3, 2.0**-12), (2, 2, 2.0**20), (3, 2, 2.0**10)])
def test_the_unit_of_the_inputs_does_not_matter_nor_does_that_of_a_normal(
    m: int, k: int, size: float
) -> None:
    wanted, normals, least, low, high = feasible(m, k)
    one = found(wanted, normals, least, low, high)
    assert int((one.point != wanted).any(-1).sum()) > 10
    other = found(size * wanted, normals, size * least, size * low, size * high)
    torch.testing.assert_close(other.point / size, one.point, rtol=1e-9, atol=1e-11)
    scaled = found(wanted, size * normals, size * least, low, high)
    torch.testing.assert_close(scaled.point, one.point, rtol=1e-11, atol=1e-11)
    # What is missing is in units of the inputs: of one impossible inequality, its distance.
    far = least + 9 * normals.norm(dim=-1)
    missing, more = (found(wanted, each * normals, each * far, low, high).shortfall for each in (1.0, size))
    torch.testing.assert_close(more, missing, rtol=1e-9, atol=1e-9)
    assert float(missing.min()) > 1


def dense(wanted: np.ndarray, rows: np.ndarray, least: np.ndarray) -> np.ndarray | None:
    """The nearest point by Lawson and Hanson's least distance programming; None where there is none."""
    from scipy.optimize import nnls

    matrix = np.vstack([rows.T, (least - rows @ wanted)[None]])
    right = np.zeros(len(matrix))
    right[-1] = 1.0
    left = matrix @ nnls(matrix, right, maxiter=1000)[0] - right
    return None if np.linalg.norm(left) < 1e-9 else wanted - left[:-1] / left[-1]


@pytest.mark.parametrize(("m", "k"), [(2, 1), (2, 3), (3, 2), (4, 1)])
def test_the_program_has_the_solution_of_a_dense_solver(m: int, k: int) -> None:
    generator = torch.Generator().manual_seed(10 * m + k)
    normals = torch.randn(60, k, m, dtype=torch.float64, generator=generator)
    wanted = 2 * torch.randn(60, m, dtype=torch.float64, generator=generator)
    least = 0.5 * torch.randn(60, k, dtype=torch.float64, generator=generator)
    low, high = -uniform(m, low=0.2, high=1.2, seed=m), uniform(m, low=0.2, high=1.2, seed=k)
    high[0] = torch.inf if m > 1 else high[0]
    answer = found(wanted, normals, least, low, high)
    bounded = torch.isfinite(high)
    limits = torch.cat((torch.eye(m).double(), -torch.eye(m).double()[bounded]))
    ends = torch.cat((low, -high[bounded]))
    solved = 0
    for row in range(60):
        rows, right = torch.cat((normals[row], limits)), torch.cat((least[row], ends))
        best = dense(wanted[row].numpy(), rows.numpy(), right.numpy())
        if best is None:
            assert float(answer.shortfall[row]) > 1e-6
            continue
        solved += 1
        assert np.abs(best - answer.point[row].numpy()).max() < 1e-8
        assert float(answer.shortfall[row]) < 1e-8
    assert solved > 10


@pytest.mark.parametrize("m", [1, 2, 3])
def test_no_row_knows_what_the_others_are_nor_how_rows_are_arranged(m: int) -> None:
    normals, wanted, least = uniform(8, 2, m, seed=1), 2 * uniform(8, m, seed=2), uniform(8, 2, seed=3)
    wanted[2], least[3], normals[4], least[5] = 1e12, 1e12, 1e-9 * normals[4], 5.0  # the last: none fits
    wanted[6], normals[7] = torch.nan, torch.nan
    low, high = torch.full((m,), -0.7, dtype=torch.float64), torch.full((m,), 0.9, dtype=torch.float64)
    together = found(wanted, normals, least, low, high)
    assert bool(together.point[6:].isnan().all())
    deep = found(wanted.view(2, 4, m), normals.view(2, 4, 2, m), least.view(2, 4, 2), low, high)
    torch.testing.assert_close(deep.point.view(8, m), together.point, equal_nan=True)
    assert deep.shortfall.shape == (2, 4)
    for k in range(6):
        alone = found(wanted[k : k + 1], normals[k : k + 1], least[k : k + 1], low, high)
        torch.testing.assert_close(alone.point, together.point[k : k + 1], rtol=1e-12, atol=1e-12)
        torch.testing.assert_close(alone.shortfall, together.shortfall[k : k + 1], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("m", [1, 2, 3])
def test_a_zero_normal_is_what_nothing_can_change(m: int) -> None:
    normals = torch.zeros(2, 2, m, dtype=torch.float64)
    normals[:, 1, 0] = 2.0
    wanted, least = torch.zeros(2, m).double(), tensor([[0.25, 1.0], [-3.0, 1.0]])
    answer = found(wanted, normals, least)
    assert answer.shortfall.tolist() == pytest.approx([0.25, 0.0], abs=1e-8)
    expected = torch.zeros(2, m).double()
    expected[:, 0] = 0.5
    torch.testing.assert_close(answer.point, expected, rtol=0, atol=1e-7)


@pytest.mark.parametrize(("half", "far", "wanted"), [(0.05, 1.0, -2.0), (5e-6, 1.0, -2.0), (0.02, 1e6, -1e6)])
def test_the_tip_of_a_wedge_is_found_however_narrow_and_however_far(
    half: float, far: float, wanted: float
) -> None:
    """Two edges at an angle of twice `half` that open along 0.3, and a point behind their tip."""
    turned = [0.3 + math.pi / 2 - half, 0.3 - math.pi / 2 + half]
    normals = tensor([[[math.cos(each), math.sin(each)] for each in turned]])
    along = tensor([[math.cos(0.3), math.sin(0.3)]])
    tip = far * along
    answer = found(tip + wanted * along, normals, (normals * tip.unsqueeze(-2)).sum(-1))
    torch.testing.assert_close(answer.point, tip, rtol=1e-11, atol=5e-10 / half)
    assert float(answer.shortfall) < 1e-9


def test_of_one_unknown_the_answer_is_an_interval_or_the_middle_of_what_is_missing() -> None:
    normals, least = uniform(100, 3, 1, seed=4), 0.6 * uniform(100, 3, seed=5)
    wanted, low, high = uniform(100, 1, seed=6), tensor([-0.7]), tensor([0.9])
    answer = found(wanted, normals, least, low, high)
    ends, up = least / normals[..., 0], normals[..., 0] > 0
    bottom = torch.where(up, ends, -INF).amax(-1)
    top = torch.where(up, INF, ends).amin(-1)
    empty = bottom > top
    point = torch.where(empty, (bottom + top) / 2, torch.minimum(torch.maximum(wanted[:, 0], bottom), top))
    torch.testing.assert_close(answer.point[:, 0], point.clamp(-0.7, 0.9), rtol=0, atol=1e-13)
    assert 10 < int(empty.sum()) < 70


@pytest.mark.parametrize("m", [2, 3])
def test_where_nothing_fits_no_small_step_within_the_bounds_misses_less(m: int) -> None:
    normals, least = uniform(60, 3, m, seed=1), uniform(60, 3, seed=2, low=0.4, high=2.0)
    wanted, low, high = uniform(60, m, seed=3), tensor([-0.5] * m), tensor([0.4] * m)
    answer = found(wanted, normals, least, low, high)
    assert bool(((answer.point >= low) & (answer.point <= high)).all())
    length = normals.norm(dim=-1)

    def missing(u: Tensor) -> Tensor:
        short = least / length - (normals / length.unsqueeze(-1) * u.unsqueeze(-2)).sum(-1)
        return short.clamp(min=0).square().sum(-1)

    none = answer.shortfall > 1e-6
    assert int(none.sum()) > 20
    for size, turn in itertools.product((1e-3, 0.1, 1.0), range(15)):
        other = torch.minimum(torch.maximum(answer.point + size * uniform(60, m, seed=100 + turn), low), high)
        assert bool((missing(other) >= missing(answer.point) - 1e-8)[none].all())


@pytest.mark.parametrize(("m", "k"), [(1, 2), (2, 2), (3, 3)])
def test_single_precision_has_the_same_answers_also_where_nothing_fits(m: int, k: int) -> None:
    wanted, normals, least, low, high = feasible(m, k, rows=100)
    for far in (least, least + normals.norm(dim=-1)):
        exact = found(wanted, normals, far, low, high)
        single = found(*(part.float() for part in (wanted, normals, far, low, high)))
        assert single.point.dtype == torch.float32
        torch.testing.assert_close(single.shortfall.double(), exact.shortfall, rtol=0, atol=1e-2)
        off = (single.point.double() - exact.point).abs().amax(-1)
        assert float(off.median()) < 1e-3

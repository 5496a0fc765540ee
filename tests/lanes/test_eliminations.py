"""Factorisations in scalar operations find what LAPACK finds."""

from __future__ import annotations

import pytest
import torch

from staf_torch import lanes
from staf_torch.lanes.eliminations import eigenvalues


def matrices(size: int, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    torch.manual_seed(size)
    some = torch.randn(9, size, size, dtype=dtype)
    some = some @ some.mT
    some[0], some[1] = 0.0, 3 * torch.eye(size)
    some[2] *= 1e-30 if dtype == torch.float32 else 1e-300
    some[3] *= 1e30 if dtype == torch.float32 else 1e150
    some[4] = torch.rand(size, dtype=dtype).diag()
    some[5] -= 7 * torch.eye(size)
    return some


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("size", [1, 2, 3, 6, 15])
def test_eigenvalues_are_those_of_lapack_to_rounding_of_the_largest(size: int, dtype: torch.dtype) -> None:
    given = matrices(size, dtype)
    wanted = torch.linalg.eigvalsh(given.double())
    error = (eigenvalues(given).double() - wanted).abs().amax(-1)
    assert (error <= 16 * torch.finfo(dtype).eps * wanted.abs().amax(-1)).all()


def test_eigenvalues_of_a_row_that_is_not_finite_are_nan() -> None:
    given = matrices(3)
    given[4, 1, 0] = given[4, 0, 1] = torch.nan
    found = eigenvalues(given)
    assert found[4].isnan().all()
    assert torch.isfinite(found[:4]).all()


def test_a_program_asks_for_eigenvalues_without_vectors() -> None:
    program, given = lanes.Program(lambda _, __, row: ((), torch.linalg.eigvalsh(row))), matrices(3)
    assert program.compiles((), (), given, steps=1)
    found, wanted = program((), (), given, steps=1)[1][:, 0], torch.linalg.eigvalsh(given)
    assert ((found - wanted).abs().amax(-1) <= 16 * 2.3e-16 * wanted.abs().amax(-1)).all()
    assert torch.equal(found[1], eigenvalues(given[1]))  # LAPACK has another last bit

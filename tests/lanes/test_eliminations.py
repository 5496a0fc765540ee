"""Factorisations in scalar operations find what LAPACK finds."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from staf_torch import lanes
from staf_torch.lanes.eliminations import (
    determinant,
    eigen,
    eigenvalues,
    inverse,
    orthogonal,
    solve,
    solve_definite,
    triangular,
)

pytestmark = pytest.mark.needs_compiler


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


@pytest.mark.parametrize("size", [1, 2, 5, 13])
def test_a_definite_system_is_solved_to_the_rounding_of_its_condition(size: int) -> None:
    torch.manual_seed(size)
    some, right = torch.randn(9, size, size).double(), torch.randn(9, size).double()
    gram = some @ some.mT + 0.1 * torch.eye(size)
    error = solve_definite(gram, right) - torch.linalg.solve(gram, right)
    assert (error.norm(dim=-1) <= 1e-13 * torch.linalg.cond(gram) * right.norm(dim=-1)).all()
    gram[..., 0, 1:] = torch.nan  # above the diagonal nothing is read
    assert solve_definite(gram, right).isfinite().all()


DEFINITE: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "factor": lambda gram, b: torch.linalg.cholesky_ex(gram)[0],
    "upper factor": lambda gram, b: torch.linalg.cholesky_ex(gram, upper=True)[0],
    "from a lower factor": lambda gram, b: torch.cholesky_solve(b, gram),
    "from an upper factor": lambda gram, b: torch.cholesky_solve(b, gram, upper=True),
    "inverse": lambda gram, b: torch.linalg.inv_ex(gram - gram.new_tensor(4.0).expand(gram.shape))[0],
}
for _upper, _left, _unit in itertools.product([True, False], repeat=3):
    DEFINITE[f"triangle {_upper} {_left} {_unit}"] = lambda gram, b, upper=_upper, left=_left, unit=_unit: (
        torch.linalg.solve_triangular(gram, b if left else b.mT, upper=upper, left=left, unitriangular=unit)
    )


def test_a_program_factors_and_solves_as_torch_does() -> None:
    """Matrices with other numbers above the diagonal than below, where only one of both is read."""
    torch.manual_seed(1)
    some, right = torch.randn(5, 4, 4).double(), torch.randn(5, 4, 2).double()
    given = some + 5 * torch.eye(4), some @ some.mT + torch.eye(4), right

    def step(_: object, __: object, row: tuple[Tensor, ...]) -> tuple[tuple[()], dict[str, Tensor]]:
        matrix, gram, b = row
        parts = {name: matrix if "triangle" in name or "from" in name else gram for name in DEFINITE}
        return (), {name: DEFINITE[name](of, b) for name, of in parts.items()}

    program = lanes.Program(step)
    assert program.compiles((), (), given, steps=1)
    found, wanted = (run((), (), given, steps=1)[1] for run in (program, program.definition))
    for name in DEFINITE:
        torch.testing.assert_close(
            found[name], wanted[name], rtol=1e-10, atol=1e-10, msg=lambda m, n=name: f"{n}: {m}"
        )


def test_matrices_of_many_entries_are_factored_a_row_a_pass() -> None:
    """Loops in the program, and also a row whose pivot is not positive."""
    torch.manual_seed(2)
    some, right = torch.randn(5, 9, 9).double(), torch.randn(5, 9, 2).double()
    definite = some @ some.mT + torch.eye(9)
    definite[3] -= 4 * torch.eye(9)

    def step(_: object, __: object, row: tuple[Tensor, ...]) -> tuple[tuple[()], tuple[Tensor, ...]]:
        gram, near, b = row
        above = torch.linalg.solve_triangular(near.mT, b, upper=True, unitriangular=True)
        return (), (*torch.linalg.cholesky_ex(gram), torch.cholesky_solve(b, near), above)

    program, given = lanes.Program(step), (definite, some + 5 * torch.eye(9), right)
    assert program.compiles((), (), given, steps=1)
    found, wanted = (run((), (), given, steps=1)[1] for run in (program, program.definition))
    assert torch.equal(found[1], wanted[1])
    assert wanted[1][3] > 0
    for one, other in zip(found, wanted, strict=True):
        torch.testing.assert_close(one[[0, 1, 2, 4]], other[[0, 1, 2, 4]], rtol=1e-9, atol=1e-9)


def test_triangles_and_inverses_of_many_entries_are_those_of_torch() -> None:
    torch.manual_seed(3)
    matrix, right = torch.randn(5, 9, 9).double() + 5 * torch.eye(9), torch.randn(5, 9, 2).double()
    q, r = orthogonal(matrix)
    torch.testing.assert_close(q @ r, matrix, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(q @ q.mT, torch.eye(9).double().expand_as(q), rtol=1e-12, atol=1e-12)
    assert torch.equal(r, r.triu())
    torch.testing.assert_close(inverse(matrix)[0], torch.linalg.inv(matrix), rtol=1e-10, atol=1e-12)
    for upper, left, unit in itertools.product([True, False], repeat=3):
        b = right if left else right.mT
        wanted = torch.linalg.solve_triangular(matrix, b, upper=upper, left=left, unitriangular=unit)
        found = triangular(matrix, b, upper=upper, left=left, unitriangular=unit)
        torch.testing.assert_close(found, wanted, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize(("size", "left"), [(3, False), (9, True)])
def test_a_program_solves_with_pivots(size: int, left: bool) -> None:
    torch.manual_seed(size)
    matrix, right = torch.randn(9, size, size).double(), torch.randn(9, size, size).double()
    matrix[:, 0, 0] = 0  # the first pivot is another
    matrix[3], matrix[4, 0] = 0, torch.nan

    def step(_: object, __: object, row: tuple[Tensor, Tensor]) -> tuple[tuple[()], Tensor]:
        return (), torch.linalg.solve_ex(*row, left=left)[0]

    program, given = lanes.Program(step), (matrix, right)
    assert program.compiles((), (), given, steps=1)
    found, wanted = (
        program((), (), given, steps=1)[1][:, 0],
        program.definition((), (), given, steps=1)[1][:, 0],
    )
    fine = [k for k in range(9) if k not in (3, 4)]
    assert not found[[3, 4]].isfinite().any()
    torch.testing.assert_close(found[fine], wanted[fine], rtol=1e-10, atol=1e-10)


def test_the_place_of_a_pivot_that_is_zero_is_said_and_a_vector_is_a_vector() -> None:
    matrix, right = torch.eye(3).double().repeat(2, 1, 1), torch.arange(6.0).double().view(2, 3)
    matrix[1, 1:] = 0
    assert solve(matrix, right.unsqueeze(-1))[3].tolist() == [0, 2]
    assert torch.equal(solve(matrix[:1], right[0])[0], right[:1])


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


@pytest.mark.parametrize("lead", [(), (4,), (2, 3)])
@pytest.mark.parametrize("size", [1, 2, 5])
def test_reflections_give_orthogonal_columns_and_a_triangle(size: int, lead: tuple[int, ...]) -> None:
    matrix = torch.randn(*lead, size, size, dtype=torch.float64)
    matrix[..., 0] = 0 if size == 5 else matrix[..., 0]  # a column that no reflection need move
    q, r = orthogonal(matrix)
    torch.testing.assert_close(q @ r, matrix, rtol=0, atol=1e-13)
    torch.testing.assert_close(q.mT @ q, torch.eye(size).double().expand_as(q), rtol=0, atol=1e-13)
    assert torch.equal(r, r.triu())


@pytest.mark.parametrize("size", [1, 2, 3, 6])
def test_rotations_give_eigenvalues_in_their_order_with_their_vectors(size: int) -> None:
    torch.manual_seed(size)
    some = torch.randn(2, 3, size, size, dtype=torch.float64)
    gram = some + some.mT
    found, vectors = eigen(gram)
    torch.testing.assert_close(found, torch.linalg.eigvalsh(gram), rtol=0, atol=1e-12)
    torch.testing.assert_close(vectors * found.unsqueeze(-2) @ vectors.mT, gram, rtol=0, atol=1e-12)
    torch.testing.assert_close(vectors.mT @ vectors, torch.eye(size).double().expand_as(gram))


@pytest.mark.parametrize("lead", [(), (5,), (2, 3)])
def test_reflections_take_any_leading_dimensions(lead: tuple[int, ...]) -> None:
    torch.manual_seed(4)
    some = torch.randn(*lead, 9, 9).double()
    for matrix in (some, torch.eye(9) + 1e-7 * some, 1e-7 * some - torch.eye(9)):  # two that hardly turn
        q, r = orthogonal(matrix)
        torch.testing.assert_close(q @ r, matrix, rtol=1e-12, atol=1e-13)
        torch.testing.assert_close(q @ q.mT, torch.eye(9).double().expand_as(q), rtol=1e-12, atol=1e-13)
        assert torch.equal(r, r.triu())


@pytest.mark.parametrize("lead", [(), (5,), (2, 5)])
@pytest.mark.parametrize("size", [1, 2, 3, 4, 6])
def test_a_determinant_is_that_of_torch_also_where_rows_change_places(
    size: int, lead: tuple[int, ...]
) -> None:
    torch.manual_seed(size)
    matrix = torch.randn(*lead, size, size).double()
    if lead:
        matrix[..., 0, :, :] = torch.eye(size).flip(0)
        matrix[..., 1, :, :] = torch.eye(size).roll(1, 0)
        matrix[..., 2, :, 0] = 0
        matrix[..., 3, 0, 0] = 0
    torch.testing.assert_close(determinant(matrix), torch.linalg.det(matrix), rtol=1e-11, atol=1e-12)

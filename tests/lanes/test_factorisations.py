"""Factorisations in scalar operations find what LAPACK finds, also compiled."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from typing import Any

import hypothesis.strategies as st
import pytest
import torch
from helpers import random_positive_definite, uniform
from hypothesis import given, settings
from torch import Tensor

from staf_torch import lanes
from staf_torch.lanes.trace.eigenvalues import eigen, eigenvalues
from staf_torch.lanes.trace.factorisations import (
    cholesky,
    cholesky_solve,
    determinant,
    inverse,
    log_determinant,
    orthogonal,
    solve,
    solve_definite,
    triangular,
)
from staf_torch.numerics.linalg import condition_number, pivoted_cholesky

SEEDS = st.integers(0, 2**31)


def drawn(*shape: int, dtype: torch.dtype = torch.float64) -> Tensor:
    generator = torch.Generator().manual_seed(sum(shape))
    return torch.randn(*shape, dtype=torch.float64, generator=generator).to(dtype)


def alike(found: Any, wanted: Any, dtype: torch.dtype) -> None:
    bound = 2000 * torch.finfo(dtype).eps
    assert found.dtype == wanted.dtype
    assert found.shape == wanted.shape
    sizes = wanted.double().abs()
    scale = 1 + float(sizes[sizes.isfinite()].max()) if bool(sizes.isfinite().any()) else 1.0
    torch.testing.assert_close(found, wanted, rtol=bound, atol=bound * scale, equal_nan=True)


def pairs(size: int, lead: tuple[int, ...], dtype: torch.dtype) -> Iterator[tuple[Any, Any]]:
    """What is found and what torch finds, of one matrix or more."""
    a = drawn(*lead, size, size, dtype=dtype) + 3 * torch.eye(size, dtype=dtype)
    gram, b = a @ a.mT + torch.eye(size, dtype=dtype), drawn(*lead, size, 2, dtype=dtype)
    for upper in (False, True):
        found, failed = cholesky(gram, upper=upper)
        yield found, torch.linalg.cholesky(gram, upper=upper)
        yield failed, torch.linalg.cholesky_ex(gram)[1]
        yield cholesky_solve(b, found, upper), torch.linalg.solve(gram, b)
    for upper, left, unit in itertools.product((True, False), repeat=3):
        right = b if left else b.mT
        yield (
            triangular(a / 4, right, upper=upper, left=left, unitriangular=unit),
            torch.linalg.solve_triangular(a / 4, right, upper=upper, left=left, unitriangular=unit),
        )
    inverted, failed = inverse(a)
    yield inverted, torch.linalg.inv(a)
    yield failed, torch.linalg.inv_ex(a)[1]
    yield solve_definite(gram, b[..., 0]), torch.linalg.solve(gram, b[..., :1]).squeeze(-1)
    for right, options in ((b, {}), (b.mT, {"left": False}), (b[..., 0], {})):
        if right.dim() == a.dim() or lead != ():
            solution, factor, pivots, info = solve(a, right, **options)
            wanted = torch.linalg.solve_ex(a, right, **options)
            yield solution, wanted[0]
            yield info, wanted[1]
            assert torch.equal(factor, a)
            assert pivots.dtype == torch.int32
            assert bool((pivots == -1).all())
            assert pivots.shape == a.shape[:-1]
    q, r = orthogonal(a)
    yield q @ r, a
    yield q @ q.mT, torch.eye(size, dtype=dtype).expand_as(a)
    values, vectors = eigen(gram)
    yield values, torch.linalg.eigvalsh(gram)
    yield vectors * values.unsqueeze(-2) @ vectors.mT, gram
    yield eigenvalues(gram), torch.linalg.eigvalsh(gram)
    for matrix in (a, a.flip(-1), a.roll(1, -1), 0 * a):  # rows change places
        yield determinant(matrix), torch.linalg.det(matrix)
    yield from zip(log_determinant(-a), torch.linalg.slogdet(-a), strict=True)


@pytest.mark.parametrize(
    ("size", "lead", "dtype"),
    [
        (1, (2,), torch.float64),
        (2, (2, 3), torch.float32),
        (4, (), torch.float64),
        (9, (2, 3), torch.float64),
    ],
)
def test_factorisations_of_any_batch_are_those_of_torch(
    size: int, lead: tuple[int, ...], dtype: torch.dtype
) -> None:
    for found, wanted in pairs(size, lead, dtype):
        alike(found, wanted, dtype)


def test_right_sides_and_matrices_broadcast() -> None:
    a, b = drawn(3, 3) + 3 * torch.eye(3), drawn(4, 3, 2)
    alike(solve(a, b)[0], torch.linalg.solve(a, b), torch.float64)
    alike(solve(drawn(5, 1, 3, 3), b)[0], torch.linalg.solve(drawn(5, 1, 3, 3), b), torch.float64)
    several = drawn(2, 3, 3) + 3 * torch.eye(3)
    for right in (drawn(3, 3), drawn(3, 1), drawn(1, 3, 2)):
        alike(solve(several, right)[0], torch.linalg.solve(several, right), torch.float64)
        alike(solve(several[:1], right)[0], torch.linalg.solve(several[:1], right), torch.float64)
    alike(solve(several[0], drawn(3))[0], torch.linalg.solve(several[0], drawn(3)), torch.float64)
    wide, many = drawn(9, 9) + 5 * torch.eye(9), drawn(4, 9, 2)
    wanted = torch.linalg.solve_triangular(wide, many, upper=True)
    alike(triangular(wide, many, upper=True), wanted, torch.float64)


@pytest.mark.parametrize("size", [3, 9])
def test_the_first_pivot_that_is_not_positive_is_told(size: int) -> None:
    gram = torch.eye(size).double().repeat(5, 1, 1)
    gram[1, 0, 0], gram[2, 1, 1], gram[3, 2, 2], gram[4, 1, 1] = 0.0, -1.0, torch.nan, 0.0
    gram[4, 2, 2] = -1.0
    found = cholesky(gram)[1]
    assert found.tolist() == [0, 1, 2, 3, 2]
    assert found.dtype == torch.int32
    singular = torch.eye(size).double().repeat(3, 1, 1)
    singular[1, :, 0], singular[2, 2:, 2:] = 0.0, 0.0
    assert solve(singular, singular)[3].tolist() == [0, 1, 3]


def test_pivots_are_the_largest_of_their_columns_in_size() -> None:
    """Rows that would lose all digits without an exchange, with numbers of either sign."""
    for head in (1e-20, -1e-20, 0.0):
        a = torch.tensor([[head, 1.0, 2.0], [-3.0, 1.0, 0.0], [2.0, 5.0, 1.0]], dtype=torch.float64)
        b = torch.tensor([[1.0], [2.0], [3.0]], dtype=torch.float64)
        alike(solve(a, b)[0], torch.linalg.solve(a, b), torch.float64)
        alike(inverse(a)[0], torch.linalg.inv(a), torch.float64)
        alike(determinant(a), torch.linalg.det(a), torch.float64)
        alike(log_determinant(a)[1], torch.linalg.slogdet(a)[1], torch.float64)


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


@pytest.mark.parametrize(
    ("size", "dtype"), [(1, torch.float64), (2, torch.float32), (3, torch.float64), (15, torch.float32)]
)
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


@pytest.mark.parametrize("size", [2, 13])
def test_a_definite_system_is_solved_to_the_rounding_of_its_condition(size: int) -> None:
    torch.manual_seed(size)
    some, right = torch.randn(9, size, size).double(), torch.randn(9, size).double()
    gram = some @ some.mT + 0.1 * torch.eye(size)
    error = solve_definite(gram, right) - torch.linalg.solve(gram, right)
    assert (error.norm(dim=-1) <= 1e-13 * torch.linalg.cond(gram) * right.norm(dim=-1)).all()
    gram[..., 0, 1:] = torch.nan  # above the diagonal nothing is read
    assert solve_definite(gram, right).isfinite().all()


# Compiled.

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


@pytest.mark.needs_compiler
def test_programs_factor_and_solve_as_torch_does() -> None:
    """Four by four written out, nine by nine in memory; of other triangles only one is read;
    a pivot that is not positive, first pivots that are zero, rows that are lost; on a device, too."""
    torch.manual_seed(1)
    few, many = (torch.randn(9, size, size).double() for size in (4, 9))
    grams = [some @ some.mT + torch.eye(some.shape[-1]) for some in (few, many)]
    grams[1][3] -= 4 * torch.eye(9)
    singular = [some.clone() for some in (few[:, :3, :3], many)]
    for some in singular:
        some[:, 0, 0], some[3], some[4, 0] = 0, 0, torch.nan
    given = few + 5 * torch.eye(4), many + 5 * torch.eye(9), *grams, *singular, torch.randn(9, 9, 2).double()

    def step(_: object, __: object, row: tuple[Tensor, ...]) -> tuple[tuple[()], dict[str, Any]]:
        matrix, near, gram, definite, small, large, b = row
        parts = {name: matrix if "triangle" in name or "from" in name else gram for name in DEFINITE}
        found: dict[str, Any] = {name: DEFINITE[name](of, b[:, :4]) for name, of in parts.items()}
        found["of many"] = torch.linalg.cholesky_ex(definite)
        found["from many"] = torch.cholesky_solve(b, near)
        found["triangle of many"] = torch.linalg.solve_triangular(near.mT, b, upper=True, unitriangular=True)
        found["pivots"] = torch.linalg.solve_ex(small, small.mT + 1, left=False)[0]
        found["many pivots"] = torch.linalg.solve_ex(large, b)[0]
        found["eigenvalues"] = torch.linalg.eigvalsh(gram)
        return (), found

    program = lanes.Program(step)
    assert program.compiles((), (), given, steps=1)
    found, wanted = (run((), (), given, steps=1)[1] for run in (program, program.definition))
    with lanes.device.host():
        torch.testing.assert_close(program((), (), given, steps=1)[1], found, equal_nan=True)
    (factor, failed), (known, place) = found.pop("of many"), wanted.pop("of many")
    assert torch.equal(failed, place)
    assert place[3] > 0
    fine = [0, 1, 2, 5, 6, 7, 8]
    torch.testing.assert_close(factor[fine], known[fine], rtol=1e-9, atol=1e-9)
    for name, one in found.items():
        rows = fine if "pivots" in name else slice(None)
        torch.testing.assert_close(
            one[rows], wanted[name][rows], rtol=1e-9, atol=1e-9, msg=lambda m, n=name: f"{n}: {m}"
        )
        assert "pivots" not in name or not one[[3, 4]].isfinite().any()


# Pivoted Cholesky.


def low_rank(seed: int, *batch: int, size: int, rank: int) -> torch.Tensor:
    half = uniform(*batch, size, rank, seed=seed)
    return half @ half.mT


def reassembled(gram: torch.Tensor) -> torch.Tensor:
    """L L' with its columns beyond the rank dropped, back in the order of K."""
    factor, order, _ = found = pivoted_cholesky(gram)
    kept = factor * found.kept().unsqueeze(-2)
    position = order.argsort(-1)
    rows = kept.gather(-2, position.unsqueeze(-1).expand(kept.shape))
    return rows @ rows.mT


@settings(max_examples=25)
@given(seed=SEEDS, size=st.integers(1, 9), data=st.data())
def test_a_factor_reproduces_its_matrix_and_knows_the_rank(seed: int, size: int, data: st.DataObject) -> None:
    rank = data.draw(st.integers(1, size))
    whole = rank == size
    gram = random_positive_definite(seed, 3, size=size) if whole else low_rank(seed, 3, size=size, rank=rank)
    found = pivoted_cholesky(gram)
    assert (found.rank == rank if whole else found.rank <= rank).all()
    assert torch.equal(found.factor, found.factor.tril())
    near = (1e-14 if whole else 1e-13) * size * float(gram.abs().max())
    torch.testing.assert_close(reassembled(gram), gram, rtol=0, atol=near)
    if not whole:
        return
    values = uniform(3, size, seed=seed)
    solved = found.solve_upper(found.solve_lower(values))
    torch.testing.assert_close((gram @ solved.unsqueeze(-1)).squeeze(-1), values, rtol=0, atol=1e-11)
    beta = found.solve_lower(values)  # |beta|^2 = v'K^-1 v, the squared native norm of the interpolant
    torch.testing.assert_close(beta.square().sum(-1), (values * solved).sum(-1), rtol=1e-10, atol=1e-14)


def test_batch_equals_loop() -> None:
    definite, deficient = random_positive_definite(1, 3, size=5), low_rank(2, 3, size=5, rank=2)
    gram, values = torch.cat((definite, deficient, torch.zeros(1, 5, 5).double())), uniform(7, 5)
    together = pivoted_cholesky(gram)
    solved = together.solve_upper(together.solve_lower(values))
    for row in range(7):
        alone = pivoted_cholesky(gram[row])
        assert all(torch.equal(part[row], own) for part, own in zip(together, alone, strict=True))
        own = alone.solve_upper(alone.solve_lower(values[row]))
        torch.testing.assert_close(solved[row], own, rtol=1e-13, atol=0)


def test_a_matrix_that_is_not_finite_has_rank_zero_and_spoils_no_other() -> None:
    clean = random_positive_definite(1, 4, size=4)
    gram = clean.clone()
    gram[2, 1, 3] = gram[2, 3, 1] = torch.inf
    found, expected = pivoted_cholesky(gram), pivoted_cholesky(clean)
    assert found.rank.tolist() == [4, 4, 0, 4]
    others = [0, 1, 3]
    assert torch.equal(found.factor[others], expected.factor[others])
    assert torch.isinf(condition_number(gram)[others]).sum() == 0
    assert torch.isnan(condition_number(gram)[2])


def test_factorisation_can_be_differentiated() -> None:
    gram = random_positive_definite(3, size=4, log_condition=1.0).requires_grad_()
    values = uniform(4)

    def solve(matrix: torch.Tensor) -> torch.Tensor:
        found = pivoted_cholesky((matrix + matrix.mT) / 2)
        return found.solve_upper(found.solve_lower(values))

    assert torch.autograd.gradcheck(solve, (gram,))

"""Factorisations and orders in plain torch, beside torch's own: shapes, dtypes, options, special rows."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
from torch import Tensor

from staf_torch.lanes import replacements
from staf_torch.lanes.eliminations import (
    _is_finite,
    _logdet,
    _one_hot,
    cholesky,
    cholesky_solve,
    determinant,
    eigen,
    eigenvalues,
    inverse,
    log_determinant,
    orthogonal,
    solve,
    solve_definite,
    triangular,
)
from staf_torch.lanes.tracer import NotLoweredError

LEADS = ((), (2,), (2, 3))


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
            assert factor.isnan().all()
            assert factor.shape == a.shape
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
    yield determinant(a), torch.linalg.det(a)
    yield from zip(log_determinant(-a), torch.linalg.slogdet(-a), strict=True)
    yield _logdet(a), torch.logdet(a)
    flipped = a.flip(-1)
    yield _logdet(flipped), torch.logdet(flipped)


@pytest.mark.parametrize("lead", LEADS)
@pytest.mark.parametrize(
    ("size", "dtype"), [(1, torch.float64), (2, torch.float32), (4, torch.float64), (9, torch.float64)]
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


def test_one_hot_and_finite_are_those_of_torch() -> None:
    index = torch.tensor([[0, 2], [1, 1]])
    alike(_one_hot(index, 4), torch.nn.functional.one_hot(index, 4), torch.float64)
    alike(_one_hot(index), torch.nn.functional.one_hot(index), torch.float64)
    assert _one_hot(torch.tensor([0, 1]), 1).tolist() == [[1], [0]]  # nothing is read back to be checked
    alike(_one_hot(torch.tensor([0]), 1), torch.nn.functional.one_hot(torch.tensor([0]), 1), torch.float64)
    x = torch.tensor([1.0, torch.nan, torch.inf, -torch.inf, -2.0])
    assert _is_finite(x).tolist() == torch.isfinite(x).tolist()
    assert _is_finite(index).dtype == torch.bool
    assert _is_finite(index).all()


# Orders.

SPECIAL = torch.tensor(
    [
        [3.0, torch.nan, 1.0, 3.0, -0.0, 0.0, torch.inf],
        [2.0, 2.0, torch.nan, torch.nan, -1.0, -torch.inf, 2.0],
    ]
)
NUMBERS = torch.tensor([[3.0, 1.0, 2.0, 3.0, -1.0, 0.5, 2.0], [2.0, 2.0, 5.0, 4.0, -1.0, -7.0, 2.0]])


def shapes(x: Tensor) -> Iterator[tuple[Tensor, int]]:
    yield x, -1
    yield x, 1
    yield x.mT.contiguous(), 0
    yield x[0], 0
    yield x.unsqueeze(1), 2
    yield x.mT.unsqueeze(0), -2


def test_orders_and_running_extremes_are_those_of_torch_along_any_dimension() -> None:
    for x, dim in (*shapes(SPECIAL), *shapes(NUMBERS)):
        for name in ("cummax", "cummin"):
            for one, other in zip(
                getattr(replacements, name)(x, dim), getattr(torch, name)(x, dim), strict=True
            ):
                alike(one, other, torch.float32)
        for keep in (False, True):
            found, wanted = replacements.median(x, dim, keep), torch.median(x, dim, keep)
            alike(found[0], wanted[0], torch.float32)
            alike(
                torch.gather(x, dim, found[1] if keep else found[1].unsqueeze(dim)).squeeze(dim),
                wanted[0].squeeze(dim) if keep else wanted[0],
                torch.float32,
            )
        alike(replacements.median(x), torch.median(x), torch.float32)
        alike(replacements.cumprod(x, dim), torch.cumprod(x, dim), torch.float32)
        alike(
            replacements.cumprod(x, dim, dtype=torch.float64),
            torch.cumprod(x, dim, dtype=torch.float64),
            torch.float32,
        )
    assert replacements.median(NUMBERS, -1)[0].shape == (2,)
    for x, dim in shapes(NUMBERS):
        for k, keep in ((1, False), (3, True), (7, False)):
            alike(
                replacements.kthvalue(x, k, dim, keep)[0], torch.kthvalue(x, k, dim, keep)[0], torch.float32
            )
        for largest in (True, False):
            alike(replacements.topk(x, 3, dim, largest)[0], torch.topk(x, 3, dim, largest)[0], torch.float32)
    alike(replacements.topk(NUMBERS, 2)[0], torch.topk(NUMBERS, 2)[0], torch.float32)
    alike(replacements.sort(NUMBERS)[0], torch.sort(NUMBERS)[0], torch.float32)
    alike(replacements.kthvalue(NUMBERS, 2)[0], torch.kthvalue(NUMBERS, 2)[0], torch.float32)
    value, place = replacements.sort(torch.tensor(3.0))
    assert (value.item(), place.item(), place.dtype) == (3.0, 0, torch.int64)


def test_places_in_a_table_are_those_of_torch() -> None:
    edges, x = torch.tensor([-1.0, 0.0, 0.0, 2.0]), torch.tensor([[-2.0, -1.0, 0.0], [1.0, 2.0, torch.nan]])
    for options in ({}, {"right": True}, {"side": "right"}, {"side": "left"}):
        wanted = torch.searchsorted(edges, x, **options)
        alike(replacements.searchsorted(edges, x, **options), wanted, torch.float32)
        rows = torch.stack((edges, edges + 1))
        alike(
            replacements.searchsorted(rows, x, **options),
            torch.searchsorted(rows, x, **options),
            torch.float32,
        )


CALLS: dict[str, Callable[[Callable[..., Any], Tensor], Any]] = {
    "fmin": lambda f, x: f(x, x.flip(-1)),
    "fmax": lambda f, x: f(x, x.flip(-1)),
    "angle": lambda f, x: f(x),
}


@pytest.mark.parametrize("name", CALLS)
def test_what_is_no_number_is_as_in_torch(name: str) -> None:
    for x in (SPECIAL, NUMBERS):
        alike(
            CALLS[name](getattr(replacements, name), x), CALLS[name](getattr(torch, name), x), torch.float32
        )


def test_variances_of_few_numbers_and_of_other_precision() -> None:
    x = drawn(3, 4, 5)
    for dims in ([0], [1, 2], [-1], None):
        for correction in (0.0, 1.0, 2.0):
            found = replacements.REPLACEMENTS["prims::var"](x, dims, correction)
            alike(found, torch.var(x, dims, correction=correction), torch.float64)
    assert replacements.REPLACEMENTS["prims::var"](x[:1], [0]).isnan().all()
    single = replacements.REPLACEMENTS["prims::sum"](x.float(), [0], output_dtype=torch.float64)
    alike(single, x.float().sum(0, dtype=torch.float64), torch.float64)
    product = replacements.REPLACEMENTS["prims::prod"]
    alike(
        product(x.float(), [0, 2], output_dtype=torch.float64),
        x.float().double().prod(2).prod(0),
        torch.float64,
    )
    assert product(x.float(), [0]).dtype == torch.float32


def test_a_search_of_a_number_or_with_a_sorter_has_no_form() -> None:
    edges = torch.arange(4.0)
    for x, sorter in ((0.5, None), (edges, torch.arange(4)), (0.5, torch.arange(4))):
        with pytest.raises(NotLoweredError, match="of a number or with a sorter"):
            replacements.searchsorted(edges, x, sorter=sorter)

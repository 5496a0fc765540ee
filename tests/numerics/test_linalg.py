"""Condition numbers, what a matrix must be, modes that nothing reaches, derivatives of rows."""

from __future__ import annotations

import re

import pytest
import torch
from helpers import random_positive_definite, tensor

from staf_torch.numerics import derivatives, linalg
from staf_torch.numerics.linalg import condition_number, exponential


@pytest.mark.parametrize("size", [1, 2, 5, 8])
def test_condition_number_is_the_ratio_of_the_extreme_singular_values(size: int) -> None:
    gram = random_positive_definite(size, 12, size=size)
    torch.testing.assert_close(condition_number(gram), torch.linalg.cond(gram), rtol=1e-9, atol=0)


def test_condition_number_is_infinite_where_the_matrix_is_not_definite_and_spoils_no_other() -> None:
    gram = torch.eye(2).double().repeat(4, 1, 1)
    gram[1], gram[2], gram[3, 0, 1] = tensor([[1.0, 2.0], [2.0, 1.0]]), 0.0, torch.nan
    found = condition_number(gram).tolist()
    assert found[:3] == [1.0, torch.inf, torch.inf]
    assert found[3] != found[3]


@pytest.mark.parametrize("size", [1, 2, 5])
def test_an_exponential_is_exact_at_every_norm_and_the_same_alone(size: int) -> None:
    some = torch.randn(12, size, size, dtype=torch.float64, generator=torch.Generator().manual_seed(size))
    norms = torch.logspace(-6, 0.3, 12, dtype=torch.float64)[:, None, None]
    matrix = some / torch.linalg.matrix_norm(some, 1)[:, None, None] * norms
    series = torch.eye(size, dtype=torch.float64)
    for k in range(40, 0, -1):
        series = torch.eye(size, dtype=torch.float64) + matrix @ series / k
    found = exponential(matrix)
    torch.testing.assert_close(found, series, rtol=0, atol=2e-15)
    for one, alone in zip(matrix, found, strict=True):
        torch.testing.assert_close(exponential(one), alone, rtol=0, atol=2e-15)
        torch.testing.assert_close(exponential(one[None])[0], alone, rtol=0, atol=2e-15)
        torch.testing.assert_close(exponential(one[None, None])[0, 0], alone, rtol=0, atol=2e-15)


@pytest.mark.parametrize(
    ("matrix", "said"),
    [
        (torch.ones(3, 3).double(), "must be (2, 2); got a tensor (3, 3)."),
        (tensor([[1.0, torch.nan], [torch.nan, 1.0]]), "must be finite; got"),
        (tensor([[1.0, 1e-6], [0.0, 1.0]]), "must be symmetric; got [[1.0, 1e-06], [0.0, 1.0]]."),
        (tensor([[1.0, 2.0], [2.0, 1.0]]), "must be positive"),
    ],
)
@pytest.mark.parametrize("name", ["positive_definite", "positive_semidefinite"])
def test_a_matrix_of_another_kind_is_refused(name: str, matrix: torch.Tensor, said: str) -> None:
    check = getattr(linalg, name)
    words = f"{said} {name.removeprefix('positive_')}; got" if said == "must be positive" else said
    with pytest.raises(ValueError, match=re.escape(f"`F(q=...)` {words}")):
        check("F", "q", matrix, 2)


@pytest.mark.parametrize(
    ("discrete", "growing", "decaying"),
    [(False, (0.5, 0.0, -0.5e-9), (-2.0, -1e-6)), (True, (-1.1, 1.0), (-0.9, -1.0 + 1e-6))],
)
def test_a_mode_that_does_not_decay_needs_an_input(
    discrete: bool, growing: tuple[float, ...], decaying: tuple[float, ...]
) -> None:
    first = tensor([[1.0], [0.0]])
    for mode in (*growing, *decaying):
        a = torch.diag(tensor([0.5 if discrete else -1.0, mode]))
        assert linalg.unstabilisable_mode(a, first, discrete) == (mode if mode in growing else None)
        assert linalg.unstabilisable_mode(a, first + first.flip(0), discrete) is None
        assert linalg.unstabilisable_mode(a, first.flip(0), discrete) is None


A, B, EYE = tensor([[0.0, 1.0], [-1.0, 0.0]]), tensor([[0.0], [1.0]]), torch.eye(2).double()


def test_a_riccati_equation_is_solved_and_its_parts_are_checked() -> None:
    pytest.importorskip("scipy", reason="the Riccati equation needs the extra `adp`")
    r = tensor([[0.5]])
    p = linalg.riccati(A, B, EYE, r)
    torch.testing.assert_close(
        A.mT @ p + p @ A - p @ B @ B.mT @ p / 0.5 + EYE, torch.zeros(2, 2).double(), rtol=0, atol=1e-9
    )
    assert torch.equal(p, p.mT)
    assert p.dtype == torch.float64
    assert linalg.riccati(A.float(), B.float(), EYE.float(), r.float()).dtype == torch.float64
    falling, unseen = torch.diag(tensor([2.0, -1.0])), EYE * tensor([0.0, 1e-20])
    for given, said in (
        ((A, B, -EYE, r), r"`riccati(q=...)` must be positive semidefinite"),
        ((A, B, EYE, 0 * r), r"`riccati(r=...)` must be positive definite"),
        ((A, B, EYE, EYE), "`riccati(r=...)` must be (1, 1)"),
        ((falling, B, EYE, r), "not stabilisable: no input reaches its mode with the eigenvalue 2 1/s."),
        ((falling, B.flip(0), unseen, r), "not detectable: the cost Q does not see its mode with the"),
    ):
        with pytest.raises(ValueError, match=re.escape(said)):
            linalg.riccati(*given)


@pytest.mark.parametrize("lead", [(), (4,), (2, 3)])
@pytest.mark.parametrize("outputs", [(), (3,), (2, 3)])
def test_derivatives_of_a_function_of_rows_are_those_of_each_row(
    lead: tuple[int, ...], outputs: tuple[int, ...]
) -> None:
    size = 1
    for each in outputs:
        size *= each
    weights = torch.arange(1.0, 2 * size + 1, dtype=torch.float64).view(2, size)
    at = torch.linspace(-1, 1, 2 * torch.Size(lead).numel(), dtype=torch.float64).view(*lead, 2)

    def function(x: torch.Tensor) -> torch.Tensor:
        return (x @ weights).sin().reshape((*x.shape[:-1], *outputs))

    values, slopes = derivatives.row_jacobian(function, at)
    torch.testing.assert_close(values, function(at))
    want = (at @ weights).cos().unsqueeze(-1) * weights.mT
    torch.testing.assert_close(slopes, want.reshape((*lead, *outputs, 2)))

"""Condition numbers, what a matrix must be, modes that nothing reaches, derivatives of rows."""

from __future__ import annotations

import re

import pytest
import torch
from helpers import random_positive_definite, tensor
from hypothesis import given
from hypothesis import strategies as st

from staf_torch.numerics import derivatives, linalg
from staf_torch.numerics.linalg import condition_number, exponential

SEEDS = st.integers(0, 2**31)


@given(seed=SEEDS, size=st.integers(1, 8))
def test_condition_number_is_the_ratio_of_the_extreme_singular_values(seed: int, size: int) -> None:
    gram = random_positive_definite(seed, 3, size=size)
    torch.testing.assert_close(condition_number(gram), torch.linalg.cond(gram), rtol=1e-9, atol=0)


def test_condition_number_is_infinite_where_the_matrix_is_not_definite() -> None:
    gram = torch.stack((torch.eye(2).double(), tensor([[1.0, 2.0], [2.0, 1.0]]), torch.zeros(2, 2).double()))
    assert condition_number(gram).tolist() == [1.0, torch.inf, torch.inf]


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


def test_a_matrix_that_is_not_finite_has_no_condition_number_and_spoils_no_other() -> None:
    gram = torch.stack((torch.eye(3), torch.eye(3), torch.diag(torch.tensor([1.0, 2.0, 8.0])))).double()
    gram[1, 0, 2] = torch.nan
    found = condition_number(gram).tolist()
    assert (found[0], found[2]) == (1.0, 8.0)
    assert found[1] != found[1]
    assert condition_number(torch.diag(tensor([0.0, 1.0]))) == torch.inf


NOT_SQUARE, ASYMMETRIC = torch.ones(2, 3).double(), tensor([[1.0, 1e-6], [0.0, 1.0]])


@pytest.mark.parametrize(
    ("matrix", "said"),
    [
        (NOT_SQUARE, "must be (2, 2); got [[1.0, 1.0, 1.0], [1.0, 1.0, 1.0]]."),
        (torch.ones(3, 3).double(), "must be (2, 2); got a tensor (3, 3)."),
        (tensor([[1.0, torch.nan], [torch.nan, 1.0]]), "must be finite; got"),
        (ASYMMETRIC, "must be symmetric; got [[1.0, 1e-06], [0.0, 1.0]]."),
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
    ("modes", "discrete", "found"),
    [
        ((-1.0, -2.0), False, None),
        ((-1.0, 0.5), False, 0.5),
        ((-1.0, 0.0), False, 0.0),
        ((-1.0, -1e-6), False, None),
        ((-1.0, -0.5e-9), False, -0.5e-9),
        ((0.5, -0.9), True, None),
        ((0.5, -1.1), True, -1.1),
        ((0.5, 1.0), True, 1.0),
        ((0.5, -1.0 + 1e-6), True, None),
    ],
)
def test_a_mode_that_does_not_decay_needs_an_input(
    modes: tuple[float, float], discrete: bool, found: object
) -> None:
    a = torch.diag(tensor(modes))
    first, second = tensor([[1.0], [0.0]]), tensor([[0.0], [1.0]])
    assert linalg.unstabilisable_mode(a, first, discrete) == found
    assert linalg.unstabilisable_mode(a, first + second, discrete) is None
    assert linalg.unstabilisable_mode(a.T, second, discrete) == (
        None if discrete or modes[0] < 0 else modes[0]
    )


A, B, EYE = tensor([[0.0, 1.0], [-1.0, 0.0]]), tensor([[0.0], [1.0]]), torch.eye(2).double()
TURN, ZERO = A, torch.zeros(2, 1).double()


@pytest.mark.parametrize(
    ("given", "discrete", "said"),
    [
        (
            (torch.diag(tensor([2.0, -1.0])), B, EYE),
            False,
            "not stabilisable: no input reaches its mode with the eigenvalue 2 1/s.",
        ),
        (
            (torch.diag(tensor([2.0, -1.0])), B.flip(0), EYE * tensor([0.0, 1e-20])),
            False,
            "not detectable: the cost Q does not see its mode with the eigenvalue 2 1/s.",
        ),
    ],
)
def test_a_plant_that_cannot_be_regulated_is_refused_with_its_mode(
    given: tuple[torch.Tensor, ...], discrete: bool, said: str
) -> None:
    with pytest.raises(ValueError, match=re.escape(f"The linearisation of it at its equilibrium is {said}")):
        linalg.check_modes(*given, name="it", discrete=discrete)


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
    with pytest.raises(ValueError, match=r"`riccati\(q=\.\.\.\)` must be positive semidefinite"):
        linalg.riccati(A, B, -EYE, r)
    with pytest.raises(ValueError, match=r"`riccati\(r=\.\.\.\)` must be positive definite"):
        linalg.riccati(A, B, EYE, 0 * r)
    with pytest.raises(ValueError, match=r"`riccati\(r=\.\.\.\)` must be \(1, 1\)"):
        linalg.riccati(A, B, EYE, EYE)
    with pytest.raises(
        ValueError, match="The linearisation of the system at its equilibrium is not stabilisable"
    ):
        linalg.riccati(A, ZERO, EYE, r)
    with pytest.raises(
        ValueError, match="The linearisation of a tank at its equilibrium is not stabilisable"
    ):
        linalg.riccati(A, ZERO, EYE, r, name="a tank")


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

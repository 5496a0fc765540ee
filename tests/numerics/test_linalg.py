"""Condition numbers."""

from __future__ import annotations

import pytest
import torch
from helpers import random_positive_definite, tensor
from hypothesis import given
from hypothesis import strategies as st

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

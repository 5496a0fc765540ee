"""Condition numbers."""

from __future__ import annotations

import torch
from helpers import random_positive_definite, tensor
from hypothesis import given
from hypothesis import strategies as st

from staf_torch.numerics.linalg import condition_number

SEEDS = st.integers(0, 2**31)


@given(seed=SEEDS, size=st.integers(1, 8))
def test_condition_number_is_the_ratio_of_the_extreme_singular_values(seed: int, size: int) -> None:
    gram = random_positive_definite(seed, 3, size=size)
    torch.testing.assert_close(condition_number(gram), torch.linalg.cond(gram), rtol=1e-9, atol=0)


def test_condition_number_is_infinite_where_the_matrix_is_not_definite() -> None:
    gram = torch.stack((torch.eye(2).double(), tensor([[1.0, 2.0], [2.0, 1.0]]), torch.zeros(2, 2).double()))
    assert condition_number(gram).tolist() == [1.0, torch.inf, torch.inf]

"""Batched pivoted Cholesky."""

from __future__ import annotations

import pytest
import torch
from helpers import random_positive_definite, uniform
from hypothesis import given
from hypothesis import strategies as st

from staf_torch.lanes.pivoted_cholesky import pivoted_cholesky
from staf_torch.numerics.linalg import condition_number

SEEDS = st.integers(0, 2**31)


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


@given(seed=SEEDS, size=st.integers(1, 9))
def test_factor_reproduces_a_positive_definite_matrix(seed: int, size: int) -> None:
    gram = random_positive_definite(seed, 4, size=size)
    found = pivoted_cholesky(gram)
    assert (found.rank == size).all()
    assert torch.equal(found.factor, found.factor.tril())
    torch.testing.assert_close(reassembled(gram), gram, rtol=0, atol=1e-14 * size * float(gram.abs().max()))


@given(seed=SEEDS, size=st.integers(2, 9), data=st.data())
def test_rank_of_a_deficient_matrix_is_reported(seed: int, size: int, data: st.DataObject) -> None:
    rank = data.draw(st.integers(1, size - 1))
    gram = low_rank(seed, 3, size=size, rank=rank)
    assert (pivoted_cholesky(gram).rank <= rank).all()
    torch.testing.assert_close(reassembled(gram), gram, rtol=0, atol=1e-13 * size * float(gram.abs().max()))


def test_rank_of_well_separated_deficient_matrices_is_exact() -> None:
    for rank in range(1, 6):
        assert (pivoted_cholesky(low_rank(rank, 20, size=6, rank=rank)).rank == rank).all()


@given(seed=SEEDS, size=st.integers(1, 8))
def test_solves_invert_the_matrix(seed: int, size: int) -> None:
    gram = random_positive_definite(seed, 3, size=size)
    values = uniform(3, size, seed=seed)
    found = pivoted_cholesky(gram)
    solved = found.solve_upper(found.solve_lower(values))
    torch.testing.assert_close((gram @ solved.unsqueeze(-1)).squeeze(-1), values, rtol=0, atol=1e-11)
    beta = found.solve_lower(values)  # |beta|^2 = v'K^-1 v, the squared native norm of the interpolant
    torch.testing.assert_close(beta.square().sum(-1), (values * solved).sum(-1), rtol=1e-10, atol=1e-14)


def test_solution_of_a_deficient_system_uses_only_the_pivots_kept() -> None:
    gram = low_rank(3, 5, size=6, rank=3)
    weights = uniform(5, 6)
    values = (gram @ weights.unsqueeze(-1)).squeeze(-1)  # in the range of K, so a solution exists
    found = pivoted_cholesky(gram)
    solved = found.solve_upper(found.solve_lower(values))
    torch.testing.assert_close((gram @ solved.unsqueeze(-1)).squeeze(-1), values, rtol=1e-10, atol=1e-11)
    assert ((solved != 0).sum(-1) == 3).all()


def test_batch_equals_loop() -> None:
    gram = torch.cat(
        [
            random_positive_definite(1, 3, size=5),
            low_rank(2, 3, size=5, rank=2),
            torch.zeros(1, 5, 5).double(),
        ]
    )
    values = uniform(7, 5)
    together = pivoted_cholesky(gram)
    for row in range(7):
        alone = pivoted_cholesky(gram[row])
        assert torch.equal(together.order[row], alone.order)
        assert torch.equal(together.rank[row], alone.rank)
        assert torch.equal(together.factor[row], alone.factor)
        torch.testing.assert_close(
            together.solve_upper(together.solve_lower(values))[row],
            alone.solve_upper(alone.solve_lower(values[row])),
            rtol=1e-13,
            atol=0,
        )


@pytest.mark.parametrize("poison", [torch.nan, torch.inf])
def test_a_matrix_that_is_not_finite_has_rank_zero_and_spoils_no_other(poison: float) -> None:
    clean = random_positive_definite(1, 4, size=4)
    gram = clean.clone()
    gram[2, 1, 3] = gram[2, 3, 1] = poison
    found, expected = pivoted_cholesky(gram), pivoted_cholesky(clean)
    assert found.rank.tolist() == [4, 4, 0, 4]
    others = [0, 1, 3]
    assert torch.equal(found.factor[others], expected.factor[others])
    assert torch.isinf(condition_number(gram)[others]).sum() == 0
    assert torch.isnan(condition_number(gram)[2])


def test_one_factor_serves_many_right_hand_sides() -> None:
    gram = random_positive_definite(5, size=4)
    values = uniform(6, 7, 4)
    found = pivoted_cholesky(gram)
    expected = torch.linalg.solve(gram, values.unsqueeze(-1)).squeeze(-1)
    torch.testing.assert_close(found.solve_upper(found.solve_lower(values)), expected, rtol=1e-9, atol=1e-11)


def test_scaling_of_the_matrix_does_not_change_the_rank() -> None:
    gram = low_rank(7, 4, size=6, rank=4)
    for scale in (2.0**-600, 1.0, 2.0**600):
        assert (pivoted_cholesky(gram * scale).rank == 4).all()


def test_factorisation_can_be_differentiated() -> None:
    gram = random_positive_definite(3, size=4, log_condition=1.0).requires_grad_()
    values = uniform(4)

    def solve(matrix: torch.Tensor) -> torch.Tensor:
        found = pivoted_cholesky((matrix + matrix.mT) / 2)
        return found.solve_upper(found.solve_lower(values))

    assert torch.autograd.gradcheck(solve, (gram,))

"""Small symmetric positive definite systems, one a row of the batch."""

from __future__ import annotations

import torch
from torch import Tensor

_UNROLLED = 12  # unknowns up to which elimination by whole-batch operations is the faster one


def solve_definite(matrix: Tensor, right: Tensor) -> Tensor:
    """M^-1 b for M positive definite: (..., M, M), (..., M) -> (..., M).

    Gauss-Jordan elimination without pivoting, which is stable for a positive definite matrix, as operations
    over the whole batch: a library call a row would take most of a step's time. A row whose matrix is not
    finite comes out non-finite, and the loop's monitor catches it.
    """
    size = right.shape[-1]
    if size > _UNROLLED:
        solution: Tensor = torch.linalg.solve_ex(matrix, right.unsqueeze(-1))[0].squeeze(-1)
        return solution
    identity = torch.eye(size, dtype=right.dtype, device=right.device)
    augmented = torch.cat((matrix, right.unsqueeze(-1)), dim=-1)
    for k in range(size):
        pivot = augmented[..., k, :] / augmented[..., k, k, None]
        # In row k this subtracts (a_kk - 1) times the scaled row, which leaves the scaled row.
        column = augmented[..., :, k] - identity[k]
        augmented = augmented - column.unsqueeze(-1) * pivot.unsqueeze(-2)
    return augmented[..., size]

"""Linear systems of any size."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from .._checks import fail, vector
from .base import ControlAffineSystem


class Linear(ControlAffineSystem):
    """x' = A x, with the exact flow e^{At} x(0).

    Args:
        matrix: A, (n, n), in 1/s.

    Raises:
        ValueError: if ``matrix`` is not square and finite.
    """

    def __init__(self, matrix: Sequence[Sequence[float]] | Tensor) -> None:
        super().__init__()
        rows = matrix.tolist() if isinstance(matrix, Tensor) else matrix
        if isinstance(rows, str) or not isinstance(rows, Sequence) or not rows:
            raise fail("Linear", "matrix", "must be (n, n)", matrix)
        a = torch.tensor([vector("Linear", "matrix", row, len(rows)) for row in rows], dtype=torch.float64)
        self.register_buffer("matrix", a)
        self.matrix: Tensor
        self.dim = a.shape[0]

    def drift(self, x: Tensor) -> Tensor:
        return x @ self.matrix.to(x).mT

    def flow(self, x: Tensor, time: Tensor) -> Tensor:
        propagators = torch.linalg.matrix_exp(time[:, None, None] * self.matrix.to(time))
        return torch.einsum("tij,...j->...ti", propagators.to(x), x)

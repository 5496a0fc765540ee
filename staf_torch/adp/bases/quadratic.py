"""The global quadratic basis: what a linear-quadratic problem needs, and no more."""

from __future__ import annotations

import torch
from torch import Tensor

from ..._checks import integer
from .base import ValueBasis


class QuadraticBasis(ValueBasis):
    """s_k(y) = y_i y_j for i <= j: n (n + 1) / 2 functions without centers.

    Args:
        dim: n, at least 1.

    Raises:
        ValueError: if ``dim`` is not a positive integer.
    """

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.dim = integer("QuadraticBasis", "dim", dim, least=1)
        rows, columns = torch.triu_indices(dim, dim)
        identity = torch.eye(dim, dtype=torch.float64)
        self.register_buffer("left", identity[rows])  # (M, n)
        self.register_buffer("right", identity[columns])
        self.left: Tensor
        self.right: Tensor
        self.count = len(rows)

    def forward(self, y: Tensor, x: Tensor) -> Tensor:
        at = y.unsqueeze(-2)
        return (at * self.left.to(y)).sum(-1) * (at * self.right.to(y)).sum(-1)

    def gradient(self, y: Tensor, x: Tensor) -> Tensor:
        at, left, right = y.unsqueeze(-2), self.left.to(y), self.right.to(y)
        return left * (at * right).sum(-1, keepdim=True) + right * (at * left).sum(-1, keepdim=True)

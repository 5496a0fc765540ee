"""A basis in the first coordinates of a larger state."""

from __future__ import annotations

import torch
from torch import Tensor

from ..._checks import integer
from .base import ValueBasis


class LeadingCoordinates(ValueBasis):
    """s(y) = s_inner(y_1, ..., y_k), constant in the other coordinates.

    In tracking the value must vanish wherever the error does, whatever the desired state is; a basis of the
    error alone does, and its weights follow the desired state in time.

    Args:
        basis: of the first k coordinates.
        dim: n >= k.

    Raises:
        ValueError: if ``dim`` is less than k.
    """

    def __init__(self, basis: ValueBasis, dim: int) -> None:
        super().__init__()
        self.basis = basis
        self.dim = integer("LeadingCoordinates", "dim", dim, least=basis.dim)
        self.count = basis.count

    def forward(self, y: Tensor, x: Tensor) -> Tensor:
        values: Tensor = self.basis(y[..., : self.basis.dim], x[..., : self.basis.dim])
        return values

    def gradient(self, y: Tensor, x: Tensor) -> Tensor:
        inner = self.basis.gradient(y[..., : self.basis.dim], x[..., : self.basis.dim])
        rest = inner.new_zeros(*inner.shape[:-1], self.dim - self.basis.dim)
        return torch.cat((inner, rest), dim=-1)

"""What a basis of a value function is to the actor-critic laws."""

from __future__ import annotations

import abc

from torch import Tensor, nn


class ValueBasis(nn.Module, abc.ABC):
    """V^(y) = W's(y; x): M functions, whose centers may stand around a state x.

    Attributes:
        count: M.
        dim: n.
    """

    count: int
    dim: int

    @abc.abstractmethod
    def forward(self, y: Tensor, x: Tensor) -> Tensor:
        """s(y; x): (..., n), (..., n) -> (..., M)."""

    @abc.abstractmethod
    def gradient(self, y: Tensor, x: Tensor) -> Tensor:
        """Ds, the rows grad s_i(y; x)': (..., n), (..., n) -> (..., M, n)."""

    def value(self, weights: Tensor, x: Tensor) -> Tensor:
        """V^(x) = W's(x; x): (..., M), (..., n) -> (...)."""
        values: Tensor = (weights * self(x, x)).sum(-1)
        return values

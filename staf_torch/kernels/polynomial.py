"""The polynomial kernel."""

from __future__ import annotations

import math

from torch import Tensor

from ..numerics.checks import hold, integer, kept, non_negative
from .base import Kernel, inner, per_entry


class PolynomialKernel(Kernel):
    """k(y, c) = (bias + y'c)^degree.

    Its space is finite: all polynomials of degree <= ``degree`` in n variables, of dimension
    C(n + degree, degree); with ``bias`` zero the homogeneous ones alone, C(n + degree - 1, degree).

    Example:
        >>> k = PolynomialKernel(degree=2)
        >>> k(torch.tensor([[1.0, 0.0]]).double(), torch.tensor([[1.0, 1.0], [0.0, 0.0]]).double())
        tensor([[4., 1.]], dtype=torch.float64)

        Shown by `staf kernel=polynomial`.

    Args:
        degree: at least 1.
        bias: not negative.

    Raises:
        ValueError: if an argument breaks its rule.
    """

    def __init__(self, degree: int = 2, bias: float | Tensor = 1.0) -> None:
        super().__init__()
        self.degree = integer("PolynomialKernel", "degree", degree, least=1)
        self.bias = hold(self, "bias", non_negative("PolynomialKernel", "bias", bias))
        self.full = self.bias.is_meta or bool((self.bias > 0).all())
        """Whether the space holds all polynomials of the degree, not the homogeneous ones alone."""

    def forward(self, x1: Tensor, x2: Tensor) -> Tensor:
        return (inner(x1, x2) + per_entry(self.shift(), 2)).pow(self.degree)

    def gradient(self, x1: Tensor, x2: Tensor, b: Tensor) -> Tensor:
        power = (inner(x1, x2) + per_entry(self.shift(), 2)).pow(self.degree - 1)
        return (self.degree * power * b.unsqueeze(-2)) @ x2

    def shift(self) -> Tensor:
        """The bias, (...); a learned one stays on its side of the rule: positive where it began so."""
        return kept(self, "bias", zero=not self.full)

    def rank(self, dim: int) -> int:
        variables = dim if self.full else dim - 1
        return math.comb(variables + self.degree, self.degree)

    def polynomial_degree(self) -> int | None:
        return self.degree if self.full else None

    def extra_repr(self) -> str:
        return f"degree={self.degree}, {super().extra_repr()}"

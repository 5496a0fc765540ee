"""Functions V: R^n -> R to approximate. Any callable (..., n) -> (...) will do in their place."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import torch
from torch import Tensor, nn

from .lanes.per_row.objects import OfRows
from .numerics.checks import fail, number, own_number, vector

__all__ = ["Cosine", "Paper", "Quadratic"]


class Paper(nn.Module):
    """V(x) = x1^2 + 5 x2^2 + tanh(x1 x2), n = 2.

    It is not in the exponential kernel's space: its native norm there is infinite.

    Example:
        >>> targets.Paper()(torch.tensor([1.0, 0.0]).double())
        tensor(1., dtype=torch.float64)

        Shown by `staf target=paper`.

    Source: Rosenfeld et al., section 7.
    """

    def forward(self, x: Tensor) -> Tensor:
        x1, x2 = x.unbind(-1)
        return x1.square() + 5 * x2.square() + (x1 * x2).tanh()


class Quadratic(nn.Module, metaclass=OfRows):
    """V(x) = x'Px.

    Example:
        >>> targets.Quadratic(2.0)(torch.tensor([1.0, 2.0]).double())
        tensor(10., dtype=torch.float64)

        Shown by `staf target=quadratic`.

    Args:
        matrix: P, (n, n), symmetric; a number p stands for p I in any dimension.

    Raises:
        ValueError: if ``matrix`` is neither, or not symmetric.
    """

    rowwise: ClassVar = {"forward": (1,)}

    def __init__(self, matrix: float | Sequence[Sequence[float]] | Tensor = 1.0) -> None:
        super().__init__()
        entries: float | Tensor = matrix if not isinstance(matrix, Sequence) else _square(matrix)
        p = torch.as_tensor(number("Quadratic", "matrix", entries), dtype=torch.float64, device="cpu")
        if p.dim() not in (0, 2) or (p.dim() == 2 and p.shape[0] != p.shape[1]):
            raise fail("Quadratic", "matrix", "must be a number or (n, n)", matrix)
        if p.dim() == 2 and not torch.equal(p, p.mT):
            raise fail("Quadratic", "matrix", "must be symmetric", matrix)
        self.register_buffer("matrix", p)
        self.matrix: Tensor

    def forward(self, x: Tensor) -> Tensor:
        if self.matrix.dim() == 0:
            return self.matrix.to(x) * x.square().sum(-1)
        return ((x @ self.matrix.to(x)) * x).sum(-1)


class Cosine(nn.Module, metaclass=OfRows):
    """V(x) = cos(a'x + phase).

    Example:
        >>> targets.Cosine(frequency=2.0)(torch.tensor([0.0, 0.0]).double())
        tensor(1., dtype=torch.float64)

        Shown by `staf target=cosine`.

    Args:
        frequency: a, rad per unit of the state: n numbers, (n,), or one for every coordinate.
        phase: rad.

    Raises:
        ValueError: if an argument is not finite.
    """

    rowwise: ClassVar = {"forward": (1,)}

    def __init__(
        self, frequency: float | Sequence[float] | Tensor = 1.0, phase: float | Tensor = 0.0
    ) -> None:
        super().__init__()
        entries = frequency
        if isinstance(frequency, Sequence):
            entries = torch.tensor(
                vector("Cosine", "frequency", frequency), dtype=torch.float64, device="cpu"
            )
        a = torch.as_tensor(number("Cosine", "frequency", entries), dtype=torch.float64, device="cpu")
        if a.dim() > 1:
            raise fail("Cosine", "frequency", "must be a number or n numbers", frequency)
        self.register_buffer("frequency", a)
        self.frequency: Tensor
        # A tensor, so that a compiled program serves every phase; frequency alone is in a state_dict.
        shift = torch.as_tensor(own_number("Cosine", "phase", phase), dtype=torch.float64, device="cpu")
        self.register_buffer("phase", shift, persistent=False)
        self.phase: Tensor

    def forward(self, x: Tensor) -> Tensor:
        return ((x * self.frequency.to(x)).sum(-1) + self.phase.to(x)).cos()


def _square(rows: Sequence[Sequence[float]]) -> Tensor:
    return torch.tensor(
        [vector("Quadratic", "matrix", row, len(rows)) for row in rows], dtype=torch.float64, device="cpu"
    )

"""Gaussians on a fixed grid: the classical basis that must cover the whole region."""

from __future__ import annotations

import itertools

import torch
from torch import Tensor

from ..._checks import flag, integer, positive_real
from .base import ValueBasis


class RBFGridBasis(ValueBasis):
    """s_i(y) = k_i(y) - k_i(0) - grad k_i(0)'y with k_i(y) = exp(-|y - c_i|^2 / (2 width^2)).

    V^ and its gradient vanish at 0 whatever the weights are, as those of V* do. Without the last term
    (``flat=False``) the control does not vanish at 0, and the state settles beside the origin. The centers
    stand on a regular grid over the box [-half_width, half_width]^n.

    Args:
        dim: n.
        points: a side of the grid, at least 2: M = points^n.
        half_width: positive, in the units of the state.
        width: positive; the spacing of the grid by default.
        flat: whether the gradient at 0 is taken off too.

    Raises:
        ValueError: if an argument breaks its rule.
    """

    def __init__(
        self,
        dim: int,
        points: int = 5,
        half_width: float = 2.0,
        width: float | None = None,
        *,
        flat: bool = True,
    ) -> None:
        super().__init__()
        self.dim = integer("RBFGridBasis", "dim", dim, least=1)
        integer("RBFGridBasis", "points", points, least=2)
        side = positive_real("RBFGridBasis", "half_width", half_width)
        spacing = 2 * side / (points - 1)
        self.width = spacing if width is None else positive_real("RBFGridBasis", "width", width)
        line = torch.linspace(-side, side, points, dtype=torch.float64).tolist()
        grid = torch.tensor(list(itertools.product(line, repeat=dim)), dtype=torch.float64)
        self.register_buffer("centers", grid)  # (M, n)
        self.anchor: Tensor
        self.register_buffer("anchor", (-0.5 * grid.square().sum(-1) / self.width**2).exp())
        slope = self.anchor.unsqueeze(-1) * grid / self.width**2  # grad k_i(0), (M, n)
        self.register_buffer("slope", slope if flag("RBFGridBasis", "flat", flat) else 0 * slope)
        self.centers: Tensor
        self.slope: Tensor
        self.count = len(grid)

    def forward(self, y: Tensor, x: Tensor) -> Tensor:
        at = y.unsqueeze(-2)
        return self._bumps(at - self.centers.to(y)) - self.anchor.to(y) - (at * self.slope.to(y)).sum(-1)

    def gradient(self, y: Tensor, x: Tensor) -> Tensor:
        apart = y.unsqueeze(-2) - self.centers.to(y)
        return -self._bumps(apart).unsqueeze(-1) * apart / self.width**2 - self.slope.to(y)

    def _bumps(self, apart: Tensor) -> Tensor:
        bumps: Tensor = (-0.5 * apart.square().sum(-1) / self.width**2).exp()
        return bumps

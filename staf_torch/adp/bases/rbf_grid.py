"""Gaussians on a fixed grid: the classical basis that must cover the whole region."""

from __future__ import annotations

import itertools

import torch
from torch import Tensor

from ..._checks import integer, positive_real
from .base import ValueBasis


class RBFGridBasis(ValueBasis):
    """s_i(y) = exp(-|y - c_i|^2 / (2 width^2)) - exp(-|c_i|^2 / (2 width^2)), so that V^(0) = 0.

    The centers stand on a regular grid over the box [-half_width, half_width]^n. A center at the origin
    is kept: its function is e^{-|y|^2 / 2 width^2} - 1.

    Args:
        dim: n.
        points: a side of the grid, at least 2: M = points^n.
        half_width: positive, in the units of the state.
        width: positive; the spacing of the grid by default.

    Raises:
        ValueError: if an argument breaks its rule.
    """

    def __init__(
        self, dim: int, points: int = 5, half_width: float = 2.0, width: float | None = None
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
        self.register_buffer("anchor", (-0.5 * grid.square().sum(-1) / self.width**2).exp())
        self.centers: Tensor
        self.anchor: Tensor
        self.count = len(grid)

    def forward(self, y: Tensor, x: Tensor) -> Tensor:
        return self._bumps(y.unsqueeze(-2) - self.centers.to(y)) - self.anchor.to(y)

    def gradient(self, y: Tensor, x: Tensor) -> Tensor:
        apart = y.unsqueeze(-2) - self.centers.to(y)
        return -self._bumps(apart).unsqueeze(-1) * apart / self.width**2

    def _bumps(self, apart: Tensor) -> Tensor:
        bumps: Tensor = (-0.5 * apart.square().sum(-1) / self.width**2).exp()
        return bumps

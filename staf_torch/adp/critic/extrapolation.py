"""Bellman extrapolation: points around the state at which the model, not the plant, is asked."""

from __future__ import annotations

import abc
import itertools
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from ...centers import ConstantRadius, Radius
from ...lanes.per_row.objects import OfRows
from ...numerics.checks import choice, hold, integer, positive


class Extrapolation(nn.Module, metaclass=OfRows):
    """N points y_i = x + b(x) z_i of the box [-b, b]^n around the state, with weights that sum to 1.

    Around the ``origin`` they are y_i = b z_i, wherever the state is. That is what a global basis needs: its
    weights hold everywhere, and points around the state alone let it forget the rest, so that it stalls.

    Example:
        >>> isinstance(adp.RandomPoints(1, half_width=0.5), adp.Extrapolation), adp.RandomPoints(3, 0.5).draws
        (True, 3)

        Shown by `staf experiment=adp`.

    Args:
        half_width: b(x), a positive number or a `Radius`, in the units of the state.
        centers: ``moving`` (each point carries its own centers, the published laws) or ``fixed`` (the
            centers of the state serve all points).
        around: ``state`` or ``origin``; the latter needs a constant b.

    Attributes:
        count: N.
        weights: (N,), sum 1.
        draws: random points that a step needs.
    """

    rowwise: ClassVar = {"forward": (1, 2)}
    count: int
    draws: int = 0
    weights: Tensor

    def __init__(self, half_width: float | Radius, centers: str = "moving", *, around: str = "state") -> None:
        super().__init__()
        name = type(self).__name__
        choice(name, "around", around, ("state", "origin"))
        if centers not in ("moving", "fixed"):
            raise ValueError(f"`{name}(centers=...)` must be 'moving' or 'fixed'; got {centers!r}.")
        if not isinstance(half_width, Radius):
            half_width = ConstantRadius(positive(name, "half_width", half_width))
        self.half_width = half_width
        self.moving = centers == "moving"
        self.fixed_box = around == "origin"
        if self.fixed_box and not self.half_width.constant:
            raise ValueError(f"`{name}(half_width=...)` must be constant for a box around the origin.")

    @abc.abstractmethod
    def cube(self, uniform: Tensor) -> Tensor:
        """z in [-1, 1]^n from ``uniform`` numbers of it, (..., draws, n): (..., N, n) or (N, n)."""

    def forward(self, x: Tensor, uniform: Tensor) -> Tensor:
        """y_i: (..., n), (..., draws, n) -> (..., N, n)."""
        width: Tensor = self.half_width(x)
        middle = torch.zeros_like(x) if self.fixed_box else x
        return middle.unsqueeze(-2) + width[..., None, None] * self.cube(uniform).to(x)


class RandomPoints(Extrapolation):
    """N points a step, independent and uniform in the box (the published laws have N = 1).

    Example:
        >>> points = adp.RandomPoints(2, half_width=0.5)
        >>> points(torch.zeros(1, 2).double(), torch.ones(1, 2, 2).double())  # uniform numbers in, points out
        tensor([[[0.5000, 0.5000],
                 [0.5000, 0.5000]]], dtype=torch.float64)

        Shown by `staf experiment=adp adp/extrapolation=random`.

    Args:
        count: N, at least 1.
        half_width, centers, around: as in `Extrapolation`.
        random: ``counter``, numbers of the row's seed and the step, or ``generator``, those of a generator a
            row as before version 0.2, drawn on the CPU ahead of a loop; the latter goes with version 0.3.

    Raises:
        ValueError: if an argument breaks its rule.
    """

    def __init__(
        self,
        count: int,
        half_width: float | Radius,
        centers: str = "moving",
        *,
        around: str = "state",
        random: str = "counter",
    ) -> None:
        super().__init__(half_width, centers, around=around)
        self.random = choice("RandomPoints", "random", random, ("counter", "generator"))
        self.count = self.draws = integer("RandomPoints", "count", count, least=1)
        self.register_buffer("weights", torch.full((count,), 1 / count, dtype=torch.float64, device="cpu"))

    def cube(self, uniform: Tensor) -> Tensor:
        return uniform


class QuadraturePoints(Extrapolation):
    """The mean over the box itself, by an order^n Gauss-Legendre rule: nothing random is left.

    Example:
        >>> points = adp.QuadraturePoints(3, dim=2, half_width=0.5)
        >>> points(torch.zeros(1, 2).double(), torch.zeros(1, 0, 2).double()).shape  # 3 a coordinate
        torch.Size([1, 9, 2])

        Shown by `staf experiment=adp adp/extrapolation=quadrature`.

    Args:
        order: points a coordinate, at least 1.
        dim: n.
        half_width, centers, around: as in `Extrapolation`.

    Raises:
        ValueError: if an argument breaks its rule.
    """

    def __init__(
        self,
        order: int,
        dim: int,
        half_width: float | Radius,
        centers: str = "moving",
        *,
        around: str = "state",
    ) -> None:
        super().__init__(half_width, centers, around=around)
        integer("QuadraturePoints", "order", order, least=1)
        integer("QuadraturePoints", "dim", dim, least=1)
        nodes, masses = np.polynomial.legendre.leggauss(order)
        grid = torch.tensor(
            list(itertools.product(nodes.tolist(), repeat=dim)), dtype=torch.float64, device="cpu"
        )
        products = torch.tensor(
            list(itertools.product(masses.tolist(), repeat=dim)), dtype=torch.float64, device="cpu"
        )
        self.grid = hold(self, "grid", grid)  # (N, n)
        self.register_buffer("weights", products.prod(-1) / 2**dim)
        self.count = len(grid)

    def cube(self, uniform: Tensor) -> Tensor:
        return self.grid

"""The companion paper's plant with three states and two inputs."""

from __future__ import annotations

import torch
from torch import Tensor

from ..numerics.checks import states
from .base import ControlAffineSystem


class ThreeState(ControlAffineSystem):
    """x' = (x2, x3, sqrt(x'Px)) + [[0, 0], [1, 0], [0, 1]] u,  P = [[1, 1, 1], [0, 1, 1], [0, 0, 1]].

    The root has no derivative at 0, so the linearisation leaves it out.

    Example:
        >>> plant = systems.ThreeState()
        >>> plant.drift(torch.tensor([1.0, 0.0, 0.0]).double())
        tensor([0., 0., 1.], dtype=torch.float64)

        Shown by `staf experiment=adp_three_state`.

    Source: MATH.md section 4, after Kamalapurkar, Rosenfeld and Dixon.
    """

    dim = 3
    inputs = 2
    spread = 0.5

    def drift(self, x: Tensor) -> Tensor:
        x1, x2, x3 = states(self, "x", x, 3).unbind(-1)
        square = x1 * (x1 + x2 + x3) + x2 * (x2 + x3) + x3.square()
        return torch.stack((x2, x3, square.sqrt()), dim=-1)

    def smooth_drift(self, x: Tensor) -> Tensor:
        return torch.stack((x[..., 1], x[..., 2], torch.zeros_like(x[..., 0])), dim=-1)

    def effectiveness(self, x: Tensor) -> Tensor:
        zero, one = torch.zeros_like(x[..., 0]), torch.ones_like(x[..., 0])
        rows = (zero, zero, one, zero, zero, one)
        return torch.stack(rows, dim=-1).reshape(*x.shape, 2)

"""The forced Van der Pol oscillator."""

from __future__ import annotations

import torch
from torch import Tensor

from ..numerics.checks import keep, own_number, states
from .base import ControlAffineSystem, Number


class VanDerPol(ControlAffineSystem):
    """x1' = x2,  x2' = damping (1 - x1^2) x2 - x1 + u.

    Example:
        >>> plant = systems.VanDerPol()
        >>> plant.drift(torch.tensor([1.0, 0.0]).double())
        tensor([ 0., -1.], dtype=torch.float64)

        Shown by `staf system=van_der_pol`.

    Args:
        damping: mu; for mu > 0 the origin is unstable inside a stable limit cycle.

    Raises:
        ValueError: if ``damping`` is not finite.
    """

    dim = 2
    inputs = 1

    def __init__(self, damping: Number = 1.0) -> None:
        super().__init__()
        self.damping = keep(self, "damping", own_number("VanDerPol", "damping", damping))

    def drift(self, x: Tensor) -> Tensor:
        x1, x2 = states(self, "x", x, 2).unbind(-1)
        return torch.stack((x2, self.damping * (1 - x1.square()) * x2 - x1), dim=-1)

    def effectiveness(self, x: Tensor) -> Tensor:
        zero = torch.zeros_like(x[..., 0])
        return torch.stack((zero, zero + 1), dim=-1).unsqueeze(-1)

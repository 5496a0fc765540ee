"""The paper's simulated system."""

from __future__ import annotations

import torch
from torch import Tensor

from ..numerics.checks import keep, own_number, states
from .base import ControlAffineSystem, Number


class Oscillator(ControlAffineSystem):
    """x' = frequency (x2, -x1): circles, with the exact flow
    x(t) = (cos(wt) x1 + sin(wt) x2, -sin(wt) x1 + cos(wt) x2).

    Example:
        >>> plant = systems.Oscillator(frequency=2.0)
        >>> plant.drift(torch.tensor([1.0, 0.0]).double())
        tensor([ 0., -2.], dtype=torch.float64)

        Shown by `staf system=oscillator`.

    Args:
        frequency: w, positive, rad/s.

    Raises:
        ValueError: if ``frequency`` is not positive.

    Source: Rosenfeld et al., section 7 (frequency 1).
    """

    dim = 2

    def __init__(self, frequency: Number = 1.0) -> None:
        super().__init__()
        self.frequency = keep(self, "frequency", own_number("Oscillator", "frequency", frequency, "positive"))

    def drift(self, x: Tensor) -> Tensor:
        x1, x2 = states(self, "x", x, 2).unbind(-1)
        return torch.stack((self.frequency * x2, -self.frequency * x1), dim=-1)

    def flow(self, x: Tensor, time: Tensor) -> Tensor:
        # Angles in float64 even for a float32 state: over a long run t alone uses up its digits.
        angle = self.frequency * time
        cos, sin = angle.cos().to(x), angle.sin().to(x)
        x1, x2 = x.unsqueeze(-2).unbind(-1)  # (..., 1)
        return torch.stack((cos * x1 + sin * x2, cos * x2 - sin * x1), dim=-1)

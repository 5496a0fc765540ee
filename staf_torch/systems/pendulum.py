"""An inverted pendulum."""

from __future__ import annotations

import torch
from torch import Tensor

from ..numerics.checks import keep, own_number, states
from .base import ControlAffineSystem, Number, Units


class Pendulum(ControlAffineSystem):
    """theta' = omega,  omega' = (gravity/length) sin(theta) + (u - damping omega) / (mass length^2).

    theta = 0 is upright, so the open loop is unstable at the equilibrium.

    Example:
        >>> plant = systems.Pendulum()
        >>> plant.drift(torch.tensor([0.0, 1.0]).double())
        tensor([ 1.0000, -0.1000], dtype=torch.float64)

        Shown by `staf system=pendulum`.

    Args:
        mass: kg, positive.
        length: m, positive.
        damping: N m s, not negative.
        gravity: m/s^2, positive.

    Raises:
        ValueError: if an argument breaks its rule.
    """

    dim = 2
    inputs = 1
    units = Units("rad, rad/s", "N m")
    spread = 0.5

    def __init__(
        self, mass: Number = 1.0, length: Number = 1.0, damping: Number = 0.1, gravity: Number = 9.81
    ) -> None:
        super().__init__()
        mass = own_number("Pendulum", "mass", mass, "positive")
        length = own_number("Pendulum", "length", length, "positive")
        gravity = own_number("Pendulum", "gravity", gravity, "positive")
        self.inertia = keep(self, "inertia", mass * length**2)
        self.damping = keep(self, "damping", own_number("Pendulum", "damping", damping, "not negative"))
        self.stiffness = keep(self, "stiffness", gravity / length)  # 1/s^2

    def drift(self, x: Tensor) -> Tensor:
        angle, rate = states(self, "x", x, 2).unbind(-1)
        acceleration = self.stiffness * angle.sin() - (self.damping / self.inertia) * rate
        return torch.stack((rate, acceleration), dim=-1)

    def effectiveness(self, x: Tensor) -> Tensor:
        zero = torch.zeros_like(x[..., 0])
        return torch.stack((zero, zero + 1 / self.inertia), dim=-1).unsqueeze(-1)

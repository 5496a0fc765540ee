"""A quadrotor in a vertical plane, around hover."""

from __future__ import annotations

import torch
from torch import Tensor

from ..numerics.checks import keep, own_number, states
from .base import ControlAffineSystem, Number, Units


class PlanarQuadrotor(ControlAffineSystem):
    """State (y, z, theta, y', z', theta'), input (thrust above hover, torque):

        y'' = -(gravity + u1/mass) sin(theta),  z'' = (gravity + u1/mass) cos(theta) - gravity,
        theta'' = u2 / inertia.

    The input is measured from the hover thrust mass * gravity, so that f(0) = 0.

    Example:
        >>> plant = systems.PlanarQuadrotor()
        >>> plant.drift(torch.tensor([0.0, 0.0, 0.0, 1.0, 0.0, 0.0]).double())
        tensor([1., 0., 0., -0., 0., 0.], dtype=torch.float64)

        Shown by `staf experiment=adp system=planar_quadrotor adp/policy=rollout`.

    Args:
        mass: kg, positive.
        inertia: kg m^2, positive.
        gravity: m/s^2, positive.

    Raises:
        ValueError: if an argument breaks its rule.
    """

    dim = 6
    inputs = 2
    units = Units("m, m, rad, m/s, m/s, rad/s", "N above hover, N m")
    spread = 0.2

    def __init__(self, mass: Number = 1.0, inertia: Number = 0.1, gravity: Number = 9.81) -> None:
        super().__init__()
        self.mass = keep(self, "mass", own_number("PlanarQuadrotor", "mass", mass, "positive"))
        self.inertia = keep(self, "inertia", own_number("PlanarQuadrotor", "inertia", inertia, "positive"))
        self.gravity = keep(self, "gravity", own_number("PlanarQuadrotor", "gravity", gravity, "positive"))

    def drift(self, x: Tensor) -> Tensor:
        angle = states(self, "x", x, 6)[..., 2]
        fall = self.gravity * (angle.cos() - 1)
        forces = torch.stack((-self.gravity * angle.sin(), fall, torch.zeros_like(angle)), dim=-1)
        return torch.cat((x[..., 3:], forces), dim=-1)

    def effectiveness(self, x: Tensor) -> Tensor:
        angle = x[..., 2]
        zero = torch.zeros_like(angle)
        thrust = (zero, zero, zero, -angle.sin() / self.mass, angle.cos() / self.mass, zero)
        torque = (zero, zero, zero, zero, zero, zero + 1 / self.inertia)
        return torch.stack((torch.stack(thrust, dim=-1), torch.stack(torque, dim=-1)), dim=-1)

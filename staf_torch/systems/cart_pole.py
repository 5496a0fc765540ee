"""A pole on a cart."""

from __future__ import annotations

import torch
from torch import Tensor

from ..numerics.checks import keep, own_number, states
from .base import ControlAffineSystem, Number, Units


class CartPole(ControlAffineSystem):
    """State (p, theta, p', theta'), theta = 0 upright, an angle; a uniform pole of half-length l:

        theta'' = (g sin(theta) - cos(theta) s) / (l (4/3 - m cos(theta)^2 / M)),
        p'' = s - m l theta'' cos(theta) / M,   s = (u + m l theta'^2 sin(theta)) / M,

    with m the mass of the pole and M that of cart and pole together.

    Example:
        >>> systems.CartPole().drift(torch.tensor([0.0, 0.0, 1.0, 0.0]).double())
        tensor([1., 0., 0., 0.], dtype=torch.float64)

        Shown by `staf experiment=adp system=cart_pole initial_state=[0.0,0.1,0.0,0.0]`.

    Args:
        cart: kg, positive.
        pole: kg, positive.
        half_length: m, positive.
        gravity: m/s^2, positive.

    Raises:
        ValueError: if an argument breaks its rule.

    Source: Florian, "Correct equations for the dynamics of the cart-pole system" (2007), without friction.
    """

    dim = 4
    inputs = 1
    units = Units("m, rad, m/s, rad/s", "N")
    spread = 0.2
    periodic = (1,)

    def __init__(
        self, cart: Number = 1.0, pole: Number = 0.1, half_length: Number = 0.5, gravity: Number = 9.81
    ) -> None:
        super().__init__()
        self.pole = keep(self, "pole", own_number("CartPole", "pole", pole, "positive"))
        self.total = keep(self, "total", own_number("CartPole", "cart", cart, "positive") + self.pole)
        half_length = own_number("CartPole", "half_length", half_length, "positive")
        self.half_length = keep(self, "half_length", half_length)
        self.gravity = keep(self, "gravity", own_number("CartPole", "gravity", gravity, "positive"))

    def drift(self, x: Tensor) -> Tensor:
        _, angle, speed, turning = states(self, "x", x, 4).unbind(-1)
        lever = self.pole * self.half_length / self.total
        shift = lever * turning.square() * angle.sin()
        bend = (self.gravity * angle.sin() - angle.cos() * shift) / self._reach(angle)
        return torch.stack((speed, turning, shift - lever * bend * angle.cos(), bend), dim=-1)

    def effectiveness(self, x: Tensor) -> Tensor:
        angle = x[..., 1]
        zero = torch.zeros_like(angle)
        bend = -angle.cos() / (self.total * self._reach(angle))
        lever = self.pole * self.half_length / self.total
        push = 1 / self.total - lever * bend * angle.cos()
        return torch.stack((zero, zero, push, bend), dim=-1).unsqueeze(-1)

    def _reach(self, angle: Tensor) -> Tensor:
        reach: Tensor = self.half_length * (4 / 3 - self.pole * angle.cos().square() / self.total)
        return reach

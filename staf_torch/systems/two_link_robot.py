"""An arm of two links in a horizontal plane, with friction in its joints."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ..numerics.checks import hold, positive_real, states, vector
from .base import ControlAffineSystem, Units


class TwoLinkRobot(ControlAffineSystem):
    """State (q1, q2, q1', q2'), input (torque at the shoulder, at the elbow):

        M(q) q'' + C(q, q') q' + F q' + S tanh(q') = u,
        M = [[p1 + 2 p3 cos q2, p2 + p3 cos q2], [., p2]],
        C = p3 sin q2 [[-q2', -q1' - q2'], [q1', 0]],  F = diag(f1, f2),  S = diag(f3, f4).

    Example:
        >>> plant = systems.TwoLinkRobot()
        >>> plant.effectiveness(torch.zeros(4).double())[2:].round(decimals=3)  # M^-1
        tensor([[ 0.3360, -0.7500],
                [-0.7500,  6.7790]], dtype=torch.float64)

        Shown by `staf system=two_link_robot`.

    Args:
        inertia: (p1, p2, p3), kg m^2, with p2 (p1 - p2) > p3^2, so that M is positive definite.
        friction: (f1, f2, f3, f4): viscous in N m s, then dry in N m, of shoulder and elbow.

    Raises:
        ValueError: if an argument breaks its rule.

    Source: Mahmud et al., Front. Robot. AI 8 (2021), second example.
    """

    dim = 4
    inputs = 2
    units = Units("rad, rad, rad/s, rad/s", "N m")

    def __init__(
        self,
        inertia: Sequence[float] = (3.473, 0.196, 0.242),
        friction: Sequence[float] = (5.3, 1.1, 8.45, 2.35),
    ) -> None:
        super().__init__()
        p1, p2, p3 = vector("TwoLinkRobot", "inertia", inertia, 3)
        positive_real("TwoLinkRobot", "inertia", p2)
        # det M = p1 p2 - p2^2 - p3^2 cos^2 q2, least at q2 = 0.
        positive_real("TwoLinkRobot", "inertia", p2 * (p1 - p2) - p3 * p3)
        self.inertia = hold(self, "inertia", torch.tensor([p1, p2, p3], dtype=torch.float64, device="cpu"))
        given = vector("TwoLinkRobot", "friction", friction, 4)
        self.friction = hold(self, "friction", torch.tensor(given, dtype=torch.float64, device="cpu"))

    def drift(self, x: Tensor) -> Tensor:
        p3 = self.inertia.to(states(self, "x", x, 4))[2]
        f1, f2, f3, f4 = self.friction.to(x).unbind(-1)
        bend, w1, w2 = x[..., 1].sin(), x[..., 2], x[..., 3]
        first = p3 * bend * w2 * (2 * w1 + w2) - f1 * w1 - f3 * w1.tanh()
        second = -p3 * bend * w1 * w1 - f2 * w2 - f4 * w2.tanh()
        turned = (self._inverse(x) * torch.stack((first, second), dim=-1).unsqueeze(-2)).sum(-1)
        return torch.cat((x[..., 2:], turned), dim=-1)

    def effectiveness(self, x: Tensor) -> Tensor:
        inverse = self._inverse(x)
        return torch.cat((torch.zeros_like(inverse), inverse), dim=-2)

    def _inverse(self, x: Tensor) -> Tensor:
        """M^-1: (..., 2, 2)."""
        p1, p2, p3 = self.inertia.to(x).unbind(-1)
        bend = x[..., 1].cos()
        one, cross = p1 + 2 * p3 * bend, p2 + p3 * bend
        other = p2 + torch.zeros_like(bend)
        det = one * other - cross * cross
        rows = torch.stack((other, -cross), dim=-1), torch.stack((-cross, one), dim=-1)
        return torch.stack(rows, dim=-2) / det[..., None, None]

"""How far the centers stand from the state."""

from __future__ import annotations

import abc

import torch
from torch import Tensor, nn

from .._checks import non_negative, positive
from .._convention import hold, shown


class Radius(nn.Module, abc.ABC):
    """nu(x) >= 0, the radius of the ball of centers at the state x."""

    constant: bool = False

    def bound(self) -> Tensor | None:
        """sup nu(x) over all states, () or a batch entry; None where it is not known."""
        return None

    @abc.abstractmethod
    def forward(self, x: Tensor) -> Tensor:
        """nu(x): (..., n) -> (...), or what broadcasts to it where it does not depend on x."""

    def extra_repr(self) -> str:
        return shown(self)


class ConstantRadius(Radius):
    """nu(x) = radius.

    Args:
        radius: positive, in the units of the state.

    Raises:
        ValueError: if ``radius`` is not positive and finite.
    """

    constant = True

    def __init__(self, radius: float | Tensor) -> None:
        super().__init__()
        hold(self, "radius", positive("ConstantRadius", "radius", radius))
        self.radius: Tensor

    def bound(self) -> Tensor:
        return self.radius

    def forward(self, x: Tensor) -> Tensor:
        return self.radius.to(x)


class StateRadius(Radius):
    """nu(x) = radius (x'x + offset) / (1 + gain x'x): centers that close in on the origin.

    Args:
        radius: positive; the radius far from the origin is radius / gain.
        offset: not negative; radius * offset is the radius at the origin, where a zero offset lets
            all centers meet.
        gain: positive.

    Raises:
        ValueError: if an argument breaks its rule.

    Source: the paper's appendix has radius 0.7, offset 0.01, gain 1.
    """

    def __init__(self, radius: float | Tensor, offset: float | Tensor, gain: float | Tensor = 1.0) -> None:
        super().__init__()
        hold(self, "radius", positive("StateRadius", "radius", radius))
        hold(self, "offset", non_negative("StateRadius", "offset", offset))
        hold(self, "gain", positive("StateRadius", "gain", gain))
        self.radius: Tensor
        self.offset: Tensor
        self.gain: Tensor

    def bound(self) -> Tensor:
        # nu is monotone in x'x, between radius * offset at the origin and radius / gain far out.
        return self.radius * torch.maximum(self.offset, 1 / self.gain)

    def forward(self, x: Tensor) -> Tensor:
        square = x.square().sum(-1)
        radius, offset, gain = self.radius.to(x), self.offset.to(x), self.gain.to(x)
        return radius * (square + offset) / (1 + gain * square)

"""The inverse multiquadric kernel."""

from __future__ import annotations

from torch import Tensor

from .radial import RadialKernel


class InverseMultiquadricKernel(RadialKernel):
    """k(y, c) = (1 + |y - c|^2 / length_scale^2)^(-1/2).

    Args:
        length_scale: positive, in the units of the state.

    Raises:
        ValueError: if ``length_scale`` is not positive and finite.
    """

    def profile(self, s: Tensor) -> Tensor:
        return (1 + s).rsqrt()

    def slope(self, s: Tensor) -> Tensor:
        return -0.5 * (1 + s) ** -1.5

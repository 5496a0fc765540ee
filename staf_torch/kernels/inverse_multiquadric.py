"""The inverse multiquadric kernel."""

from __future__ import annotations

from torch import Tensor

from .radial import RadialKernel


class InverseMultiquadricKernel(RadialKernel):
    """k(y, c) = (1 + |y - c|^2 / length_scale^2)^(-1/2).

    Example:
        >>> k = InverseMultiquadricKernel(length_scale=2.0)
        >>> k(torch.tensor([[1.0, 0.0]]).double(), torch.tensor([[1.0, 1.0], [0.0, 0.0]]).double())
        tensor([[0.8944, 0.8944]], dtype=torch.float64)

        Shown by `staf kernel=inverse_multiquadric`.

    Args:
        length_scale: positive, in the units of the state.

    Raises:
        ValueError: if the length scale is not positive and finite.
    """

    def profile(self, s: Tensor) -> Tensor:
        return (1 + s).rsqrt()

    def slope(self, s: Tensor) -> Tensor:
        return -0.5 * (1 + s) ** -1.5

"""The rational quadratic kernel."""

from __future__ import annotations

from torch import Tensor

from ..numerics.checks import hold, kept, positive
from .base import per_entry
from .radial import RadialKernel


class RationalQuadraticKernel(RadialKernel):
    """k(y, c) = (1 + |y - c|^2 / (2 alpha length_scale^2))^(-alpha).

    A scale mixture of Gaussian kernels; alpha -> infinity is the Gaussian of that width.

    Example:
        >>> k = RationalQuadraticKernel(alpha=2.0)
        >>> k(torch.tensor([[1.0, 0.0]]).double(), torch.tensor([[1.0, 1.0], [0.0, 0.0]]).double())
        tensor([[0.6400, 0.6400]], dtype=torch.float64)

        Shown by `staf kernel=rational_quadratic`.

    Args:
        alpha: positive shape parameter.
        length_scale: positive, in the units of the state.

    Raises:
        ValueError: if an argument is not positive and finite.
    """

    def __init__(self, alpha: float | Tensor = 1.0, length_scale: float | Tensor = 1.0) -> None:
        super().__init__(length_scale)
        self.alpha = hold(self, "alpha", positive("RationalQuadraticKernel", "alpha", alpha))

    def profile(self, s: Tensor) -> Tensor:
        alpha = per_entry(kept(self, "alpha"), 2)
        return ((s / (2 * alpha)).log1p() * -alpha).exp()

    def slope(self, s: Tensor) -> Tensor:
        alpha = per_entry(kept(self, "alpha"), 2)
        return -0.5 * ((s / (2 * alpha)).log1p() * -(alpha + 1)).exp()

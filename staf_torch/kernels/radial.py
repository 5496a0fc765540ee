"""Radial kernels: a profile of the squared distance, in units of a length scale."""

from __future__ import annotations

import abc

import torch
from torch import Tensor

from ..numerics.checks import hold, kept, positive
from .base import Kernel, per_entry, squared_distance, weighted_differences


class RadialKernel(Kernel):
    """k(y, c) = phi(|y - c|^2 / length_scale^2); a subclass gives the profile phi, phi(0) = 1.

    Near a state the kernel is a function of z - d alone, so its core is itself.

    Example:
        >>> issubclass(MaternKernel, RadialKernel), issubclass(ExponentialKernel, RadialKernel)
        (True, False)

        Shown by `staf kernel=inverse_multiquadric`.
    """

    state_free = True
    scale_slope = 0.0

    def __init__(self, length_scale: float | Tensor = 1.0) -> None:
        super().__init__()
        self.length_scale = hold(
            self, "length_scale", positive(type(self).__name__, "length_scale", length_scale)
        )

    @abc.abstractmethod
    def profile(self, s: Tensor) -> Tensor:
        """phi(s), elementwise, for s >= 0."""

    def slope(self, s: Tensor) -> Tensor | None:
        """phi'(s), elementwise; None where autograd has to find it."""
        return None

    def forward(self, x1: Tensor, x2: Tensor) -> Tensor:
        return self.profile(
            squared_distance(x1, x2) / per_entry(kept(self, "length_scale", squared=True), 2).square()
        )

    def follow(self, y: Tensor, step: Tensor) -> tuple[Tensor, Tensor]:
        return torch.zeros_like(y[..., 0]), torch.zeros_like(y)  # translation invariant

    def core(self, x: Tensor, z: Tensor, d: Tensor) -> Tensor:
        return self.forward(z, d)

    def gradient(self, x1: Tensor, x2: Tensor, b: Tensor) -> Tensor | None:
        scale = per_entry(kept(self, "length_scale", squared=True), 2).square()
        slope = self.slope(squared_distance(x1, x2) / scale)
        if slope is None:
            return None
        return weighted_differences(slope * b.unsqueeze(-2), x2, x1) * (-2 / scale)

    def core_gradient(self, x: Tensor, z: Tensor, d: Tensor, b: Tensor) -> Tensor | None:
        return self.gradient(z, d, b)

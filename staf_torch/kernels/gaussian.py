"""The Gaussian kernel: the exponential kernel, normalised."""

from __future__ import annotations

import torch
from torch import Tensor

from ..numerics.checks import hold, kept, positive
from .base import Kernel, inner, per_entry, squared_distance, weighted_differences


class GaussianKernel(Kernel):
    """k(y, c) = exp(-|y - c|^2 / (2 width^2)).

    Translation invariant: its accuracy and conditioning do not depend on the state. Near a state,
    k = e^{-|z|^2 / 2 width^2} e^{z'd / width^2} e^{-|d|^2 / 2 width^2}: the core is the exponential
    kernel's at the rate 1 / width^2.

    Example:
        >>> k = GaussianKernel(width=0.5)
        >>> k(torch.tensor([[1.0, 0.0]]).double(), torch.tensor([[1.0, 1.0], [0.0, 0.0]]).double())
        tensor([[0.1353, 0.1353]], dtype=torch.float64)

        Shown by `staf kernel=gaussian`.

    Args:
        width: positive, in the units of the state; a tensor of shape (...) gives one a batch entry.

    Raises:
        ValueError: if ``width`` is not positive and finite.
    """

    state_free = True
    scale_slope = 0.0

    def __init__(self, width: float | Tensor = 1.0) -> None:
        super().__init__()
        self.width = hold(self, "width", positive("GaussianKernel", "width", width))

    def forward(self, x1: Tensor, x2: Tensor) -> Tensor:
        return (squared_distance(x1, x2) * (-0.5 * per_entry(self.exponent_rate(), 2))).exp()

    def gradient(self, x1: Tensor, x2: Tensor, b: Tensor) -> Tensor:
        return weighted_differences(self(x1, x2) * b.unsqueeze(-2), x2, x1) * per_entry(
            self.exponent_rate(), 2
        )

    def follow(self, y: Tensor, step: Tensor) -> tuple[Tensor, Tensor]:
        return torch.zeros_like(y[..., 0]), torch.zeros_like(y)  # translation invariant

    def core(self, x: Tensor, z: Tensor, d: Tensor) -> Tensor:
        return (inner(z, d) * per_entry(self.exponent_rate(), 2)).exp()

    def core_gradient(self, x: Tensor, z: Tensor, d: Tensor, b: Tensor) -> Tensor:
        return (self.core(x, z, d) * b.unsqueeze(-2)) @ d * per_entry(self.exponent_rate(), 2)

    def log_scale(self, x: Tensor, z: Tensor) -> Tensor:
        return z.square().sum(-1) * (-0.5 * per_entry(self.exponent_rate(), 1))

    def log_scale_gradient(self, x: Tensor, z: Tensor) -> Tensor:
        return z * -per_entry(self.exponent_rate(), 2)

    def exponent_rate(self) -> Tensor:
        return kept(self, "width", squared=True).square().reciprocal()

    def anchored(self, x1: Tensor, x2: Tensor) -> Tensor:
        rate = self.exponent_rate()
        left = (x1.square().sum(-1) * (-0.5 * per_entry(rate, 1))).exp()
        right = (x2.square().sum(-1) * (-0.5 * per_entry(rate, 1))).exp()
        middle = (inner(x1, x2) * per_entry(rate, 2)).expm1()
        return left.unsqueeze(-1) * middle * right.unsqueeze(-2)

    def anchored_gradient(self, x1: Tensor, x2: Tensor, b: Tensor) -> Tensor:
        rate = self.exponent_rate()
        right = b * (x2.square().sum(-1) * (-0.5 * per_entry(rate, 1))).exp()
        left = (x1.square().sum(-1) * (-0.5 * per_entry(rate, 1))).exp().unsqueeze(-1)
        exponent, weights = inner(x1, x2) * per_entry(rate, 2), right.unsqueeze(-2)
        total = (exponent.expm1() * weights).sum(-1, keepdim=True)
        return left * per_entry(rate, 2) * ((exponent.exp() * weights) @ x2 - total * x1)

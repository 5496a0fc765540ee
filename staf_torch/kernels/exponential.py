"""The paper's kernel."""

from __future__ import annotations

import torch
from torch import Tensor

from .base import Kernel, inner


class ExponentialKernel(Kernel):
    """k(y, c) = exp(y'c), the kernel of the (real) Bargmann-Fock space.

    Near a state it factors as exp((x+z)'(x+d)) = e^{|x|^2} e^{x'z} e^{z'd} e^{x'd}, so constant
    offsets have one Gram core for all states. The naive form overflows at |x| = 26.7 in float64.

    Example:
        >>> k = ExponentialKernel()
        >>> k(torch.tensor([[1.0, 0.0]]).double(), torch.tensor([[1.0, 1.0], [0.0, 0.0]]).double())
        tensor([[2.7183, 1.0000]], dtype=torch.float64)

        Shown by `staf kernel=exponential`.

    Source: Rosenfeld, Kamalapurkar and Dixon, "State Following (StaF) Kernel Functions for Function
    Approximation", section 2.
    """

    state_free = True
    scale_slope = 1.0

    def forward(self, x1: Tensor, x2: Tensor) -> Tensor:
        return inner(x1, x2).exp_()

    def gradient(self, x1: Tensor, x2: Tensor, b: Tensor) -> Tensor:
        return (inner(x1, x2).exp() * b.unsqueeze(-2)) @ x2

    def core(self, x: Tensor, z: Tensor, d: Tensor) -> Tensor:
        return inner(z, d).exp()

    def core_gradient(self, x: Tensor, z: Tensor, d: Tensor, b: Tensor) -> Tensor:
        return (inner(z, d).exp() * b.unsqueeze(-2)) @ d

    def log_gain(self, x: Tensor) -> Tensor:
        return x.square().sum(-1)

    def log_scale(self, x: Tensor, z: Tensor) -> Tensor:
        if z.dim() == 2 and x.dim() > 1:  # the same offsets at all states: one product, states last
            return (z @ x.mT).mT
        if x.dim() == 1:
            return z @ x
        # Term by term: a sum over the last dimension would write all products to memory first.
        total = x[..., :1] * z[..., 0]
        for i in range(1, x.shape[-1]):
            total = torch.addcmul(total, x[..., i : i + 1], z[..., i])
        return total

    def log_scale_gradient(self, x: Tensor, z: Tensor) -> Tensor:
        return x if x.dim() == 1 else x.unsqueeze(-2)

    def follow(self, y: Tensor, step: Tensor) -> tuple[Tensor, Tensor]:
        # (y + h)'(c + h) = (y'h + h'h) + (y + h)'c
        return (step * (y + step)).sum(-1), step

    def exponent_rate(self) -> Tensor:
        return torch.ones((), dtype=torch.float64, device="cpu")

    def anchored(self, x1: Tensor, x2: Tensor) -> Tensor:
        return inner(x1, x2).expm1()

    def anchored_gradient(self, x1: Tensor, x2: Tensor, b: Tensor) -> Tensor:
        return self.gradient(x1, x2, b)

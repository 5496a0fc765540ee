"""The approximant by exponentials that the proof of the bound builds."""

from __future__ import annotations

import dataclasses
import math

import torch
from torch import Tensor

from .._checks import fail, trailing
from .polynomials import monomials


@dataclasses.dataclass(frozen=True)
class Construction:
    """F_m(x + z) = e^{x'z} prod_k g_k(tau(z)), tau_i(z) = m (e^{z_i/m} - 1), at every state x of a domain.

    tau(z) -> z as m grows, and prod_i tau_i^{a_i} is a combination of the exponentials e^{z'l/m} with whole
    numbers 0 <= l_i <= a_i: so F_m is a combination of `count` exponential kernels with the centers
    x + l/m, |l|/m <= degree/m < radius. It is evaluated in this product form only. The binomial sum over
    the centers, as printed, needs weights of the size m^degree and loses every digit.

    Source: Rosenfeld et al., section 4, proof of the theorem on the exponential kernel.
    """

    states: Tensor  # x, (D, n) float64
    radius: float  # of the balls
    m: int  # the centers stand 1/m apart
    factors: tuple[Tensor, ...]  # of each g_k the coefficients of (z / radius)^a, (D, C_k), graded
    degrees: tuple[int, ...]  # of the g_k
    error: float  # sup |V - F_m| over the balls: see `exponential_bound`

    @property
    def degree(self) -> int:
        """Of the product of the g_k."""
        return sum(self.degrees)

    @property
    def count(self) -> int:
        """C(n + degree, n): exponential kernels that the construction takes at a state."""
        return math.comb(self.states.shape[-1] + self.degree, self.degree)

    def __call__(self, z: Tensor) -> Tensor:
        """F_m(x + z) at the offsets z (P, n), the same at each state, or (D, P, n): -> (D, P) float64.

        Raises:
            ValueError: if ``z`` has another shape.
        """
        trailing("Construction", "z", z, dims=2, last=self.states.shape[-1])
        if z.dim() > 3 or (z.dim() == 3 and z.shape[0] != self.states.shape[0]):
            rule = f"must have the shape (P, n) or (D, P, n) with D = {self.states.shape[0]} states"
            raise fail("Construction", "z", rule, tuple(z.shape))
        z = z.to(self.states)
        tau = self.m * torch.expm1(z / self.m) / self.radius
        result = (z @ self.states.unsqueeze(-1)).squeeze(-1).exp()
        for coefficients, degree in zip(self.factors, self.degrees, strict=True):
            result = result * (monomials(tau, degree) @ coefficients.unsqueeze(-1)).squeeze(-1)
        return result

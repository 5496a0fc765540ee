"""Base class of kernels, and their factorisation near a moving state."""

from __future__ import annotations

import abc
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from ..lanes.gradients import grad
from ..lanes.per_row.objects import OfRows
from ..numerics.checks import shown, states


class Kernel(nn.Module, metaclass=OfRows):
    """A real, symmetric, positive definite kernel k(y, c).

    A kernel of your own is a subclass with `forward` alone; gradients come from autograd. The other
    methods say how the kernel factors around a state x, with offsets z and d small,

        k(x + z, x + d) = e^{g(x)} e^{s(x, z)} k0(z, d) e^{s(x, d)},

    with g the `log_gain`, s the `log_scale` and k0 the `core`. Where k0 does not depend on x
    (`state_free`), the Gram matrix of constant offsets is factored once for all states. The defaults
    say nothing of the sort: g = s = 0 and k0(z, d) = k(x + z, x + d).

    A hyperparameter that is given as an `nn.Parameter` is learned, a number or another tensor is fixed.

    Example:
        >>> class Cauchy(Kernel):
        ...     def forward(self, x1, x2):  # (..., P, n), (..., M, n) -> (..., P, M)
        ...         return 1 / (1 + (x1.unsqueeze(-2) - x2.unsqueeze(-3)).square().sum(-1))
        >>> Cauchy()(torch.zeros(1, 2), torch.tensor([[1.0, 0.0], [0.0, 0.0]]))
        tensor([[0.5000, 1.0000]])

        Shown by `staf kernel=custom kernel.path=staf_torch.MaternKernel`.
    """

    rowwise: ClassVar = {
        **dict.fromkeys(("forward", "anchored"), (2, 2)),
        **dict.fromkeys(("gradient", "anchored_gradient"), (2, 2, 1)),
        **dict.fromkeys(("log_scale", "log_scale_gradient"), (1, 2)),
        **{"core": (1, 2, 2), "core_gradient": (1, 2, 2, 1), "log_gain": (1,), "follow": (2, 2)},
    }
    state_free: bool = False
    scale_slope: float | None = None
    """q where s(x, z) = q x'z plus a function of z alone, None where s has another form."""

    def __call__(self, x1: Tensor, x2: Tensor) -> Any:
        if type(x1) is Tensor is type(x2) and x1.is_floating_point() and x2.is_floating_point():
            return super().__call__(x1, x2)
        return super().__call__(states(self, "x1", x1), states(self, "x2", x2))

    @abc.abstractmethod
    def forward(self, x1: Tensor, x2: Tensor) -> Tensor:
        """k(x1, x2): (..., P, n), (..., M, n) -> (..., P, M)."""

    def core(self, x: Tensor, z: Tensor, d: Tensor) -> Tensor:
        """k0(z, d) at the state x: (..., n), (..., P, n), (..., M, n) -> (..., P, M)."""
        at = x.unsqueeze(-2)
        result: Tensor = self(at + z, at + d)
        return result

    def gradient(self, x1: Tensor, x2: Tensor, b: Tensor) -> Tensor | None:
        """d/dx1 of sum_i b_i k(x1, x2_i) in closed form, None where autograd has to find it.

        Args:
            x1: (..., P, n).
            x2: (..., M, n).
            b: (..., M).

        Returns:
            (..., P, n).
        """
        return None

    def core_gradient(self, x: Tensor, z: Tensor, d: Tensor, b: Tensor) -> Tensor | None:
        """d/dz of sum_i b_i k0(z, d_i) at the state x, None where autograd has to find it: (..., P, n)."""
        at = x.unsqueeze(-2)
        return self.gradient(at + z, at + d, b)

    def log_gain(self, x: Tensor) -> Tensor | None:
        """g(x): (..., n) -> (...), or None where it is zero."""
        return None

    def log_scale(self, x: Tensor, z: Tensor) -> Tensor | None:
        """s(x, z): (..., n), (..., P, n) -> (..., P), or None where it is zero."""
        return None

    def log_scale_gradient(self, x: Tensor, z: Tensor) -> Tensor | None:
        """ds/dz: (..., n), (..., P, n) -> what broadcasts to (..., P, n), or None where s is zero."""
        if self.log_scale(x, z) is None:
            return None

        def total(at: Tensor) -> Tensor:
            s = self.log_scale(x, at)
            assert s is not None
            return s.sum()

        gradient: Tensor = grad(total)(z)
        return gradient

    def exponent_rate(self) -> Tensor | None:
        """q where k0(z, d) = exp(q z'd), and None for every other kernel."""
        return None

    def polynomial_degree(self) -> int | None:
        """k where the function space is that of all polynomials of degree <= k, None otherwise."""
        return None

    def follow(self, y: Tensor, step: Tensor) -> tuple[Tensor, Tensor] | None:
        """Return the change of the point and the log factor that a translation of all arguments amounts to.

        k(y + step, c + step) = e^{p} k(y + q, c) with p and q that do not depend on c.

        Args:
            y: (..., P, n).
            step: (..., P, n).

        Returns:
            p (..., P) and q (..., P, n), or None where the kernel has no such rule.
        """
        return None

    def anchored(self, x1: Tensor, x2: Tensor) -> Tensor:
        """k(y, c) - k(y, 0) k(0, c) / k(0, 0), see `AnchoredKernel`: (..., P, M)."""
        zero = x1.new_zeros(1, x1.shape[-1])
        left, right, corner = self(x1, zero), self(zero, x2), self(zero, zero)
        result: Tensor = self(x1, x2) - left * right / corner
        return result

    def anchored_gradient(self, x1: Tensor, x2: Tensor, b: Tensor) -> Tensor | None:
        """`gradient` of `anchored`: (..., P, n)."""
        zero = x1.new_zeros(1, x1.shape[-1])
        own, left = self.gradient(x1, x2, b), self.gradient(x1, zero, x1.new_ones(1))
        if own is None or left is None:
            return None
        right: Tensor = self(zero, x2) / self(zero, zero)
        return own - left * (right * b.unsqueeze(-2)).sum(-1, keepdim=True)

    def rank(self, dim: int) -> int | None:
        """Dimension of the kernel's function space over R^dim, None where it is infinite."""
        return None

    def extra_repr(self) -> str:
        return shown(self)


def per_entry(value: Tensor, extra: int) -> Tensor:
    """A hyperparameter of shape (...) made to broadcast over ``extra`` trailing dimensions.

    A scalar stays without dimensions: it then takes the dtype of what it meets, as a Python number
    would.
    """
    return value if value.dim() == 0 else value[(..., *([None] * extra))]


def inner(x1: Tensor, x2: Tensor) -> Tensor:
    """x1'x2: (..., P, n), (..., M, n) -> (..., P, M)."""
    return torch.matmul(x1, x2.mT)


def squared_distance(x1: Tensor, x2: Tensor) -> Tensor:
    """|x1 - x2|^2 from the differences: (..., P, n), (..., M, n) -> (..., P, M).

    The expansion |x1|^2 - 2 x1'x2 + |x2|^2 would lose every digit of a small distance far from 0.
    """
    return (x1.unsqueeze(-2) - x2.unsqueeze(-3)).square().sum(-1)


def weighted_differences(weights: Tensor, x1: Tensor, x2: Tensor) -> Tensor:
    """sum_i w_i (x1_i - x2) by differences: (..., P, M), (..., M, n), (..., P, n) -> (..., P, n)."""
    return (weights.unsqueeze(-1) * (x1.unsqueeze(-3) - x2.unsqueeze(-2))).sum(-2)

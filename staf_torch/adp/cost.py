"""What a controller is paid for, and the policy that a value gradient implies."""

from __future__ import annotations

import abc
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from ..numerics.checks import fail, positive_real, vector
from ..numerics.linalg import positive_definite

_EDGE = 1 - 1e-9  # of the bound, beyond which artanh is that of this share

Matrix = float | Sequence[Sequence[float]] | Tensor


class Cost(nn.Module, abc.ABC):
    """The cost rate x'Qx + U(u) of an infinite horizon, with U convex and U(0) = 0.

    Args:
        state: Q, (n, n); a number q stands for q I once the sizes are known (`sized`).
        control: R, (m, m); a number likewise.
        dim: n.
        inputs: m.

    Raises:
        ValueError: if Q or R is not symmetric positive definite of its size.
    """

    def __init__(self, state: Matrix, control: Matrix, dim: int, inputs: int) -> None:
        super().__init__()
        name = type(self).__name__
        self.register_buffer("q", positive_definite(name, "state", _square(name, "state", state, dim), dim))
        r = positive_definite(name, "control", _square(name, "control", control, inputs), inputs)
        self.register_buffer("r", r)
        self.register_buffer("r_inverse", torch.linalg.inv(r))
        self.q: Tensor
        self.r: Tensor
        self.r_inverse: Tensor

    def state_rate(self, x: Tensor) -> Tensor:
        """x'Qx: (..., n) -> (...)."""
        return quadratic(self.q, x)

    def rate(self, x: Tensor, u: Tensor) -> Tensor:
        """x'Qx + U(u): (..., n), (..., m) -> (...)."""
        return self.state_rate(x) + self.input_rate(u)

    @abc.abstractmethod
    def input_rate(self, u: Tensor) -> Tensor:
        """U(u): (..., m) -> (...)."""

    @abc.abstractmethod
    def policy(self, effectiveness: Tensor, gradient: Tensor) -> Tensor:
        """argmin_u of U(u) + p'g u, for g (..., n, m) and the value gradient p (..., n): (..., m)."""

    def saturate(self, v: Tensor) -> Tensor:
        """The admissible input that a free one stands for: (..., m) -> (..., m)."""
        return v

    def unsaturated(self, u: Tensor) -> Tensor:
        """A free input that `saturate` maps to u, or near to it at the edge: (..., m) -> (..., m)."""
        return u

    def _unconstrained(self, effectiveness: Tensor, gradient: Tensor) -> Tensor:
        """-1/2 R^-1 g'p: (..., m)."""
        pull = (effectiveness * gradient.unsqueeze(-1)).sum(-2)
        return -0.5 * matvec(self.r_inverse, pull)


class QuadraticCost(Cost):
    """x'Qx + u'Ru, whose policy is u = -1/2 R^-1 g(x)' grad V.

    The appendix of the paper loses the minus of the policy.
    """

    def input_rate(self, u: Tensor) -> Tensor:
        return quadratic(self.r, u)

    def policy(self, effectiveness: Tensor, gradient: Tensor) -> Tensor:
        return self._unconstrained(effectiveness, gradient)


class BoundedInputCost(Cost):
    """x'Qx + U(u) with |u_i| < bound, whose policy is u = -bound tanh(R^-1 g' grad V / (2 bound)):

        U(u) = 2 bound sum_i R_ii int_0^{u_i} artanh(v / bound) dv,

    which is u'Ru for small u and finite at the bound.

    Args:
        bound: positive, in the units of u.

    Raises:
        ValueError: if R is not diagonal, or the bound is not positive.

    Source: Abu-Khalaf and Lewis, Automatica 41 (2005), with a diagonal R.
    """

    def __init__(self, state: Matrix, control: Matrix, dim: int, inputs: int, *, bound: float) -> None:
        super().__init__(state, control, dim, inputs)
        if not torch.equal(self.r, torch.diag(self.r.diagonal())):
            raise fail("BoundedInputCost", "control", "must be diagonal", control)
        self.bound = positive_real("BoundedInputCost", "bound", bound)

    def input_rate(self, u: Tensor) -> Tensor:
        share = u / self.bound
        # artanh's integral: v artanh v + log(1 - v^2)/2, in a form that is finite at |v| = 1.
        up, down = 1 + share, 1 - share
        integral = 0.5 * (torch.xlogy(up, up) + torch.xlogy(down, down))
        return 2 * self.bound**2 * (self.r.diagonal().to(u) * integral).sum(-1)

    def policy(self, effectiveness: Tensor, gradient: Tensor) -> Tensor:
        return self.saturate(self._unconstrained(effectiveness, gradient))

    def saturate(self, v: Tensor) -> Tensor:
        """bound tanh(v / bound)."""
        return self.bound * (v / self.bound).tanh()

    def unsaturated(self, u: Tensor) -> Tensor:
        """bound artanh(u / bound), finite at the bound itself."""
        return self.bound * (u / self.bound).clamp(-_EDGE, _EDGE).atanh()


def quadratic(matrix: Tensor, x: Tensor) -> Tensor:
    """x'Mx: (n, n), (..., n) -> (...)."""
    return (matvec(matrix, x) * x).sum(-1)


def matvec(matrix: Tensor, x: Tensor) -> Tensor:
    """M x by broadcasting, which a compiler fuses where it would call a library for a product:
    (..., k, n), (..., n) -> (..., k)."""
    return (matrix.to(x) * x.unsqueeze(-2)).sum(-1)


def _square(call: str, name: str, value: Matrix, size: int) -> Tensor:
    if isinstance(value, Tensor):
        return value.to(torch.float64)
    if isinstance(value, Sequence) and not isinstance(value, str):
        return torch.tensor([vector(call, name, row, size) for row in value], dtype=torch.float64)
    return positive_real(call, name, value) * torch.eye(size, dtype=torch.float64)

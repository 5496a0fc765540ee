"""The linear-quadratic regulator of a plant's linearisation: the baseline, and a base policy."""

from __future__ import annotations

from torch import Tensor, nn

from ..riccati import riccati
from ..systems import ControlAffineSystem
from .cost import BoundedInputCost, Cost, matvec, quadratic


class LQR(nn.Module):
    """u = -K x with K = R^-1 B'P and P from the Riccati equation of the linearisation at 0.

    With a `BoundedInputCost` it is u = -bound tanh(K x / bound).

    Args:
        system: the plant.
        cost: the cost rate.

    Attributes:
        p: P, (n, n): x'Px is the value of the linear plant.
        k: K, (m, n).

    Raises:
        ValueError: if the plant does not rest at 0, or its linearisation cannot be stabilised.
    """

    def __init__(self, system: ControlAffineSystem, cost: Cost) -> None:
        super().__init__()
        check_equilibrium(system)
        a, b = system.linearisation()
        p = riccati(a, b, cost.q, cost.r, name=type(system).__name__)
        self.register_buffer("p", p)
        self.register_buffer("k", cost.r_inverse @ b.to(p).mT @ p)
        self.p: Tensor
        self.k: Tensor
        self.bound = cost.bound if isinstance(cost, BoundedInputCost) else None

    def forward(self, x: Tensor) -> Tensor:
        """u: (..., n) -> (..., m)."""
        u = -matvec(self.k, x)
        return u if self.bound is None else self.bound * (u / self.bound).tanh()

    def value(self, x: Tensor) -> Tensor:
        """x'Px: (..., n) -> (...)."""
        return quadratic(self.p, x)


def check_equilibrium(system: ControlAffineSystem) -> None:
    """Refuse a plant with f(0) != 0.

    Raises:
        ValueError: if f(0) is not 0, with its value.
    """
    at = system.drift(system.equilibrium())
    if not bool((at.abs() <= 1e-9).all()):
        raise ValueError(
            f"`{type(system).__name__}.drift` must be 0 at the origin, the state to regulate to; "
            f"got {at.tolist()}. Measure states and inputs from the equilibrium."
        )

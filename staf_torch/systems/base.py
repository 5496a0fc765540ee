"""What a plant is."""

from __future__ import annotations

import abc
from typing import NamedTuple

import torch
from torch import Tensor, nn


class Linearisation(NamedTuple):
    """x' = A x + B u near the equilibrium 0."""

    matrix: Tensor  # A, (n, n), 1/s
    input_matrix: Tensor  # B, (n, m)


class Units(NamedTuple):
    """Units of a plant's quantities, entry by entry where they differ: ``rad, rad/s``."""

    state: str = "1"
    input: str = "1"


class ControlAffineSystem(nn.Module, abc.ABC):
    """x' = f(x) + g(x) u, batched. A plant of your own is a subclass with `drift` and, where it has
    inputs, `effectiveness`; its trajectories then come from a fourth-order Runge-Kutta method.

    Attributes:
        dim: n, the number of states; None where the plant takes any.
        inputs: m, the number of inputs.
        units: of states and inputs, for the sheet of `staf-export`.
        spread: episodes of `envs` begin uniformly in [-spread, spread]^n unless told otherwise.

    The equilibrium is the origin without control: states and inputs are measured from there.
    """

    dim: int | None = None
    inputs: int = 0
    units: Units = Units()
    spread: float = 1.0

    @abc.abstractmethod
    def drift(self, x: Tensor) -> Tensor:
        """f(x): (..., n) -> (..., n)."""

    def effectiveness(self, x: Tensor) -> Tensor:
        """g(x): (..., n) -> (..., n, m). Without inputs, m = 0."""
        return x.new_zeros(*x.shape, 0)

    def rate(self, x: Tensor, u: Tensor) -> Tensor:
        """x' = f(x) + g(x) u: (..., n), (..., m) -> (..., n)."""
        # Not a matrix product: a compiler fuses this where it would call a library for that.
        return self.drift(x) + (self.effectiveness(x) * u.unsqueeze(-2)).sum(-1)

    def flow(self, x: Tensor, time: Tensor) -> Tensor | None:
        """x(t) from x(0) without control, where it is known in closed form.

        Args:
            x: x(0), (..., n).
            time: t, (T,), in seconds, float64 on the CPU whatever x is.

        Returns:
            (..., T, n), or None where the flow is not known: it is then integrated.
        """
        return None

    def smooth_drift(self, x: Tensor) -> Tensor:
        """f without the terms that have no derivative at 0; what `linearisation` differentiates."""
        return self.drift(x)

    def equilibrium(self) -> Tensor:
        """The state at which the plant rests without control: (n,), zeros."""
        return torch.zeros(self._size(), dtype=torch.float64)

    def linearisation(self) -> Linearisation:
        """A = df/dx and B = g at the equilibrium, by automatic differentiation.

        Raises:
            ValueError: if ``dim`` is None.
        """
        at = self.equilibrium()
        matrix = torch.func.jacrev(self.smooth_drift)(at)
        return Linearisation(matrix.detach(), self.effectiveness(at).detach())

    def optimal_value(self, x: Tensor, state_cost: Tensor, input_cost: Tensor) -> Tensor | None:
        """V*(x) for the cost x'Qx + u'Ru, where it is known.

        Args:
            x: (..., n).
            state_cost: Q, (n, n).
            input_cost: R, (m, m).

        Returns:
            (...), or None where it is not known.
        """
        return None

    def _size(self) -> int:
        if self.dim is None:
            raise ValueError(f"`{type(self).__name__}.dim` must be the number of states; got None.")
        return self.dim

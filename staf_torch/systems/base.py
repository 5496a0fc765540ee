"""What a plant is."""

from __future__ import annotations

import abc

from torch import Tensor, nn


class ControlAffineSystem(nn.Module, abc.ABC):
    """x' = f(x) + g(x) u, batched. A plant of your own is a subclass with `drift` and, where it has
    inputs, `effectiveness`; its trajectories then come from a fourth-order Runge-Kutta method.

    Attributes:
        dim: n, the number of states; None where the plant takes any.
    """

    dim: int | None = None

    @abc.abstractmethod
    def drift(self, x: Tensor) -> Tensor:
        """f(x): (..., n) -> (..., n)."""

    def effectiveness(self, x: Tensor) -> Tensor:
        """g(x): (..., n) -> (..., n, m). Without inputs, m = 0."""
        return x.new_zeros(*x.shape, 0)

    def flow(self, x: Tensor, time: Tensor) -> Tensor | None:
        """x(t) from x(0) without control, where it is known in closed form.

        Args:
            x: x(0), (..., n).
            time: t, (T,), in seconds, float64 on the CPU whatever x is.

        Returns:
            (..., T, n), or None where the flow is not known: it is then integrated.
        """
        return None

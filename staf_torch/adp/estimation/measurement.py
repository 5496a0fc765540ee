"""Outputs with noise, which a controller gets in place of the state."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ...lanes.row_decisions import in_any_row
from ...numerics.checks import non_negative, one_or_each, trailing
from ..loop.controller import Carried, Controller
from ..problem.cost import Output


def gaussian(uniform: Tensor, count: int) -> Tensor:
    """Normal numbers of uniform ones of [-1, 1), by Box and Muller: (..., 2 k) -> (..., count <= 2 k)."""
    first, second = uniform.chunk(2, dim=-1)
    size = (-2 * (0.5 * (1 - first)).log()).sqrt()  # 1 - u > 0, for u is drawn from [-1, 1)
    angle = math.pi * second
    return torch.cat((size * angle.cos(), size * angle.sin()), dim=-1)[..., :count]


class Measured(Controller):
    """A controller that sees y = h(x) + noise in place of x, the noise white and normal.

    Example:
        >>> plant, cost = systems.Pendulum(), adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
        >>> seen = adp.Measured(adp.Feedback(adp.LQR(plant, cost)), noise=0.01, dim=2)
        >>> x0 = torch.tensor([[0.3, 0.0]]).double()
        >>> run = adp.simulate(seen, plant, cost, x0, dt=0.02, steps=150)
        >>> bool(run.state[0, -1].norm() < 0.2), bool(run.state[0, -1].norm() > 1e-6)
        (True, True)

        Shown by `staf experiment=faults`.

    Args:
        controller: of y.
        noise: standard deviation, one number or one an output, in the units of y, not negative. Where it is
            0 nothing is drawn, of rows where it is 0 in all.
        dim: q, entries of y.
        output: h, (..., n) -> (..., q); None for the first q states.

    Raises:
        ValueError: if the noise is negative or has another length.
    """

    def __init__(
        self,
        controller: Controller,
        *,
        noise: float | Sequence[float],
        dim: int,
        output: Output | None = None,
    ) -> None:
        super().__init__()
        self.controller, self.dim, self.output = controller, dim, output
        self.noise = non_negative("Measured", "noise", one_or_each("Measured", "noise", noise, dim))
        # Normal numbers come in pairs: an odd number of outputs takes two points of the state's size.
        self._own = (1 + dim % 2) if in_any_row(self.noise > 0) else 0
        self.period = controller.period

    @property
    def label(self) -> str:
        return self.controller.label

    @property
    def draws(self) -> int:  # type: ignore[override]
        return self._own + self.controller.draws

    def seen(self, x: Tensor) -> Tensor:
        """h(x): (..., n) -> (..., q)."""
        return x[..., : self.dim] if self.output is None else self.output(x)

    def init(self, x0: Tensor) -> Carried:
        trailing(type(self).__name__, "x0", x0, 2)
        return self.controller.init(self.seen(x0))

    def recorded(self, carried: Carried) -> dict[str, Tensor]:
        return self.controller.recorded(carried)

    def step(self, x: Tensor, carried: Carried, uniform: Tensor, dt: float) -> tuple[Tensor, Carried]:
        y = self.seen(x)
        if self._own:
            drawn = uniform[..., : self._own, : self.dim].flatten(-2)
            y = y + self.noise.to(y) * gaussian(drawn, self.dim)
        return self.controller.step(y, carried, uniform[..., self._own :, : self.dim], dt)

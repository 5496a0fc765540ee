"""A base policy for swing-ups: bring the energy to that of the goal, then regulate."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

import torch
from torch import Tensor, nn

from ...lanes.gradients import grad
from ...lanes.per_row.objects import OfRows
from ...numerics.checks import fail, positive_real, trailing
from ...systems import ControlAffineSystem
from ..loop.controller import LQR
from ..problem.cost import Cost
from ..problem.rules import check_value


class EnergyShaping(nn.Module, metaclass=OfRows):
    """u = clip(u_s - gain (E(x) - E(x_s)) g(x)' grad E(x)) far from the goal x_s, the LQR near to it.

    Without friction E' = grad E'g u, so that outside of the region of the LQR |E - E(x_s)| falls wherever the
    input has power; a pendulum-like plant then passes by the goal and is caught. "Near" is where the LQR's
    value is below ``capture``: there it must regulate within the bounds.

    Example:
        >>> plant = systems.Pendulum(damping=0.0)
        >>> cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1, low=-2.0, high=2.0)
        >>> pump = adp.EnergyShaping(
        ...     plant, cost, lambda x: 0.5 * x[..., 1] ** 2 + 9.81 * x[..., 0].cos(), gain=1.0, capture=1.0
        ... )
        >>> pump(torch.tensor([3.0, 0.5], dtype=torch.float64))  # hanging: it pushes along the rate
        tensor([2.], dtype=torch.float64)

        Shown by `staf_torch/adp/README.md`.

    Args:
        system: the plant.
        cost: the cost rate, with bounds in it or in the plant.
        energy: E, (..., n) -> (...): differentiated by `torch.func`.
        gain: positive, in units of the input over energy squared a unit of input and time.
        capture: the LQR's value below which the LQR has the control, positive.
        period: as in `LQR`.

    Raises:
        ValueError: if an argument breaks its rule, the inputs have no bounds, or the plant has no LQR.

    Source: Åström and Furuta, "Swinging up a pendulum by energy control", Automatica 36 (2000).
    """

    rowwise: ClassVar = {"forward": (1,)}

    def __init__(
        self,
        system: ControlAffineSystem,
        cost: Cost,
        energy: Callable[[Tensor], Tensor],
        *,
        gain: float,
        capture: float,
        period: float | None = None,
    ) -> None:
        super().__init__()
        if not isinstance(system, ControlAffineSystem):
            raise fail("EnergyShaping", "system", "must be a ControlAffineSystem", system)
        self.system, self.energy = system, energy
        self.gain = positive_real("EnergyShaping", "gain", gain)
        self.capture = positive_real("EnergyShaping", "capture", capture)
        self.lqr = LQR(system, cost, period)
        self.period = self.lqr.period
        check_value("EnergyShaping", "energy", energy, self.lqr.cost)
        if self.lqr.cost.bounds is None:
            raise fail("EnergyShaping", "cost", "or the plant must have bounds of the inputs", None)

    def forward(self, x: Tensor) -> Tensor:
        """u: (..., n) -> (..., m)."""
        trailing("EnergyShaping", "x", x, 1, self.lqr.cost.dim)
        cost = self.lqr.cost
        goal = torch.zeros_like(x) if cost.target is None else cost.target.to(x).expand_as(x)
        slope: Tensor = grad(lambda z: self.energy(z).sum())(x)
        power = (self.system.effectiveness(x) * slope.unsqueeze(-1)).sum(-2)  # g' grad E, (..., m)
        short = (self.energy(goal) - self.energy(x)).unsqueeze(-1)
        pumped = cost.saturate(cost.input_of(self.gain * short * power))
        near = (self.lqr.value(x) < self.capture).unsqueeze(-1)
        return torch.where(near, self.lqr(x), pumped)

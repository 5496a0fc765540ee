"""What a controller sees of a plant: outputs with noise; plants whose parameters change while they run."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from ...numerics.checks import fail
from ...systems import ControlAffineSystem
from ..adaptation.parametric import ParametricPlant
from ..loop.controller import Controller, ControllerState
from ..problem.cost import Cost

Output = Callable[[Tensor], Tensor]
"""y from x: (..., n) -> (..., q)."""
_CLOCK = 10.0  # s in which the clock of a changing plant falls to 1/e


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
        noise: standard deviation, one number or one an output, in the units of y, not negative.
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
        several = [noise] * dim if isinstance(noise, int | float) else list(noise)
        if len(several) != dim or not all(s >= 0 for s in several):
            raise fail("Measured", "noise", f"must not be negative, one number or {dim}", noise)
        self.controller, self.dim, self.output = controller, dim, output
        self.noise = torch.tensor(several, dtype=torch.float64)
        # Normal numbers come in pairs: an odd number of outputs takes two points of the state's size.
        self._own = (1 + dim % 2) if any(s > 0 for s in several) else 0
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

    def init(self, x0: Tensor) -> ControllerState:
        return self.controller.init(self.seen(x0))

    def step(
        self, x: Tensor, carried: ControllerState, uniform: Tensor, dt: float
    ) -> tuple[Tensor, ControllerState]:
        y = self.seen(x)
        if self._own:
            drawn = uniform[..., : self._own, : self.dim].flatten(-2)
            y = y + self.noise.to(y) * gaussian(drawn, self.dim)
        return self.controller.step(y, carried, uniform[..., self._own :, : self.dim], dt)


class ChangingPlant(ControlAffineSystem):
    """A plant with parameters of its own in every row, which may change once:

        state (x, theta_1, theta_2, c),  theta = theta_1 while c > 1 and theta_2 afterwards,  c' = -c / 10 s.

    Example:
        >>> plant = adp.ChangingPlant(adp.ParametricPlant.of_effectiveness(systems.Pendulum()))
        >>> x0 = torch.tensor([[0.3, 0.0]]).double()
        >>> z0 = plant.start(x0, before=[1.0], after=[0.5], at=2.0)
        >>> z0.shape, plant.motion(z0, torch.ones(1, 1).double())[0, 1].round(decimals=3)
        (torch.Size([1, 5]), tensor(3.8990, dtype=torch.float64))

        Shown by `staf experiment=faults`.

    Args:
        model: the plant.
    """

    def __init__(self, model: ParametricPlant) -> None:
        super().__init__()
        self.model = model
        self.own, self.count = model._size(), model.parameters_count
        self.size = self.own + 2 * self.count + 1
        self.dim, self.inputs = self.size, model.inputs
        self.periodic, self.bounds = model.periodic, model.bounds

    def start(
        self,
        x0: Tensor,
        before: Sequence[float] | Tensor,
        after: Sequence[float] | Tensor | None = None,
        at: float | Tensor = 0.0,
    ) -> Tensor:
        """The state at time 0: (B, n) -> (B, n + 2 p + 1).

        Args:
            x0: (B, n).
            before: theta_1, (p,) or (B, p).
            after: theta_2, likewise; None for theta_1.
            at: s, (B,) or one number, when theta changes.
        """
        first, last = (
            torch.as_tensor(theta, dtype=x0.dtype, device=x0.device).expand(len(x0), self.count)
            for theta in (before, before if after is None else after)
        )
        when = torch.as_tensor(at, dtype=x0.dtype, device=x0.device).expand(len(x0))
        return torch.cat((x0, first, last, (when / _CLOCK).exp().unsqueeze(-1)), dim=-1)

    def theta(self, z: Tensor) -> Tensor:
        """The parameters of the moment: (..., N) -> (..., p)."""
        first, last = z[..., self.own : -1].chunk(2, dim=-1)
        return torch.where(z[..., -1:] > 1, first, last)

    def rate(self, x: Tensor, u: Tensor) -> Tensor:
        moved = self.model.believing(self.theta(x)).rate(x[..., : self.own], u)
        still = torch.zeros_like(x[..., self.own : -1])
        return torch.cat((moved, still, -x[..., -1:] / _CLOCK), dim=-1)

    def drift(self, x: Tensor) -> Tensor:
        return self.rate(x, x.new_zeros(*x.shape[:-1], self.inputs))

    def effectiveness(self, x: Tensor) -> Tensor:
        own = self.model.believing(self.theta(x)).effectiveness(x[..., : self.own])
        rest = x.new_zeros(*x.shape[:-1], self.size - self.own, self.inputs)
        return torch.cat((own, rest), dim=-2)

    def cost(self, cost: Cost) -> Cost:
        """The cost of x alone, for this plant.

        Raises:
            ValueError: if the cost has a set-point or an output of its own.
        """
        if cost.output is not None or cost.target is not None or self.periodic:
            raise fail("ChangingPlant", "cost", "must be of x itself at the origin, without angles", cost)
        own, wide = self.own, copy.copy(cost)
        wide._buffers, wide._modules = dict(cost._buffers), dict(cost._modules)
        wide.dim, wide.output = self.size, lambda z: z[..., :own]
        return wide

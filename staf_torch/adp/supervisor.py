"""A safeguard: a learned control may differ from the LQR only by as much as stability allows."""

from __future__ import annotations

import torch
from torch import Tensor

from .._checks import real
from .controller import Controller, Memory
from .cost import Cost, quadratic
from .lqr import LQR


class Supervised(Controller):
    """The control of another controller, drawn towards the LQR just as far as it must be:

        u_applied = u_LQR + s (u - u_LQR),  s <= 1 the largest with |u_applied - u_LQR|_R <= trust |u_LQR|_R.

    For a linear plant and trust <= 1/2 the Riccati value then falls at the rate of x'Qx at least, whatever
    the weights are: V_P' <= -x'Qx - (1 - 2 trust) u_LQR'R u_LQR. It bounds a control that is too weak as
    well as one that is too strong for its time step. The controller learns on as if its own control had
    been applied: the laws ask the model, not the plant.

    Args:
        controller: the controller to supervise.
        lqr: the base feedback, of the same plant and cost.
        cost: the cost rate.
        trust: in (0, 1].

    Raises:
        ValueError: if ``trust`` is not in (0, 1].
    """

    def __init__(self, controller: Controller, lqr: LQR, cost: Cost, trust: float = 0.5) -> None:
        super().__init__()
        if not 0 < real("Supervised", "trust", trust) <= 1:
            raise ValueError(f"`Supervised(trust=...)` must be in (0, 1]; got {trust!r}.")
        self.controller, self.lqr, self.cost, self.trust = controller, lqr, cost, trust
        self.draws = controller.draws

    def init(self, x0: Tensor) -> Memory:
        return self.controller.init(x0)

    def step(self, x: Tensor, memory: Memory, uniform: Tensor, dt: float) -> tuple[Tensor, Memory]:
        u, after = self.controller.step(x, memory, uniform, dt)
        return self.restrain(x, u), after

    def restrain(self, x: Tensor, u: Tensor) -> Tensor:
        """The control to apply in place of u: (..., n), (..., m) -> (..., m)."""
        base = self.lqr(x)
        apart = u - base
        allowed = self.trust * quadratic(self.cost.r, base).sqrt()
        wanted = quadratic(self.cost.r, apart).sqrt()
        share = torch.where(wanted > allowed, allowed / wanted, 1.0)
        restrained: Tensor = base + share.unsqueeze(-1) * apart
        return restrained

    def value(self, x: Tensor, memory: Memory) -> Tensor | None:
        return self.controller.value(x, memory)

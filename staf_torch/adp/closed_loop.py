"""One step of the closed loop: plant and controller advance together, all rows at once."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from .._checks import choice, positive_real
from ..systems import ControlAffineSystem
from .controller import Controller, Memory
from .cost import Cost, matvec


class LoopState(NamedTuple):
    """Everything that one step maps to the next."""

    x: Tensor  # (B, n)
    cost: Tensor  # (B,) the integral of the cost rate so far
    alive: Tensor  # (B,) bool; a row that became non-finite keeps its last finite values
    lived: Tensor  # (B,) steps taken alive
    memory: Memory


class ClosedLoop(nn.Module):
    """One step of controller and plant: the control is computed at the state, then held for dt.

    Args:
        controller: the controller.
        system: the plant.
        cost: the cost rate.
        dt: s.
        integrator: of the plant over a step, ``runge_kutta`` (fourth order) or ``euler`` (as published).
        limit: a row whose state exceeds it in norm has diverged.

    Raises:
        ValueError: if an argument breaks its rule.
    """

    def __init__(
        self,
        controller: Controller,
        system: ControlAffineSystem,
        cost: Cost,
        *,
        dt: float,
        integrator: str = "runge_kutta",
        limit: float = 1e6,
    ) -> None:
        super().__init__()
        choice("ClosedLoop", "integrator", integrator, ("runge_kutta", "euler"))
        self.controller, self.system, self.cost = controller, system, cost
        self.dt = positive_real("ClosedLoop", "dt", dt)
        self.limit = positive_real("ClosedLoop", "limit", limit)
        self.euler = integrator == "euler"

    def init(self, x0: Tensor) -> LoopState:
        """The state at time 0 of the rows x0 (B, n)."""
        alive = torch.isfinite(x0).all(-1)
        zeros = x0.new_zeros(x0.shape[0])
        return LoopState(x0, zeros, alive, zeros.clone(), self.controller.init(x0))

    def forward(self, state: LoopState, uniform: Tensor) -> tuple[LoopState, Tensor]:
        """The state after dt seconds, and the control held until then, (B, m)."""
        u, memory = self.controller.step(state.x, state.memory, uniform, self.dt)
        x, spent = self._advance(state.x, u)
        good = torch.isfinite(spent) & (x.square().sum(-1) <= self.limit**2)
        for part in (u, *memory):
            good = good & torch.isfinite(part).flatten(1).all(-1)
        alive = state.alive & good
        kept = Memory(*(_where(alive, new, old) for new, old in zip(memory, state.memory, strict=True)))
        cost = state.cost + torch.where(alive, spent, 0.0)
        return LoopState(_where(alive, x, state.x), cost, alive, state.lived + alive, kept), u

    def _advance(self, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """The state after dt with u held, and the cost until then."""
        h = self.dt
        paid = self.cost.input_rate(u)
        k1 = self._field(x, u)
        c1 = self.cost.state_rate(x)
        if self.euler:
            return x + h * k1, h * (c1 + paid)
        x2 = x + 0.5 * h * k1
        k2 = self._field(x2, u)
        x3 = x + 0.5 * h * k2
        k3 = self._field(x3, u)
        x4 = x + h * k3
        k4 = self._field(x4, u)
        middle = self.cost.state_rate(x2) + self.cost.state_rate(x3)
        spent = h * (paid + (c1 + 2 * middle + self.cost.state_rate(x4)) / 6)
        return x + (h / 6) * (k1 + 2 * (k2 + k3) + k4), spent

    def _field(self, x: Tensor, u: Tensor) -> Tensor:
        rate: Tensor = self.system.drift(x) + matvec(self.system.effectiveness(x), u)
        return rate


def _where(alive: Tensor, new: Tensor, old: Tensor) -> Tensor:
    return torch.where(alive[(..., *([None] * (new.dim() - 1)))], new, old)

"""One step of the closed loop, plant and controller together and all rows at once, and many of them."""

from __future__ import annotations

import math
from collections.abc import Hashable
from typing import NamedTuple

import torch
from torch import Tensor, nn

from ..lanes import Program
from ..lanes.content import content
from ..numerics.checks import choice, positive_real
from ..systems import ControlAffineSystem
from .controllers import Controller, ControllerState
from .cost import Cost

_KEPT = 16
_kept: dict[Hashable, Program] = {}


class LoopState(NamedTuple):
    """Everything that one step maps to the next."""

    x: Tensor  # (B, n)
    cost: Tensor  # (B,) the integral of the cost rate so far
    alive: Tensor  # (B,) bool; a row that became non-finite keeps its last finite values
    lived: Tensor  # (B,) steps taken alive
    carried: ControllerState


class ClosedLoop(nn.Module):
    """One step of controller and plant: the control is computed at the state, clipped to the bounds of the
    cost or the plant, and held for dt.

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
        self.controller, self.system, self.cost = controller, system, cost.around(system)
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
        u, carried = self.controller.step(state.x, state.carried, uniform, self.dt)
        if self.cost.bounds is not None:  # an actuator that is asked for more gives its bound
            u = self.cost.bounds.clip(u)
        x, spent = self._advance(state.x, u)
        good = torch.isfinite(spent) & (x.square().sum(-1) <= self.limit**2)
        for part in (u, *carried):
            good = good & torch.isfinite(part).flatten(1).all(-1)
        alive = state.alive & good
        kept = ControllerState(
            *(_where(alive, new, old) for new, old in zip(carried, state.carried, strict=True))
        )
        if self.cost.discount:
            spent = spent * torch.exp(-self.cost.discount * self.dt * state.lived)
        cost = state.cost + torch.where(alive, spent, 0.0)
        return LoopState(_where(alive, x, state.x), cost, alive, state.lived + alive, kept), u

    def _advance(self, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """The state after dt with u held, and the cost until then."""
        h = self.dt
        paid = self.cost.input_rate(u)
        half = math.exp(-0.5 * self.cost.discount * h)  # what the middle of the step counts; its end, squared
        k1 = self.system.rate(x, u)
        c1 = self.cost.state_rate(x)
        if self.euler:
            return x + h * k1, h * (c1 + paid)
        x2 = x + 0.5 * h * k1
        k2 = self.system.rate(x2, u)
        x3 = x + 0.5 * h * k2
        k3 = self.system.rate(x3, u)
        x4 = x + h * k3
        k4 = self.system.rate(x4, u)
        middle = self.cost.state_rate(x2) + self.cost.state_rate(x3)
        if self.cost.discount:
            paid = paid * (1 + 4 * half + half**2) / 6
        spent = h * (paid + (c1 + 2 * half * middle + half**2 * self.cost.state_rate(x4)) / 6)
        return x + (h / 6) * (k1 + 2 * (k2 + k3) + k4), spent


def _where(alive: Tensor, new: Tensor, old: Tensor) -> Tensor:
    return torch.where(alive[(..., *([None] * (new.dim() - 1)))], new, old)


def program(loop: ClosedLoop, compile: bool) -> Program:
    """Return ``loop`` over many steps: it records the state before every step, and the control.

    The last few programs are kept with what they were made of: a loop of the same numbers, settings and
    classes is not traced again.

    Args:
        loop: one step.
        compile: whether to compile it at all; what cannot be compiled runs in plain torch.
    """
    key = content(loop) if compile else None
    found = _kept.pop(key, None)
    if found is None:
        found = Program(lambda state, uniform, _: recorded(loop, state, uniform), name="the closed loop")
        found.compile = compile
    if key is not None:
        _kept[key] = found
        while len(_kept) > _KEPT:
            del _kept[next(iter(_kept))]
    return found


def recorded(loop: ClosedLoop, state: LoopState, uniform: Tensor) -> tuple[LoopState, tuple[Tensor, ...]]:
    """Return the state after one step, and what is recorded of the time before it."""
    after, u = loop(state, uniform)
    return after, record(state, torch.where(after.alive.unsqueeze(-1), u, torch.nan))


def record(state: LoopState, u: Tensor) -> tuple[Tensor, ...]:
    """Return x, u, Wa, Wc, the cost and the identifier."""
    carried = state.carried
    return state.x, u, carried.actor, carried.critic, state.cost, carried.identifier

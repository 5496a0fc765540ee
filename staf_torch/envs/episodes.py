"""Episodes of a controlled plant, many side by side, in torch: what both environments run on."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from .._checks import fail, positive_real
from ..adp import Controller, Cost, Memory
from ..adp.closed_loop import ClosedLoop, LoopState
from ..systems import ControlAffineSystem


class _Held(Controller):
    """u is what the memory holds: the loop's controller is outside."""

    def init(self, x0: Tensor) -> Memory:
        return holding(x0.new_zeros(x0.shape[0], 0))

    def step(self, x: Tensor, memory: Memory, uniform: Tensor, dt: float) -> tuple[Tensor, Memory]:
        return memory.actor, memory


def holding(u: Tensor) -> Memory:
    """A memory that holds the control u (B, m) and nothing else."""
    empty = u.new_zeros(u.shape[0], 0)
    return Memory(empty, u, u.new_zeros(u.shape[0], 0, 0), empty)


class Episodes:
    """B episodes of one plant: the control is held for dt, the reward is minus the cost of that time.

    The steps are those of `adp.simulate`, so that the rewards of an episode add up to minus its cost.

    Args:
        system: the plant, with inputs.
        cost: the cost rate.
        rows: B.
        dt: s.
        horizon: s; an episode is truncated there.
        limit: an episode terminates when its state would exceed it in norm, or become non-finite; the state
            then stays at its last good values.
        penalty: cost of that, so that leaving never pays.

    Attributes:
        state: x, (B, n).
        age: steps of each episode so far, (B,).

    Raises:
        ValueError: if an argument breaks its rule.
    """

    def __init__(
        self,
        system: ControlAffineSystem,
        cost: Cost,
        rows: int,
        *,
        dt: float,
        horizon: float,
        limit: float,
        penalty: float,
    ) -> None:
        positive_real("Episodes", "horizon", horizon)
        self.loop = ClosedLoop(_Held(), system, cost, dt=dt, limit=limit)
        self.steps = math.ceil(horizon / self.loop.dt - 1e-9)
        self.penalty = positive_real("Episodes", "penalty", penalty)
        self.state = cost.q.new_zeros(rows, cost.q.shape[0])
        self.age = torch.zeros(rows, dtype=torch.int64)

    def begin(self, rows: Tensor, x0: Tensor) -> None:
        """New episodes in the rows of a mask (B,), from x0 (B, n)."""
        self.state = torch.where(rows.unsqueeze(-1), x0.to(self.state), self.state)
        self.age = torch.where(rows, 0, self.age)

    def step(self, u: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Hold u (B, m) for dt: reward, terminated and truncated, (B,) each.

        Raises:
            ValueError: if u has another shape.
        """
        wanted = (len(self.state), self.loop.cost.r.shape[0])
        if u.shape != wanted:
            raise fail("Episodes.step", "u", f"must have the shape {wanted}", tuple(u.shape))
        alive = torch.ones_like(self.age, dtype=torch.bool)
        before = LoopState(
            self.state, self.state.new_zeros(len(u)), alive, self.age, holding(u.to(self.state))
        )
        with torch.no_grad():
            after, _ = self.loop(before, self.state.new_zeros(len(u), 0, self.state.shape[1]))
        self.state = after.x
        self.age = self.age + 1
        reward = -torch.where(after.alive, after.cost, self.penalty)
        return reward, ~after.alive, self.age >= self.steps

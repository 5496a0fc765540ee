"""Result of direct shooting, and a controller that runs it."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from ....numerics.repr_text import span
from ...loop.controller import Controller


class Optimum(NamedTuple):
    """The best trajectories found from x0, a row each; NaN in the rows where none was found.

    Example:
        >>> plant = systems.TwoState()
        >>> cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
        >>> found = adp.DirectShooting(plant, cost, horizon=2.0).solve(torch.tensor([[0.2, 0.1]]).double())
        >>> bool(found.converged.all()), bool(found.mesh_error.max() < 1e-4)
        (True, True)

        Shown by `staf experiment=adp_three_state`.
    """

    value: Tensor  # V*(x0), (B,): the cost of the control that was found
    gradient: Tensor  # grad V*(x0), (B, n)
    control: Tensor  # u*(x0), (B, m)
    state: Tensor  # (B, N + 1, n)
    time: Tensor  # (N + 1,) seconds
    mesh_error: Tensor  # relative change of the value since a mesh of half as many intervals, (B,); inf if
    # that mesh was too coarse to converge on
    horizon_error: Tensor  # share of the value that is the terminal cost, (B,)
    iterations: Tensor  # Newton steps, all meshes and starts together, (B,)
    converged: Tensor  # (B,) bool: stationary in u, and no other start was known to be lower by 1e-4
    plan: Tensor  # u at the start and at the end of every interval, linear in between, (B, N, 2, m)
    optimality: Tensor  # (B,) what is left of the Hamiltonian over its minimum, as a share of the value
    reason: tuple[str, ...]  # a row: "" where it converged, else why it did not, or "local: ..."

    def __repr__(self) -> str:
        rows, times = self.state.shape[:2]
        found = int(self.converged.sum())
        why = sorted({reason for reason in self.reason if reason})
        more = f"; {why[0]}" + (f" (and {len(why) - 1} more reasons)" if len(why) > 1 else "") if why else ""
        return (
            f"Optimum({rows} states, value {span(self.value)}, {found} converged, {times - 1} intervals over "
            f"{float(self.time[-1]):.4g} s{more})"
        )

    def to(self, device: torch.device) -> Optimum:
        """Return the optimum on a device."""
        moved: dict[str, Any] = {
            name: part.to(device) for name, part in self._asdict().items() if name != "reason"
        }
        return self._replace(**moved)

    def replay(self) -> PlanReplay:
        """A controller that runs the plan of every row, open loop; it holds the mean over each period."""
        return PlanReplay(self.time, self.plan)


class PlanReplay(Controller):
    """u(t) of a plan (B, N, 2, m), u at the start and the end of every interval between times (N + 1,)
    from 0, linear on each, averaged over each period; its last value afterwards."""

    def __init__(self, time: Tensor, plan: Tensor) -> None:
        super().__init__()
        self.register_buffer("time", time)
        self.register_buffer("plan", plan)
        self.time: Tensor
        self.plan: Tensor

    def init(self, x0: Tensor) -> Tensor:
        """The time, (B, 1)."""
        if len(x0) != len(self.plan):
            raise ValueError(f"This plan is for {len(self.plan)} initial states; got {len(x0)}.")
        return x0.new_zeros(len(x0), 1)

    def step(self, x: Tensor, carried: Tensor, uniform: Tensor, dt: float) -> tuple[Tensor, Tensor]:
        now = float(carried[0, 0])
        u = (self.integral(now + dt) - self.integral(now)) / dt
        return u.to(x), carried + dt

    def integral(self, until: float) -> Tensor:
        """int_0^t u dt, (B, m)."""
        lengths = self.time.diff()
        share = ((until - self.time[:-1]) / lengths).clamp(0.0, 1.0)
        first, last = self.plan.unbind(2)
        weights = (lengths * share)[:, None]
        reached = first + 0.5 * share[:, None] * (last - first)
        beyond = max(0.0, until - float(self.time[-1]))
        total: Tensor = (weights * reached).sum(1) + beyond * last[:, -1]
        return total

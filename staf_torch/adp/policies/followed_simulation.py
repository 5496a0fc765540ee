"""A feedback followed through a simulator in NumPy, with nothing of torch between two periods."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from ...systems import Bounds, Plant, StepPlant
from ...systems.black_box import Numbers
from ..loop.controller import LQR, Policy
from ..problem.cost import QuadraticCost


@dataclasses.dataclass(frozen=True)
class Followed:
    """(x (..., n), T) -> states (..., T + 1, n) and controls (..., T, m) of a policy within its bounds."""

    plant: StepPlant
    base: Policy
    bounds: Bounds

    def __call__(self, x: Tensor, steps: int) -> tuple[Tensor, Tensor]:
        rows = x.detach().reshape(-1, x.shape[-1]).to("cpu", torch.float64).numpy()
        linear = type(self.base) is LQR and type(self.base.cost) is QuadraticCost
        feedback = self._linear() if linear else self._asked
        states, controls = self.plant.function.follow(rows, feedback, steps)
        return (
            torch.from_numpy(states).to(x).view(*x.shape[:-1], *states.shape[1:]),
            torch.from_numpy(controls).to(x).view(*x.shape[:-1], *controls.shape[1:]),
        )

    def _linear(self) -> Callable[[Numbers], Numbers]:
        """The LQR within its bounds, in NumPy."""
        assert isinstance(self.base, LQR)
        cost, size = self.base.cost, self.base.cost.dim
        columns = np.ascontiguousarray(self.base.k.numpy().T)
        target = np.zeros(size) if cost.target is None else cost.target.numpy()
        rest = np.zeros(cost.inputs) if cost.target_input is None else cost.target_input.numpy()
        low, high = self.bounds.low.numpy(), self.bounds.high.numpy()
        turn, whole = np.array([2 * np.pi * (k in cost.periodic) for k in range(size)]), 2 * np.pi

        def feedback(x: Numbers) -> Numbers:
            away = x - target
            if cost.periodic:
                away = away - turn * np.rint(away / whole)
            # A product a row: one of all rows may have other bits.
            u: Numbers = rest - (away[:, None] @ columns)[:, 0]
            return np.minimum(np.maximum(u, low), high) if self.bounds.present else u

        return feedback

    def _asked(self, x: Numbers) -> Numbers:
        with torch.no_grad():
            u: Numbers = self.bounds.clip(self.base(torch.from_numpy(x))).numpy()
        return u


def followed(plant: Plant, base: Policy, bounds: Bounds, period: float) -> Followed | None:
    """What follows a policy through a simulator that a user brings; None of other plants, or where the plant
    does more than its function.

    Args:
        plant: the plant.
        base: the policy, which is clipped to the bounds.
        bounds: of the inputs.
        period: s, for which a control is held.
    """
    if plant.traceable or not isinstance(plant, StepPlant) or plant.period != period:
        return None
    return Followed(plant, base, bounds) if type(plant).step is StepPlant.step else None

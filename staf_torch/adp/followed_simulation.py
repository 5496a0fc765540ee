"""A feedback followed through a simulator in NumPy, with nothing of torch between two periods."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from ..systems import Bounds, Plant, StepPlant
from ..systems.black_box import Numbers
from .controllers import LQR, Policy
from .cost import QuadraticCost

Followed = Callable[[Tensor, int], tuple[Tensor, Tensor]]
"""(x (..., n), T) -> the states (..., T + 1, n) and the controls (..., T, m)."""


def followed(plant: Plant, base: Policy, bounds: Bounds, period: float) -> Followed | None:
    """What follows a policy through a simulator that a user brings; None of other plants.

    Args:
        plant: the plant.
        base: the policy, which is clipped to the bounds.
        bounds: of the inputs.
        period: s, for which a control is held.
    """
    if plant.traceable or not isinstance(plant, StepPlant) or plant.period != period:
        return None
    if type(plant).step is not StepPlant.step:  # a plant that does more than its function
        return None
    feedback = _linear(base, bounds) if _is_linear(base) else _any(base, bounds)
    black_box = plant.function

    def follow(x: Tensor, steps: int) -> tuple[Tensor, Tensor]:
        rows = x.detach().reshape(-1, x.shape[-1]).to("cpu", torch.float64).numpy()
        states, controls = black_box.follow(rows, feedback, steps)
        return (
            torch.from_numpy(states).to(x).view(*x.shape[:-1], *states.shape[1:]),
            torch.from_numpy(controls).to(x).view(*x.shape[:-1], *controls.shape[1:]),
        )

    return follow


def _is_linear(base: Policy) -> bool:
    return type(base) is LQR and type(base.cost) is QuadraticCost


def _linear(lqr: Policy, bounds: Bounds) -> Callable[[Numbers], Numbers]:
    """The LQR within its bounds, in NumPy."""
    assert isinstance(lqr, LQR)
    cost, size = lqr.cost, lqr.cost.dim
    columns = np.ascontiguousarray(lqr.k.numpy().T)
    target = np.zeros(size) if cost.target is None else cost.target.numpy()
    rest = np.zeros(cost.inputs) if cost.target_input is None else cost.target_input.numpy()
    low, high = bounds.low.numpy(), bounds.high.numpy()
    bounded = bounds.present
    turn = np.array([2 * np.pi * (k in cost.periodic) for k in range(size)])
    whole = 2 * np.pi

    def feedback(x: Numbers) -> Numbers:
        away = x - target
        if cost.periodic:
            away = away - turn * np.rint(away / whole)
        # A product a row: one of all rows may have other bits.
        u: Numbers = rest - (away[:, None] @ columns)[:, 0]
        return np.minimum(np.maximum(u, low), high) if bounded else u

    return feedback


def _any(base: Policy, bounds: Bounds) -> Callable[[Numbers], Numbers]:
    """A policy in torch within the bounds."""

    def feedback(x: Numbers) -> Numbers:
        with torch.no_grad():
            u: Numbers = bounds.clip(base(torch.from_numpy(x))).numpy()
        return u

    return feedback

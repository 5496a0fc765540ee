"""Sizes of a global value that two states need, and four: one call without numbers to choose."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ...systems import Plant
from ...systems.base import spread_of
from ..problem.sampled import SampledProblem
from .ddp import BoxDDP
from .global_value import GlobalValue
from .global_value_learning import learn_global_value
from .receding_horizon import best_held

_STEPS = (60, 480)  # of a trajectory, at least and at most
_PROBED, _LATE = 24, 0.1  # states from which plans are tried, and the share of them that may be late
_ARRIVED = 1e-2  # share of a trajectory's cost that may be left at its end
_ENOUGH = 0.97  # share of fresh states known to 1 %
_SEED = 7


def box_of(plant: Plant, dim: int) -> Tensor:
    """Half the width of a plant's box: its ``spread``, and of its angles all of them: (n,)."""
    width = torch.ones(dim, dtype=torch.float64, device="cpu")
    spread = spread_of(plant, width)
    width *= spread if isinstance(spread, Tensor) and spread.dim() else float(spread)
    width[list(plant.periodic)] = math.pi
    return width


def global_value_of(problem: SampledProblem, width: Tensor, steps: int) -> GlobalValue:
    """The global value of a box, in seconds for two states and up to some minutes for four.

    Args:
        problem: plant, cost and bounds in steps.
        width: half the width of the box, (n,).
        steps: of a trajectory, to begin with: twice as many where fewer than nine of ten arrive.

    Raises:
        ValueError: if no trajectory arrives.
    """
    count = _enough_steps(problem, width, min(max(steps, _STEPS[0]), _STEPS[1] // 2))
    if problem.dim > 2:
        trajectories, rounds, candidates, lookahead = 120, 4, 48, 60
    else:
        trajectories, rounds, candidates, lookahead = 80, 3, 24, 40
    return learn_global_value(
        problem,
        width,
        steps=count,
        trajectories=trajectories,
        rounds=rounds,
        states=100,
        seed=_SEED,
        candidates=candidates,
        lookahead=lookahead,
        enough=_ENOUGH,
    )


def _enough_steps(problem: SampledProblem, width: Tensor, steps: int) -> int:
    """Steps in which nine of ten plans arrive at the goal; else the most."""
    generator = torch.Generator().manual_seed(_SEED)
    uniform = torch.rand(_PROBED, problem.dim, dtype=torch.float64, generator=generator, device="cpu")
    x0 = problem.goal + width * (2 * uniform - 1)
    while steps < _STEPS[1]:
        found = best_held(BoxDDP(problem, steps=steps, iterations=40, tolerance=1e-5), x0)
        late = found.value[:, -1] > _ARRIVED * found.cost
        if float(late.double().mean()) <= _LATE:
            break
        steps = min(2 * steps, _STEPS[1])
    return steps

"""A closed loop with everything that a simulation of it needs."""

from __future__ import annotations

import dataclasses

from torch import Tensor

from ...systems import Plant
from ..problem.cost import Cost
from .controller import Controller


@dataclasses.dataclass(frozen=True)
class OptimumSettings:
    """Settings of the search for the optimum where no formula knows it."""

    shooting: bool
    states: int  # recorded states, of all trajectories together, whose V* and u* are wanted
    horizon: float | None  # s
    intervals: int | None


@dataclasses.dataclass(frozen=True)
class AdpProblem:
    """A closed loop, checked."""

    system: Plant
    cost: Cost
    controller: Controller
    initial_states: Tensor  # (B, n)
    dt: float  # s
    steps: int
    every: int  # steps between recorded times
    seed: int
    integrator: str
    compile: bool | str
    optimum: OptimumSettings

    def with_states(self, states: Tensor) -> AdpProblem:
        """Return the problem with other initial states (B, n)."""
        return dataclasses.replace(self, initial_states=states)

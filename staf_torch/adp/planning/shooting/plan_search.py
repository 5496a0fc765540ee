"""Starts for direct shooting from a search in equal steps: plans by `BoxDDP`, and those of a memory."""

from __future__ import annotations

import functools
import logging

from torch import Tensor

from ....lanes.row_numbers import some_rows
from ....systems import Plant
from ...problem.cost import Cost
from ...problem.sampled import SampledProblem
from ..ddp import BoxDDP
from ..global_value import GlobalValue
from ..global_value_learning import best_from
from ..global_value_sizes import box_of, global_value_of
from ..receding_horizon import held_plans
from ..trajectories import Trajectories

_log = logging.getLogger(__name__)
_BEST = 2  # plans of a state that begin with a held bound
_REMEMBERED = 2  # states of a plant at most, of which a memory is learnt


class PlanSearch:
    """Plans from states, the controls held for a step each.

    Args:
        problem: the plant, its cost and bounds in steps.
        width: half the width of the box of the memory, (n,).
        steps: T.
    """

    def __init__(self, problem: SampledProblem, width: Tensor, steps: int) -> None:
        self.problem, self.width, self.steps = problem, width, steps
        self._search = BoxDDP(problem, steps=steps, iterations=60, tolerance=1e-6)

    @classmethod
    def of(cls, plant: Plant, cost: Cost, dt: float, steps: int) -> PlanSearch | None:
        """The search for a plant; None where it has no problem in steps."""
        try:
            problem = SampledProblem.of(plant, cost, dt=dt)
        except ValueError as error:
            _log.info("direct shooting begins without a search in steps: %s", str(error).splitlines()[0])
            return None
        return cls(problem, box_of(plant, problem.dim), steps)

    def held(self, x0: Tensor) -> list[Trajectories]:
        """The best plans from x0 (B, n) that begin with the goal's feedback or a held bound."""
        return held_plans(self._search, x0, _BEST)

    def remembered(self, x0: Tensor) -> list[Trajectories]:
        """The best plan from x0 (B, n) by a memory, if there is one."""
        return [] if self._memory is None else [best_from(self._memory, self._search, x0)]

    @functools.cached_property
    def _memory(self) -> GlobalValue | None:
        if self.problem.dim > _REMEMBERED or not self.problem.endless:
            return None
        try:
            with some_rows(None):  # its states are its own, and none of those that are planned from
                return global_value_of(self.problem, self.width, self.steps)
        except ValueError as error:
            _log.info("direct shooting begins without a memory: %s", str(error).splitlines()[0])
            return None

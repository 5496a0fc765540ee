"""The control where bounds bite: the best of several short plans."""

from __future__ import annotations

import torch
from torch import Tensor

from ..lanes import repeat
from ..lanes.function import RowFunction
from .plans import Reference
from .sampled_problem import SampledProblem
from .trajectory_optimisation import BoxDDP

_LENGTHS = (2, 4, 7, 12, 20, 30)  # periods for which a corner of the bounds is held before the feedback
_ITERATIONS = 15


class BoundedPlans:
    """u_0 of the cheapest plan over T periods by `BoxDDP`, begun from the linear feedback of the goal and
    from each corner of the bounds that is held for 2 to 30 periods before it.

    Args:
        problem: plant, cost and bounds in steps.
        steps: T.
    """

    def __init__(self, problem: SampledProblem, steps: int) -> None:
        self.problem, self.steps = problem, steps
        self._search = BoxDDP(problem, steps=steps, iterations=_ITERATIONS)
        self._strained = RowFunction(self._strain, problem, "whether a bound is met")

    def strained(self, x: Tensor) -> Tensor:
        """Whether the linear feedback, followed over the horizon, meets a bound: (B, n) -> (B,) bool."""
        return self._strained(x)[:, 0] > 0

    def __call__(self, x: Tensor) -> Tensor:
        """u: (B, n) -> (B, m)."""
        control, feedback = self._guesses(x)
        count, b = len(control), len(x)
        goal = self.problem.goals(x, self.steps)[:, :-1]
        found = self._search.solve(
            x.repeat(count, 1),
            control.repeat_interleave(b, 0),
            Reference(goal.repeat(count, 1, 1), feedback.repeat_interleave(b, 0)),
        )
        cost = torch.where(torch.isfinite(found.cost), found.cost, torch.inf).view(count, b)
        best = cost.argmin(0) * b + torch.arange(b)
        return found.control[best, 0]

    def _guesses(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """First controls (G, T, m), and their feedback (G, T, m, n)."""
        levels = self.problem.levels()
        corners = levels[(levels != self.problem.rest).all(-1)]
        lengths = [0, *(length for length in _LENGTHS if length < self.steps)]
        held = [(length, u) for length in lengths for u in (corners if length else corners[:1])]
        control = self.problem.rest.repeat(len(held), self.steps, 1)
        feedback = (-self.problem.k).repeat(len(held), self.steps, 1, 1)
        for k, (length, u) in enumerate(held):
            control[k, :length], feedback[k, :length] = u, 0.0
        return control, feedback

    def _strain(self, x: Tensor) -> Tensor:
        low, high = self.problem.bounds.low.to(x), self.problem.bounds.high.to(x)

        def step(now: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
            at, met = now
            u = self.problem.linear_feedback(at)
            after, _ = self.problem.advance(at, u)
            bound = ((u <= low) | (u >= high)).any(-1)
            return after, torch.where(bound, 1.0, met)

        met: Tensor = repeat(self.steps, step, (x, torch.zeros_like(x[..., 0])))[1]
        return met.unsqueeze(-1)

"""The control where bounds bite: the best of several short plans."""

from __future__ import annotations

import torch
from torch import Tensor

from ..lanes.function import RowFunction
from .plans import Reference, Trajectories
from .sampled_problem import SampledProblem
from .sampled_rollout import SampledRollout
from .trajectory_optimisation import BoxDDP

_LENGTHS = (2, 4, 7, 12, 20, 30)  # periods for which a corner of the bounds is held before the feedback
_ITERATIONS = 15


class BoundedPlans:
    """u_0 of the cheapest plan over T periods by `BoxDDP`, begun from the linear feedback of the goal and
    from each corner of the bounds that is held for 2 to 30 periods before it.

    Args:
        problem: plant, cost and bounds in steps.
        steps: T.
        policy: whose base is the linear feedback; a program is kept by what the policy holds, as a problem
            holds closures, which are not known again.
    """

    def __init__(self, problem: SampledProblem, steps: int, policy: SampledRollout) -> None:
        self.problem, self.steps = problem, steps
        self._search = BoxDDP(problem, steps=steps, iterations=_ITERATIONS)
        self._strained = RowFunction(policy.meets_bound, policy, "whether a bound is met")

    def strained(self, x: Tensor) -> Tensor:
        """Whether the base, followed over the policy's horizon, meets a bound: (B, n) -> (B,) bool."""
        return self._strained(x).reshape(-1) > 0

    def hasten(self) -> None:
        """Compile `strained` at its next call."""
        self._strained.hasten()

    def __call__(self, x: Tensor) -> Tensor:
        """u: (B, n) -> (B, m)."""
        return best_held(self._search, x).control[:, 0]


def best_held(search: BoxDDP, x: Tensor) -> Trajectories:
    """The cheapest trajectories from x (B, n) that a search reaches from the linear feedback of the goal, and
    from each corner of the bounds, held for 2 to 30 periods before it."""
    control, feedback = _guesses(search.problem, search.steps)
    count, b = len(control), len(x)
    goal = search.problem.goals(x, search.steps)[:, :-1]
    found = search.solve(
        x.repeat(count, 1),
        control.repeat_interleave(b, 0),
        Reference(goal.repeat(count, 1, 1), feedback.repeat_interleave(b, 0)),
    )
    cost = torch.where(torch.isfinite(found.cost), found.cost, torch.inf).view(count, b)
    return found.rows(cost.argmin(0) * b + torch.arange(b))


def _guesses(problem: SampledProblem, steps: int) -> tuple[Tensor, Tensor]:
    """First controls (G, T, m), and their feedback (G, T, m, n); the linear feedback first."""
    levels = problem.levels()
    corners = levels[(levels != problem.rest).all(-1)]
    held = [(length, u) for length in _LENGTHS if length < steps for u in corners]
    control = problem.rest.repeat(1 + len(held), steps, 1)
    feedback = (-problem.k).repeat(1 + len(held), steps, 1, 1)
    for k, (length, u) in enumerate(held, 1):
        control[k, :length], feedback[k, :length] = u, 0.0
    return control, feedback

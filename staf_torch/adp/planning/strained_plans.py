"""A policy in a loop that plans where its base would meet a bound, and only as long as that lasts."""

from __future__ import annotations

import torch
from torch import Tensor

from ...lanes import repeat
from ...lanes.combinators import tracing_now
from ...lanes.function import RowFunction
from ..loop.controller import Controller, ControllerState, carrying
from ..policies.sampled_rollout import SampledRollout
from ..problem.sampled import SampledProblem
from .ddp import BoxDDP
from .receding_horizon import RecedingHorizon, best_held

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


class StrainedPlans(Controller):
    """u = policy(x), but a plan's where the linear feedback of the goal, followed from x, would meet a bound.

    There a row carries a plan from control to control and improves it on the way, until the linear feedback
    meets no bound any more. That the plan is carried matters: two ways around that cost nearly the same would
    take turns, were each control decided anew. Where this is so at the beginning, the first plan is the best
    of several, which `init` finds before the loop; in the loop there is no time for this, and a plan begins
    from the linear feedback.

    Args:
        policy: of the other states; its base is the linear feedback.
        planner: of its plant, cost and bounds; it knows where bounds are met.
        begun: what carries the plans, of the planner's problem.
    """

    def __init__(self, policy: SampledRollout, planner: BoundedPlans, begun: RecedingHorizon) -> None:
        super().__init__()
        self.policy, self.period = policy, policy.period
        self._planner, self._begun = planner, begun

    @property
    def label(self) -> str:
        return type(self.policy).__name__

    def init(self, x0: Tensor) -> ControllerState:
        """The first plans from x0 (B, n), of the rows that need one.

        After `lanes.ready` of the policy, what the loop may need is made and compiled here, too.
        """
        carried = self._without(x0)
        if self.policy.compiled:
            self._planner.hasten()
            self._begun.hasten()
            self._begun.step(x0, self._begun.idle(x0), x0, self.policy.period)
        rows = self._strained(x0).nonzero().squeeze(1)
        if len(rows):  # saves work: the best of several takes a tenth of a second
            carried.identifier[rows] = self._begun.init(x0[rows]).identifier
        return carried

    def step(
        self, x: Tensor, carried: ControllerState, uniform: Tensor, dt: float
    ) -> tuple[Tensor, ControllerState]:
        if tracing_now():
            return self._traced(x, carried, uniform, dt)
        rows = self._strained(x).nonzero().squeeze(1)
        none = carried.identifier[:, 0] < 0
        if not len(rows):  # saves work, as below: a plan takes milliseconds
            return self.policy(x), carried if bool(none.all()) else self._without(x)
        # The policy sees all rows, as each number of rows would be a program of its own.
        u = self.policy(x) if len(rows) < len(x) else x.new_empty(len(x), self.policy.cost.inputs)
        plans, begins = carried.identifier[rows], none[rows].unsqueeze(-1)
        plans = torch.where(begins, self._begun.idle(x[rows]).identifier, plans)
        mine = carried._replace(**{name: part[rows] for name, part in carried._asdict().items()})
        planned, ahead = self._begun.step(x[rows], mine._replace(identifier=plans), uniform[rows], dt)
        after = self._without(x)
        after.identifier[rows] = ahead.identifier
        return u.index_copy(0, rows, planned), after

    def _traced(
        self, x: Tensor, carried: ControllerState, uniform: Tensor, dt: float
    ) -> tuple[Tensor, ControllerState]:
        """`step` for a program, which plans where the row asks for it."""
        met, known = self._strained(x), carried.identifier
        plans = torch.where(known[:, :1] < 0, self._begun.idle(x).identifier, known)

        def plan(_: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
            u, after = self._begun.step(x, carried._replace(identifier=plans), uniform, dt)
            return u, after.identifier

        start = self.policy(x), self._without(x).identifier
        u, after = repeat(1, plan, start, where=lambda _: met)
        return u, carrying(after)

    def _without(self, x: Tensor) -> ControllerState:
        """No plan in any row: -1 steps of it are done."""
        return carrying(x.new_full((len(x), 1 + self._begun.width), -1.0))

    def _strained(self, x: Tensor) -> Tensor:
        """(B, n) -> (B,) bool; a row that has left the finite numbers has nothing to plan."""
        return self._planner.strained(x) & torch.isfinite(x).all(-1)

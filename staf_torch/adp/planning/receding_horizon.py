"""Receding-horizon control: always, or only while a base policy would meet a bound."""

from __future__ import annotations

import copy
import functools
import math
from typing import NamedTuple

import torch
from torch import Tensor

from ...lanes import compiled, traced_as, where_rows
from ...lanes.gradients import without_gradient
from ...lanes.row_numbers import over_rows
from ...numerics.checks import fail, flag, integer, trailing
from ...numerics.default_device import where_held
from ..loop.controller import Controller
from ..policies.sampled_rollout import SampledRollout
from ..problem.sampled import SampledProblem, goal_of
from .ddp import BoxDDP
from .global_value import GlobalValue
from .global_value_learning import best_from, best_held
from .trajectories import (
    LocalModel,
    Reference,
    Trajectories,
    around,
    packed,
    resting,
    unpacked,
)

_ITERATIONS = 15  # of `BoxDDP`, for a plan that is made anew at every control


class Following(NamedTuple):
    """The plan that a row follows."""

    plan: Tensor  # state, control and feedback of every step, (B, T, n + m + m n)
    done: Tensor  # steps that were followed of it, (B,); -1 where a row has no plan


class RecedingHorizon(Controller):
    """u_0 of argmin sum_{k<T} l(x_k, u_k) + V_T(x_T), low <= u <= high, from the state x = x_0.

    Every period improves a plan by a few iterations of `BoxDDP`, all rows together. It begins from the plan
    of the period before, a step further on, followed with its feedback from where the plant is now; V_T is
    the value of the goal's linear feedback. With a `GlobalValue` it begins from the plan that the memory
    finds now, and V_T is the model that it remembers where that ends: a plan that goes on from its own past
    drifts to where the models err (1.02 to 1.12 of the optimum on the pendulum, against 1.00).

    Example:
        >>> def step(x, u):  # a cart without friction, for 0.1 s
        ...     after = torch.stack((x[:, 0] + 0.1 * x[:, 1], x[:, 1] + 0.1 * u[:, 0]), dim=-1)
        ...     return after, 0.1 * (x.square().sum(-1) + u.square().sum(-1))
        >>> problem = adp.SampledProblem(step, dim=2, inputs=1, low=-1.0, high=1.0)
        >>> mpc = adp.RecedingHorizon(problem, steps=5, compile=False)
        >>> x = torch.tensor([[0.5, 0.0]]).double()
        >>> plan = mpc.init(x)
        >>> u, plan = mpc.step(x, plan, uniform=x, dt=0.1)  # again and again; no random points are used
        >>> u.shape
        torch.Size([1, 1])

        Shown by `staf_torch/adp/README.md`.

    Args:
        problem: plant, cost and bounds in steps; its period is that of the loop.
        steps: T.
        iterations: of a period; the first plan takes as many as it needs, up to 60. 0: the first plan alone
            is followed, with its feedback and then with that of the goal, in some 50 us a control; let
            ``steps`` be the whole episode then.
        memory: for V_T and the plan to begin from; None for the linear feedback and the last plan.
        held: whether the first plan is the best of several, begun also from holding each corner of the
            bounds for 2 to 30 periods before the linear feedback: the first plan decides which of several
            ways to the goal is gone. Without a memory, whose first plans are the best of several.
        compile: as in `BoxDDP`.

    Raises:
        ValueError: if an argument breaks its rule, or the memory is of another problem.

    Source: Tassa, Erez, Todorov, "Synthesis and stabilization of complex behaviors through online trajectory
    optimization", IROS (2012), for warm-started DDP in the loop.
    """

    def __init__(
        self,
        problem: SampledProblem,
        *,
        steps: int,
        iterations: int = 3,
        memory: GlobalValue | None = None,
        held: bool = False,
        compile: bool = True,
    ) -> None:
        super().__init__()
        self.problem, self.memory = problem, memory
        if memory is not None and memory.problem is not problem:
            raise fail("RecedingHorizon", "memory", "must be of the same problem", memory.problem)
        self.held = flag("RecedingHorizon", "held", held)
        if held and memory is not None:
            raise fail("RecedingHorizon", "held", "must be False with a memory, which has plans", held)
        self.steps = integer("RecedingHorizon", "steps", steps, least=1)
        self.iterations = integer("RecedingHorizon", "iterations", iterations, least=0)
        self.costly, self._compile = self.iterations > 0, compile
        self._first = BoxDDP(problem, steps=steps, compile=compile)
        self._search: BoxDDP | None = None
        if iterations:
            self._search = copy.copy(self._first)  # by the same programs: none is traced twice
            self._search.iterations = self.iterations

    def hasten(self) -> None:
        """Let `step` be one program from its next call on, where it improves the plan of a period before.

        Some seconds of a C++ compiler, and a control takes a tenth of the time: .13 ms of a cart-pole, 40
        periods ahead.
        """
        if self._compile and self._search is not None and self.memory is None:
            self._improved.hasten()

    @where_held("RecedingHorizon.init", goal_of)
    @without_gradient("RecedingHorizon.init", "x0", "self")
    def init(self, x0: Tensor) -> Following:
        """The first plan, from the states x0 (B, n)."""
        x0 = trailing(type(self).__name__, "x0", x0, 2).to(self.problem.goal.dtype)
        if self._search is None and self.memory is not None:
            return _following(best_from(self.memory, self._first, x0))
        if self.held:
            return _following(best_held(self._first, x0))
        control, reference = (None, None) if self.memory is None else self._remembered(x0)
        found = self._first.solve(x0, control, reference, self._terminal(x0, control, reference))
        return _following(found)

    @where_held("RecedingHorizon.idle", goal_of)
    def idle(self, x0: Tensor) -> Following:
        """The linear feedback of the goal as a plan, not yet followed from the states x0 (B, n)."""
        plan = over_rows(lambda x: resting(self.problem, self.problem.goals(x, self.steps)[:, :-1]), x0)
        return Following(plan, torch.zeros_like(plan[:, 0, 0]))

    @where_held("RecedingHorizon.step", goal_of)
    @without_gradient("RecedingHorizon.step", "x", "self")
    def step(self, x: Tensor, carried: Following, uniform: Tensor, dt: float) -> tuple[Tensor, Following]:
        """The first control of the improved plan (B, m), and the plan a step further on."""
        step = self._followed if self._search is None else self._improved
        at = trailing("RecedingHorizon.step", "x", x, 2, self.problem.dim)
        u, after = step(at.to(self.problem.goal.dtype), carried)
        return u.to(x.dtype), after

    def _begun(self, x: Tensor, carried: Following) -> tuple[Tensor, Reference]:
        """Return the start of a search: the memory's plan, or the carried one."""
        if self.memory is not None:
            return self._remembered(x)
        state, control, feedback = unpacked(self.problem, carried.plan)
        return control, Reference(state, feedback)

    @compiled("a plan improved", pays=math.inf, copies=0)
    def _improved(self, x: Tensor, carried: Following) -> tuple[Tensor, Following]:
        """The first control of an improved plan, and the plan from the next step on, at its end the linear
        feedback of the goal near the last state."""
        assert self._search is not None
        control, reference = self._begun(x, carried)
        found = self._search.solve(x, control, reference, self._terminal(x, control, reference))
        hold = over_rows(lambda x: resting(self.problem, self.problem.goals(x, 0)), found.state[:, -1])
        plan = torch.cat((_rows(found)[:, 1:], hold), dim=1)
        return found.control[:, 0], Following(plan, torch.zeros_like(carried.done))

    def _remembered(self, x: Tensor) -> tuple[Tensor, Reference]:
        assert self.memory is not None
        return self.memory.replay(x, self.memory.choose(x).entry, self.steps)

    def _terminal(self, x: Tensor, control: Tensor | None, reference: Reference | None) -> LocalModel | None:
        """The remembered model where a plan ends."""
        if self.memory is None or control is None or reference is None:
            return None
        for step in packed(reference.state, control, reference.feedback).unbind(1):
            x, _ = self.problem.advance(x, around(self.problem, x, step))
        return self.memory.model(x)

    def _looked_up(self, x: Tensor, carried: Following) -> tuple[Tensor, Following]:
        """`_followed` of a program, which cannot ask for a number: it looks up the row of the plan."""
        plan, done = carried
        last = self.steps - 1
        at = done.clamp(max=last).long()[:, None, None].expand(-1, -1, plan.shape[-1])
        planned = around(self.problem, x, plan.gather(1, at).squeeze(1))
        u = torch.where((done > last).unsqueeze(-1), self.problem.linear_feedback(x), planned)
        return u, Following(plan, done + 1)

    @traced_as(_looked_up)
    def _followed(self, x: Tensor, carried: Following) -> tuple[Tensor, Following]:
        """The control of a plan that is not improved, and the plan with one step more done."""
        plan, done = carried
        begun, after = int(done[0]), Following(plan, done + 1)  # all rows began together
        if begun >= self.steps:
            return self.problem.linear_feedback(x), after
        return around(self.problem, x, plan[:, begun]), after


def _rows(found: Trajectories) -> Tensor:
    """State, control and feedback of every step: (B, T, n + m + m n)."""
    return packed(found.state[:, :-1], found.control, found.feedback)


def _following(found: Trajectories) -> Following:
    """A plan of which no step is done."""
    plan = _rows(found)
    return Following(plan, torch.zeros_like(plan[:, 0, 0]))


class BoundedPlans:
    """u_0 of the cheapest plan over T periods by `BoxDDP`, begun from the linear feedback of the goal,
    which is the base of the policy, and from each corner of the bounds that is held for 2 to 30 periods
    before it."""

    def __init__(self, problem: SampledProblem, steps: int, policy: SampledRollout) -> None:
        self.problem, self.steps, self.policy = problem, steps, policy
        self._search = BoxDDP(problem, steps=steps, iterations=_ITERATIONS)

    def strained(self, x: Tensor) -> Tensor:
        """Return where the base, followed over the policy's horizon, meets a bound: (B, n) -> (B,) bool."""
        return self.policy.meets_bound(x).reshape(-1) > 0

    @functools.cached_property
    def loop(self) -> RecedingHorizon:
        """Controller of all loops: it holds programs and nothing of a loop."""
        return RecedingHorizon(self.problem, steps=self.steps, held=True)

    def __call__(self, x: Tensor) -> Tensor:
        """u: (B, n) -> (B, m)."""
        return best_held(self._search, x).control[:, 0]


class StrainedPlans(Controller):
    """u = policy(x), but a plan's where the linear feedback of the goal, followed from x, would meet a
    bound.

    There a row carries a plan from control to control and improves it on the way, until the linear feedback
    meets no bound any more. That the plan is carried matters: two ways around that cost nearly the same
    would take turns, were each control decided anew. Where this is so at the beginning, the first plan is
    the best of several, which `init` finds before the loop; in the loop there is no time for this, and a
    plan begins from the linear feedback, the base of the policy.
    """

    def __init__(self, policy: SampledRollout, planner: BoundedPlans) -> None:
        super().__init__()
        self.policy, self.period = policy, policy.period
        self._planner, self._begun = planner, planner.loop

    @property
    def label(self) -> str:
        return type(self.policy).__name__

    @without_gradient("NearOptimal.controller().init", "x0", "self")
    def init(self, x0: Tensor) -> Following:
        """The first plans from x0 (B, n), of the rows that need one.

        After `lanes.ready` of the policy, what the loop may need is made and compiled here, too.
        """
        x0 = trailing("NearOptimal.controller", "x0", x0, 2).to(self.policy.metric.dtype)
        if self.policy.improved.compiled:
            self.policy.meets_bound.hasten()
            self._begun.hasten()
            self._begun.step(x0, self._begun.idle(x0), x0, self.policy.period)
        # Saves work: the best of several takes a tenth of a second.
        return where_rows(self._strained(x0), self._begun.init, x0, _without(self._begun.idle(x0)))

    @without_gradient("NearOptimal.controller().step", "x", "self")
    def step(self, x: Tensor, carried: Following, uniform: Tensor, dt: float) -> tuple[Tensor, Following]:
        def planned(now: tuple[Tensor, Following, Tensor]) -> tuple[Tensor, Following]:
            x, carried, uniform = now
            return self._begun.step(x, self._or_idle(x, carried), uniform, dt)

        given = trailing("NearOptimal.controller", "x", x, 2).dtype
        x = x.to(self.policy.metric.dtype)
        # The policy sees all rows, as each number of rows would be a program of its own.
        otherwise = self.policy(x), _without(carried)
        u, after = where_rows(self._strained(x), planned, (x, carried, uniform), otherwise)
        return u.to(given), after

    def _or_idle(self, x: Tensor, carried: Following) -> Following:
        """The plans, and where a row has none the linear feedback of the goal as one."""
        none, idle = carried.done < 0, self._begun.idle(x)
        plan = torch.where(none[:, None, None], idle.plan, carried.plan)
        return Following(plan, torch.where(none, idle.done, carried.done))

    def _strained(self, x: Tensor) -> Tensor:
        """(B, n) -> (B,) bool; a row that has left the finite numbers has nothing to plan."""
        return self._planner.strained(x) & torch.isfinite(x).all(-1)


def _without(carried: Following) -> Following:
    """No plan in any row."""
    return Following(*(torch.full_like(part, -1.0) for part in carried))

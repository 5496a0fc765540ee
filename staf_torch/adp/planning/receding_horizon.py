"""Receding-horizon control: always, or only while a base policy would meet a bound."""

from __future__ import annotations

import copy

import torch
from torch import Tensor

from ...lanes import Program, repeat
from ...lanes.function import RowFunction
from ...lanes.loops import tracing_now
from ...numerics.checks import fail, flag, integer
from ..loop.controller import Controller, ControllerState, carrying
from ..policies.sampled_rollout import SampledRollout
from ..problem.sampled import SampledProblem
from .ddp import BoxDDP, LocalModel, Reference, Trajectories, around, packed, resting, unpacked
from .global_value import GlobalValue
from .global_value_learning import best_from

_LENGTHS = (2, 4, 7, 12, 20, 30)  # periods for which a corner of the bounds is held before the feedback


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
            ``steps`` be the whole episode then. With a memory that plan is the best that `BoxDDP` reaches
            from several of the memory's, also after holding a bound for a while.
        memory: for V_T and the plan to begin from; None for the linear feedback and the last plan.
        held: whether the first plan is the best of several, begun also from holding each corner of the
            bounds for 2 to 30 periods before the linear feedback, not from this feedback alone: where the
            bounds are met there are several ways to the goal, and the plan of a period before decides which
            one is gone. Without a memory, which has its own.
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
        self.costly = self.iterations > 0
        self._first = BoxDDP(problem, steps=steps, compile=compile)
        self._search: BoxDDP | None = None
        if iterations:
            self._search = copy.copy(self._first)  # by the same programs: none is traced twice
            self._search.iterations = self.iterations
        self._hastened = False
        self._whole = Program(
            lambda carry, now, row: (carry, self._improved(*row)),
            name="a plan improved",
            compile=compile,
        )

    def hasten(self) -> None:
        """Let `step` be one program from its next call on, where it improves the plan of a period before.

        Some seconds of a C++ compiler, and a control takes a tenth of the time: .13 ms of a cart-pole, 40
        periods ahead.
        """
        self._hastened = self._search is not None and self.memory is None

    @property
    def width(self) -> int:
        """Numbers of a plan: T (n + m + m n)."""
        n, m = self.problem.dim, self.problem.inputs
        return self.steps * (n + m + m * n)

    def init(self, x0: Tensor) -> ControllerState:
        """The first plan, from the states x0 (B, n)."""
        if self._search is None and self.memory is not None:
            return _carrying(_rows(best_from(self.memory, self._first, x0)))
        if self.held:
            return _carrying(_rows(best_held(self._first, x0)))
        control, reference = (None, None) if self.memory is None else self._remembered(x0)
        found = self._first.solve(x0, control, reference, self._terminal(x0, control, reference))
        return _carrying(_rows(found))

    def idle(self, x0: Tensor) -> ControllerState:
        """The linear feedback of the goal as a plan, not yet followed from the states x0 (B, n)."""
        return _carrying(resting(self.problem, self.problem.goals(x0, self.steps)[:, :-1]))

    def step(
        self, x: Tensor, carried: ControllerState, uniform: Tensor, dt: float
    ) -> tuple[Tensor, ControllerState]:
        """The first control of the improved plan (B, m), and the plan a step further on."""
        if self._search is None:
            return self._followed(x, carried.identifier)
        row = x, carried.identifier
        if self._hastened and not tracing_now() and self._whole.compiles((), (), row, steps=1):
            _, found = self._whole((), (), row, steps=1)
            u, plan = (part[:, 0] for part in found)
        else:
            u, plan = self._improved(*row)
        return u, carrying(plan)

    def _begun(self, x: Tensor, plan: Tensor) -> tuple[Tensor, Reference]:
        """What a search begins from: the memory's plan, or the carried one (B, 1 + T w)."""
        if self.memory is not None:
            return self._remembered(x)
        state, control, feedback = unpacked(self.problem, plan[:, 1:].unflatten(-1, (self.steps, -1)))
        return control, Reference(state, feedback)

    def _improved(self, x: Tensor, plan: Tensor) -> tuple[Tensor, Tensor]:
        """The first control of an improved plan and the numbers that are carried: (B, n), (B, 1 + T w)."""
        assert self._search is not None
        control, reference = self._begun(x, plan)
        found = self._search.solve(x, control, reference, self._terminal(x, control, reference))
        return found.control[:, 0], self._ahead(_rows(found), found.state[:, -1]).identifier

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

    def _followed(self, x: Tensor, plan: Tensor) -> tuple[Tensor, ControllerState]:
        """The control of a plan that is not improved, (B, 1 + T w), and the plan with one step more done."""
        width, last = self.width // self.steps, self.steps - 1
        carried = _carrying(plan[:, 1:], plan[:, :1] + 1)
        if tracing_now():  # a program cannot ask for a number: it looks up the row of the plan
            done, steps = plan[:, :1], plan[:, 1:].unflatten(-1, (self.steps, width))
            now = steps.gather(1, done.clamp(max=last).long().unsqueeze(-1).expand(-1, -1, width)).squeeze(1)
            planned = around(self.problem, x, now)
            return torch.where(done > last, self.problem.linear_feedback(x), planned), carried
        begun = int(plan[0, 0])  # all rows began together
        if begun > last:
            return self.problem.linear_feedback(x), carried
        now = plan[:, 1 + begun * width : 1 + (begun + 1) * width]
        return around(self.problem, x, now), carried

    def _ahead(self, plan: Tensor, last: Tensor) -> ControllerState:
        """The plan (B, T, w) from the next step on, and at its end the linear feedback of the goal near the
        last state (B, n)."""
        hold = resting(self.problem, self.problem.goals(last, 0))
        return _carrying(torch.cat((plan[:, 1:], hold), dim=1))


def _rows(found: Trajectories) -> Tensor:
    """State, control and feedback of every step: (B, T, n + m + m n)."""
    return packed(found.state[:, :-1], found.control, found.feedback)


def _carrying(plan: Tensor, done: Tensor | None = None) -> ControllerState:
    """A plan (B, T, w) and how many of its steps are done, (B, 1); none by default."""
    done = plan.new_zeros(len(plan), 1) if done is None else done
    return carrying(torch.cat((done, plan.flatten(1)), dim=1))


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

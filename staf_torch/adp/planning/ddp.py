"""Box-constrained differential dynamic programming: optimal trajectories of many initial states at once.

Backward in time a quadratic model of the value is propagated through second-order expansions, the control
of each step minimised over its box; forward the new control is tried at five lengths. A collocated program
with a general solver has the same optima, but a row costs it a hundred times as much, and its plan has no
feedback. In plain torch rows that are done leave the batch and all times are expanded at once; in a program
of one row both are loops.

Source: Tassa, Mansard and Todorov, "Control-limited differential dynamic programming", ICRA (2014).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ...lanes import Program, repeat, scan, traced_as
from ...lanes.gradients import without_gradient
from ...lanes.per_row.decisions import numbers_of_rows
from ...lanes.row_numbers import over_rows, some_rows
from ...lanes.threads import alone
from ...lanes.torch_compile.operators import opaque
from ...lanes.tree import Tree, flatten, unflatten
from ...numerics.box import minimum_and_slopes
from ...numerics.checks import fail, integer, positive_real, trailing
from ...numerics.default_device import beside, where_held
from ...numerics.riccati import riccati_step
from ...signs import Sign
from ..problem.sampled import Derivatives, SampledProblem, goal_of
from .trajectories import (
    CostedTrajectories,
    End,
    EndFunction,
    LocalModel,
    Reference,
    Trajectories,
    chosen,
    first_controls,
    rows_of,
)

LENGTHS = (1.0, 0.5, 0.2, 0.07, 0.02)  # shares of a step that are tried side by side
EASIER, HARDER = 0.4, 8.0  # what success and failure do to the regularisation of a row
# Of the regularisation, in units of the cost's curvature in u:
LEAST, FIRST, TRUSTED, MOST = 1e-9, 1e-3, 1.0, 1e9
CONVERGED = -1.0
_ROUNDED = 4.0
_NUMBERS = 2**25  # second derivatives that are held at once
_STARTS = 12  # first controls that are improved where there is no linear feedback


class BoxDDP:
    """min sum_{k<T} l(x_k, u_k) + V_T(x_T) over bounded controls, from every state of a batch.

    Backward in time, the quadratic model of l + V(F) around the trajectory is minimised over the box of
    controls, which gives a change of the control and a feedback (0 at a bound); forward, five lengths of the
    change are tried, each with the feedback, and a row takes the best that lowers its cost. A row that finds
    none is regularised more, and changes between the full second derivatives and those of Gauss and Newton.

    The minimum is a local one. No row sees another.

    Example:
        >>> def step(x, u):  # a cart without friction, for 0.1 s
        ...     after = torch.stack((x[:, 0] + 0.1 * x[:, 1], x[:, 1] + 0.1 * u[:, 0]), dim=-1)
        ...     return after, 0.1 * (x.square().sum(-1) + u.square().sum(-1))
        >>> problem = adp.SampledProblem(step, dim=2, inputs=1, low=-1.0, high=1.0)
        >>> found = adp.BoxDDP(problem, steps=20, compile=False).solve(torch.tensor([[1.0, 0.0]]).double())
        >>> bool(found.converged.all()), float(found.control.abs().max()) <= 1
        (True, True)

        Shown by `staf_torch/adp/README.md`.

    Args:
        problem: plant, cost and bounds in steps.
        steps: T.
        iterations: at most.
        tolerance: relative change of the cost at which a row has converged, positive. So it has where only
            rounding of states and controls is left to be gained, as of a cost that is 0.
        compile: whether `lanes` compiles the passes: some seconds of a C++ compiler for a plant that is new
            to its cache, and a hundred times faster then.

    Raises:
        ValueError: if an argument breaks its rule.

    Source: Tassa, Mansard, Todorov, "Control-limited differential dynamic programming", ICRA (2014).
    """

    def __init__(
        self,
        problem: SampledProblem,
        *,
        steps: int,
        iterations: int = 60,
        tolerance: float = 1e-7,
        compile: bool = True,
    ) -> None:
        self.problem = problem
        self.steps = integer("BoxDDP", "steps", steps, least=1)
        self.iterations = integer("BoxDDP", "iterations", iterations, least=1)
        self.tolerance = positive_real("BoxDDP", "tolerance", tolerance)
        self._expand = Program(self.expand, name="derivatives of a step", compile=compile)
        self._back = Program(self.backward, name="a backward pass", compile=compile)
        self._forth = Program(self.forward, name="a forward pass", compile=compile)

    def __repr__(self) -> str:
        about = f"steps={self.steps}, iterations={self.iterations}, tolerance={self.tolerance:g}"
        return f"BoxDDP({self.problem!r}, {about})"

    @where_held("BoxDDP.solve", goal_of)
    @opaque
    @without_gradient("BoxDDP.solve", "x0", "control", "reference", "terminal", "self")
    @Sign("BoxDDP")
    @beside
    def solve(
        self,
        x0: Tensor,
        control: Tensor | None = None,
        reference: Reference | None = None,
        terminal: LocalModel | None = None,
    ) -> Trajectories:
        """The trajectories from x0 that the search reaches from a first control.

        Args:
            x0: (B, n).
            control: (B, T, m), used as it is, or around ``reference``; None for the goal's linear feedback,
                and of a problem without one for the best of several: bounds held for a while, random ones.
            reference: states and feedback that the first control goes with; none for open loop.
            terminal: V_T, a model a row; None for that of the problem: its own, or the value of the goal's
                linear feedback.

        Raises:
            ValueError: if a shape is wrong.
        """
        n, m = self.problem.dim, self.problem.inputs
        if trailing("BoxDDP.solve", "x0", x0, 2, n, meta=False, vmap=False).dim() != 2:
            raise fail("BoxDDP.solve", "x0", f"must have the shape (B, {n})", tuple(x0.shape))
        real = self.problem.goal.dtype
        if x0.dtype != real:
            given, shape = flatten((x0, control, reference, terminal))
            return self.solve(*unflatten(shape, iter([each.to(real) for each in given]))).to(x0.dtype)
        expected = (len(x0), self.steps, m)
        if control is None and self.problem.unregulated:
            return self._best_of_several(x0, terminal)
        if control is None:
            control, reference = over_rows(self._linear, x0)
        if control.shape != expected:
            raise ValueError(
                f"`BoxDDP.solve(control=...)` must have the shape {expected}; got {tuple(control.shape)}."
            )
        if reference is None:
            still = x0.unsqueeze(1).expand(-1, self.steps, -1)
            reference = Reference(still, x0.new_zeros(*expected, n))
        ends: End = over_rows(self.ends, x0) if terminal is None else terminal
        together = max(1, _NUMBERS // (self.steps * (n + 1) * (n + m) ** 2))
        whole = x0, self.problem.admissible(control), *reference, *ends
        if len(x0) <= together:
            with alone(len(x0) * self.steps * (n + m) ** 2):
                return self._solve(*whole)
        parts = []
        for rows in torch.arange(len(x0), device=x0.device).split(together):
            with some_rows(rows):
                parts.append(self._solve(*(part[rows] for part in whole)))
        return Trajectories(*(torch.cat(column) for column in zip(*parts, strict=True)))

    def _best_of_several(self, x0: Tensor, terminal: LocalModel | None) -> Trajectories:
        """The cheapest trajectories of the cheapest first controls of each row."""
        b = len(x0)

        def first() -> tuple[Tensor]:
            return (self.problem.admissible(first_controls(self.problem, self.steps)),)

        (tried,) = numbers_of_rows(first).numbers  # (B or 1, G, T, m)
        tried = tried.to(x0).expand(b, -1, -1, -1).transpose(0, 1)
        ends = over_rows(self.ends, x0) if terminal is None else terminal
        still = x0.unsqueeze(1).expand(-1, self.steps, -1)
        none = x0.new_zeros(*still.shape[:2], self.problem.inputs, x0.shape[1])
        zero = x0.new_zeros(b, self.steps, self.problem.inputs), none, x0.new_ones(b, 1)
        cost = torch.stack([self._followed(x0, (still, u, *zero[:2]), zero[2], ends).cost for u in tried])
        best = cost.argsort(dim=0, stable=True)[:_STARTS]  # (S, B)
        count, rows = len(best), torch.arange(b, device="cpu")
        again = None if terminal is None else rows_of(terminal, rows.repeat(count))
        with some_rows(rows.repeat(count)):
            found = self.solve(x0.repeat(count, 1), tried[best, rows].flatten(0, 1), None, again)
        lowest = torch.where(torch.isfinite(found.cost), found.cost, torch.inf).view(count, b)
        return rows_of(found, lowest.argmin(0) * b + rows)

    def _linear(self, x0: Tensor) -> tuple[Tensor, Reference]:
        """The linear feedback of the goal as a first control of (B, n), and what it is a feedback around."""
        problem, shape = self.problem, (len(x0), self.steps, self.problem.inputs)
        goals = problem.goals(x0, self.steps)[:, :-1]
        return problem.rest.expand(shape), Reference(goals, (-problem.k).expand(*shape, problem.dim))

    def ends(self, x0: Tensor) -> End:
        """V_T of plans from x0 (B, n): the value of the goal's linear feedback, or what the problem pays."""
        if self.problem.end_value is not None:
            return EndFunction(x0.new_zeros(len(x0)))
        none, bent = torch.zeros_like(x0), (2 * self.problem.end).expand(*x0.shape, x0.shape[-1])
        goal = self.problem.goal.expand_as(x0)
        if self.problem.path is not None:
            goal = self.problem.goals(x0, self.steps)[:, -1]
        return LocalModel(goal, none[:, 0], none, bent)

    def _solve(self, x0: Tensor, control: Tensor, *more: Tensor) -> Trajectories:
        """`solve` for as many rows as fit; ``more`` are the fields of a reference and of a terminal model."""
        reference = Reference(*more[:2])
        terminal: End = LocalModel(*more[2:]) if len(more) > 3 else EndFunction(*more[2:])
        around = reference.state, control, torch.zeros_like(control), reference.feedback
        plan = self._followed(x0, around, x0.new_ones(len(x0), 1), terminal)
        going, ones = torch.isfinite(plan.cost).to(x0), torch.ones_like(plan.cost)
        begun = SearchState(*plan, FIRST * ones, ones.clone(), going)
        return self._models(self._searched(begun, terminal), terminal)

    def _searched_alone(self, begun: SearchState, terminal: End) -> SearchState:
        """`_searched` of a program: a single row has no rows to leave out."""

        def iterated(now: SearchState) -> SearchState:
            return self._iterated(now, self._derivatives(now), terminal)

        found: SearchState = repeat(self.iterations, iterated, begun, where=lambda now: now.going > 0)
        return found

    @traced_as(_searched_alone)
    def _searched(self, found: SearchState, terminal: End) -> SearchState:
        """The state of the search after all iterations, of each the rows that go on."""
        rows = found.going.nonzero().squeeze(1)
        now, ends, known = rows_of(found, rows), rows_of(terminal, rows), None
        for _ in range(self.iterations):
            if not len(rows):
                break
            with some_rows(rows):
                known = self._derivatives(now) if known is None else known
                after = self._iterated(now, known, ends)
            for part, current in zip(found, after, strict=True):
                part[rows] = current
            on = after.going > 0
            fresh = (after.cost < now.cost)[on]
            known = rows_of(known, on)
            rows, now, ends = rows[on], rows_of(after, on), rows_of(ends, on)
            if bool(fresh.any()):  # saves work: rows that did not move keep their derivatives
                with some_rows(rows[fresh]):
                    again = self._derivatives(rows_of(now, fresh))
                for old, fresher in zip(known, again, strict=True):
                    old[fresh] = fresher
        return found

    def _iterated(self, now: SearchState, known: Derivatives, terminal: End) -> SearchState:
        """Take one iteration: a backward pass, the best length of its change, the row's regularisation."""
        end, (change, feedback, _, bent) = self._backwards(now, known, now.mu, now.full, terminal)
        definite = end.definite > 0
        around = now.state[:, :-1], now.control, change, feedback
        tried = self._best(now.state[:, 0], around, terminal)
        better = definite & (tried.cost < now.cost)
        gain = (now.cost - tried.cost) / now.cost.abs().clamp(min=1e-300)
        plan = chosen(better, tried, CostedTrajectories(*now[:4]))
        hidden = _rounding(now, known, bent)
        small = end.promised.abs() <= self.tolerance * plan.cost.abs() + hidden
        done = ((better & (gain <= self.tolerance)) | (definite & small)) & (now.mu <= TRUSTED)
        mu = torch.where(better, (now.mu * EASIER).clamp(min=LEAST), now.mu * HARDER)
        going = torch.where(done, CONVERGED, (mu <= MOST).to(mu))
        return SearchState(*plan, mu, torch.where(better, now.full, 1 - now.full), going)

    def _best_in_turn(self, x0: Tensor, around: tuple[Tensor, ...], terminal: End) -> CostedTrajectories:
        """`_best` of a program: one length after the other."""
        lengths = x0.new_tensor(LENGTHS).expand(len(x0), -1)

        def attempt(now: tuple[Tensor, Tensor], length: Tensor) -> tuple[tuple[Tensor, Tensor], tuple[()]]:
            cost = self._followed(x0, around, length.unsqueeze(1), terminal).cost
            lower = cost < now[0]
            return (torch.where(lower, cost, now[0]), torch.where(lower, length, now[1])), ()

        none = torch.zeros_like(x0[:, 0])
        (_, length), _ = scan(attempt, (none + torch.inf, none), lengths)
        return self._followed(x0, around, length.unsqueeze(1), terminal)

    @traced_as(_best_in_turn)
    def _best(self, x0: Tensor, around: tuple[Tensor, ...], terminal: End) -> CostedTrajectories:
        """The cheapest of five lengths of a change, side by side."""
        lengths = x0.new_tensor(LENGTHS).expand(len(x0), -1)
        return self._followed(x0, around, lengths.contiguous(), terminal)

    def _followed(
        self, x0: Tensor, around: tuple[Tensor, ...], lengths: Tensor, terminal: End
    ) -> CostedTrajectories:
        """Return the best of u = control + length change + feedback (x - state) within the bounds, from
        x0 (B, n), of lengths (B, L); ``around`` is state, control, change and feedback, (B, T, ...) each."""
        start = x0.unsqueeze(1).expand(-1, lengths.shape[1], -1).contiguous()
        end, (x, u, paid) = self._forth(start, around, lengths)
        last = terminal.at(self.problem, end)  # (B, L)
        cost = paid.sum(1) + last
        cost = torch.where(torch.isfinite(cost), cost, torch.inf)
        states, parts = torch.cat((x, end.unsqueeze(1)), dim=1), torch.cat((paid, last.unsqueeze(1)), dim=1)
        if lengths.shape[1] == 1:
            return CostedTrajectories(states.squeeze(2), u.squeeze(2), cost.squeeze(1), parts.squeeze(2))
        best, at = cost.min(1)
        rows = torch.arange(len(x0), device=x0.device)
        return CostedTrajectories(states[rows, :, at], u[rows, :, at], best, parts[rows, :, at])

    def forward(
        self, x: Tensor, now: tuple[Tensor, ...], lengths: Tensor
    ) -> tuple[Tensor, tuple[Tensor, ...]]:
        """Take one step of all lengths: x (B, L, n), (B, n), (B, m), (B, m), (B, m, n), (B, L)."""
        state, control, change, feedback = now
        apart = self.problem.offset(x, state.unsqueeze(1))
        u = control.unsqueeze(1) + lengths.unsqueeze(-1) * change.unsqueeze(1)
        u = u + (feedback.unsqueeze(1) * apart.unsqueeze(-2)).sum(-1)
        u = self.problem.admissible(u)
        after, paid = self.problem.advance(x, u)
        return after, (x, u, paid)

    def expand(self, carry: Tree, _: Tree, row: tuple[Tensor, ...]) -> tuple[Tree, tuple[Tensor, ...]]:
        """Return the derivatives of a step, as the step of a row program."""
        return carry, tuple(self.problem.derivatives(*row))

    def _derivatives(self, plan: SearchState) -> Derivatives:
        """Along the trajectories: (B, T, ...)."""
        return Derivatives(*self._expand.over((plan.state[:, :-1], plan.control)))

    def _backwards(
        self, plan: SearchState, known: Derivatives, mu: Tensor, full: Tensor, terminal: End
    ) -> tuple[Model, tuple[Tensor, ...]]:
        slope, bent = terminal.bent(self.problem, plan.state[:, -1])
        last = Model(slope, bent.contiguous(), torch.zeros_like(mu), torch.ones_like(mu))
        reverse = tuple(part.flip(1) for part in (*known, plan.control))
        end, out = self._back(last, reverse, (mu, full))
        return end, tuple(part.flip(1) for part in out)

    def backward(
        self, after: Model, now: tuple[Tensor, ...], row: tuple[Tensor, Tensor]
    ) -> tuple[Model, tuple[Tensor, ...]]:
        """Take one step of the recursion, backward in time."""
        (first, second, cost_first, cost_second, control), (mu, full) = now, row
        n = self.problem.dim
        bent = (after.gradient[..., None, None] * second).sum(-3)
        low, high = self.problem.bounds.low - control, self.problem.bounds.high - control
        scale = cost_second[:, n:, n:].diagonal(dim1=-2, dim2=-1).abs().mean(-1)
        if not self.problem.curved:  # a cost that is linear in u: its slope over the range of an input
            pull = cost_first[:, n:] + (first[..., n:] * after.gradient.unsqueeze(-1)).sum(-2)
            least, most = self.problem.reach()
            scale = torch.where(scale > 0, scale, (pull.abs() / (most - least)).mean(-1))
        firmness = (mu * scale)[:, None, None] * torch.eye(
            control.shape[-1], dtype=control.dtype, device=control.device
        )
        definite = after.definite

        def minimum(slope: Tensor, cross: Tensor, hessian: Tensor) -> tuple[Tensor, Tensor]:
            nonlocal definite
            firm = hessian + firmness
            definite = definite * _definite(firm)
            return minimum_and_slopes(firm, slope, cross, low, high)

        curved = cost_second + full[:, None, None] * bent
        found = riccati_step(after.gradient, after.curvature, first, cost_first, curved, minimum)
        gradient, curvature, promised, change, feedback = found
        model = Model(gradient, curvature, after.promised + promised, definite)
        return model, (change, feedback, gradient, curvature)

    def _models(self, plan: SearchState, terminal: End) -> Trajectories:
        """The local models along finished trajectories, with as little regularisation as they bear."""
        known, small = self._derivatives(plan), torch.full_like(plan.cost, LEAST)

        def models(_: tuple[()], full: Tensor) -> tuple[tuple[()], tuple[Tensor, ...]]:
            end, (_change, *parts) = self._backwards(plan, known, small, full, terminal)
            return (), (*parts, (end.definite > 0) & torch.isfinite(end.curvature).all(-1).all(-1))

        both = torch.stack((torch.ones_like(small), torch.zeros_like(small)), dim=1)
        *parts, fine = scan(models, (), both)[1]  # the second model is that of Gauss and Newton
        exact, gauss = zip(*(part.unbind(1) for part in parts), strict=True)
        feedback, gradient, curvature = chosen(fine[:, 0], exact, gauss)
        last, bent = terminal.bent(self.problem, plan.state[:, -1])
        return Trajectories(
            plan.state,
            plan.control,
            feedback,
            plan.paid.flip(1).cumsum(1).flip(1),
            torch.cat((gradient, last.unsqueeze(1)), dim=1),
            torch.cat((curvature, bent.unsqueeze(1)), dim=1),
            (plan.going == CONVERGED) & torch.isfinite(plan.cost),
        )


class SearchState(NamedTuple):
    """Plans, and how the search goes on with each."""

    state: Tensor  # (B, T + 1, n)
    control: Tensor  # (B, T, m)
    cost: Tensor  # (B,)
    paid: Tensor  # of every step, and at last the terminal value, (B, T + 1)
    mu: Tensor  # regularisation, (B,)
    full: Tensor  # 1 with the second derivatives of the plant, 0 without, (B,)
    going: Tensor  # 1 goes on, 0 has given up, `CONVERGED` has converged, (B,)


class Model(NamedTuple):
    """Local model of the value at one time, and what the recursion adds up."""

    gradient: Tensor  # (B, n)
    curvature: Tensor  # (B, n, n)
    promised: Tensor  # (B,)
    definite: Tensor  # (B,) 1 or 0


def _rounding(plan: SearchState, known: Derivatives, curvature: Tensor) -> Tensor:
    """Return the cost of relative errors of `_ROUNDED` rounding units in every state and control of a
    plan, (B,), by the derivatives and the curvature of the value (B, T, n, n) along it."""
    state, control = plan.state[:, :-1].abs(), plan.control.abs()
    size = control.shape[-1]
    pulled = (curvature.abs() * state.unsqueeze(-2)).sum(-1)
    pushed = (known.cost_second[..., -size:, -size:].abs() * control.unsqueeze(-2)).sum(-1)
    paid = (pulled * state).sum((-2, -1)) + (pushed * control).sum((-2, -1))
    return (_ROUNDED * torch.finfo(state.dtype).eps) ** 2 * paid


def _definite(a: Tensor) -> Tensor:
    """1 where all pivots of (B, m, m) are positive, else 0."""
    fine = torch.ones_like(a[..., 0, 0])
    for _ in range(a.shape[-1]):
        pivot = a[..., 0, 0]
        fine = fine * (pivot > 0)
        a = a[..., 1:, 1:] - a[..., 1:, :1] * a[..., :1, 1:] / pivot[..., None, None]
    return fine

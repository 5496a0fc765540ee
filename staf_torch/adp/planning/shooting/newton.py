"""Newton's method on a transcribed problem: its intervals, and one linear-quadratic problem an iteration.

An interval is one Runge-Kutta step with a linear input. An iteration expands all intervals to second order,
with the costates in the curvature, and solves the linear-quadratic problem that results by a Riccati
recursion: exact Newton, at a cost linear in the horizon, where a sparse solver would factor the whole KKT
matrix of every row by itself.

Source: Dunn and Bertsekas, JOTA 63 (1989).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from ....lanes.row_numbers import over_rows
from ....numerics.derivatives import row_jacobian, slope_of
from ....numerics.riccati import riccati_step
from ....numerics.runge_kutta import SHARES, runge_kutta_mean, runge_kutta_stages, runge_kutta_step
from ....systems import ControlAffineSystem, Plant
from ...problem.bounded_input_cost import BoundedInputCost
from ...problem.cost import Cost
from ..trajectories import chosen

_ROUNDING = 1e-9  # relative promise below which a step that does not pay is one that rounding hides
_LEAST_CURVATURE = 1e-6  # of its largest eigenvalue, that a convexified interval keeps
_SHORTER = (0.5, 0.25, 0.1, 0.03, 0.01)  # shares of the Newton step, where the whole one does not pay


class Expansion(NamedTuple):
    """Derivatives of every interval's map and cost in z = (x, v)."""

    slope: Tensor  # dF/dz, (B, N, n, n + 2m)
    gradient: Tensor  # dl/dz, (B, N, n + 2m)
    curvature: Tensor  # d2/dz2 of l + lambda'F, (B, N, n + 2m, n + 2m)


class Interval:
    """x+ = F(x, v) and the cost l(x, v) of an interval on which the input runs linearly from v's first
    half to its second, by one Runge-Kutta step. A smoothly bounded input is the saturated v; a hard bound
    is one of v itself."""

    def __init__(self, system: Plant, cost: Cost) -> None:
        self.system, self.cost = system, cost
        hard = cost.bounds is not None and not isinstance(cost, BoundedInputCost)
        self.box: tuple[Tensor, Tensor] | None = None
        if hard and cost.bounds is not None:
            self.box = (cost.bounds.low.repeat(2), cost.bounds.high.repeat(2))

    def admitted(self, v: Tensor) -> Tensor:
        """v with hard bounds kept: (..., 2m) -> (..., 2m)."""
        if self.box is None:
            return v
        low, high = self.box
        kept: Tensor = over_rows(lambda v: torch.minimum(torch.maximum(v, low.to(v)), high.to(v)), v)
        return kept

    def room(self, v: Tensor) -> tuple[Tensor, Tensor] | None:
        """Return how far v may fall and rise, (..., 2m) each; None without hard bounds."""
        if self.box is None:
            return None
        low, high = self.box
        found: tuple[Tensor, Tensor] = over_rows(lambda v: (low.to(v) - v, high.to(v) - v), v)
        return found

    def gap(self, x: Tensor, v: Tensor, costate: Tensor) -> Tensor:
        """Return how much the Hamiltonian r + p'f of a half of a control (..., m) exceeds its minimum over
        the admissible ones, at x and p (..., n).

        It is measured in u, so that a saturated control that should be another is seen, which the slope in v
        is not. Of a plant that is not affine in u it is measured along the slope there.
        """
        u = self.input(v)
        with torch.no_grad():
            if isinstance(self.system, ControlAffineSystem):
                g = self.system.effectiveness(x)
            else:
                g = _input_slope(self.system, x, u)
            best = self.cost.policy(g, costate)
            pull = (g * costate.unsqueeze(-1)).sum(-2)
            now, least = (self.cost.input_rate(w) + (pull * w).sum(-1) for w in (u, best))
        return (now - least).clamp(min=0.0)

    def input(self, v: Tensor) -> Tensor:
        """u of a half of v, (..., m); a smooth bound saturates it, a hard one it keeps already."""
        return v if self.box is not None else self.cost.saturate(v)

    def advance(self, x: Tensor, v: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
        """(..., n), (..., 2m), lengths h (...) in s: x+ (..., n), the cost (...)."""

        def step(x: Tensor, v: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
            after, at = self.moved(x, v, h)
            return after, self.paid(at, v, h)

        found: tuple[Tensor, Tensor] = over_rows(step, x, v, h)
        return found

    def moved(self, x: Tensor, v: Tensor, h: Tensor) -> tuple[Tensor, list[Tensor]]:
        """x+ as of `advance`, and the four states (..., n) at which the Runge-Kutta step looks."""
        u, step = self._inputs(v), h.unsqueeze(-1)
        at, slopes = runge_kutta_stages(lambda at, share: self.system.motion(at, u[share]), x, step)
        return x + runge_kutta_mean(slopes, step), at

    def paid(self, at: Sequence[Tensor], v: Tensor, h: Tensor) -> Tensor:
        """The cost (...) of steps with these four states, which `moved` returned, (..., n) each."""
        u = self._inputs(v)
        return runge_kutta_mean([self.cost.rate(x, u[share]) for x, share in zip(at, SHARES, strict=True)], h)

    def _inputs(self, v: Tensor) -> dict[float, Tensor]:
        """u (..., m) at the shares of a step at which its stages stand."""
        first, last = v.chunk(2, dim=-1)
        return {0.0: self.input(first), 0.5: self.input(0.5 * (first + last)), 1.0: self.input(last)}

    def expand(self, x: Tensor, v: Tensor, h: Tensor, end: Tensor) -> Expansion:
        """Derivatives at (B, N, n), (B, N, 2m), for the costate ``end`` (B, n) at the horizon."""
        size = x.shape[-1]
        with torch.enable_grad():
            z = torch.cat((x, v), dim=-1).detach().requires_grad_()
            after, spent = self.advance(z[..., :size], z[..., size:], h)
            # What does not depend on z at all still gets a derivative, 0.
            rows = [slope_of(after[..., i], z) for i in range(size)]
            slope = torch.stack(rows, dim=-2)
            gradient = slope_of(spent, z)
            costate = adjoint(slope[..., :size], gradient[..., :size], end)
            weighted = spent + (costate * after).sum(-1)
            along = slope_of(weighted, z, create_graph=True)
            columns = [slope_of(along[..., i], z) for i in range(z.shape[-1])]
        curvature = torch.stack(columns, dim=-1)
        return Expansion(slope, gradient, 0.5 * (curvature + curvature.mT))


def _input_slope(system: Plant, x: Tensor, u: Tensor) -> Tensor:
    """df/du, (..., n, m)."""
    with torch.enable_grad():
        return row_jacobian(lambda w: system.motion(x.detach(), w), u.detach())[1].detach()


def adjoint(slope: Tensor, gradient: Tensor, end: Tensor) -> Tensor:
    """Costates lambda_{k+1} of every interval: lambda_k = l_x + F_x' lambda_{k+1}, (B, N, n)."""
    costates = [end]
    for k in range(slope.shape[1] - 1, 0, -1):
        costates.append(gradient[:, k] + (slope[:, k] * costates[-1].unsqueeze(-1)).sum(-2))
    return torch.stack(costates[::-1], dim=1)


class MeshPlan(NamedTuple):
    """Trajectories of the transcribed problem, a row each."""

    state: Tensor  # (B, N + 1, n)
    control: Tensor  # v, (B, N, 2m)
    cost: Tensor  # (B,) inf where it is not finite


class Direction(NamedTuple):
    """The Newton step of every row as an affine feedback v = v_k + share k_k + K_k (x - x_k)."""

    offset: Tensor  # k, (B, N, 2m)
    feedback: Tensor  # K, (B, N, 2m, n)
    gradient: Tensor  # of the cost in x(0), after the step, (B, n)
    decrement: Tensor  # how much the quadratic model falls, (B,)
    definite: Tensor  # (B,) bool: the quadratic model had a minimum
    costates: Tensor  # grad V along the plan, (B, N + 1, n)


def direction(
    expansion: Expansion, end: Tensor, end_curvature: Tensor, room: tuple[Tensor, Tensor] | None = None
) -> Direction:
    """Return the minimiser of the quadratic model, backwards in time from the derivatives (B, n), (B, n,
    n) of V_T at the plan's end. A control at the end of its ``room``, how far v may fall and rise, (B, N,
    2m) each, that the model pushes outward stays there, and gets no feedback."""
    slope, gradient, curvature = expansion
    costate, bent = end, end_curvature
    decrement, definite = torch.zeros_like(end[:, 0]), torch.ones_like(end[:, 0], dtype=torch.bool)
    offsets, feedbacks, costates = [], [], [end]
    for k in range(slope.shape[1] - 1, -1, -1):

        def minimum(q: Tensor, cross: Tensor, Q: Tensor, k: int = k) -> tuple[Tensor, Tensor]:
            nonlocal definite
            box = () if room is None else (room[0][:, k], room[1][:, k])
            offset, feedback, good = _boxed_step(q, cross, Q, *box) if box else _free_step(q, cross, Q)
            definite = definite & good
            return offset, feedback

        step = riccati_step(costate, bent, slope[:, k], gradient[:, k], curvature[:, k], minimum)
        costate, bent, decrement = step.gradient, step.curvature, decrement - step.promised
        offsets.append(step.change)
        feedbacks.append(step.feedback)
        costates.append(costate)
    offset, feedback = torch.stack(offsets[::-1], dim=1), torch.stack(feedbacks[::-1], dim=1)
    return Direction(offset, feedback, costate, decrement, definite, torch.stack(costates[::-1], dim=1))


def _free_step(slope: Tensor, cross: Tensor, curvature: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Offset, feedback and definiteness of the model of one interval, (B, 2m), (B, 2m, n), (B,)."""
    factor, info = torch.linalg.cholesky_ex(curvature)
    solved = -torch.cholesky_solve(torch.cat((slope.unsqueeze(-1), cross), dim=-1), factor)
    return solved[..., 0], solved[..., 1:], info == 0


def _boxed_step(
    slope: Tensor, cross: Tensor, curvature: Tensor, low: Tensor, high: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """`_free_step` within a box, by projected Newton steps: what leaves it is fixed at its bound, and freed
    where the model pulls it back."""
    offset, held = torch.zeros_like(slope), None
    for _ in range(2 * slope.shape[-1]):
        pull = slope + (curvature @ offset.unsqueeze(-1)).squeeze(-1)
        fixed = ((offset <= low) & (pull > 0)) | ((offset >= high) & (pull < 0))
        if held is not None and torch.equal(fixed, held):  # costs time alone: every further pass is this one
            break
        held, free = fixed, (~fixed).to(slope)
        both = free.unsqueeze(-1) * free.unsqueeze(-2)
        factor, info = torch.linalg.cholesky_ex(both * curvature + torch.diag_embed(1 - free))
        right = torch.cat(((free * pull).unsqueeze(-1), free.unsqueeze(-1) * cross), dim=-1)
        solved = -torch.cholesky_solve(right, factor)
        offset = torch.minimum(torch.maximum(offset + solved[..., 0], low), high)
    bent = (offset <= low) | (offset >= high)
    feedback = torch.where(bent.unsqueeze(-1), 0.0, solved[..., 1:])
    return offset, feedback, info == 0


def convexified(expansion: Expansion) -> Expansion:
    """Replace every interval's curvature by its absolute value, so that the model has a minimum."""
    finite = torch.where(torch.isfinite(expansion.curvature), expansion.curvature, 0.0)
    values, vectors = torch.linalg.eigh(finite)
    size = values.abs()
    size = torch.maximum(size, _LEAST_CURVATURE * size.amax(-1, keepdim=True))
    return expansion._replace(curvature=(vectors * size.unsqueeze(-2)) @ vectors.mT)


def replay(
    stage: Interval,
    plan: MeshPlan,
    x0: Tensor,
    lengths: Tensor,
    terminal: object,
    feedback: Tensor,
    offset: Tensor,
) -> MeshPlan:
    """The plan's control with feedback around its states and an offset, from x0 (..., B, n)."""

    def again(x0: Tensor, state: Tensor, planned: Tensor, feedback: Tensor, offset: Tensor) -> MeshPlan:
        def control(x: Tensor, k: int) -> Tensor:
            apart = (x - state[:, k]).unsqueeze(-2)
            return stage.admitted(planned[:, k] + offset[..., k, :] + (feedback[:, k] * apart).sum(-1))

        return _driven(stage, control, x0, lengths, terminal)

    given = plan.state, plan.control, feedback
    if x0.dim() == 2:
        return over_rows(again, x0, *given, offset)

    def rows_first(x0: Tensor, state: Tensor, planned: Tensor, feedback: Tensor, offset: Tensor) -> MeshPlan:
        return _swapped(again(x0.transpose(0, 1), state, planned, feedback, offset.transpose(0, 1)))

    return _swapped(over_rows(rows_first, x0.transpose(0, 1), *given, offset.transpose(0, 1)))


def _swapped(plan: MeshPlan) -> MeshPlan:
    return MeshPlan(*(part.transpose(0, 1) for part in plan))


def _driven(
    stage: Interval,
    control: Callable[[Tensor, int], Tensor],
    x0: Tensor,
    lengths: Tensor,
    terminal: object,
) -> MeshPlan:
    """The trajectories from x0 (..., B, n) under a control v(x, interval), with what they cost."""
    x, states, controls, seen = x0, [x0], [], []
    for k, h in enumerate(lengths.unbind()):
        v = control(x, k)
        x, at = stage.moved(x, v, h)
        states.append(x)
        controls.append(v)
        seen.append(at)
    v = torch.stack(controls, dim=-2)
    # What was paid, for all intervals at once: one by one that is a good part of the time of a replay.
    paid = stage.paid([torch.stack(part, dim=-2) for part in zip(*seen, strict=True)], v, lengths)
    cost = paid.sum(-1) + terminal(x)  # type: ignore[operator]
    return MeshPlan(torch.stack(states, dim=-2), v, torch.where(torch.isfinite(cost), cost, torch.inf))


def improved(
    stage: Interval, plan: MeshPlan, lengths: Tensor, terminal: object, step: Direction
) -> tuple[MeshPlan, Tensor]:
    """The plan after the longest share of the step that lowers its cost, and which rows it lowered."""
    x0 = plan.state[:, 0]
    tried = replay(stage, plan, x0, lengths, terminal, step.feedback, step.offset)
    lower = tried.cost < plan.cost
    best = chosen(lower, tried, plan)
    if not bool(lower.all()):  # costs time alone: rows that took the whole step keep it
        shares = torch.tensor(_SHORTER, dtype=x0.dtype, device=x0.device)
        several = x0.expand(len(shares), *x0.shape)
        offsets = shares[:, None, None, None] * step.offset
        tried = replay(stage, plan, several, lengths, terminal, step.feedback, offsets)
        cost, which = tried.cost.min(dim=0)
        rows = torch.arange(len(x0), device=x0.device)
        shortened = MeshPlan(tried.state[which, rows], tried.control[which, rows], cost)
        pays = ~lower & (cost < plan.cost)
        best, lower = chosen(pays, shortened, best), lower | pays
    return best, lower


class ShootingProblem(Protocol):
    """Settings of the iteration; `DirectShooting` has them."""

    stage: Interval
    terminal: Callable[[Tensor], Tensor]
    tolerance: float
    iterations: int


class NewtonSolution(NamedTuple):
    """End of the iteration, a row each."""

    plan: MeshPlan
    feedback: Tensor  # of the last expansion, (B, N, 2m, n)
    gradient: Tensor  # of the cost in x(0), (B, n)
    converged: Tensor  # (B,) bool
    costates: Tensor  # grad V along the plan, (B, N + 1, n)
    promise: Tensor  # relative improvement that the last model promises, (B,)
    iterations: Tensor  # (B,)


def follow(
    problem: ShootingProblem, control: Callable[[Tensor, float], Tensor], x0: Tensor, lengths: Tensor
) -> MeshPlan:
    """The trajectories under a control u(x, t) on a mesh: (B, n), (N,)."""
    stage, times = problem.stage, [0.0, *itertools.accumulate(lengths.tolist())]

    def both(x: Tensor, k: int) -> Tensor:
        now, end, h = times[k], times[k + 1], lengths[k]
        ahead = runge_kutta_step(lambda at: stage.system.motion(at, control(at, now)), x, float(h))
        v = [stage.cost.unsaturated(control(at, t)) for at, t in ((x, now), (ahead, end - 1e-9 * float(h)))]
        return stage.admitted(torch.cat(v, dim=-1))

    return over_rows(lambda x0: _driven(stage, both, x0, lengths, problem.terminal), x0)


def minimise(problem: ShootingProblem, plan: MeshPlan, lengths: Tensor) -> NewtonSolution:
    """Newton's iteration from a plan on a mesh of interval lengths (N,)."""
    batch = len(plan.cost)
    done = torch.zeros(batch, dtype=torch.bool, device=plan.cost.device)
    stuck, rough = ~torch.isfinite(plan.cost), torch.zeros_like(done)
    count = torch.zeros(batch, dtype=torch.int64, device=plan.cost.device)
    kept, rough = _step(problem, plan, lengths, rough)
    for _ in range(problem.iterations):
        promise = kept.decrement / plan.cost.abs()
        done = done | (~stuck & kept.definite & (promise <= problem.tolerance))
        if bool((done | stuck).all()):  # costs time alone: rows that are done no longer move
            break
        moved, lower = improved(problem.stage, plan, lengths, problem.terminal, kept)
        moving = ~done & ~stuck
        plan = chosen(moving & lower, moved, plan)
        count = count + moving
        done = done | (moving & ~lower & (promise <= _ROUNDING))
        stuck = stuck | (moving & ~lower & ~done & rough)
        step, rough = _step(problem, plan, lengths, moving & ~lower)  # convexified where it did not pay
        kept = chosen(done | stuck, kept, step)
    promise = torch.where(kept.definite, kept.decrement / plan.cost.abs(), torch.inf)
    return NewtonSolution(plan, kept.feedback, kept.gradient, done, kept.costates, promise, count)


def _step(
    problem: ShootingProblem, plan: MeshPlan, lengths: Tensor, rough: Tensor
) -> tuple[Direction, Tensor]:
    """The Newton step, of the convexified model in the rows ``rough`` and where it has no minimum."""
    slope, curvature = _derivatives(problem.terminal, plan.state[:, -1])
    batch, intervals = plan.control.shape[:2]
    spread = lengths.expand(batch, intervals)
    expansion = problem.stage.expand(plan.state[:, :-1], plan.control, spread, slope)
    room = problem.stage.room(plan.control)
    step = direction(expansion, slope, curvature, room)
    rough = rough | ~step.definite
    if bool(rough.any()):  # costs time alone
        step = chosen(~rough, step, direction(convexified(expansion), slope, curvature, room))
    return step, rough


def _derivatives(value: Callable[[Tensor], Tensor], x: Tensor) -> tuple[Tensor, Tensor]:
    """First and second derivatives of V_T: (B, n) -> (B, n), (B, n, n)."""
    with torch.enable_grad():
        at = x.detach().requires_grad_()
        slope = slope_of(value(at), at, create_graph=True)
        rows = [slope_of(s, at) for s in slope.unbind(-1)]
    curvature = torch.stack(rows, dim=-2)
    return slope.detach(), 0.5 * (curvature + curvature.mT)


def why_none(known: bool, solution: NewtonSolution, left: float, row: int) -> str:
    """Why a row has no optimum, in words; empty where it has."""
    if known:
        return ""
    if not bool(torch.isfinite(solution.plan.cost[row])):
        return "the cost is not finite from here under any start: give a `base` that does not diverge"
    if not bool(solution.converged[row]):
        promise = float(solution.promise[row])
        if not math.isfinite(promise):
            return "not stationary: the expansion around the last trajectory is not finite or has no minimum"
        return f"not stationary: the last quadratic model predicted a decrease by {promise:.2g} of the value"
    return f"the control misses the minimum of the Hamiltonian by {left:.2g} of the value: it is saturated"

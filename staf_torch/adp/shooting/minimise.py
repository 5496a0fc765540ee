"""Newton's iteration on one mesh, every row for itself."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from .newton import Direction, Plan, convexified, direction, improved
from .stage import Stage, closed_stage

_ROUNDING = 1e-9  # relative promise below which a step that does not pay is one that rounding hides


class Problem(Protocol):
    """What the iteration needs to know; `DirectShooting` has it."""

    stage: Stage
    base: Callable[[Tensor], Tensor]
    terminal: Callable[[Tensor], Tensor]
    tolerance: float
    iterations: int


class Solution(NamedTuple):
    """Where the iteration ended, a row each."""

    plan: Plan
    feedback: Tensor  # of the last expansion, (B, N, 2m, n)
    gradient: Tensor  # of the cost in x(0), (B, n)
    converged: Tensor  # (B,) bool
    iterations: Tensor  # (B,)


def follow(problem: Problem, x0: Tensor, lengths: Tensor) -> Plan:
    """The base policy's trajectories on a mesh: (B, n), (N,)."""
    stage = problem.stage
    x, spent, states, controls = x0, torch.zeros_like(x0[:, 0]), [x0], []
    for h in lengths.unbind():
        ahead = closed_stage(stage, problem.base, x, h)
        v = torch.cat([stage.cost.unsaturated(problem.base(at)) for at in (x, ahead)], dim=-1)
        x, c = stage.advance(x, v, h)
        spent = spent + c
        states.append(x)
        controls.append(v)
    cost = spent + problem.terminal(x)
    cost = torch.where(torch.isfinite(cost), cost, torch.inf)
    return Plan(torch.stack(states, dim=1), torch.stack(controls, dim=1), cost)


def minimise(problem: Problem, plan: Plan, lengths: Tensor) -> Solution:
    """Newton's iteration from a plan on a mesh of interval lengths (N,)."""
    batch = len(plan.cost)
    done = torch.zeros(batch, dtype=torch.bool, device=plan.cost.device)
    stuck, rough = ~torch.isfinite(plan.cost), torch.zeros_like(done)
    count = torch.zeros(batch, dtype=torch.int64, device=plan.cost.device)
    kept, rough = _step(problem, plan, lengths, rough)
    for _ in range(problem.iterations):
        promise = kept.decrement / plan.cost
        done = done | (~stuck & kept.definite & (promise <= problem.tolerance))
        if bool((done | stuck).all()):  # costs time alone: rows that are done no longer move
            break
        moved, lower = improved(problem.stage, plan, lengths, problem.terminal, kept)
        moving = ~done & ~stuck
        plan = Plan(*(_rows(moving & lower, new, old) for new, old in zip(moved, plan, strict=True)))
        count = count + moving
        done = done | (moving & ~lower & (promise <= _ROUNDING))
        stuck = stuck | (moving & ~lower & ~done & rough)
        step, rough = _step(problem, plan, lengths, moving & ~lower)  # convexified where it did not pay
        kept = _where(done | stuck, kept, step)
    return Solution(plan, kept.feedback, kept.gradient, done, count)


def _step(problem: Problem, plan: Plan, lengths: Tensor, rough: Tensor) -> tuple[Direction, Tensor]:
    """The Newton step, of the convexified model in the rows ``rough`` and where it has no minimum."""
    slope, curvature = _derivatives(problem.terminal, plan.state[:, -1])
    batch, intervals = plan.control.shape[:2]
    spread = lengths.expand(batch, intervals)
    expansion = problem.stage.expand(plan.state[:, :-1], plan.control, spread, slope)
    step = direction(expansion, slope, curvature)
    rough = rough | ~step.definite
    if bool(rough.any()):  # costs time alone
        step = _where(~rough, step, direction(convexified(expansion), slope, curvature))
    return step, rough


def _derivatives(value: Callable[[Tensor], Tensor], x: Tensor) -> tuple[Tensor, Tensor]:
    """First and second derivatives of V_T: (B, n) -> (B, n), (B, n, n)."""
    with torch.enable_grad():
        at = x.detach().requires_grad_()
        (slope,) = torch.autograd.grad(value(at).sum(), at, create_graph=True)
        rows = [
            torch.autograd.grad(s.sum(), at, retain_graph=True, materialize_grads=True)[0]
            for s in slope.unbind(-1)
        ]
    curvature = torch.stack(rows, dim=-2)
    return slope.detach(), 0.5 * (curvature + curvature.mT)


def _where(rows: Tensor, new: Direction, old: Direction) -> Direction:
    return Direction(*(_rows(rows, a, b) for a, b in zip(new, old, strict=True)))


def _rows(rows: Tensor, new: Tensor, old: Tensor) -> Tensor:
    return torch.where(rows[(..., *([None] * (new.dim() - 1)))], new, old)

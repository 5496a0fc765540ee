"""Newton's method on a transcribed optimal-control problem: one linear-quadratic problem an iteration."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from .stage import Expansion, Stage

_LEAST_CURVATURE = 1e-6  # of its largest eigenvalue, that a convexified interval keeps
_SHORTER = (0.5, 0.25, 0.1, 0.03, 0.01)  # shares of the Newton step, where the whole one does not pay


class Plan(NamedTuple):
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


def direction(expansion: Expansion, end: Tensor, end_curvature: Tensor) -> Direction:
    """The minimiser of the quadratic model, backwards in time.

    Args:
        expansion: of the current plan.
        end: dV_T/dx at its last state, (B, n).
        end_curvature: the second derivative there, (B, n, n).
    """
    slope, gradient, curvature = expansion
    size = end.shape[-1]
    s, S = end, end_curvature
    decrement, definite = torch.zeros_like(end[:, 0]), torch.ones_like(end[:, 0], dtype=torch.bool)
    offsets, feedbacks = [], []
    for k in range(slope.shape[1] - 1, -1, -1):
        J = slope[:, k]
        q = gradient[:, k] + (J * s.unsqueeze(-1)).sum(-2)
        Q = curvature[:, k] + J.mT @ S @ J
        factor, info = torch.linalg.cholesky_ex(Q[:, size:, size:])
        definite = definite & (info == 0)
        right = torch.cat((q[:, size:, None], Q[:, size:, :size]), dim=-1)
        solved = -torch.cholesky_solve(right, factor)
        offset, feedback = solved[..., 0], solved[..., 1:]
        s = q[:, :size] + (Q[:, size:, :size] * offset.unsqueeze(-1)).sum(-2)
        S = Q[:, :size, :size] + Q[:, :size, size:] @ feedback
        S = 0.5 * (S + S.mT)
        decrement = decrement - 0.5 * (q[:, size:] * offset).sum(-1)
        offsets.append(offset)
        feedbacks.append(feedback)
    offset, feedback = torch.stack(offsets[::-1], dim=1), torch.stack(feedbacks[::-1], dim=1)
    return Direction(offset, feedback, s, decrement, definite)


def convexified(expansion: Expansion) -> Expansion:
    """The same with every interval's curvature replaced by its absolute value: the model has a minimum."""
    finite = torch.where(torch.isfinite(expansion.curvature), expansion.curvature, 0.0)
    values, vectors = torch.linalg.eigh(finite)
    size = values.abs()
    size = torch.maximum(size, _LEAST_CURVATURE * size.amax(-1, keepdim=True))
    return expansion._replace(curvature=(vectors * size.unsqueeze(-2)) @ vectors.mT)


def replay(
    stage: Stage, plan: Plan, x0: Tensor, lengths: Tensor, terminal: object, feedback: Tensor, offset: Tensor
) -> Plan:
    """The plan's control with feedback around its states and an offset, from x0 (..., B, n)."""
    x, spent = x0, torch.zeros_like(x0[..., 0])
    states, controls = [x], []
    for k, h in enumerate(lengths.unbind()):
        apart = (x - plan.state[:, k]).unsqueeze(-2)
        v = plan.control[:, k] + offset[..., k, :] + (feedback[:, k] * apart).sum(-1)
        x, c = stage.advance(x, v, h)
        spent = spent + c
        states.append(x)
        controls.append(v)
    cost = spent + terminal(x)  # type: ignore[operator]
    cost = torch.where(torch.isfinite(cost), cost, torch.inf)
    return Plan(torch.stack(states, dim=-2), torch.stack(controls, dim=-2), cost)


def improved(
    stage: Stage, plan: Plan, lengths: Tensor, terminal: object, step: Direction
) -> tuple[Plan, Tensor]:
    """The plan after the longest share of the step that lowers its cost, and which rows it lowered."""
    x0 = plan.state[:, 0]
    tried = replay(stage, plan, x0, lengths, terminal, step.feedback, step.offset)
    lower = tried.cost < plan.cost
    best = choose(lower, tried, plan)
    if not bool(lower.all()):  # costs time alone: rows that took the whole step keep it
        shares = torch.tensor(_SHORTER, dtype=x0.dtype, device=x0.device)
        several = x0.expand(len(shares), *x0.shape)
        offsets = shares[:, None, None, None] * step.offset
        tried = replay(stage, plan, several, lengths, terminal, step.feedback, offsets)
        cost, which = tried.cost.min(dim=0)
        rows = torch.arange(len(x0), device=x0.device)
        shortened = Plan(tried.state[which, rows], tried.control[which, rows], cost)
        pays = ~lower & (cost < plan.cost)
        best, lower = choose(pays, shortened, best), lower | pays
    return best, lower


def choose(rows: Tensor, new: Plan, old: Plan) -> Plan:
    """The new plan in ``rows`` (B,), the old one in the others."""
    state = torch.where(rows[:, None, None], new.state, old.state)
    control = torch.where(rows[:, None, None], new.control, old.control)
    return Plan(state, control, torch.where(rows, new.cost, old.cost))

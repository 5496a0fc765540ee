"""What a remembered plan is worth from another state than its own."""

from __future__ import annotations

import torch
from torch import Tensor

from ..lanes import scan
from .sampled_problem import SampledProblem

_REACH = 0.3  # of the region: a rollout that ends further from what it follows has lost it


def follow_plan(
    problem: SampledProblem, region: Tensor, worst: float, x: Tensor, window: Tensor, end: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Cost (B,), first control (B, m) and arrival (B,) bool of following a plan, a row each.

    Args:
        problem: plant, cost and bounds in steps.
        region: half the width of the box of states, (n,).
        worst: the largest value that is remembered, added where the plan is lost.
        x: (B, n).
        window: state, control and feedback of H steps, (B, H, n + m + m n).
        end: state, value, gradient and curvature after them, (B, n + 1 + n + n n).
    """
    n, m = problem.dim, problem.inputs

    def control(x: Tensor, plan: Tensor) -> Tensor:
        state, u, feedback = plan.split((n, m, m * n), dim=-1)
        return problem.admissible(u + (feedback.unflatten(-1, (m, n)) * (x - state).unsqueeze(-2)).sum(-1))

    def step(now: tuple[Tensor, Tensor], plan: Tensor) -> tuple[tuple[Tensor, Tensor], tuple[()]]:
        after, paid = problem.advance(now[0], control(now[0], plan))
        return (after, now[1] + paid), ()

    first = window[:, 0]
    x = first[:, :n] + problem.offset(x, first[:, :n])
    (last, paid), _ = scan(step, (x, torch.zeros_like(x[:, 0])), window)
    state, value, gradient, curvature = end.split((n, 1, n, n * n), dim=-1)
    d = last - state
    bent = (curvature.unflatten(-1, (n, n)) * d.unsqueeze(-2)).sum(-1)
    rest = value.squeeze(-1) + ((gradient + 0.5 * bent) * d).sum(-1)
    far = (d / region).square().sum(-1)
    covered = (far < _REACH**2) & torch.isfinite(paid)
    lost = paid + value.squeeze(-1) + worst * (1 + far)
    cost = torch.where(covered, paid + rest, lost)
    return torch.where(torch.isfinite(cost), cost, torch.inf), control(x, first), covered

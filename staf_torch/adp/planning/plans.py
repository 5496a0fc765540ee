"""Trajectories with local models of the value along them, and what a plan is made of."""

from __future__ import annotations

from typing import NamedTuple, TypeVar

import torch
from torch import Tensor

from ..problem.sampled import SampledProblem


class Trajectories(NamedTuple):
    """Trajectories and the local models of the value along them: V(x) ~ V + g'd + d'Hd/2, d = x - x_k.

    Example:
        >>> def step(x, u):  # a cart without friction, for 0.1 s
        ...     after = torch.stack((x[:, 0] + 0.1 * x[:, 1], x[:, 1] + 0.1 * u[:, 0]), dim=-1)
        ...     return after, 0.1 * (x.square().sum(-1) + u.square().sum(-1))
        >>> problem = adp.SampledProblem(step, dim=2, inputs=1, low=-1.0, high=1.0)
        >>> found = adp.BoxDDP(problem, steps=20, compile=False).solve(torch.tensor([[1.0, 0.0]]).double())
        >>> found.state.shape, found.feedback.shape
        (torch.Size([1, 21, 2]), torch.Size([1, 20, 1, 2]))

        Shown by `staf_torch/adp/README.md`.
    """

    state: Tensor  # (B, T + 1, n), not wrapped
    control: Tensor  # (B, T, m)
    feedback: Tensor  # du/dx, (B, T, m, n); 0 where a bound holds
    value: Tensor  # cost from x_k on, (B, T + 1)
    gradient: Tensor  # g, (B, T + 1, n)
    curvature: Tensor  # H, (B, T + 1, n, n)
    converged: Tensor  # (B,) bool: no step of the search promises or brings a relative gain of tolerance

    @property
    def cost(self) -> Tensor:
        """(B,)."""
        return self.value[:, 0]

    def rows(self, index: Tensor) -> Trajectories:
        """Some of the rows."""
        return Trajectories(*(part[index] for part in self))


class Reference(NamedTuple):
    """What a control is a feedback around."""

    state: Tensor  # (B, T, n)
    feedback: Tensor  # (B, T, m, n)


class LocalModel(NamedTuple):
    """V(x) ~ v + g'd + d'Hd/2 with d = x - state by the shorter way around, a row each."""

    state: Tensor  # (B, n)
    value: Tensor  # v, (B,)
    gradient: Tensor  # g, (B, n)
    curvature: Tensor  # H, (B, n, n)

    def rows(self, index: Tensor) -> LocalModel:
        """Some of the rows."""
        return LocalModel(*(part[index] for part in self))

    def at(self, problem: SampledProblem, x: Tensor) -> Tensor:
        """V at L states a row: (B, L, n) -> (B, L)."""
        d = problem.offset(x, self.state.unsqueeze(1))
        bent = (self.curvature.unsqueeze(1) * d.unsqueeze(-2)).sum(-1)
        return self.value.unsqueeze(1) + ((self.gradient.unsqueeze(1) + 0.5 * bent) * d).sum(-1)

    def slope(self, problem: SampledProblem, x: Tensor) -> Tensor:
        """Its gradient at a state a row: (B, n) -> (B, n)."""
        d = problem.offset(x, self.state)
        return self.gradient + (self.curvature * d.unsqueeze(-2)).sum(-1)


class Plan(NamedTuple):
    """Trajectories without their models."""

    state: Tensor  # (B, T + 1, n)
    control: Tensor  # (B, T, m)
    cost: Tensor  # (B,)
    paid: Tensor  # of every step, and at last the terminal value, (B, T + 1)

    def rows(self, index: Tensor) -> Plan:
        """Some of the rows."""
        return Plan(*(part[index] for part in self))


def packed(state: Tensor, control: Tensor, feedback: Tensor) -> Tensor:
    """Steps of a plan as numbers: (..., n), (..., m), (..., m, n) -> (..., n + m + m n)."""
    return torch.cat((state, control, feedback.flatten(-2)), dim=-1)


def unpacked(problem: SampledProblem, steps: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """State, control and feedback of `packed` steps."""
    n, m = problem.dim, problem.inputs
    state, control, feedback = steps.split((n, m, m * n), dim=-1)
    return state, control, feedback.unflatten(-1, (m, n))


def resting(problem: SampledProblem, goal: Tensor) -> Tensor:
    """The linear feedback of goals (..., n) as `packed` steps."""
    shape = goal.shape[:-1]
    return packed(goal, problem.rest.expand(*shape, -1), (-problem.k).expand(*shape, -1, -1))


def around(problem: SampledProblem, x: Tensor, step: Tensor) -> Tensor:
    """The control of a `packed` step at another state than its own: (..., n), (..., w) -> (..., m)."""
    state, control, feedback = unpacked(problem, step)
    return problem.admissible(control + (feedback * (x - state).unsqueeze(-2)).sum(-1))


Some = TypeVar("Some", bound=tuple[Tensor, ...])


def chosen(rows: Tensor, new: Some, old: Some) -> Some:
    """The tensors of ``new`` in ``rows`` (B,), those of ``old`` in the others."""

    def pick(a: Tensor, b: Tensor) -> Tensor:
        return torch.where(rows.reshape(-1, *[1] * (a.dim() - 1)), a, b)

    picked = map(pick, new, old)
    return type(new)(*picked) if hasattr(new, "_fields") else type(new)(picked)

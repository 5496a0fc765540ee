"""Trajectories, local models of the value along them, steps of plans as numbers, and first controls."""

from __future__ import annotations

from typing import NamedTuple, TypeVar

import torch
from torch import Tensor

from ...numerics.repr_text import span
from ...numerics.rows import chosen as chosen
from ..problem.sampled import SampledProblem

_LENGTHS = (2, 4, 7, 12, 20, 30)  # periods for which a corner of the bounds is held before the feedback
_HELD = 10  # periods for which a random control is held
_RANDOM = 8  # random controls
_MOST = 81  # combinations of bounds that are tried


class Trajectories(NamedTuple):
    """Trajectories and the local models of the value along them: V(x) ~ V + g'd + d'Hd/2, d = x - x_k."""

    state: Tensor  # (B, T + 1, n), angles as the step returned them
    control: Tensor  # (B, T, m)
    feedback: Tensor  # du/dx, (B, T, m, n); 0 where a bound holds
    value: Tensor  # cost from x_k on, (B, T + 1)
    gradient: Tensor  # g, (B, T + 1, n)
    curvature: Tensor  # H, (B, T + 1, n, n)
    converged: Tensor  # (B,) bool: no step promises or brings a gain of tolerance, or one above rounding

    @property
    def cost(self) -> Tensor:
        """(B,)."""
        return self.value[:, 0]

    def __repr__(self) -> str:
        rows, steps = self.control.shape[:2]
        found = f"{int(self.converged.sum())} converged" if self.converged.numel() == rows else ""
        return f"Trajectories({rows} of {steps} steps, cost {span(self.cost)}, {found})"

    def to(self, dtype: torch.dtype) -> Trajectories:
        """Return them with numbers of a dtype."""
        return Trajectories(*(part.to(dtype) if part.is_floating_point() else part for part in self))


class Reference(NamedTuple):
    """Trajectory and feedback that a control is applied around."""

    state: Tensor  # (B, T, n)
    feedback: Tensor  # (B, T, m, n)


class LocalModel(NamedTuple):
    """V(x) ~ v + g'd + d'Hd/2 with d = x - state by the shorter way around, a row each."""

    state: Tensor  # (B, n)
    value: Tensor  # v, (B,)
    gradient: Tensor  # g, (B, n)
    curvature: Tensor  # H, (B, n, n)

    def at(self, problem: SampledProblem, x: Tensor) -> Tensor:
        """V at L states a row: (B, L, n) -> (B, L)."""
        d = problem.offset(x, self.state.unsqueeze(1))
        bent = (self.curvature.unsqueeze(1) * d.unsqueeze(-2)).sum(-1)
        return self.value.unsqueeze(1) + ((self.gradient.unsqueeze(1) + 0.5 * bent) * d).sum(-1)

    def slope(self, problem: SampledProblem, x: Tensor) -> Tensor:
        """Its gradient at a state a row: (B, n) -> (B, n)."""
        d = problem.offset(x, self.state)
        return self.gradient + (self.curvature * d.unsqueeze(-2)).sum(-1)

    def bent(self, problem: SampledProblem, x: Tensor) -> tuple[Tensor, Tensor]:
        """Its gradient and its second derivative at a state a row: (B, n) -> (B, n), (B, n, n)."""
        return self.slope(problem, x), self.curvature


class EndFunction(NamedTuple):
    """V_T of a problem that was given one as a function; `LocalModel` of the others."""

    rows: Tensor  # (B,) of no meaning: a row each

    def at(self, problem: SampledProblem, x: Tensor) -> Tensor:
        """V_T at L states a row: (B, L, n) -> (B, L)."""
        return problem.terminal(x)

    def bent(self, problem: SampledProblem, x: Tensor) -> tuple[Tensor, Tensor]:
        """Gradient and second derivative at a state a row: (B, n) -> (B, n), (B, n, n)."""
        return problem.end_model(x)


End = LocalModel | EndFunction


class CostedTrajectories(NamedTuple):
    """Trajectories without their models."""

    state: Tensor  # (B, T + 1, n)
    control: Tensor  # (B, T, m)
    cost: Tensor  # (B,)
    paid: Tensor  # of every step, and at last the terminal value, (B, T + 1)


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
    return problem.admissible(control + (feedback * problem.offset(x, state).unsqueeze(-2)).sum(-1))


Some = TypeVar("Some", bound=tuple[Tensor, ...])


def rows_of(parts: Some, index: Tensor) -> Some:
    """Some of the rows of a named tuple."""
    return type(parts)(*(part[index] for part in parts))


def held_controls(problem: SampledProblem, steps: int) -> tuple[Tensor, Tensor]:
    """First controls (G, T, m) and their feedback (G, T, m, n): the linear feedback of the goal, and each
    corner of the bounds held for 2 to 30 periods before it."""
    levels = problem.levels()
    corners = levels[(levels != problem.rest).all(-1)]
    held = [(length, u) for length in _LENGTHS if length < steps for u in corners]
    control = problem.rest.repeat(1 + len(held), steps, 1)
    feedback = (-problem.k).repeat(1 + len(held), steps, 1, 1)
    for k, (length, u) in enumerate(held, 1):
        control[k, :length], feedback[k, :length] = u, 0.0
    return control, feedback


def first_controls(problem: SampledProblem, steps: int) -> Tensor:
    """First controls of a problem without a linear feedback, (G, T, m): where the control is at rest a plant
    with a kink, or one that is only steered while it moves, has no slope to follow.

    The bounds, and where there are none a unit of the input around its rest, in all combinations, for a while
    and all the time; some at random.
    """
    rest = problem.admissible(problem.rest)
    low, high = problem.reach()
    columns = [torch.stack((a, b, c)).unique() for a, b, c in zip(rest, low, high, strict=True)]
    levels = torch.cartesian_prod(*columns).reshape(-1, problem.inputs)[:_MOST]
    tried = [rest.expand(steps, -1)]
    for u in levels:
        lengths = (*(length for length in _LENGTHS if length < steps), steps)
        tried += [
            torch.where(torch.arange(steps, device="cpu")[:, None] < length, u, rest) for length in lengths
        ]
    draw = torch.Generator().manual_seed(0)
    shares = torch.rand(
        _RANDOM, -(-steps // _HELD), problem.inputs, dtype=torch.float64, generator=draw, device="cpu"
    )
    random = (low + (high - low) * shares).repeat_interleave(_HELD, 1)[:, :steps]
    return torch.cat((torch.stack(tried), random))

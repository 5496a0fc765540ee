"""What a plan around what moves costs, and steps of Gauss and Newton that lower it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ...lanes import repeat, scan
from ...lanes.combinators import tracing_now
from ...numerics.angles import wrap
from ...numerics.box import minimum_and_slopes
from ...numerics.forward_mode import use_forward_mode
from ...numerics.linalg import row_jacobian
from ...numerics.riccati import product, riccati_step
from ...numerics.runge_kutta import runge_kutta_step
from ..problem.cost import QuadraticCost, matvec
from .detour_rollout import DetourRollout

_TRIES, _SHORTER = 6, 0.3  # lengths of a step that are tried, each this share of the one before

Chosen = Callable[[Tensor, Tensor, Any, Tensor], Tensor]
"""u from the moved states, the others, what the period brings, and the number of periods so far."""


class Plan(NamedTuple):
    """A plan over T periods."""

    states: Tensor  # of the states that the inputs move, (B, T + 1, p)
    control: Tensor  # (B, T, m)
    total: Tensor  # J, (B,)


class PlanProblem:
    """J of a plan over T periods, and how it is lowered.

    Args:
        detours: plant, constraints with their margins, period, T and V_T.
        cost: the rate of J.
        moved: p: the inputs move the first p states.
        weight: of squares of what is missing of the margins.
    """

    def __init__(self, detours: DetourRollout, cost: QuadraticCost, moved: int, weight: float) -> None:
        self.detours, self.plant, self.cost = detours, detours.plant, cost
        self.hold, self.steps = detours.hold, detours.steps
        self.moved, self.weight = moved, weight

    def improve(self, now: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        """One step: the first of a few lengths that lowers J."""
        others, done, *parts = now
        plan = Plan(*parts)
        change, feedback = self._newton(plan, others, done)
        whole = torch.ones_like(plan.total)

        def attempt(now: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
            *before, length, _ = now

            def wanted(y: Tensor, others: Tensor, given: tuple[Tensor, ...], k: Tensor) -> Tensor:
                planned, u, change, feedback = given
                u = u + length.unsqueeze(-1) * change + matvec(feedback, y - planned)
                return self.clipped(u)

            given = plan.states[:, :-1], plan.control, change, feedback
            found = self.follow(plan.states[:, 0], others, done, given, wanted)
            better = found.total < before[2]
            kept = (better[:, None, None], better[:, None, None], better)
            after = [torch.where(w, a, b) for w, a, b in zip(kept, found, before, strict=True)]
            return *after, _SHORTER * length, torch.where(better, 0.0 * length, 1.0)

        found = repeat(_TRIES, attempt, (*plan, whole, whole), where=lambda now: now[-1] > 0)
        return others, done, *found[:3]

    def follow(self, y: Tensor, others: Tensor, done: Tensor, inputs: Any, chosen: Chosen) -> Plan:
        """Follow the plant over T periods, with the control that a function chooses at each."""

        def period(now: tuple[Tensor, ...], given: tuple[Tensor, Any]) -> tuple[tuple[Tensor, ...], Any]:
            y, k, total = now
            others, inputs = given
            u = chosen(y, others, inputs, k)
            x = self.whole(y, others)
            total = total + self.paid(x, u, (done[:, 0] + k) * self.hold)
            return (self._ahead(y, others, u), k + 1, total), (y, u)

        none = torch.zeros_like(y[:, 0])
        (end, k, total), (states, control) = scan(period, (y, none, none), (others[:, :-1], inputs))
        x = self.whole(end, others[:, -1])
        total = total + self.hold * self.penalty(x, (done[:, 0] + k) * self.hold) + self.detours.terminal(x)
        return Plan(torch.cat((states, end.unsqueeze(1)), dim=1), control, total)

    def paid(self, x: Tensor, u: Tensor, t: Tensor) -> Tensor:
        """A period's part of J: (B, n), (B, m), (B,) -> (B,)."""
        return self.hold * (self.cost.state_rate(x) + self.cost.input_rate(u) + self.penalty(x, t))

    def longer(self, x: Tensor, u: Tensor) -> Tensor:
        """What a last period with u adds to J where no constraint is met: (B, n), (B, m) -> (B,)."""
        rates = self.cost.state_rate(x) + self.cost.input_rate(u)
        value = self.detours.terminal
        added: Tensor = self.hold * rates + value(self._advance(x, u)) - value(x)
        return added

    def whole(self, y: Tensor, others: Tensor) -> Tensor:
        """The states of both kinds: (B, p), (B, n - p) -> (B, n)."""
        return y if self.moved == self.cost.dim else torch.cat((y, others), dim=-1)

    def others(self, x: Tensor) -> Tensor:
        """The states that no input moves, at the times of a plan: (B, n) -> (B, T + 1, n - p), or one column
        that nobody reads where all are moved: a program has no tensors without entries."""
        if self.moved == self.cost.dim:
            return x.new_zeros(len(x), self.steps + 1, 1)
        rest = self.plant.resting_input().to(x).expand(len(x), -1)

        def period(now: Tensor, _: Tensor) -> tuple[Tensor, Tensor]:
            return self._advance(now, rest), now[:, self.moved :]

        end, found = scan(period, x, x.new_zeros(len(x), self.steps))
        return torch.cat((found, end[:, self.moved :].unsqueeze(1)), dim=1)

    def _ahead(self, y: Tensor, others: Tensor, u: Tensor) -> Tensor:
        """The moved states after a period: (B, p), (B, n - p), (B, m) -> (B, p)."""
        return self._advance(self.whole(y, others), u)[..., : self.moved]

    def _advance(self, x: Tensor, u: Tensor) -> Tensor:
        """x after a period: one Runge-Kutta step."""
        plant = self.plant
        return runge_kutta_step(lambda at: plant.velocity(at, u), x, self.hold, plant.displaced)

    def bounds(self, like: Tensor) -> tuple[Tensor, Tensor]:
        """(m,) each; infinite where there are none."""
        if self.cost.bounds is None:
            none = like.new_full((self.cost.inputs,), torch.inf)
            return -none, none
        return self.cost.bounds.low.to(like), self.cost.bounds.high.to(like)

    def clipped(self, u: Tensor) -> Tensor:
        return u if self.cost.bounds is None else self.cost.bounds.clip(u)

    def penalty(self, x: Tensor, t: Tensor) -> Tensor:
        """weight sum_i max(0, margin_i - h_i)^2: (B, n), (B,) -> (B,)."""
        total = torch.zeros_like(t)
        for h, margin in zip(self.detours.constraints, self.detours.margin.to(x), strict=True):
            short = margin - torch.func.vmap(lambda x, t, h=h: h(x, t)[0])(x.unsqueeze(1), t)
            total = total + torch.where(short > 0, short.square(), 0.0 * short)
        return self.weight * total

    def _newton(self, plan: Plan, others: Tensor, done: Tensor) -> tuple[Tensor, Tensor]:
        """Changes of the controls (B, T, m) and their feedback (B, T, m, p), backward in time."""
        low, high = self.bounds(plan.control)
        bend = 2 * self.hold * self.cost.r.to(plan.control)
        rest = self.cost.target_input

        def period(now: tuple[Tensor, ...], given: tuple[Tensor, ...]) -> tuple[tuple[Tensor, ...], Any]:
            (gradient, curvature, k), (y, others, u) = now, given
            lx, lxx = self._stage(y, others, (done[:, 0] + k) * self.hold)
            lu = matvec(bend, u if rest is None else u - rest.to(u))
            apart = y.new_zeros(*y.shape, u.shape[-1])  # no cost of a state and an input together
            upper = torch.cat((lxx, apart), dim=-1)
            lower = torch.cat((apart.mT, bend.expand(len(y), -1, -1)), dim=-1)
            found = riccati_step(
                gradient,
                curvature,
                self._slopes(y, others, u),
                torch.cat((lx, lu), dim=-1),
                torch.cat((upper, lower), dim=-2),
                lambda s, cross, bent: minimum_and_slopes(bent, s, cross, low - u, high - u),
            )
            return (found.gradient, found.curvature, k - 1), (found.change, found.feedback)

        last = torch.full_like(plan.total, float(self.steps))
        end = self._end(plan.states[:, -1], others[:, -1], (done[:, 0] + last) * self.hold)
        given = plan.states[:, :-1].flip(1), others[:, :-1].flip(1), plan.control.flip(1)
        _, (change, feedback) = scan(period, (*end, last - 1), given)
        return change.flip(1), feedback.flip(1)

    def _slopes(self, y: Tensor, others: Tensor, u: Tensor) -> Tensor:
        """A and B of a period beside each other: (B, p, p + m)."""
        p, z = self.moved, torch.cat((y, u), dim=-1)
        return _along(lambda z: self._ahead(z[..., :p], others, z[..., p:]), z)[1]

    def _stage(self, y: Tensor, others: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        """Slope and curvature (Gauss and Newton's) of what the states of a period cost: (B, p), (B, p, p)."""
        cost = self.cost
        see = (lambda x: x) if cost.output is None else cost.output
        error, slope = _along(lambda y: see(self.whole(y, others)), y)
        if cost.target is not None:
            error = error - see(cost.target.to(y))
        error = error if cost.output is not None else wrap(error, cost.periodic)
        heavy = 2 * self.hold * product(slope.mT, cost.q.to(y).expand(len(y), -1, -1))
        gradient, curvature = self._pressure(y, others, t)
        return gradient + matvec(heavy, error), curvature + product(heavy, slope)

    def _end(self, y: Tensor, others: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        """Slope and curvature of V_T, and of what is missing there."""

        def value(y: Tensor) -> Tensor:
            paid: Tensor = self.detours.terminal(self.whole(y, others))
            return paid.unsqueeze(-1)

        slope, bend = _along(lambda y: _along(value, y)[1][:, 0], y)
        gradient, curvature = self._pressure(y, others, t)
        return gradient + slope, curvature + bend

    def _pressure(self, y: Tensor, others: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        """Slope and curvature of the penalty over a period."""
        gradient = torch.zeros_like(y)
        curvature = gradient.unsqueeze(-1) * gradient.unsqueeze(-2)
        for h, margin in zip(self.detours.constraints, self.detours.margin.to(y), strict=True):

            def level(y: Tensor, others: Tensor, t: Tensor, h: Any = h) -> Tensor:
                margin_left: Tensor = h(self.whole(y, others).unsqueeze(0), t)[0]
                return margin_left

            slope, value = torch.func.vmap(torch.func.grad_and_value(level))(y, others, t)
            short = (margin - value).unsqueeze(-1)
            heavy = torch.where(short > 0, torch.ones_like(short), 0.0 * short)
            heavy = 2 * self.hold * self.weight * heavy
            gradient = gradient - heavy * short * slope
            curvature = curvature + (heavy * slope).unsqueeze(-1) * slope.unsqueeze(-2)
        return gradient, curvature


def _along(function: Callable[[Tensor], Tensor], z: Tensor) -> tuple[Tensor, Tensor]:
    """A function's value (B, q) and its slopes along all coordinates of z (B, d): (B, q, d).

    Forward in a program, whose text is shorter so; backwards in plain torch, where a product with a number
    takes thirty times as long forward.
    """
    if not tracing_now():
        return row_jacobian(function, z)
    use_forward_mode()
    units = torch.eye(z.shape[-1], dtype=z.dtype, device=z.device)
    found = [torch.func.jvp(function, (z,), (unit.expand_as(z).clone(),)) for unit in units]
    return found[0][0], torch.stack([one[1] for one in found], dim=-1)

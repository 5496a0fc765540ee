"""Plans around what moves: the best of many detours at the start, then improved at every control."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..lanes import repeat, scan
from ..lanes.function import RowFunction
from ..numerics.angles import wrap
from ..numerics.box import LARGEST, box_minimum
from ..numerics.checks import fail, integer, positive_real
from ..numerics.forward_mode import use_forward_mode
from .controllers import Controller, ControllerState
from .cost import QuadraticCost, matvec
from .detours import DetourRollout
from .trajectory_optimisation import slopes_of_minimum

_LENGTHS, _SHARES = (5, 15, 40), (0.3, 1.0)  # periods for which shares of the bounds are held, as starts
_TRIES, _SHORTER = 3, 0.3  # lengths of a step that are tried, each this share of the one before
_PROBES = 8  # states at which it is tried whether the inputs move what they must not

Chosen = Callable[[Tensor, Tensor, Any, Tensor], Tensor]
"""u from the moved states, the others, what the period brings, and the number of periods so far."""


class _Plan(NamedTuple):
    """A plan over T periods."""

    states: Tensor  # of the states that the inputs move, (B, T + 1, p)
    control: Tensor  # (B, T, m)
    total: Tensor  # J, (B,)


class DetourPlans(Controller):
    """u_0 of a plan u_0, ..., u_{T-1} that follows the plant for T periods and has a low

        J = sum_k dt (l(x_k, u_k) + weight sum_i max(0, margin_i - h_i(x_k, t_k))^2) + V_T(x_T).

    A `DetourRollout` compares ways that a policy can go; this one has the control at every period free. Where
    a loop begins, `init` improves a plan for each of its detours, and for shares of the bounds that are held
    for a while, and keeps the best: so many local minima are compared. Each control then moves the plan a
    period on, the policy at its end, and improves it by steps of Gauss and Newton on the box of inputs
    (differential dynamic programming; only what lowers J is taken). A way once chosen is kept. Constraints
    stand in J at the ends of the periods alone: put a `SafetyFilter` around it.

    Example:
        >>> plant = systems.Linear([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])
        >>> cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1, low=-1.0, high=1.0)
        >>> lqr = adp.LQR(plant, cost, period=0.1)
        >>> wall = [lambda x, t: x[:, 0] + 0.1]
        >>> there = {"axes": [[1.0, 0.0]], "steps": 20, "terminal": lqr.value, "sizes": [0.5], "lengths": [6]}
        >>> ahead = adp.DetourRollout(lqr, plant, cost, wall, dt=0.1, **there)
        >>> plans, x0 = adp.DetourPlans(ahead), torch.tensor([[1.0, 0.0]]).double()
        >>> run = adp.simulate(plans, plant, cost, x0, steps=5)
        >>> run.control.shape
        torch.Size([1, 6, 1])

        Shown by `staf_torch/adp/README.md`.

    Args:
        detours: policy, plant, cost, constraints with their margins, period, T and V_T; its cost must be a
            `QuadraticCost` without discount, its inputs 4 at most.
        moved: p: the inputs move the first p states, the others go their own way, as obstacles do. A step
            then costs what p states cost. None for all.
        iterations: of a control.
        first: iterations of each plan in `init`.
        weight: of squares of what is missing of the margins, in units of the cost rate, positive.

    Raises:
        ValueError: if an argument breaks its rule, or the first p states or the inputs move another one.

    Source: Tassa, Mansard, Todorov, "Control-limited differential dynamic programming", ICRA (2014).
    """

    def __init__(
        self,
        detours: DetourRollout,
        *,
        moved: int | None = None,
        iterations: int = 2,
        first: int = 12,
        weight: float = 1e4,
    ) -> None:
        super().__init__()
        cost = detours.cost
        if not isinstance(cost, QuadraticCost) or cost.discount or cost.inputs > LARGEST:
            rule = f"must have a QuadraticCost without discount and {LARGEST} inputs at most"
            raise fail("DetourPlans", "detours", rule, cost)
        self.detours, self.plant, self.cost = detours, detours.plant, cost
        self.period = self.hold = detours.hold
        self.steps = detours.steps
        self.moved = cost.dim if moved is None else integer("DetourPlans", "moved", moved, least=1)
        if self.moved > cost.dim:
            raise fail("DetourPlans", "moved", f"must be at most the {cost.dim} states", moved)
        self.iterations = integer("DetourPlans", "iterations", iterations, least=1)
        self.first = integer("DetourPlans", "first", first, least=1)
        self.weight = positive_real("DetourPlans", "weight", weight)
        self._check_others()
        self._prepare()

    def _prepare(self) -> None:
        use_forward_mode()
        self._rows = RowFunction(self._definition, self, "a plan around what moves")
        self._begun = RowFunction(self._first_plan, self, "first plans around what moves")

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_rows": None, "_begun": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)  # type: ignore[no-untyped-call]
        self._prepare()

    def init(self, x0: Tensor) -> ControllerState:
        """The best of the first plans from the states x0 (B, n), some 200 of each."""
        count, starts = len(x0), self._starts(x0)
        x, found = x0.repeat(len(starts), 1), starts.flatten(0, 1).flatten(1)
        for _ in range(self.first):
            improved = self._begun(torch.cat((x, found), dim=-1))
            found = improved[:, 1:]
        found = improved.unflatten(0, (len(starts), count))
        total = torch.where(torch.isfinite(found[..., 0]), found[..., 0], torch.inf)
        best = found[total.argmin(0), torch.arange(count, device=x0.device), 1:]
        empty = x0.new_zeros(count, 0)
        known = torch.cat((best, x0.new_zeros(count, 1)), dim=-1)  # the plan, the periods so far
        return ControllerState(empty, empty, x0.new_zeros(count, 0, 0), known)

    def step(
        self, x: Tensor, carried: ControllerState, uniform: Tensor, dt: float
    ) -> tuple[Tensor, ControllerState]:
        if dt != self.hold:
            raise fail("DetourPlans", "dt", f"must be that of the loop, {dt:g} s", self.hold)
        known = carried.identifier
        found = self._rows(torch.cat((x, known), dim=-1))
        u, known = found.split((self.plant.inputs, known.shape[-1]), dim=-1)
        return u, carried._replace(identifier=known)

    def _check_others(self) -> None:
        """Raise where the moved states or the inputs change how another state moves."""
        x, other = torch.randn(
            2, _PROBES, self.cost.dim, dtype=torch.float64, generator=torch.Generator().manual_seed(0)
        ).unbind(0)
        rest = self.plant.resting_input().double().expand(_PROBES, -1)
        other = torch.cat((other[:, : self.moved], x[:, self.moved :]), dim=-1)
        own, changed = self.plant.velocity(x, rest), self.plant.velocity(other, rest + 1)
        if not torch.equal(own[:, self.moved :], changed[:, self.moved :]):
            raise fail("DetourPlans", "moved", "must count every state that the inputs move", self.moved)

    def _starts(self, x0: Tensor) -> Tensor:
        """First controls: the policy's, of every detour, and of shares of the bounds held: (S, B, T, m)."""
        fresh = self.detours.fresh.to(x0)
        tried = torch.cat((torch.zeros_like(fresh[:1]), fresh)).repeat_interleave(len(x0), 0)
        x = x0.repeat(len(fresh) + 1, 1)
        others, done = self._others(x), torch.zeros_like(x[:, :1])
        followed = self._followed(x[:, : self.moved], others, tried, done).control
        starts: Tensor = followed.unflatten(0, (len(fresh) + 1, len(x0)))
        if self.cost.bounds is None:
            return starts
        low, high = self._bounds(x0)
        levels = torch.stack((torch.zeros_like(low), low, high))
        levels = torch.where(torch.isfinite(levels), levels, 0.0)
        ways = torch.cartesian_prod(*levels.unbind(-1)).reshape(-1, len(low))
        held = []
        for length in _LENGTHS:
            for u in torch.cat([share * ways for share in _SHARES]):
                held.append(starts[0].clone())
                held[-1][:, :length] = u
        return torch.cat((starts, torch.stack(held)))

    def _first_plan(self, z: Tensor) -> Tensor:
        """Of rows of (x, controls) J and the controls of the plan after one step."""
        x, control = z.split((self.cost.dim, z.shape[-1] - self.cost.dim), dim=-1)
        _, _, _, control, total = self._improved(x, control, torch.zeros_like(x[:, :1]), 1)
        return torch.cat((total.unsqueeze(-1), control.flatten(1)), dim=-1)

    def _definition(self, z: Tensor) -> Tensor:
        """Of rows of (x, controls, periods so far) the control, and both for the next period."""
        flat = z.reshape(-1, z.shape[-1])
        n = self.cost.dim
        x, control, done = flat.split((n, flat.shape[-1] - n - 1, 1), dim=-1)
        others, _, states, control, _ = self._improved(x, control, done, self.iterations)
        last = self._clipped(self.detours.policy(self._whole(states[:, -1], others[:, -1])))
        ahead = torch.cat((control[:, 1:], last.unsqueeze(1)), dim=1)
        return torch.cat((control[:, 0], ahead.flatten(1), done + 1), dim=-1).reshape(*z.shape[:-1], -1)

    def _improved(self, x: Tensor, control: Tensor, done: Tensor, count: int) -> tuple[Tensor, ...]:
        """Others, periods so far, and the plan after so many steps of Gauss and Newton."""
        others = self._others(x)
        given = control.unflatten(-1, (self.steps, -1))
        plan = self._run(x[:, : self.moved], others, done, given, lambda y, others, u, k: u)
        found: tuple[Tensor, ...] = repeat(count, self._improve, (others, done, *plan))
        return found

    def _improve(self, now: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        """One step: the first of a few lengths that lowers J."""
        others, done, *parts = now
        plan = _Plan(*parts)
        change, feedback = self._newton(plan, others, done)
        whole = torch.ones_like(plan.total)

        def attempt(now: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
            *before, length, _ = now

            def wanted(y: Tensor, others: Tensor, given: tuple[Tensor, ...], k: Tensor) -> Tensor:
                planned, u, change, feedback = given
                u = u + length.unsqueeze(-1) * change + matvec(feedback, y - planned)
                return self._clipped(u)

            given = plan.states[:, :-1], plan.control, change, feedback
            found = self._run(plan.states[:, 0], others, done, given, wanted)
            better = found.total < before[2]
            kept = (better[:, None, None], better[:, None, None], better)
            after = [torch.where(w, a, b) for w, a, b in zip(kept, found, before, strict=True)]
            return *after, _SHORTER * length, torch.where(better, 0.0 * length, 1.0)

        found = repeat(_TRIES, attempt, (*plan, whole, whole), where=lambda now: now[-1] > 0)
        return others, done, *found[:3]

    def _run(self, y: Tensor, others: Tensor, done: Tensor, inputs: Any, chosen: Chosen) -> _Plan:
        """Follow the plant over T periods, with the control that a function chooses at each."""

        def period(now: tuple[Tensor, ...], given: tuple[Tensor, Any]) -> tuple[tuple[Tensor, ...], Any]:
            y, k, total = now
            others, inputs = given
            u = chosen(y, others, inputs, k)
            x = self._whole(y, others)
            paid = self.cost.state_rate(x) + self.cost.input_rate(u)
            total = total + self.hold * (paid + self._penalty(x, (done[:, 0] + k) * self.hold))
            return (self._ahead(y, others, u), k + 1, total), (y, u)

        none = torch.zeros_like(y[:, 0])
        (end, k, total), (states, control) = scan(period, (y, none, none), (others[:, :-1], inputs))
        x = self._whole(end, others[:, -1])
        total = total + self.hold * self._penalty(x, (done[:, 0] + k) * self.hold) + self.detours.terminal(x)
        return _Plan(torch.cat((states, end.unsqueeze(1)), dim=1), control, total)

    def _followed(self, y: Tensor, others: Tensor, tried: Tensor, done: Tensor) -> _Plan:
        """What a detour (B, k + 1) does."""

        def wanted(y: Tensor, others: Tensor, _: Tensor, k: Tensor) -> Tensor:
            x = self._whole(y, others).unsqueeze(1)
            return self.detours._control(x, tried.unsqueeze(1), k.unsqueeze(1))[:, 0]

        return self._run(y, others, done, y.new_zeros(len(y), self.steps), wanted)

    def _whole(self, y: Tensor, others: Tensor) -> Tensor:
        """The states of both kinds: (B, p), (B, n - p) -> (B, n)."""
        return y if self.moved == self.cost.dim else torch.cat((y, others), dim=-1)

    def _others(self, x: Tensor) -> Tensor:
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
        return self._advance(self._whole(y, others), u)[..., : self.moved]

    def _advance(self, x: Tensor, u: Tensor) -> Tensor:
        """x after a period: one Runge-Kutta step."""
        plant, h = self.plant, self.hold
        k1 = plant.velocity(x, u)
        k2 = plant.velocity(plant.displaced(x, 0.5 * h * k1), u)
        k3 = plant.velocity(plant.displaced(x, 0.5 * h * k2), u)
        k4 = plant.velocity(plant.displaced(x, h * k3), u)
        return plant.displaced(x, (h / 6) * (k1 + 2 * (k2 + k3) + k4))

    def _bounds(self, like: Tensor) -> tuple[Tensor, Tensor]:
        """(m,) each; infinite where there are none."""
        if self.cost.bounds is None:
            none = like.new_full((self.cost.inputs,), torch.inf)
            return -none, none
        return self.cost.bounds.low.to(like), self.cost.bounds.high.to(like)

    def _clipped(self, u: Tensor) -> Tensor:
        return u if self.cost.bounds is None else self.cost.bounds.clip(u)

    def _penalty(self, x: Tensor, t: Tensor) -> Tensor:
        """weight sum_i max(0, margin_i - h_i)^2: (B, n), (B,) -> (B,)."""
        total = torch.zeros_like(t)
        for h, margin in zip(self.detours.constraints, self.detours.margin.to(x), strict=True):
            short = margin - torch.func.vmap(lambda x, t, h=h: h(x, t)[0])(x.unsqueeze(1), t)
            total = total + torch.where(short > 0, short.square(), 0.0 * short)
        return self.weight * total

    def _newton(self, plan: _Plan, others: Tensor, done: Tensor) -> tuple[Tensor, Tensor]:
        """Changes of the controls (B, T, m) and their feedback (B, T, m, p), backward in time."""
        low, high = self._bounds(plan.control)
        bend = 2 * self.hold * self.cost.r.to(plan.control)
        rest = self.cost.target_input

        def period(now: tuple[Tensor, ...], given: tuple[Tensor, ...]) -> tuple[tuple[Tensor, ...], Any]:
            (gradient, curvature, k), (y, others, u) = now, given
            a, b = self._slopes(y, others, u)
            lx, lxx = self._stage(y, others, (done[:, 0] + k) * self.hold)
            pulled_a, pulled_b = _product(curvature, a), _product(curvature, b)
            qx = lx + matvec(a.mT, gradient)
            qu = matvec(bend, u if rest is None else u - rest.to(u)) + matvec(b.mT, gradient)
            qxx, qux = lxx + _product(a.mT, pulled_a), _product(b.mT, pulled_a)
            quu = bend + _product(b.mT, pulled_b)
            change = box_minimum(quu, qu, low - u, high - u)
            feedback = slopes_of_minimum(quu, qux, (change > low - u) & (change < high - u))
            turn = feedback.mT
            slope = qx + matvec(turn, matvec(quu, change) + qu) + matvec(qux.mT, change)
            cross = _product(turn, qux)
            bent = qxx + _product(turn, _product(quu, feedback)) + cross + cross.mT
            return (slope, 0.5 * (bent + bent.mT), k - 1), (change, feedback)

        last = torch.full_like(plan.total, float(self.steps))
        end = self._end(plan.states[:, -1], others[:, -1], (done[:, 0] + last) * self.hold)
        given = plan.states[:, :-1].flip(1), others[:, :-1].flip(1), plan.control.flip(1)
        _, (change, feedback) = scan(period, (*end, last - 1), given)
        return change.flip(1), feedback.flip(1)

    def _slopes(self, y: Tensor, others: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """A and B of a period: (B, p, p), (B, p, m)."""
        p, z = self.moved, torch.cat((y, u), dim=-1)
        _, slope = _along(lambda z: self._ahead(z[..., :p], others, z[..., p:]), z)
        return slope[..., :p], slope[..., p:]

    def _stage(self, y: Tensor, others: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        """Slope and curvature (Gauss and Newton's) of what the states of a period cost: (B, p), (B, p, p)."""
        cost = self.cost
        see = (lambda x: x) if cost.output is None else cost.output
        error, slope = _along(lambda y: see(self._whole(y, others)), y)
        if cost.target is not None:
            error = error - see(cost.target.to(y))
        error = error if cost.output is not None else wrap(error, cost.periodic)
        heavy = 2 * self.hold * _product(slope.mT, cost.q.to(y).expand(len(y), -1, -1))
        gradient, curvature = self._pressure(y, others, t)
        return gradient + matvec(heavy, error), curvature + _product(heavy, slope)

    def _end(self, y: Tensor, others: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        """Slope and curvature of V_T, and of what is missing there."""

        def value(y: Tensor) -> Tensor:
            paid: Tensor = self.detours.terminal(self._whole(y, others))
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
                margin_left: Tensor = h(self._whole(y, others).unsqueeze(0), t)[0]
                return margin_left

            slope, value = torch.func.vmap(torch.func.grad_and_value(level))(y, others, t)
            short = (margin - value).unsqueeze(-1)
            heavy = torch.where(short > 0, torch.ones_like(short), 0.0 * short)
            heavy = 2 * self.hold * self.weight * heavy
            gradient = gradient - heavy * short * slope
            curvature = curvature + (heavy * slope).unsqueeze(-1) * slope.unsqueeze(-2)
        return gradient, curvature


def _along(function: Callable[[Tensor], Tensor], z: Tensor) -> tuple[Tensor, Tensor]:
    """A function's value (B, q) and its slopes along all coordinates of z (B, d): (B, q, d)."""
    units = torch.eye(z.shape[-1], dtype=z.dtype, device=z.device)
    found = [torch.func.jvp(function, (z,), (unit.expand_as(z).clone(),)) for unit in units]
    value: Tensor = found[0][0]
    return value, torch.stack([one[1] for one in found], dim=-1)


def _product(a: Tensor, b: Tensor) -> Tensor:
    """(..., i, j), (..., j, k) -> (..., i, k), entry by entry: a program folds what is 0."""
    total: Tensor = (a.unsqueeze(-1) * b.unsqueeze(-3)).sum(-2)
    return total

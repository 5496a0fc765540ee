"""Plans around what moves: the best of many detours, improved by Gauss-Newton steps at every control."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ...lanes import compiled, repeat, scan, traced_as
from ...lanes.gradients import grad
from ...numerics.box import LARGEST, minimum_and_slopes
from ...numerics.checks import fail, integer, positive_real, trailing
from ...numerics.derivatives import row_jacobian, use_forward_mode
from ...numerics.riccati import product, riccati_step
from ..loop.controller import Controller
from ..problem.cost import QuadraticCost, matvec
from ..problem.held_plant import Holding
from .obstacles import DetourRollout

_TRIES, _SHORTER = 6, 0.3  # lengths of a step that are tried, each this share of the one before

Chosen = Callable[[Tensor, Tensor, Any, Tensor], Tensor]
"""u from the moved states, the others, what the period brings, and the number of periods so far."""

_LENGTHS, _SHARES = (5, 15, 40), (0.3, 1.0)  # periods for which shares of the bounds are held, as starts
_WORSE = 0.02  # share of J by which a carried plan may cost more than a period ago was expected
_FRESH = 2  # rounds of iterations that a detour gets to be better than such a plan
_PROBES = 8  # states at which it is tried whether the inputs move what they must not


class DetourPlan(NamedTuple):
    """A plan over T periods."""

    states: Tensor  # of the states that the inputs move, (B, T + 1, p)
    control: Tensor  # (B, T, m)
    total: Tensor  # J, (B,)


class PlanProblem:
    """J of a plan over T periods, and how it is lowered: plant, constraints with their margins, period, T
    and V_T are those of the detours; the inputs move the first p states; ``weight`` is that of squares of
    what is missing."""

    def __init__(self, detours: DetourRollout, cost: QuadraticCost, moved: int, weight: float) -> None:
        self.detours, self.plant, self.cost = detours, detours.plant, cost
        self.hold, self.steps = detours.hold, detours.steps
        self.holding = Holding("DetourDDP", self.plant, None, self.hold)
        self.moved, self.weight = moved, weight

    def improve(self, now: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        """Take one step: the first of a few lengths that lowers J."""
        others, done, *parts = now
        plan = DetourPlan(*parts)
        change, feedback = self._newton(plan, others, done)
        whole = torch.ones_like(plan.total)

        def attempt(now: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
            *before, length, _ = now

            def wanted(y: Tensor, others: Tensor, given: tuple[Tensor, ...], k: Tensor) -> Tensor:
                planned, u, change, feedback = given
                u = u + length.unsqueeze(-1) * change + matvec(feedback, y - planned)
                return self.cost.admissible(u)

            given = plan.states[:, :-1], plan.control, change, feedback
            found = self.follow(plan.states[:, 0], others, done, given, wanted)
            better = found.total < before[2]
            kept = (better[:, None, None], better[:, None, None], better)
            after = [torch.where(w, a, b) for w, a, b in zip(kept, found, before, strict=True)]
            return *after, _SHORTER * length, torch.where(better, 0.0 * length, 1.0)

        found = repeat(_TRIES, attempt, (*plan, whole, whole), where=lambda now: now[-1] > 0)
        return others, done, *found[:3]

    def follow(self, y: Tensor, others: Tensor, done: Tensor, inputs: Any, chosen: Chosen) -> DetourPlan:
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
        return DetourPlan(torch.cat((states, end.unsqueeze(1)), dim=1), control, total)

    def paid(self, x: Tensor, u: Tensor, t: Tensor) -> Tensor:
        """A period's part of J: (B, n), (B, m), (B,) -> (B,)."""
        return self.hold * (self.cost.state_rate(x) + self.cost.input_rate(u) + self.penalty(x, t))

    def longer(self, x: Tensor, u: Tensor) -> Tensor:
        """Return what a last period with u adds to J away from constraints: (B, n), (B, m) -> (B,)."""
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
        """x after a period."""
        return self.holding(x, u)[0]

    def bounds(self, like: Tensor) -> tuple[Tensor, Tensor]:
        """(m,) each; infinite where there are none."""
        if self.cost.bounds is None:
            none = like.new_full((self.cost.inputs,), torch.inf)
            return -none, none
        return self.cost.bounds.low.to(like), self.cost.bounds.high.to(like)

    def penalty(self, x: Tensor, t: Tensor) -> Tensor:
        """weight sum_i max(0, margin_i - h_i)^2: (B, n), (B,) -> (B,)."""
        total = torch.zeros_like(t)
        for h, margin in zip(self.detours.constraints, self.detours.margin.to(x), strict=True):
            short = margin - torch.func.vmap(lambda x, t, h=h: h(x, t)[0])(x.unsqueeze(1), t)
            total = total + torch.where(short > 0, short.square(), 0.0 * short)
        return self.weight * total

    def _newton(self, plan: DetourPlan, others: Tensor, done: Tensor) -> tuple[Tensor, Tensor]:
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
        seen, slope = _along(lambda y: cost.outputs(self.whole(y, others)), y)
        heavy = 2 * self.hold * product(slope.mT, cost.q.to(y).expand(len(y), -1, -1))
        gradient, curvature = self._pressure(y, others, t)
        return gradient + matvec(heavy, cost.error(seen)), curvature + product(heavy, slope)

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

            def level(y: Tensor, others: Tensor, t: Tensor, h: Any = h) -> tuple[Tensor, Tensor]:
                margin_left: Tensor = h(self.whole(y, others).unsqueeze(0), t)[0]
                return margin_left, margin_left

            slope, value = torch.func.vmap(grad(level, has_aux=True))(y, others, t)
            short = (margin - value).unsqueeze(-1)
            heavy = torch.where(short > 0, torch.ones_like(short), 0.0 * short)
            heavy = 2 * self.hold * self.weight * heavy
            gradient = gradient - heavy * short * slope
            curvature = curvature + (heavy * slope).unsqueeze(-1) * slope.unsqueeze(-2)
        return gradient, curvature


def _forward_jacobian(function: Callable[[Tensor], Tensor], z: Tensor) -> tuple[Tensor, Tensor]:
    """A function's value (B, q) and its slopes along all coordinates of z (B, d): (B, q, d)."""
    use_forward_mode()
    units = torch.eye(z.shape[-1], dtype=z.dtype, device=z.device)
    found = [torch.func.jvp(function, (z,), (unit.expand_as(z).clone(),)) for unit in units]
    return found[0][0], torch.stack([one[1] for one in found], dim=-1)


# A program is shorter forward; in plain torch a product with a number takes thirty times as long so.
_along = traced_as(_forward_jacobian)(row_jacobian)


class CarriedPlan(NamedTuple):
    """Carried state of `DetourPlans`."""

    control: Tensor  # (B, T, m)
    expected: Tensor  # J of it, (B, 1)
    done: Tensor  # periods since the beginning, (B, 1)


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
        >>> there = {"axes": [[1.0, 0.0]], "steps": 6, "terminal": lqr.value, "sizes": [0.5], "lengths": [3]}
        >>> ahead = adp.DetourRollout(lqr, plant, cost, wall, dt=0.1, **there)
        >>> plans, x0 = adp.DetourPlans(ahead), torch.tensor([[1.0, 0.0]]).double()
        >>> run = adp.simulate(plans, plant, cost, x0, steps=1)
        >>> run.control.shape
        torch.Size([1, 2, 1])

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

    work = 300.0

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
        self._problem = PlanProblem(detours, cost, self.moved, self.weight)
        self._check_others()

    def init(self, x0: Tensor) -> CarriedPlan:
        """The best of the first plans from the states x0 (B, n), some 200 of each."""
        x0 = trailing(type(self).__name__, "x0", x0, 2).to(self.detours.margin.dtype)
        count, starts = len(x0), self._starts(x0)
        x, found = x0.repeat(len(starts), 1), starts.flatten(0, 1).flatten(1)
        for _ in range(self.first):
            improved = self._first_plan(torch.cat((x, found), dim=-1))
            found = improved[:, 1:]
        found = improved.unflatten(0, (len(starts), count))
        total = torch.where(torch.isfinite(found[..., 0]), found[..., 0], torch.inf)
        best = found[total.argmin(0), torch.arange(count, device=x0.device), 1:]
        expected, done = x0.new_full((count, 1), torch.inf), x0.new_zeros(count, 1)
        return CarriedPlan(best.unflatten(-1, (self.steps, -1)), expected, done)

    def step(self, x: Tensor, carried: CarriedPlan, uniform: Tensor, dt: float) -> tuple[Tensor, CarriedPlan]:
        if dt != self.hold:
            raise fail("DetourPlans", "dt", f"must be that of the loop, {dt:g} s", self.hold)
        control = carried.control
        at = trailing("DetourPlans.step", "x", x, 2).to(self.detours.margin.dtype)
        found = self._next(torch.cat((at, control.flatten(1), carried.expected, carried.done), dim=-1))
        u, ahead, *rest = found.split((control.shape[-1], control[0].numel(), 1, 1), dim=-1)
        return u.to(x.dtype), CarriedPlan(ahead.unflatten(-1, control.shape[1:]), *rest)

    def _check_others(self) -> None:
        """Raise where the moved states or the inputs change how another state moves."""
        x, other = torch.randn(
            2,
            _PROBES,
            self.cost.dim,
            dtype=torch.float64,
            generator=torch.Generator().manual_seed(0),
            device="cpu",
        ).unbind(0)
        at_rest = self.plant.resting_input()
        x, other = x.to(at_rest.device), other.to(at_rest.device)
        rest = at_rest.double().expand(_PROBES, -1)
        other = torch.cat((other[:, : self.moved], x[:, self.moved :]), dim=-1)
        own, changed = self.plant.velocity(x, rest), self.plant.velocity(other, rest + 1)
        if not torch.equal(own[:, self.moved :], changed[:, self.moved :]):
            raise fail("DetourPlans", "moved", "must count every state that the inputs move", self.moved)

    def _starts(self, x0: Tensor) -> Tensor:
        """First controls: the policy's, of every detour, and of shares of the bounds held: (S, B, T, m)."""
        fresh = self.detours.fresh.to(x0)
        tried = torch.cat((torch.zeros_like(fresh[:1]), fresh)).repeat_interleave(len(x0), 0)
        x = x0.repeat(len(fresh) + 1, 1)
        others, done = self._problem.others(x), torch.zeros_like(x[:, :1])
        followed = self._followed(x[:, : self.moved], others, tried, done).control
        starts: Tensor = followed.unflatten(0, (len(fresh) + 1, len(x0)))
        if self.cost.bounds is None:
            return starts
        low, high = self._problem.bounds(x0)
        levels = torch.stack((torch.zeros_like(low), low, high))
        levels = torch.where(torch.isfinite(levels), levels, 0.0)
        ways = torch.cartesian_prod(*levels.unbind(-1)).reshape(-1, len(low))
        held = []
        for length in _LENGTHS:
            for u in torch.cat([share * ways for share in _SHARES]):
                held.append(starts[0].clone())
                held[-1][:, :length] = u
        return torch.cat((starts, torch.stack(held)))

    @compiled("first plans around what moves")
    def _first_plan(self, z: Tensor) -> Tensor:
        """Return J and the controls after one step, from rows of (x, controls)."""
        x, control = z.split((self.cost.dim, z.shape[-1] - self.cost.dim), dim=-1)
        _, _, _, control, total = self._improved(x, control, torch.zeros_like(x[:, :1]), 1)
        return torch.cat((total.unsqueeze(-1), control.flatten(1)), dim=-1)

    @compiled("a plan around what moves")
    def _next(self, z: Tensor) -> Tensor:
        """Return the control and the next carried numbers, from rows of (x, controls, J, periods)."""
        flat = z.reshape(-1, z.shape[-1])
        n, problem = self.cost.dim, self._problem
        x, control, expected, done = flat.split((n, flat.shape[-1] - n - 2, 1, 1), dim=-1)
        others, plan = self._kept(x, control, expected[:, 0], done)
        first, end = plan.control[:, 0], problem.whole(plan.states[:, -1], others[:, -1])
        last = self.cost.admissible(self.detours.policy(end))
        ahead = torch.cat((plan.control[:, 1:], last.unsqueeze(1)), dim=1)
        left = plan.total - problem.paid(x, first, done[:, 0] * self.hold) + problem.longer(end, last)
        after = torch.cat((first, ahead.flatten(1), left.unsqueeze(-1), done + 1), dim=-1)
        return after.reshape(*z.shape[:-1], -1)

    def _kept(self, x: Tensor, control: Tensor, expected: Tensor, done: Tensor) -> tuple[Tensor, DetourPlan]:
        """Others, and the best plan: the improved one, or a detour where that costs more than expected."""
        problem = self._problem
        others, y = problem.others(x), x[:, : self.moved]
        given = control.unflatten(-1, (self.steps, -1))
        carried = problem.follow(y, others, done, given, lambda y, others, u, k: u)

        def begin(now: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
            x, k = now[3:]  # in the carry: what a pass reads from outside is computed in any case
            none = x.new_zeros(len(x), self.detours.fresh.shape[1])
            tried = self.detours.cheapest(x, none, done)
            return *self._followed(x[:, : self.moved], others, tried, done), x, k

        def attempt(now: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
            best, plan, k = now[:3], now[3:6], now[6]
            plan = repeat(1, begin, (*plan, x, k), where=lambda now: now[-1] == 1)[:3]
            plan = repeat(self.iterations, problem.improve, (others, done, *plan))[2:5]
            better = plan[2] < torch.where(k == 0, torch.inf, best[2])
            kept = (better[:, None, None], better[:, None, None], better)
            best = tuple(torch.where(w, a, b) for w, a, b in zip(kept, plan, best, strict=True))
            worse = best[2] > expected + _WORSE * expected.abs()
            return *best, *plan, k + 1, torch.where(worse, 1.0, 0.0 * k)

        none = torch.zeros_like(expected)
        found = repeat(
            1 + _FRESH, attempt, (*carried, *carried, none, none + 1), where=lambda now: now[-1] > 0
        )
        return others, DetourPlan(*found[:3])

    def _improved(self, x: Tensor, control: Tensor, done: Tensor, count: int) -> tuple[Tensor, ...]:
        """Others, periods so far, and the plan after so many steps of Gauss and Newton."""
        others = self._problem.others(x)
        given = control.unflatten(-1, (self.steps, -1))
        plan = self._problem.follow(x[:, : self.moved], others, done, given, lambda y, others, u, k: u)
        found: tuple[Tensor, ...] = repeat(count, self._problem.improve, (others, done, *plan))
        return found

    def _followed(self, y: Tensor, others: Tensor, tried: Tensor, done: Tensor) -> DetourPlan:
        """Follow a detour (B, k + 1)."""

        def wanted(y: Tensor, others: Tensor, _: Tensor, k: Tensor) -> Tensor:
            x = self._problem.whole(y, others).unsqueeze(1)
            return self.detours.control_along(x, tried.unsqueeze(1), k.unsqueeze(1))[:, 0]

        return self._problem.follow(y, others, done, y.new_zeros(len(y), self.steps), wanted)

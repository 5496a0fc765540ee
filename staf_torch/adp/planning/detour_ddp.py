"""Plans around what moves: the best of many detours at the start, then improved at every control."""

from __future__ import annotations

import torch
from torch import Tensor

from ...lanes import repeat
from ...lanes.function import RowFunction
from ...numerics.box import LARGEST
from ...numerics.checks import fail, integer, positive_real
from ..loop.controller import Controller, ControllerState, carrying
from ..problem.cost import QuadraticCost
from .detour_rollout import DetourRollout
from .plan_problem import Plan, PlanProblem

_LENGTHS, _SHARES = (5, 15, 40), (0.3, 1.0)  # periods for which shares of the bounds are held, as starts
_WORSE = 0.02  # share of J by which a carried plan may cost more than a period ago was expected
_FRESH = 2  # rounds of iterations that a detour gets to be better than such a plan
_PROBES = 8  # states at which it is tried whether the inputs move what they must not


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
        >>> there = {"axes": [[1.0, 0.0]], "steps": 12, "terminal": lqr.value, "sizes": [0.5], "lengths": [6]}
        >>> ahead = adp.DetourRollout(lqr, plant, cost, wall, dt=0.1, **there)
        >>> plans, x0 = adp.DetourPlans(ahead), torch.tensor([[1.0, 0.0]]).double()
        >>> run = adp.simulate(plans, plant, cost, x0, steps=2)
        >>> run.control.shape
        torch.Size([1, 3, 1])

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
        self._rows = RowFunction(self._definition, self, "a plan around what moves")
        self._begun = RowFunction(self._first_plan, self, "first plans around what moves")

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
        expected, done = x0.new_full((count, 1), torch.inf), x0.new_zeros(count, 1)
        return carrying(torch.cat((best, expected, done), dim=-1))  # the plan, its J, the periods so far

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

    def _first_plan(self, z: Tensor) -> Tensor:
        """Of rows of (x, controls) J and the controls of the plan after one step."""
        x, control = z.split((self.cost.dim, z.shape[-1] - self.cost.dim), dim=-1)
        _, _, _, control, total = self._improved(x, control, torch.zeros_like(x[:, :1]), 1)
        return torch.cat((total.unsqueeze(-1), control.flatten(1)), dim=-1)

    def _definition(self, z: Tensor) -> Tensor:
        """Of rows of (x, controls, J expected, periods so far) the control, and these for the next period."""
        flat = z.reshape(-1, z.shape[-1])
        n, problem = self.cost.dim, self._problem
        x, control, expected, done = flat.split((n, flat.shape[-1] - n - 2, 1, 1), dim=-1)
        others, plan = self._kept(x, control, expected[:, 0], done)
        first, end = plan.control[:, 0], problem.whole(plan.states[:, -1], others[:, -1])
        last = problem.clipped(self.detours.policy(end))
        ahead = torch.cat((plan.control[:, 1:], last.unsqueeze(1)), dim=1)
        left = plan.total - problem.paid(x, first, done[:, 0] * self.hold) + problem.longer(end, last)
        after = torch.cat((first, ahead.flatten(1), left.unsqueeze(-1), done + 1), dim=-1)
        return after.reshape(*z.shape[:-1], -1)

    def _kept(self, x: Tensor, control: Tensor, expected: Tensor, done: Tensor) -> tuple[Tensor, Plan]:
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
        return others, Plan(*found[:3])

    def _improved(self, x: Tensor, control: Tensor, done: Tensor, count: int) -> tuple[Tensor, ...]:
        """Others, periods so far, and the plan after so many steps of Gauss and Newton."""
        others = self._problem.others(x)
        given = control.unflatten(-1, (self.steps, -1))
        plan = self._problem.follow(x[:, : self.moved], others, done, given, lambda y, others, u, k: u)
        found: tuple[Tensor, ...] = repeat(count, self._problem.improve, (others, done, *plan))
        return found

    def _followed(self, y: Tensor, others: Tensor, tried: Tensor, done: Tensor) -> Plan:
        """What a detour (B, k + 1) does."""

        def wanted(y: Tensor, others: Tensor, _: Tensor, k: Tensor) -> Tensor:
            x = self._problem.whole(y, others).unsqueeze(1)
            return self.detours.control_along(x, tried.unsqueeze(1), k.unsqueeze(1))[:, 0]

        return self._problem.follow(y, others, done, y.new_zeros(len(y), self.steps), wanted)

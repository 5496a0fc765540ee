"""Sets that must not be entered: in the cost, a penalty or a log barrier; ahead of a policy, detours."""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Callable, Sequence
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor

from ...lanes import compiled, each, repeat
from ...lanes.per_row.objects import made_by_rows
from ...lanes.row_numbers import all_rows, over_rows, points_of_rows
from ...numerics.checks import (
    choice,
    fail,
    hold,
    integer,
    non_negative,
    object_of,
    one_or_each,
    positive,
    positive_real,
    trailing,
    vector,
)
from ...numerics.default_device import device_of
from ...numerics.linalg import Matrix
from ...numerics.rows import check_rows
from ...signs import Sign
from ...systems import Plant
from ..loop.controller import Controller, Policy, Value
from ..problem.cost import Cost, QuadraticCost
from ..problem.held_plant import Holding
from ..problem.rules import check_objects, state_of
from ..problem.sampled import SampledProblem
from ..safety.conditions import Constraint, check_traceable, listed
from .ddp import BoxDDP
from .trajectories import Reference, Trajectories, chosen, rows_of

Obstacle = Callable[[Tensor], Tensor]
"""h(x), at least 0 outside: (..., n) -> (...)."""
_EDGE = 0.01  # of the reach, below which the rate goes on as its second-order expansion: finite inside too;
# times the root of the share to which a weight shrinks, so that the slope there stays steep
_AXES = 4  # at most: their combinations are 3^k - 1
_AROUND = (0.2, 0.07)  # by which the detour of the period before is varied, in units of the axes


class AvoidanceCost(QuadraticCost):
    """x'Qx + u'Ru + weight sum_i P(h_i(x) / reach), with P(q) = 0 for q >= 1 and else

        P(q) = (1/q - 1)^2 (``penalty``)  or  P(q) = log(q)^2 (``log``).

    With h = |x - z|^2 - r_a^2 and reach = r_d^2 - r_a^2 the first is the penalty of the avoidance papers,
    ( min{0, (|x - z|^2 - r_d^2) / (|x - z|^2 - r_a^2)} )^2, r_a and r_d the radii of avoidance and
    detection. Both grow beyond all bounds towards the edge, up to 1 % of the reach, from where they go on as
    a parabola: a search may begin with a collision. Nothing keeps a policy out but what it costs.

    Example:
        >>> cost = adp.AvoidanceCost(1.0, 1.0, dim=2, inputs=1, obstacles=lambda x: x[..., 0] + 1, reach=0.5)
        >>> cost.state_rate(torch.tensor([[0.0, 0.0], [-0.75, 0.0]]).double())  # (2 - 1)^2 at half the reach
        tensor([0.0000, 1.5625], dtype=torch.float64)

        Shown by `staf_torch/adp/README.md`.

    Args:
        obstacles: h, or a list of them.
        reach: in units of h, positive: nothing is paid from there on. The set-point must be that far away.
        weight: positive.
        kind: ``penalty`` or ``log``.
        state, control, dim, inputs: as in `QuadraticCost`, and so is what else is given by name.

    Raises:
        ValueError: if an argument breaks its rule.

    Source: Deptula, Chen, Licitra, Rosenfeld, Dixon, IEEE T-RO 36 (2020).
    """

    rowwise: ClassVar = {"penalty": (0,), "outside": (1,)}

    def __init__(
        self,
        state: Matrix,
        control: Matrix,
        dim: int,
        inputs: int,
        *,
        obstacles: Obstacle | Sequence[Obstacle],
        reach: float,
        weight: float = 1.0,
        kind: str = "penalty",
        **more: object,
    ) -> None:
        super().__init__(state, control, dim, inputs, **more)  # type: ignore[arg-type]
        self.obstacles = [obstacles] if callable(obstacles) else list(obstacles)
        if not self.obstacles or not all(map(callable, self.obstacles)):
            raise fail("AvoidanceCost", "obstacles", "must be h(x) or a list of them", obstacles)
        for k, h in enumerate(self.obstacles):
            what = f"AvoidanceCost(obstacles=...)` number {k} `h(x)"
            check_rows(what, h, [state_of(self)], sizes=(inputs, len(self.obstacles)))
        self.reach = positive_real("AvoidanceCost", "reach", reach)
        self.kind = choice("AvoidanceCost", "kind", kind, ("penalty", "log"))
        heavy = positive_real("AvoidanceCost", "weight", weight)
        self.weight = hold(self, "weight", self.q.new_tensor(heavy))
        self.edge = hold(self, "edge", self.q.new_tensor(_EDGE))

    def state_rate(self, x: Tensor) -> Tensor:
        """e'Qe and what the obstacles add: (..., n) -> (...)."""
        paid = super().state_rate(x)
        for h in self.obstacles:
            paid = paid + self.weight.to(x) * self.penalty(h(x))
        return paid

    def penalty(self, h: Tensor) -> Tensor:
        """P(h / reach)."""
        q = h / self.reach
        edge = self.edge.to(h)
        near = torch.where(q < edge, edge, torch.where(q > 1, 1.0, q))
        if self.kind == "log":
            log = near.log()
            value, slope, bend = log.square(), 2 * log / near, 2 * (1 - log) / near.square()
        else:
            value, slope = (1 / near - 1).square(), 2 * (near - 1) / near**3
            bend = (6 - 4 * near) / near**4
        beyond = q - edge
        return torch.where(q < edge, value + slope * beyond + 0.5 * bend * beyond.square(), value)

    def outside(self, x: Tensor) -> Tensor:
        """The smallest h over the obstacles: (..., n) -> (...)."""
        return torch.stack([h(x) for h in self.obstacles], dim=-1).amin(-1)


class AvoidancePlans(NamedTuple):
    """Plans around obstacles."""

    trajectories: Trajectories  # a row a start
    cost: Tensor  # (B,) of x'Qx + u'Ru alone; inf where every plan touches an obstacle
    margin: Tensor  # (B,) the smallest h at the times of the plan

    def or_cheaper(self, other: AvoidancePlans) -> AvoidancePlans:
        """The cheaper plan of every row; of two that touch an obstacle the other one."""
        kept = self.cost < other.cost
        trajectories = chosen(kept, self.trajectories, other.trajectories)
        return AvoidancePlans(trajectories, *chosen(kept, self[1:], other[1:]))


@Sign("plan_around")
def plan_around(
    plant: Plant,
    cost: AvoidanceCost,
    x0: Tensor,
    *,
    dt: float,
    steps: int,
    shrink: Sequence[float] = (1.0, 0.1, 0.01, 1e-3, 1e-4),
    iterations: int = 40,
    compile: bool = True,
) -> AvoidancePlans:
    """Optimal plans that keep out of the obstacles, by an interior path: `BoxDDP` with weights that shrink.

    Each start is tried from the goal's linear feedback with every combination of bounds held for a quarter of
    the time, so that both ways around an obstacle are among the guesses; the cheapest plan of any guess and
    weight that keeps h >= 0 at all of its times is the result: with a small weight a plan may dip into an
    obstacle by a hair. Nothing is chosen by the start.

    Example:
        >>> plant = systems.Linear([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])
        >>> slow = {"obstacles": lambda x: x[..., 1] + 0.4, "reach": 0.3, "kind": "log"}
        >>> cost = adp.AvoidanceCost(1.0, 1.0, dim=2, inputs=1, low=-1.0, high=1.0, **slow)
        >>> x0 = torch.tensor([[1.0, 0.0]]).double()
        >>> few = {"steps": 6, "shrink": [1.0], "iterations": 3, "compile": False}
        >>> found = adp.plan_around(plant, cost, x0, dt=0.3, **few)
        >>> found.trajectories.state.shape, bool(found.margin > 0)
        (torch.Size([1, 7, 2]), True)

        Shown by `staf_torch/adp/README.md`.

    Args:
        plant: as in `SampledProblem.of`.
        cost: with the obstacles, its weight the first one; bounds in the cost or the plant.
        x0: (B, n).
        dt: s.
        steps: of the plan; the value of the goal's linear feedback stands at its end.
        shrink: shares of the weight, one after the other.
        iterations: of each, at most.
        compile: as in `BoxDDP`.

    Raises:
        ValueError: if an argument breaks its rule.
    """
    check_objects("plan_around", plant=plant, cost=cost)
    object_of("plan_around", AvoidanceCost, cost=cost)
    integer("plan_around", "steps", steps, least=4)
    if not len(shrink):
        raise fail("plan_around", "shrink", "must have at least one share", shrink)
    cost = copy.deepcopy(cost)  # its weight is going to change
    weight = all_rows(cost.weight)
    first = weight.clone()
    free = QuadraticCost(cost.q, cost.r, cost.dim, cost.inputs)
    problem = SampledProblem.of(plant, cost, dt=dt)
    ways = made_by_rows(problem.levels)
    count, pushed = len(ways), torch.arange(steps, device=x0.device) < steps // 4

    def guesses(x: Tensor) -> tuple[Tensor, ...]:
        away = torch.where(pushed[:, None], (ways - problem.rest).unsqueeze(1), 0.0)
        many = len(x), count, steps
        goal, gains = problem.goal.expand(*many, -1), (-problem.k).expand(*many, -1, -1)
        return (problem.rest + away).expand(*many, -1), goal, gains

    rows = x0.repeat_interleave(count, dim=0)
    control, *along = (part.flatten(0, 1) for part in over_rows(guesses, x0))
    around = Reference(*along)
    bare = SampledProblem.of(plant, free, dt=dt, low=problem.bounds.low, high=problem.bounds.high)
    best: AvoidancePlans | None = None
    with points_of_rows(len(x0), count):
        for share in shrink:
            weight.copy_(first * positive_real("plan_around", "shrink", share))
            cost.edge.fill_(_EDGE * math.sqrt(share))
            search = BoxDDP(problem, steps=steps, iterations=iterations, compile=compile)
            found = search.solve(rows, control, around)
            control, around = found.control, Reference(found.state[:, :-1], found.feedback)
            _, paid = bare.advance(found.state[:, :-1], found.control)
            total = paid.sum(1) + bare.terminal(found.state[:, -1])
            margin = cost.outside(found.state).amin(-1)
            total = torch.where((margin >= 0) & torch.isfinite(total), total, torch.inf)
            now = AvoidancePlans(found, total, margin)
            best = now if best is None else best.or_cheaper(now)
    assert best is not None
    chosen = best.cost.reshape(len(x0), -1).argmin(-1) + torch.arange(len(x0), device=x0.device) * count
    return AvoidancePlans(rows_of(best.trajectories, chosen), best.cost[chosen], best.margin[chosen])


class Detour(NamedTuple):
    """Carried state of a `DetourRollout`."""

    way: Tensor  # along each axis, and for how many periods, (B, k + 1)
    done: Tensor  # periods since the beginning, (B, 1)


class DetourRollout(Controller):
    """u = policy(x - s) with the detour (s, L) of the least

        J = sum of the costs of policy(x - s) for L periods and of policy(x) after them, over the horizon,
            + V_T where that ends + weight * integral of sum_i max(0, margin_i - h_i(x, t)).

    A safety filter alone gives way to what moves when it must, and may brake in front of a disc that it could
    have passed, or be driven on by it. This one chooses the side, by making for another place for a while.
    Where the policy keeps every h_i >= margin_i over the horizon it has the control, bit for bit, and nothing
    is compared. Else the candidates are the policy, detours of each size and length along every combination
    of the axes, the detour of the period before, one period shorter, and small changes of that one: what was
    found is kept and improved. J is a model's word, with constraints at the ends of the rollout's steps
    alone: put a `SafetyFilter` around it.

    Example:
        >>> plant = systems.Linear([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])
        >>> cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1, low=-1.0, high=1.0)
        >>> lqr = adp.LQR(plant, cost, period=0.1)
        >>> wall = [lambda x, t: x[:, 0] + 0.1]
        >>> there = {"axes": [[1.0, 0.0]], "steps": 20, "terminal": lqr.value}
        >>> ahead = adp.DetourRollout(lqr, plant, cost, wall, dt=0.1, **there)
        >>> safe = adp.SafetyFilter(ahead, plant, wall, dt=0.1, low=-1.0, high=1.0)
        >>> run = adp.simulate(safe, plant, cost, torch.tensor([[2.0, -1.0]]).double(), steps=5)
        >>> safe.report(run)["constraint_violations"]
        0

        Shown by `staf_torch/adp/README.md`.

    Args:
        policy: u from x, (..., n) -> (..., m).
        plant: in continuous time: the model.
        cost: the cost rate; its bounds, if any, clip u.
        constraints: h(x, t), or a list of them, as in `SafetyFilter`.
        axes: (k, n), along which the goal may be displaced, k at most 4: s is a combination of them.
        dt: s, for which a control is held.
        steps: periods in the horizon, a multiple of ``stride``.
        terminal: V_T, (..., n) -> (...): of the policy where nothing is in its way.
        margin: in units of h, one number or one a constraint.
        weight: of what is missing of the margins, in units of the cost a unit of h and second, positive.
        sizes: of detours, in units of the axes, positive.
        lengths: of detours, in periods.
        stride: periods of a step of the rollouts, which integrate the plant over that long at once.

    Raises:
        ValueError: if an argument breaks its rule.

    Source: Bertsekas, "Rollout, Policy Iteration, and Distributed Reinforcement Learning" (2020), ch. 2, for
    the improvement of a policy by rollouts of few candidates.
    """

    work = 50.0

    def __init__(
        self,
        policy: Policy,
        plant: Plant,
        cost: Cost,
        constraints: Constraint | Sequence[Constraint],
        *,
        axes: Tensor | Sequence[Sequence[float]],
        dt: float,
        steps: int,
        terminal: Value,
        margin: float | Sequence[float] = 0.0,
        weight: float = 1e5,
        sizes: Sequence[float] = (0.3, 0.6, 1.0, 1.5),
        lengths: Sequence[int] = (3, 6, 12, 20, 30),
        stride: int = 1,
    ) -> None:
        super().__init__()
        check_objects("DetourRollout", plant=plant, cost=cost)
        check_traceable("DetourRollout", plant)
        self.policy, self.plant, self.terminal, self.cost = policy, plant, terminal, cost.around(plant)
        self.constraints = listed("DetourRollout", constraints, plant)
        along = torch.as_tensor(axes, dtype=torch.float64, device=getattr(axes, "device", "cpu"))
        fits = along.dim() == 2 and along.shape[1] == cost.dim and 1 <= len(along) <= _AXES
        if not fits or not bool(torch.isfinite(along).all()):
            raise fail(
                "DetourRollout", "axes", f"must be 1 to {_AXES} rows of {cost.dim} finite numbers", axes
            )
        self.period = self.hold = positive_real("DetourRollout", "dt", dt)
        self.stride = integer("DetourRollout", "stride", stride, least=1)
        self.steps = integer("DetourRollout", "steps", steps, least=1)
        if self.steps % self.stride:
            raise fail("DetourRollout", "steps", f"must be a multiple of stride={self.stride}", steps)
        kept = one_or_each("DetourRollout", "margin", margin, len(self.constraints))
        non_negative("DetourRollout", "margin", kept)
        self.weight = positive_real("DetourRollout", "weight", weight)
        large = torch.tensor(vector("DetourRollout", "sizes", list(sizes)), dtype=torch.float64, device="cpu")
        positive("DetourRollout", "sizes", large)
        long = [integer("DetourRollout", "lengths", length, least=1) for length in lengths]
        device = device_of(plant)
        self.axes = hold(self, "axes", along.clone().to(device))  # (k, n)
        self.margin = hold(self, "margin", kept.to(device))
        self.register_buffer("fresh", _detours(len(along), large, long).to(device))
        self.changes = hold(self, "changes", _changes(len(along)).to(device))  # (C, k + 1)
        self.fresh: Tensor  # (P, k + 1), the length last
        self.holding = Holding("DetourRollout", plant, self.cost, self.stride * self.hold)

    def init(self, x0: Tensor) -> Detour:
        x0 = trailing(type(self).__name__, "x0", x0, 2).to(self.margin.dtype)
        return Detour(x0.new_zeros(len(x0), len(self.axes) + 1), x0.new_zeros(len(x0), 1))

    def step(self, x: Tensor, carried: Detour, uniform: Tensor, dt: float) -> tuple[Tensor, Detour]:
        if dt != self.hold:
            raise fail("DetourRollout", "dt", f"must be that of the loop, {dt:g} s", self.hold)
        at = trailing("DetourRollout.step", "x", x, 2).to(self.margin.dtype)
        found = self._chosen(torch.cat((at, *carried), dim=-1))
        u, way, done = found.split((self.plant.inputs, carried.way.shape[-1], 1), dim=-1)
        return u.to(x.dtype), Detour(way, done)

    @compiled("a choice of detours")
    def _chosen(self, z: Tensor) -> Tensor:
        """Return the control and the next carried numbers, from rows of (x, detour, periods so far)."""
        k = len(self.axes)
        flat = z.reshape(-1, z.shape[-1])
        x, before, done = flat.split((flat.shape[-1] - k - 2, k + 1, 1), dim=-1)
        none = torch.zeros_like(before)
        _, missing = self._paid(x.unsqueeze(1), none.unsqueeze(1), done)
        start = x, before, done, none, missing[:, 0] > 0

        def compare(now: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
            x, before, done, _, going = now
            return x, before, done, self.cheapest(x, before, done), going

        chosen = repeat(1, compare, start, where=lambda now: now[4])[3]
        u = self.control_along(x, chosen, torch.zeros_like(done[:, 0]))
        left = torch.where(chosen[:, k:] > 1, chosen[:, k:] - 1, 0.0)
        return torch.cat((u, chosen[:, :k], left, done + 1), dim=-1).reshape(*z.shape[:-1], -1)

    def cheapest(self, x: Tensor, before: Tensor, done: Tensor) -> Tensor:
        """The detour of the least J: (B, n), (B, k + 1), (B, 1) -> (B, k + 1); the policy alone first."""
        known = before.unsqueeze(1) + self.changes.to(x)
        fresh = self.fresh.to(x).expand(len(x), -1, -1)
        tried = torch.cat((torch.zeros_like(before).unsqueeze(1), known, fresh), dim=1)

        def total_of(tried: Tensor) -> Tensor:
            paid, missing = self._paid(x.unsqueeze(1).expand(-1, tried.shape[1], -1), tried, done)
            return (paid + self.weight * missing).unsqueeze(-1)

        total = each(total_of, tried, together=1).squeeze(-1)
        total = torch.where(torch.isfinite(total), total, torch.inf)
        place = torch.arange(tried.shape[1], dtype=x.dtype, device=x.device)
        first = torch.where(total == total.amin(-1, keepdim=True), place, float(len(place))).amin(-1)
        return torch.where((place == first.unsqueeze(-1)).unsqueeze(-1), tried, 0.0).sum(1)

    def _paid(self, x: Tensor, tried: Tensor, done: Tensor) -> tuple[Tensor, Tensor]:
        """Cost with V_T, and the integral of what is missing: (B, C, n), (B, C, k + 1), (B, 1) -> (B, C)."""
        step_time = self.stride * self.hold

        def step(now: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
            x, k, spent, missing = now
            after, paid = self.holding(x, self.control_along(x, tried, k))
            k = k + self.stride
            short = self._missing(after, (done + k) * self.hold)
            return after, k, spent + paid, missing + step_time * short

        none = torch.zeros_like(x[..., 0])
        x, _, spent, missing = repeat(self.steps // self.stride, step, (x, none, none, none))
        return spent + self.terminal(x), missing

    def control_along(self, x: Tensor, tried: Tensor, k: Tensor) -> Tensor:
        """The control k periods on: the policy's own where the detour is over."""
        s = (tried[..., :-1].unsqueeze(-1) * self.axes.to(x)).sum(-2)
        u = self.policy(torch.where((k < tried[..., -1]).unsqueeze(-1), x - s, x))
        return self.cost.admissible(u)

    def _missing(self, x: Tensor, t: Tensor) -> Tensor:
        """sum_i max(0, margin_i - h_i): (B, C, n), (B, C) -> (B, C)."""
        rows, times = x.reshape(-1, x.shape[-1]), t.reshape(-1)
        total = torch.zeros_like(times)
        for h, margin in zip(self.constraints, self.margin.to(x), strict=True):
            short = margin - torch.func.vmap(lambda x, t, h=h: h(x, t)[0])(rows.unsqueeze(1), times)
            total = total + torch.where(short > 0, short, 0.0)
        return total.reshape(t.shape)


def _detours(count: int, sizes: Tensor, lengths: Sequence[int]) -> Tensor:
    """Detours along all combinations of axes, of each size and length: (P, count + 1)."""
    ways = torch.tensor(
        [way for way in itertools.product((0.0, 1.0, -1.0), repeat=count) if any(way)],
        dtype=torch.float64,
        device="cpu",
    )
    ways = ways / ways.norm(dim=-1, keepdim=True)
    rows = [
        torch.cat((size * ways, ways.new_full((len(ways), 1), length)), dim=-1)
        for size, length in itertools.product(sizes, lengths)
    ]
    return torch.cat(rows)


def _changes(count: int) -> Tensor:
    """Return no change, and small changes of a detour along each axis: (C, count + 1)."""
    unit = torch.eye(count, count + 1, dtype=torch.float64, device="cpu")
    steps = [sign * share * unit for share in _AROUND for sign in (1.0, -1.0)]
    return torch.cat((torch.zeros(1, count + 1, dtype=torch.float64, device="cpu"), *steps))

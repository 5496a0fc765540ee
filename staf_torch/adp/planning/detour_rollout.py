"""A policy that looks ahead where constraints are in its way: detours, compared by rollouts."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ...lanes import compiled, each, repeat
from ...numerics.checks import (
    fail,
    hold,
    integer,
    non_negative,
    one_or_each,
    positive,
    positive_real,
    trailing,
    vector,
)
from ...numerics.default_device import device_of
from ...systems import Plant
from ..loop.controller import Controller, Policy, Value
from ..problem.cost import Cost
from ..problem.held_plant import Holding
from ..problem.rules import check_objects
from ..safety.conditions import Constraint, check_traceable, listed

_AXES = 4  # at most: their combinations are 3^k - 1
_AROUND = (0.2, 0.07)  # by which the detour of the period before is varied, in units of the axes


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

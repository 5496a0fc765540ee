"""A policy held for a period and improved by rollouts; a feedback followed through a simulator in NumPy."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ...approximation.basis import StaFBasis
from ...lanes import compiled, each, repeat, scan
from ...lanes.gradients import defer_gradient, marked
from ...lanes.per_row.objects import Rowwise
from ...lanes.trace.loops import repeat_counted
from ...numerics.box import LARGEST, box_minimum
from ...numerics.checks import fail, hold, integer, positive_real, trailing
from ...numerics.default_device import KeptPrecision, beside, device_of
from ...systems import Bounds, Plant, StepPlant
from ...systems.black_box import Numbers
from ..loop.controller import LQR, Policy, Value
from ..problem.cost import Cost, QuadraticCost, matvec
from ..problem.held_plant import Holding
from ..problem.rules import check_policy, check_problem, check_value
from .rollout import fitted_slope

_SHARES = (1.0, 0.3)  # of the Newton step, that are tried
_PROBE = 1e-3  # of the range of an input, or of 1, by which it is moved to find slopes
_SHORTER = 0.75  # of the horizon, at which the promise of a control must hold as well
_MARGIN = 1e-9  # relative, by which a control must be better than the base's


RolloutStretch = tuple[Tensor, Tensor, Tensor]
"""The state, what was paid, and what a cost still counts."""


class Promise(NamedTuple):
    """Costs that rollouts of the base promise."""

    whole: Tensor  # cost over the horizon and V_T at its end, (...)
    part: Tensor  # likewise over three quarters of it
    free: Tensor  # (...) bool: no bound holds the base's control at the end, so that V_T can be believed


class Along(NamedTuple):
    """A basis of the inputs, around which nothing changes with the state."""

    places: Tensor  # z of the centers, (M, m)
    weights: Tensor  # dV^/dz at 0 is these times the values at the centers, (m, M)
    middle: int | None  # the center at z = 0


class SampledRollout(KeptPrecision, metaclass=Rowwise):
    """u(x) = the best of u_b and u_b + s d, s in {1, 0.3}, by what a simulation of each costs:

        Q(x, u) = cost of holding u for one period + sum of the base's costs over the horizon + V_T,
        d = argmin over the box of (r_u + B'grad V^)'d + d'(R + B'P B) d,

    where u_b is the base policy's control, B = dx+/du, and V^ interpolates, at M centers around the state
    after one period, the cost of the base from there. The fit proposes; the comparison on rollouts of the
    same length decides, state by state: a control that does not promise less than the base's, both over the
    horizon and over three quarters of it (where V_T is wrong the two disagree), is not applied, nor is one
    after which the base still ends at a bound. Slopes in u are central differences, so that a simulator in
    NumPy will do. V^ may live along the inputs alone: with a basis of m coordinates z the centers are the
    states x + sum_j z_j B_j / |B_j|, with B_j the columns of B, since B'grad V^ is all of grad V^ that d
    takes. These are 2 m + 1 simulations in place of 2 n + 1.

    Differences of costs decide, which float32 does not hold: states of float32 are computed with in float64,
    the controls are float32, and `.float()` rounds none of its numbers.

    Args:
        basis: kernel and centers, of the n states or of the m inputs; of the latter it is read once, here.
        plant: in continuous or in discrete time, of at most 4 inputs.
        cost: the cost rate.
        base: the base policy, (..., n) -> (..., m).
        terminal: V_T, (..., n) -> (...): the value of the base at the end of a rollout.
        metric: P, (n, n), positive semidefinite, of the step's length: that of the LQR.
        period: s, for which a control is held.
        steps: periods in the horizon, at least 4.
        substeps: integration steps a period of a plant in continuous time; None for as many as `Holding`
            finds necessary.

    Raises:
        ValueError: if an argument breaks its rule.

    Source: Bertsekas, "Rollout, Policy Iteration, and Distributed Reinforcement Learning" (2020), ch. 2: a
    rollout that keeps the base's control among its choices does not cost more than the base.
    """

    rowwise: ClassVar = {"control": (1,), "value": (1,), "rollout": (1,), "proposal": (1, 1)}

    @beside
    def __init__(
        self,
        basis: StaFBasis,
        plant: Plant,
        cost: Cost,
        base: Policy,
        terminal: Value,
        metric: Tensor,
        *,
        period: float,
        steps: int = 20,
        substeps: int | None = None,
    ) -> None:
        super().__init__()
        cost = cost.around(plant)
        if basis.dim not in (cost.dim, cost.inputs):
            rule = f"must have the plant's {cost.dim} states or its {cost.inputs} inputs"
            raise fail("SampledRollout", "basis", rule, basis.dim)
        if cost.inputs > LARGEST:
            raise fail("SampledRollout", "plant", f"must have at most {LARGEST} inputs", cost.inputs)
        check_problem(plant, cost)
        check_policy("SampledRollout", "base", cost, base)
        check_value("SampledRollout", "terminal", terminal, cost)
        self.basis, self.plant, self.cost, self.base, self.terminal = basis, plant, cost, base, terminal
        self.period = positive_real("SampledRollout", "period", period)
        self.steps = integer("SampledRollout", "steps", steps, least=4)
        self.counted = False  # True where rows have horizons of their own: ``quarter`` periods, four times
        self.holding = Holding("SampledRollout", plant, cost, self.period, substeps).checked()
        self.register_buffer("metric", metric.double())
        self.metric: Tensor
        self.bounds = Bounds(None, None, cost.inputs) if cost.bounds is None else cost.bounds
        span = self.bounds.high - self.bounds.low
        self.probe = hold(self, "probe", _PROBE * torch.where(torch.isfinite(span), span, 1.0))  # (m,)
        self.along = None if basis.dim == cost.dim else _along(basis)
        self._followed = followed(plant, base, self.bounds, self.period)

    def forward(self, x: Tensor) -> Tensor:
        """u: (..., n) -> (..., m)."""
        return self.improved(x) if self.plant.traceable else self.control(x)

    @compiled("a sampled rollout")
    def improved(self, x: Tensor) -> Tensor:
        """`control`, compiled where that pays: (..., n) -> (..., m)."""
        return self.control(x)

    def control(self, x: Tensor) -> Tensor:
        """`forward` in plain torch: (..., n) -> (..., m)."""
        trailing(type(self).__name__, "x", x, 1, self.cost.dim)
        if x.dtype != self.metric.dtype:
            return self.control(x.to(self.metric.dtype)).to(x.dtype)
        base = self.bounds.clip(self.base(x))
        step, known = self._proposed(x, base)
        tried = torch.stack([base, *(self.bounds.clip(base + share * step) for share in _SHARES)], dim=-2)
        after, paid = self.holding(x.unsqueeze(-2).expand(*tried.shape[:-1], x.shape[-1]), tried)
        promise, discount = self._promise(after, known), self._discount()
        whole, part = paid + discount * promise.whole, paid + discount * promise.part  # (..., 3)
        least = whole[..., :1] - _MARGIN * whole[..., :1].abs()
        better = promise.free & (whole < least) & (part < part[..., :1])
        u, best = base, whole[..., 0]
        for k in range(1, tried.shape[-2]):
            lower = better[..., k] & (whole[..., k] < best)
            u = torch.where(lower.unsqueeze(-1), tried[..., k, :], u)
            best = torch.where(lower, whole[..., k], best)
        return u

    def proposal(self, x: Tensor, base: Tensor) -> Tensor:
        """The Newton step d from the base's control, by the fit: (..., n), (..., m) -> (..., m)."""
        return self._proposed(x, base)[0]

    def _proposed(self, x: Tensor, base: Tensor) -> tuple[Tensor, Promise]:
        """`proposal`, and what the base promises from the centers, (..., M)."""
        after, _ = self.holding(x, base)
        probes = torch.diag(self.probe).to(x)
        around = torch.cat((base.unsqueeze(-2) + probes, base.unsqueeze(-2) - probes), dim=-2)  # (..., 2m, m)
        moved, paid = self.holding(x.unsqueeze(-2).expand(*around.shape[:-1], x.shape[-1]), around)
        size, width = base.shape[-1], 2 * self.probe.to(x)
        apart = self.plant.difference(moved[..., :size, :], moved[..., size:, :])
        slopes = apart / width.unsqueeze(-1)  # B', (..., m, n)
        rise = (paid[..., :size] - paid[..., size:]) / width
        if self.along is None:
            known = self.rollout(self.basis.centers(after))
            steep = matvec(slopes, fitted_slope(self.basis, after, known.whole))
        else:
            reach = slopes.square().sum(-1).sqrt()  # |B_j|, (..., m)
            units = slopes / torch.where(reach > 0, reach, 1.0).unsqueeze(-1)
            away = (self.along.places.to(x).unsqueeze(-1) * units.unsqueeze(-3)).sum(-2)  # (..., M, n)
            known = self.rollout(after.unsqueeze(-2) + away)
            steep = reach * matvec(self.along.weights.to(x), known.whole)
        pull = rise + self._discount() * steep
        weighted = (slopes.unsqueeze(-2) * self.metric.to(x)).sum(-1)  # B'P, (..., m, n)
        bent = (weighted.unsqueeze(-2) * slopes.unsqueeze(-3)).sum(-1)  # B'P B, (..., m, m)
        curvature = 2 * (self.period * self.cost.r.to(x) + bent)
        low, high = self.bounds.low.to(x) - base, self.bounds.high.to(x) - base
        return box_minimum(curvature, pull, low, high), known

    def _promise(self, after: Tensor, known: Promise) -> Promise:
        """Return the base's costs from (..., 1 + S, n), of which the first may be among the centers."""
        middle = None if self.along is None else self.along.middle
        if middle is None:
            return self.rollout(after)
        others = self.rollout(after[..., 1:, :])
        first = (part[..., middle : middle + 1] for part in known)
        return Promise(*(torch.cat(pair, dim=-1) for pair in zip(first, others, strict=True)))

    def rollout(self, x: Tensor) -> Promise:
        """Return the base's costs from x on: (..., n)."""
        rest = max(1, self.steps - round(_SHORTER * self.steps))
        passes = math.gcd(self.steps, rest)  # of a stretch of which both are made: a program has one loop
        discount = self._discount()
        if self._followed is not None:
            return self._promised(x, self.steps - rest)

        stretches = x.new_zeros(self.steps // passes)

        def step(now: RolloutStretch) -> RolloutStretch:
            at, spent, share = now
            after, paid = self.holding(at, self.bounds.clip(self.base(at)))
            return after, spent + share * paid, discount * share

        def stretch(now: RolloutStretch, _: Tensor) -> tuple[RolloutStretch, Tensor]:
            at, spent, share = repeat(passes, step, now)
            return (at, spent, share), spent + share * self.terminal(at)

        if self.counted:
            quarter = self.get_buffer("quarter")

            def stretch(now: RolloutStretch, _: Tensor) -> tuple[RolloutStretch, Tensor]:
                at, spent, share = repeat_counted(passes, quarter, step, now)
                return (at, spent, share), spent + share * self.terminal(at)

        def whole(x: Tensor) -> Tensor:
            none = torch.zeros_like(x[..., 0])
            (at, _, _), promised = scan(stretch, (x, none, none + 1.0), stretches, dim=0)
            u = self.base(at)
            free = ((u > self.bounds.low.to(x)) & (u < self.bounds.high.to(x))).all(-1)
            return torch.stack((promised[-1], promised[-1 - rest // passes], free.to(x)), dim=-1)

        found: Tensor = each(whole, x, dim=x.dim() - 2) if x.dim() > 1 else whole(x)
        return Promise(found[..., 0], found[..., 1], found[..., 2] > 0)

    @compiled("whether a bound is met")
    def meets_bound(self, x: Tensor) -> Tensor:
        """1 where the base, followed over the horizon, meets a bound, else 0: (..., n) -> (..., 1)."""
        if x.dtype != self.metric.dtype:
            exact: Tensor = self.meets_bound.definition(x.to(self.metric.dtype))
            return exact.to(x.dtype)
        low, high = self.bounds.low.to(x), self.bounds.high.to(x)

        def step(now: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
            at, met = now
            u = self.bounds.clip(self.base(at))
            after, _ = self.holding(at, u)
            return after, torch.where(((u <= low) | (u >= high)).any(-1), 1.0, met)

        start = x, torch.zeros_like(x[..., 0])
        if self.counted:
            met: Tensor = repeat_counted(self.steps, 4 * self.get_buffer("quarter"), step, start)[1]
        else:
            met = repeat(self.steps, step, start)[1]
        return met.unsqueeze(-1)

    def _promised(self, x: Tensor, first: int) -> Promise:
        """`rollout` of a simulator: it goes through all periods, and then all of it is paid for at once."""
        assert self._followed is not None
        states, controls = self._followed(x, self.steps)
        paid = self.period * self.cost.rate(states[..., :-1, :], controls)
        share = torch.exp(
            -self.cost.discount * self.period * torch.arange(self.steps + 1, dtype=x.dtype, device=x.device)
        )
        spent = (share[:-1] * paid).cumsum(-1)
        part = spent[..., first - 1] + share[first] * self.terminal(states[..., first, :])
        end = states[..., -1, :]
        u = self.base(end)
        free = ((u > self.bounds.low.to(x)) & (u < self.bounds.high.to(x))).all(-1)
        return Promise(spent[..., -1] + share[-1] * self.terminal(end), part, free)

    def value(self, x: Tensor) -> Tensor:
        """Return the cost that the chosen control promises: (..., n) -> (...)."""
        trailing(f"{type(self).__name__}.value", "x", x, 1, self.cost.dim)
        if x.dtype != self.metric.dtype:
            return self.value(x.to(self.metric.dtype)).to(x.dtype)
        after, paid = self.holding(x, self.control(x))
        return paid + self._discount() * self.rollout(after).whole

    def _discount(self) -> float | Tensor:
        rate = self.cost.discount  # a tensor where rows have their own
        return torch.exp(-rate * self.period) if isinstance(rate, Tensor) else math.exp(-rate * self.period)


def _along(basis: StaFBasis) -> Along:
    middle = basis.centers.directions.new_zeros(basis.count, basis.dim)
    places = basis.centers(middle[0])
    weights = fitted_slope(
        basis, middle, torch.eye(basis.count, dtype=middle.dtype, device=middle.device)
    ).mT  # a unit value a row
    at = (places == 0).all(-1).nonzero().flatten().tolist()
    return Along(places, weights, at[0] if at else None)


@dataclasses.dataclass(frozen=True)
class FollowedSimulator:
    """(x (..., n), T) -> states (..., T + 1, n) and controls (..., T, m) of a policy within its bounds."""

    plant: StepPlant
    base: Policy
    bounds: Bounds

    def __call__(self, x: Tensor, steps: int) -> tuple[Tensor, Tensor]:
        call = f"{type(self.plant).__name__} of a function without derivatives"
        late = defer_gradient(call, x=x)
        rows = x.detach().reshape(-1, x.shape[-1]).to("cpu", torch.float64).numpy()
        linear = type(self.base) is LQR and type(self.base.cost) is QuadraticCost
        feedback = self._linear() if linear else self._asked
        states, controls = self.plant.function.follow(rows, feedback, steps)
        found = (
            torch.from_numpy(states).to(x).view(*x.shape[:-1], *states.shape[1:]),
            torch.from_numpy(controls).to(x).view(*x.shape[:-1], *controls.shape[1:]),
        )
        return marked(call, late, found)

    def _linear(self) -> Callable[[Numbers], Numbers]:
        """The LQR within its bounds, in NumPy."""
        assert isinstance(self.base, LQR)
        cost, size = self.base.cost, self.base.cost.dim
        columns = np.ascontiguousarray(self.base.k.cpu().numpy().T)
        target = np.zeros(size) if cost.target is None else cost.target.cpu().numpy()
        rest = np.zeros(cost.inputs) if cost.target_input is None else cost.target_input.cpu().numpy()
        low, high = self.bounds.low.cpu().numpy(), self.bounds.high.cpu().numpy()
        turn, whole = np.array([2 * np.pi * (k in cost.periodic) for k in range(size)]), 2 * np.pi

        def feedback(x: Numbers) -> Numbers:
            away = x - target
            if cost.periodic:
                away = away - turn * np.rint(away / whole)
            # A product a row: one of all rows may have other bits.
            u: Numbers = rest - (away[:, None] @ columns)[:, 0]
            return np.minimum(np.maximum(u, low), high) if self.bounds.present else u

        return feedback

    def _asked(self, x: Numbers) -> Numbers:
        with torch.no_grad():
            at = torch.from_numpy(x).to(
                device_of(self.base)
            )  # a simulator is on the CPU, a policy need not be
            u: Numbers = self.bounds.clip(self.base(at)).cpu().numpy()
        return u


def followed(plant: Plant, base: Policy, bounds: Bounds, period: float) -> FollowedSimulator | None:
    """Return what follows a policy, clipped to the bounds, through a user's simulator; None of other
    plants, or where the plant does more than its function."""
    if plant.traceable or not isinstance(plant, StepPlant) or plant.period != period:
        return None
    return FollowedSimulator(plant, base, bounds) if type(plant).step is StepPlant.step else None

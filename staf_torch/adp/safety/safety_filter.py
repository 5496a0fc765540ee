"""A filter that keeps h(x, t) >= 0 whatever the policy behind it wants: control barrier functions, held."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ...lanes import compiled, repeat
from ...numerics.checks import fail, non_negative, one_or_each, positive, positive_real, trailing
from ...systems import Bounds, Plant, StepPlant
from ...systems.bounds import Limit
from ..loop.controller import Carried, Controller, Feedback, Policy
from ..loop.simulation import LoopResult
from ..problem.held_plant import Holding
from .quadratic_program import cases, nearest_admissible

Constraint = Callable[[Tensor, Tensor], Tensor]
"""h(x, t), kept at least 0: states (B, n) and a time, a number in a tensor (), to (B,)."""
RowValue = Callable[[Tensor, Tensor], Tensor]
"""A function of one row (1, n) and a time () to a number ()."""
INFEASIBLE = 1e-6  # slack, in units of the input, from which on a row counts as infeasible
_PASSES, _MOST = 2, 8  # linearisations at least, the first at the wanted control; at most, until all is met
_SOLVED = 1e-6  # of what a wanted control misses, at which it is
_PROBES, _TIMES = 32, (0.0, 0.1, 1.0, 10.0, 100.0)  # states and times (s) at which constraints are tried
_NOTHING = 1e-9  # of the slopes that make it, below which the effect of a control counts as none


class Filtered(NamedTuple):
    """Result of a filter at states x."""

    control: Tensor  # (..., m)
    margin: Tensor  # h of every constraint now, (..., k)
    slack: Tensor  # (...) how much further u would have to reach, in its (weighted) units; 0: all is met


class Watched(NamedTuple):
    """Carried state of a `SafetyFilter`; all but the first are recorded by these names."""

    inner: Carried  # of the controller behind it
    filtered_steps: Tensor  # (B,)
    least_margin: Tensor  # smallest h so far, (B,)
    largest_slack: Tensor  # (B,)
    acted: Tensor  # steps with another control than the wanted one, (B,)


class SafetyFilter(Controller):
    """The control nearest to what a policy wants that keeps h_i(x, t) >= 0:

        min |u - policy(x)|^2 over low <= u <= high with
        phi_i(x(t + dt; u), t + dt) >= e^(-decay_i dt) phi_i(x, t),
        phi = h (relative degree one),  phi = h' + decay h (relative degree two, h' along the plant).

    That is the exponential control barrier function of a control that is held: x(t + dt; u) is the plant
    itself, integrated as everywhere, linearised in u where it was found, until what u must satisfy it
    satisfies. What phi dips between the samples, which its value in the middle of the hold shows, is kept
    as a margin, so that phi and with it h stay positive in between too. In the limit of a short hold the
    condition is phi' >= -decay phi. The quadratic
    program is solved exactly: in closed form for one input, else by comparing all cases.

    A wanted control that satisfies everything is applied bit for bit. Bounds are hard; where they and the
    constraints contradict each other, the bounds hold, the squares of what is missing are least, and `slack`
    says how much is missing.

    Example:
        >>> plant = systems.Linear([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])
        >>> lqr = adp.LQR(plant, adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1))
        >>> wall = adp.SafetyFilter(lqr, plant, lambda x, t: x[:, 0] + 0.1, dt=0.01, low=-3.0, high=3.0)
        >>> x0 = torch.tensor([[2.0, -1.0]]).double()
        >>> cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
        >>> run = adp.simulate(wall, plant, cost, x0, steps=200)
        >>> wall.report(run)["constraint_violations"], wall.report(run)["infeasible"]
        (0, [])

        Shown by `staf experiment=avoidance`.

    Args:
        policy: u from x, (..., n) -> (..., m), or a controller, also one that learns.
        plant: in continuous time, torch all through: the model that the filter believes.
        constraints: h, or a list of them, twice differentiable. h sees states (B, n) and one time as a
            tensor (), and returns (B,); it runs under `torch.func.vmap`.
        dt: s, for which a control is held; `simulate` takes it over.
        low: of the inputs, as in `systems.Bounds`; both None for those of the plant.
        high: likewise.
        decay: 1/s, one number or one a constraint: how fast h may fall. Large ones let the policy come nearer
            to the edge, and need larger controls there. At most 1/dt where the relative degree is two.
        degree: 1 or 2 a constraint, or None: found by trying states around the equilibrium.
        margin: in units of h, one number or one a constraint: h >= margin is kept.
        weight: of the squares of u - policy(x), positive, one an input; all 1 by default.

    Raises:
        ValueError: if an argument breaks its rule, a constraint returns another shape, or u moves neither its
            first nor its second derivative.

    Source: Ames et al., "Control barrier functions: theory and applications", ECC (2019); Nguyen and
    Sreenath, "Exponential control barrier functions", ACC (2016), for degree two.
    """

    def __init__(
        self,
        policy: Policy | Controller,
        plant: Plant,
        constraints: Constraint | Sequence[Constraint],
        *,
        dt: float,
        low: Limit = None,
        high: Limit = None,
        decay: float | Sequence[float] = 2.0,
        degree: int | Sequence[int] | None = None,
        margin: float | Sequence[float] = 0.0,
        weight: Sequence[float] | None = None,
    ) -> None:
        super().__init__()
        check_traceable("SafetyFilter", plant)
        self.controller = policy if isinstance(policy, Controller) else Feedback(policy)
        self.plant, self.draws = plant, self.controller.draws
        self.hold = positive_real("SafetyFilter", "dt", dt)
        self.period = self.hold
        self.constraints = listed("SafetyFilter", constraints)
        count = len(self.constraints)
        own = Bounds(low, high, plant.inputs)
        self.bounds = plant.bounds if not own.present and plant.bounds is not None else own
        rates = one_or_each("SafetyFilter", "decay", decay, count)
        self.register_buffer("decay", positive("SafetyFilter", "decay", rates))
        kept = one_or_each("SafetyFilter", "margin", margin, count)
        self.register_buffer("margin", non_negative("SafetyFilter", "margin", kept))
        heavy = one_or_each("SafetyFilter", "weight", 1.0 if weight is None else weight, plant.inputs)
        positive("SafetyFilter", "weight", heavy)
        self.register_buffer("unit", heavy.rsqrt())
        self.decay: Tensor  # (k,) 1/s
        self.margin: Tensor  # (k,)
        self.unit: Tensor  # (m,) of an input, in which distances are measured
        low_, high_ = self.bounds.low / self.unit, self.bounds.high / self.unit
        self.register_buffer("table", cases(count, low_.tolist(), high_.tolist()))
        self.table: Tensor
        self.holding = Holding("SafetyFilter", plant, None, 0.5 * self.hold)
        self.degree, self.moving = self._probe(degree)
        second = torch.tensor(self.degree, dtype=torch.int64) == 2
        if bool((second & (self.decay * self.hold > 1)).any()):
            rule = f"must be at most 1/dt = {1 / self.hold:g} where the relative degree is two"
            raise fail("SafetyFilter", "decay", rule, decay)

    @property
    def label(self) -> str:
        return f"filtered {self.controller.label}"

    def forward(self, x: Tensor, t: float | Tensor | None = None) -> Tensor:
        """u: (..., n) -> (..., m), of a policy without a state of its own.

        Args:
            x: (..., n).
            t: s, a number or (...); needed where a constraint depends on it.

        Raises:
            ValueError: if the time is missing, or the policy is a controller that remembers.
        """
        if not isinstance(self.controller, Feedback):
            raise fail("SafetyFilter", "policy", "must be a function of x to be asked at x", self.controller)
        return self.restrain(x, self.controller.policy(x), t).control

    def restrain(self, x: Tensor, u: Tensor, t: float | Tensor | None = None) -> Filtered:
        """Return the control to apply in place of u: (..., n), (..., m).

        Args:
            x: (..., n).
            u: what the policy wants, (..., m).
            t: s, a number or (...).

        Raises:
            ValueError: if a constraint depends on the time, which is missing, or a shape is wrong.
        """
        trailing("SafetyFilter", "x", x, 1, self.plant.dim)
        trailing("SafetyFilter", "u", u, 1, self.plant.inputs)
        if t is None and self.moving:
            raise fail("SafetyFilter", "t", "must be given: a constraint depends on the time", t)
        time = torch.as_tensor(0.0 if t is None else t).to(x).expand(x.shape[:-1])
        found = self._nearest(torch.cat((x, u, time.unsqueeze(-1)), dim=-1))
        control, margin, slack = found.split((u.shape[-1], len(self.constraints), 1), dim=-1)
        return Filtered(control, margin, slack.squeeze(-1))

    def init(self, x0: Tensor) -> Watched:
        none = x0.new_zeros(len(x0))
        return Watched(self.controller.init(x0), none, none + math.inf, none.clone(), none.clone())

    def recorded(self, carried: Watched) -> dict[str, Tensor]:
        inner, *own = carried
        return {**self.controller.recorded(inner), **dict(zip(Watched._fields[1:], own, strict=True))}

    def step(self, x: Tensor, carried: Watched, uniform: Tensor, dt: float) -> tuple[Tensor, Watched]:
        if dt != self.hold:
            raise fail("SafetyFilter", "dt", f"must be that of the loop, {dt:g} s", self.hold)
        inner, steps, least, most, acted = carried
        u, inner = self.controller.step(x, inner, uniform, dt)
        found = self.restrain(x, u, steps * self.hold)
        least, most = torch.minimum(least, found.margin.amin(-1)), torch.maximum(most, found.slack)
        acted = acted + (found.control != self.bounds.clip(u)).any(-1)
        return found.control, Watched(inner, steps + 1, least, most, acted)

    def value(self, x: Tensor, recorded: Mapping[str, Tensor]) -> Tensor | None:
        return self.controller.value(x, recorded)

    def margins(self, x: Tensor, t: float | Tensor = 0.0) -> Tensor:
        """h of every constraint: (..., n) and a number or (...) -> (..., k)."""
        time = torch.as_tensor(t).to(x).expand(x.shape[:-1]).reshape(-1)
        rows = x.reshape(-1, x.shape[-1])
        columns = [torch.func.vmap(h)(rows.unsqueeze(1), time) for h in map(_number, self.constraints)]
        return torch.stack(columns, dim=-1).reshape(*x.shape[:-1], -1)

    def report(self, result: LoopResult) -> dict[str, Any]:
        """Report the constraints in a closed loop of this filter, over all of its steps.

        Returns:
            ``minimum_margin``, the smallest h over rows and times; ``constraint_violations``, the number of
            rows with h < 0 at a time; ``infeasible``, the rows in which no admissible control met the
            condition at a time; ``largest_slack``; ``acted``, the share of the steps in which the control was
            another than the wanted one within the bounds.
        """
        steps, least, most, acted = (result[name][:, -1] for name in Watched._fields[1:])
        last = self.margins(result.state[:, -1], steps * self.hold).amin(-1)
        least = torch.minimum(least, last)
        return {
            "minimum_margin": float(least.min()),
            "constraint_violations": int((least < 0).sum()),
            "infeasible": (most > INFEASIBLE).nonzero().flatten().tolist(),
            "largest_slack": float(most.max()),
            "acted": float(acted.sum() / steps.sum()),
        }

    def inequalities(self, x: Tensor, u: Tensor, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """a_i, c_i and h_i of the condition a_i'u >= c_i, linearised at u: (B, n), (B, m), (B,) ->
        (B, k, m), (B, k), (B, k)."""
        normal, least, margin = self._every(self._inequality, x, u, t)
        return normal[:, :, 0], least, margin

    def _every(self, of: Callable[..., tuple[Tensor, ...]], x: Tensor, u: Tensor, t: Tensor) -> list[Tensor]:
        """Evaluate a function of (k, x, u, t), one row, for every constraint: (B, k, ...) each."""
        rows = [functools.partial(of, k) for k in range(len(self.constraints))]
        parts = [torch.func.vmap(row)(x.unsqueeze(1), u.unsqueeze(1), t) for row in rows]
        return [torch.stack(column, dim=1) for column in zip(*parts, strict=True)]

    @compiled("a safety filter")
    def _nearest(self, z: Tensor) -> Tensor:
        """u, margins and slack of rows of (x, u, t): (..., n + m + 1) -> (..., m + k + 1)."""
        n, m = self.plant.equilibrium().numel(), self.plant.inputs
        flat = z.reshape(-1, z.shape[-1])
        x, wanted, t = flat[:, :n], flat[:, n : n + m], flat[:, n + m]
        unit = self.unit.to(x)
        low, high = self.bounds.low.to(x) / unit, self.bounds.high.to(x) / unit
        first = torch.minimum(torch.maximum(wanted / unit, low), high)
        at = torch.where(
            ((wanted >= self.bounds.low.to(x)) & (wanted <= self.bounds.high.to(x))), wanted, first * unit
        )

        shortfall, margin = self._every(self._shortfall, x, at, t)
        asked = shortfall.amax(-1)
        met = asked <= 0  # needs neither slopes nor a quadratic program
        none = torch.zeros_like(t)

        def linearise(now: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
            u, best, slack, least, passes, _ = now
            normal, required, _ = self.inequalities(x, u, t)
            found = nearest_admissible(first, normal * unit, required, low, high, self.table)
            u, passes = found.point * unit, passes + 1
            missing, _ = self._every(self._shortfall, x, u, t)
            left = missing.amax(-1)
            unmet = left > _SOLVED * asked
            # Where a line is a poor likeness: what is still missing, along its slope.
            length = self.hold * (normal * unit).square().sum(-1).sqrt()
            short = torch.where((missing > 0) & (length > 0), missing / length, torch.zeros_like(missing))
            reach = torch.maximum(found.shortfall, torch.where(unmet, short.amax(-1), none))
            better = (passes <= _PASSES) | (left < least)
            best = torch.where(better.unsqueeze(-1), u, best)
            slack, least = torch.where(better, reach, slack), torch.where(better, left, least)
            again = (passes < _PASSES) | (unmet & (passes < _MOST))
            return u, best, slack, least, passes, again

        start = at, at, none, none, none, ~met
        _, u, slack, *_ = repeat(_MOST, linearise, start, where=lambda now: now[5])
        return torch.cat((u, margin, slack.unsqueeze(-1)), dim=-1).reshape(*z.shape[:-1], -1)

    def _shortfall(self, k: int, x: Tensor, u: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        """Return how far phi misses its condition with u held, and h now: (1, n), (1, m), () -> (), ()."""
        end, middle = self._held(k, x, u, t)
        return self._required(k, x, t, end, middle) - end, _number(self.constraints[k])(x, t)

    def _inequality(self, k: int, x: Tensor, u: Tensor, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Linearise one constraint for one row: (1, n), (1, m), () -> (1, m), (), ()."""

        def held(u: Tensor) -> tuple[Tensor, Tensor]:
            return self._held(k, x, u, t)

        slope, (end, middle) = torch.func.grad_and_value(held, has_aux=True)(u)
        required = self._required(k, x, t, end, middle)
        miss = (required - end + (slope * u).sum()) / self.hold
        return slope / self.hold, miss, _number(self.constraints[k])(x, t)

    def _held(self, k: int, x: Tensor, u: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        """phi at the end of the hold, and in its middle."""
        phi, middle = self._level(k), self._advance(x, u)
        return phi(self._advance(middle, u), t + self.hold), phi(middle, t + 0.5 * self.hold)

    def _required(self, k: int, x: Tensor, t: Tensor, end: Tensor, middle: Tensor) -> Tensor:
        """Return the least phi at the end."""
        now = self._level(k)(x, t)
        dip = 0.5 * (now + end) - middle
        dip = torch.where(dip > 0, dip, 0.0)
        return dip + torch.exp(-self.decay[k].to(x) * self.hold) * (now - dip)

    def _advance(self, x: Tensor, u: Tensor) -> Tensor:
        """x after half a hold."""
        return self.holding(x, u)[0]

    def _level(self, k: int) -> RowValue:
        """phi of one row: (1, n), () -> ()."""
        h = _number(self.constraints[k])
        if self.degree[k] == 1:
            return lambda x, t: h(x, t) - self.margin[k].to(x)
        rest = self.plant.resting_input()

        def level(x: Tensor, t: Tensor) -> Tensor:
            falls = self.decay[k].to(x) * (h(x, t) - self.margin[k].to(x))
            return _rate(h, self.plant, x, rest.to(x).unsqueeze(0), t) + falls

        return level

    def _probe(self, degree: int | Sequence[int] | None) -> tuple[tuple[int, ...], bool]:
        """The relative degrees, and whether a constraint depends on the time."""
        generator = torch.Generator().manual_seed(0)
        around = torch.randn(_PROBES, self.plant.dim or 0, dtype=torch.float64, generator=generator)
        x = (self.plant.equilibrium() + around).repeat(len(_TIMES), 1)
        t = torch.tensor(_TIMES, dtype=torch.float64).repeat_interleave(_PROBES)
        for k, h in enumerate(self.constraints):
            shape = tuple(h(x[:3], t[0]).shape)
            if shape != (3,):
                raise fail("SafetyFilter", "constraints", f"must map (3, n) to (3,), number {k}", shape)
        values = self.margins(x, t).unflatten(0, (len(_TIMES), _PROBES))
        moving = bool((values != values[:1]).any())
        if degree is not None:
            given = [degree] * len(self.constraints) if isinstance(degree, int) else list(degree)
            if len(given) != len(self.constraints) or not set(given) <= {1, 2}:
                raise fail("SafetyFilter", "degree", "must be 1 or 2, one a constraint", degree)
            return tuple(given), moving
        found = [self._degree(_number(h), x.unsqueeze(1), t) for h in self.constraints]
        if 0 in found:
            raise ValueError(
                f"`SafetyFilter(constraints=...)`: the control moves neither first nor second derivative "
                f"of number {found.index(0)}, at {len(x)} states around the equilibrium. A relative degree "
                "of three and more needs another h; one that is flat there needs its `degree`."
            )
        return tuple(found), moving

    def _degree(self, h: RowValue, x: Tensor, t: Tensor) -> int:
        """1 or 2: which derivative of h the control moves at states (P, 1, n); 0 for neither."""
        rest = self.plant.resting_input().double().unsqueeze(0)

        def first(x: Tensor, t: Tensor) -> Tensor:
            return _rate(h, self.plant, x, rest, t)

        for number, phi in ((1, h), (2, first)):

            def rate(u: Tensor, x: Tensor, t: Tensor, phi: RowValue = phi) -> Tensor:
                return _rate(phi, self.plant, x, u, t)

            effect = torch.func.vmap(torch.func.grad(rate), in_dims=(None, 0, 0))(rest, x, t)
            if bool((effect.abs() > _NOTHING).any()):
                return number
        return 0


def listed(call: str, constraints: Constraint | Sequence[Constraint]) -> list[Constraint]:
    """The constraints as a list, refused in the name of ``call`` where they are no functions."""
    several = [constraints] if callable(constraints) else list(constraints)
    if not several or not all(map(callable, several)):
        raise fail(call, "constraints", "must be h(x, t) or a list of them", constraints)
    return several


def check_traceable(call: str, plant: Plant) -> None:
    """Refuse a plant in discrete time, or with what torch cannot see into."""
    if isinstance(plant, StepPlant) or not isinstance(plant, Plant) or not plant.traceable:
        raise fail(call, "plant", "must be in continuous time and torch all through", plant)


def _number(h: Constraint) -> RowValue:
    """h of one row: (1, n), () -> ()."""
    return lambda x, t: h(x, t)[0]


def _rate(phi: RowValue, plant: Plant, x: Tensor, u: Tensor, t: Tensor) -> Tensor:
    """d phi / dt along the plant: (1, n), (1, m), () -> ()."""
    along_x, along_t = torch.func.grad(phi, argnums=(0, 1))(x, t)
    rate: Tensor = (along_x * plant.motion(x, u)).sum() + along_t
    return rate


def walls(low: Sequence[float], high: Sequence[float]) -> list[Constraint]:
    """h of every coordinate with a wall, in its units: (x - low)(high - x)/(high - low), or the distance to
    its one wall.

    Args:
        low: of the n coordinates, -inf for no wall.
        high: likewise, inf for none.
    """
    pairs = enumerate(zip(low, high, strict=True))
    return [_within(k, *pair) for k, pair in pairs if not all(map(math.isinf, pair))]


def _within(k: int, low: float, high: float) -> Constraint:
    if math.isinf(low) or math.isinf(high):
        return lambda x, t: high - x[:, k] if math.isinf(low) else x[:, k] - low
    return lambda x, t: (x[:, k] - low) * (high - x[:, k]) / (high - low)

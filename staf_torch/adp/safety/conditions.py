"""Conditions on a held control that keep h(x, t) >= 0: the barrier's, the stop's, and what the brakes can do.

The barrier condition of relative degree two, phi' >= -decay phi with phi = h' + decay h, keeps h >= 0 only
where phi >= 0 holds already and the bounds can go on meeting it. Where phi < 0 the state comes nearer faster
than decay allows: then the constant deceleration that stops it at the edge, v^2 / 2h, is asked for as well.
Where bounds limit h'' the speed must stay one that they can stop, v^2 <= 2 a h.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from ...lanes.gradients import grad, jacrev
from ...lanes.per_row.decisions import agreed, in_any_row
from ...numerics.checks import fail, non_negative, one_or_each, positive, trailing
from ...numerics.default_device import device_of
from ...numerics.linalg import shortest_solution
from ...numerics.rows import check_rows, known_quantile
from ...numerics.runge_kutta import runge_kutta_step
from ...systems import Bounds, Plant, StepPlant
from ..problem.held_plant import Holding

Constraint = Callable[[Tensor, Tensor], Tensor]
"""h(x, t), kept at least 0: states (B, n) and a time, a number in a tensor (), to (B,)."""
RowValue = Callable[[Tensor, Tensor], Tensor]
"""A function of one row (1, n) and a time () to a number ()."""
_PROBES, TIMES = 32, (0.0, 0.1, 1.0, 10.0, 100.0)  # states and times (s) at which constraints are tried
_NOTHING = 1e-9  # of the slopes that make it, below which the effect of a control counts as none
_RESERVE = 1e-3  # share of a distance, and of the brakes, that a stop leaves
_PERIODS = 5.0  # in which h falls by 1/e at the fastest decay that is chosen without being asked for
_CAREFUL, _RARE = 0.5, 0.1  # a stop is looked into from this share of that quantile of the brakes on
_FAR = 100.0  # times the largest bound, to which brakes may use an input that has none
_ON_EDGE = 1e-12  # of h and h', at which a state is on an edge
_SEVERAL = 1 / 3  # of the edges tried, on which brakes that cannot hold h make a constraint a weak one


class Lean(NamedTuple):
    """The rate of a constraint at a state: its last derivative before the inputs, and what they add."""

    value: Tensor  # h - margin, (B, k)
    rate: Tensor  # h' at the resting input, 0 where the degree is one
    drift: Tensor  # derivative of h (degree one) or of its rate (two) at the resting input
    slope: Tensor  # of that in the inputs, (B, k, m)
    ability: Tensor  # the largest one within the bounds, (B, k)


class Ends(NamedTuple):
    """A constraint over a hold: at its beginning and end; of one row () each, of all (B, k)."""

    value: Tensor
    rate: Tensor
    between: Tensor  # the value in the middle
    last_value: Tensor
    last_rate: Tensor
    last_slope: Tensor  # the square of the gradient of h

    def least(self, hold: float | Tensor) -> Tensor:
        """The smallest value after the beginning, by the parabola where the rate changes its sign."""
        turns = (self.rate < 0) & (self.last_rate > 0)
        bend = torch.where(turns, self.last_rate - self.rate, 1.0)
        summit = torch.where(turns, self.value - 0.5 * hold * self.rate.square() / bend, self.last_value)
        return torch.minimum(torch.minimum(summit, self.between), self.last_value)


class Conditions(nn.Module):
    """Conditions on a held control that keep h_i(x, t) >= margin_i, one row and constraint at a time,
    with arguments and rules of `SafetyFilter`."""

    def __init__(
        self,
        plant: Plant,
        constraints: Sequence[Constraint],
        bounds: Bounds,
        hold: float,
        decay: float | Sequence[float] | None,
        degree: int | Sequence[int] | None,
        margin: float | Sequence[float],
    ) -> None:
        super().__init__()
        self.plant, self.constraints, self.bounds, self.hold = plant, list(constraints), bounds, hold
        self.holding = Holding("SafetyFilter", plant, None, 0.5 * hold)
        count = len(self.constraints)
        kept = one_or_each("SafetyFilter", "margin", margin, count)
        self.register_buffer("margin", non_negative("SafetyFilter", "margin", kept).to(device_of(plant)))
        self.register_buffer("decay", torch.ones(count, dtype=torch.float64, device=device_of(plant)))
        self.margin: Tensor  # (k,)
        self.decay: Tensor  # (k,) 1/s
        if decay is not None:
            rates = positive("SafetyFilter", "decay", one_or_each("SafetyFilter", "decay", decay, count))
            self.register_buffer("decay", rates.to(self.decay))
        for name, end in (("low", bounds.low), ("high", bounds.high)):
            self.register_buffer(name, _reachable(end, bounds, plant.resting_input()))
        self.low: Tensor  # (m,) as far as brakes may reach
        self.high: Tensor
        x, t = self._around()
        values = self.margins(x, t).unflatten(0, (len(TIMES), _PROBES))
        self.unknown = [k for k in range(count) if in_any_row(values[..., k].isnan())]
        self.moving = bool((values.nan_to_num(0.0) != values[:1].nan_to_num(0.0)).any())
        if not self.moving:  # one time says it all
            x, t = x[:_PROBES], t[:_PROBES]
        self.degree = self._degrees(degree, x, t)
        slowest = self._find_brakes(x, t)
        if decay is None:
            self.register_buffer("decay", slowest.to(self.decay))
        second = torch.tensor(self.degree, dtype=torch.int64, device=self.decay.device) == 2
        if bool((second & (self.decay * self.hold > 1)).any()):
            rule = f"must be at most 1/dt = {1 / self.hold:g} where the relative degree is two"
            raise fail("SafetyFilter", "decay", rule, decay)

    def margins(self, x: Tensor, t: float | Tensor = 0.0) -> Tensor:
        """h of every constraint: (..., n) and a number or (...) -> (..., k)."""
        trailing("SafetyFilter.margins", "x", x, 1, self.plant.dim)
        time = torch.as_tensor(t, device=x.device).to(x).expand(x.shape[:-1]).reshape(-1)
        rows = x.reshape(-1, x.shape[-1])
        if not len(rows):
            return x.new_zeros(*x.shape[:-1], len(self.constraints))
        columns = [torch.func.vmap(h)(rows.unsqueeze(1), time) for h in map(number, self.constraints)]
        return torch.stack(columns, dim=-1).reshape(*x.shape[:-1], -1)

    def every(self, of: Callable[..., tuple[Tensor, ...]], *rows: Tensor) -> list[Tensor]:
        """Evaluate a function of (k, x, ..., t), one row, for every constraint: (B, k, ...) each."""
        *states, t = rows
        given = [each.unsqueeze(1) for each in states]
        each = [functools.partial(of, k) for k in range(len(self.constraints))]
        parts = [torch.func.vmap(one)(*given, t) for one in each]
        return [torch.stack(column, dim=1) for column in zip(*parts, strict=True)]

    def shortfall(self, k: int, x: Tensor, u: Tensor, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return how far the conditions are missed with u held, h now, and by how much the speed at the end
        is one to be looked into, positive if so: (1, n), (1, m), () -> (), (), ()."""
        ends, end, middle = self._held(k, x, u, t)
        missing = self._required(k, ends, end, middle) - end
        if self.degree[k] == 2:
            missing = torch.maximum(missing, -self._stop(k, ends))
        strain = torch.zeros_like(missing) - 1
        if not self.braked[k] and self.limited[k] and self.degree[k] == 2:
            room = (2 * _CAREFUL * self.usual[k] * ends.last_value).square() * ends.last_slope
            near = (ends.last_rate < 0) & (ends.last_value > 0)
            strain = torch.where(near, ends.last_rate.square().square() - room, strain)
        return missing, number(self.constraints[k])(x, t), strain

    def inequality(self, k: int, x: Tensor, u: Tensor, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Linearise one constraint for one row: (1, n), (1, m), () -> (1, m), (), ()."""

        def held(u: Tensor) -> tuple[Tensor, tuple[Tensor, Ends, Tensor]]:
            ends, end, middle = self._held(k, x, u, t)
            return end, (end, ends, middle)

        slope, (end, ends, middle) = grad(held, has_aux=True)(u)
        miss = self._required(k, ends, end, middle) - end
        if self.degree[k] == 2:

            def stop(u: Tensor) -> tuple[Tensor, Tensor]:
                gap = self._stop(k, self._held(k, x, u, t)[0])
                return gap, gap

            other, gap = grad(stop, has_aux=True)(u)
            first, second = slope.square().sum().sqrt(), other.square().sum().sqrt()
            harder = (-gap * first > miss * second) & (gap < 0)
            slope, miss = torch.where(harder, other, slope), torch.where(harder, -gap, miss)
        least = (miss + (slope * u).sum()) / self.hold
        return slope / self.hold, least, number(self.constraints[k])(x, t)

    def over(self, k: int, x: Tensor, u: Tensor, t: Tensor) -> Ends:
        """Return one constraint over the hold: (1, n), (1, m), () -> () each."""
        return self._held(k, x, u, t)[0]

    def lean(self, k: int, x: Tensor, t: Tensor) -> Lean:
        """Return what moves one constraint of one row: (1, n), () -> () each, the slope (m,)."""
        value, rate, _ = self.level(k, x, t)

        def push(u: Tensor) -> tuple[Tensor, Tensor]:
            found = rate_along(self._last(k), self.plant, x, u, t)
            return found, found

        rest = self.plant.resting_input().to(x).unsqueeze(0)
        slope, drift = grad(push, has_aux=True)(rest)
        low, high = self.low.to(x), self.high.to(x)
        farther = torch.where(slope > 0, slope * (high - rest), slope * (low - rest))
        ability = drift + torch.where(slope == 0, 0.0, farther).sum()
        return Lean(value, rate, drift, slope[0], ability)

    def halfway(self, x: Tensor, u: Tensor) -> Tensor:
        """x after half a hold."""
        return self.holding(x, u)[0]

    def advance(self, x: Tensor, u: Tensor, length: Tensor) -> Tensor:
        """x after half a hold, or half of a row's own, (..., 1) s, where the plant takes single steps."""
        if not self.holding.classical:
            return self.halfway(x, u)
        plant = self.plant
        return runge_kutta_step(lambda at: plant.velocity(at, u), x, 0.5 * length, plant.displaced)

    def level(self, k: int, x: Tensor, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return h - margin, h' at the resting input (0 where the degree is one) and the square of the
        gradient of h, of one row."""
        h, rest = number(self.constraints[k]), self.plant.resting_input()
        value = h(x, t) - self.margin[k].to(x)
        if self.degree[k] == 1:
            return value, torch.zeros_like(value), torch.ones_like(value)
        along_x, along_t = grad(h, argnums=(0, 1))(x, t)
        rate = (along_x * self.plant.motion(x, rest.to(x).unsqueeze(0))).sum() + along_t
        return value, rate, along_x.square().sum()

    def _last(self, k: int) -> RowValue:
        """Return the last derivative of h, along the plant, that no input moves."""
        h, rest = number(self.constraints[k]), self.plant.resting_input()
        if self.degree[k] == 1:
            return h
        return lambda x, t: rate_along(h, self.plant, x, rest.to(x).unsqueeze(0), t)

    def _phi(self, k: int, value: Tensor, rate: Tensor) -> Tensor:
        return value if self.degree[k] == 1 else rate + self.decay[k].to(rate) * value

    def _held(self, k: int, x: Tensor, u: Tensor, t: Tensor) -> tuple[Ends, Tensor, Tensor]:
        """The constraint over the hold, and phi at its end and in its middle."""
        middle = self.halfway(x, u)
        end = self.halfway(middle, u)
        value, rate, _ = self.level(k, x, t)
        between, middle_rate, _ = self.level(k, middle, t + 0.5 * self.hold)
        last = self.level(k, end, t + self.hold)
        phi, halfway = self._phi(k, *last[:2]), self._phi(k, between, middle_rate)
        return Ends(value, rate, between, *last), phi, halfway

    def _required(self, k: int, ends: Ends, end: Tensor, middle: Tensor) -> Tensor:
        """Return the least phi at the end by the barrier's condition."""
        decay, now = self.decay[k].to(end), self._phi(k, ends.value, ends.rate)
        dip = 0.5 * (now + end) - middle
        dip = torch.where(dip > 0, dip, 0.0)
        return dip + torch.exp(-decay * self.hold) * (now - dip)

    def _stop(self, k: int, ends: Ends) -> Tensor:
        """Return by how much the stop's condition is kept, as a rate of h.

        Where phi < 0: h' at the end is what the deceleration leaves that stops at the edge. Else, where the
        brakes are one number: the speed at the end can be stopped.
        """
        value, rate, _, last_value, last_rate, _ = ends
        speed = speed_of(rate)
        least = _RESERVE * speed * self.hold
        room = (1 - _RESERVE) * torch.where(value > least, value, least)
        asked = 0.5 * self.hold * speed.square() / torch.where(speed > 0, room, 1.0) - speed
        asked = torch.where(value > 0, asked, 0.0)
        fast = (rate < 0) & (rate + self.decay[k].to(rate) * value < 0)
        free = torch.ones_like(rate)
        if self.braked[k]:
            most = (1 - _RESERVE) * self.brakes[k].to(rate)
            left = 2 * most * last_value - speed_of(last_rate).square()
            free = torch.where(value > 0, left / (most * self.hold + rate.abs()), free)
        return torch.where(fast, last_rate - asked, free)

    def _around(self) -> tuple[Tensor, Tensor]:
        """Return states around the equilibrium, and times."""
        generator = torch.Generator().manual_seed(0)
        rest, size = self.plant.equilibrium(), (_PROBES, self.plant.dim or 0)
        around = torch.randn(size, dtype=torch.float64, generator=generator, device="cpu")
        x = (rest + around.to(rest.device)).repeat(len(TIMES), 1)
        return x, torch.tensor(TIMES, dtype=torch.float64, device=x.device).repeat_interleave(_PROBES)

    def _degrees(self, degree: int | Sequence[int] | None, x: Tensor, t: Tensor) -> tuple[int, ...]:
        if degree is not None:
            given = [degree] * len(self.constraints) if isinstance(degree, int) else list(degree)
            if len(given) != len(self.constraints) or not set(given) <= {1, 2}:
                raise fail("SafetyFilter", "degree", "must be 1 or 2, one a constraint", degree)
            return tuple(given)
        found = [self._degree(number(h), x.unsqueeze(1), t) for h in self.constraints]
        if 0 in found:
            raise ValueError(
                f"`SafetyFilter(constraints=...)`: the control moves neither first nor second derivative "
                f"of number {found.index(0)}, at {len(x)} states around the equilibrium. A relative degree "
                "of three and more needs another h; one that is flat there needs its `degree`."
            )
        return tuple(found)

    def _degree(self, h: RowValue, x: Tensor, t: Tensor) -> int:
        """1 or 2: which derivative of h the control moves at states (P, 1, n); 0 for neither."""
        rest = self.plant.resting_input().double().unsqueeze(0)

        def first(x: Tensor, t: Tensor) -> Tensor:
            return rate_along(h, self.plant, x, rest, t)

        for which, phi in ((1, h), (2, first)):

            def rate(u: Tensor, x: Tensor, t: Tensor, phi: RowValue = phi) -> Tensor:
                return rate_along(phi, self.plant, x, u, t)

            effect = torch.func.vmap(grad(rate), in_dims=(None, 0, 0))(rest, x, t)
            if bool((effect.abs() > _NOTHING).any()):
                return which
        return 0

    @torch.no_grad()
    def _find_brakes(self, x: Tensor, t: Tensor) -> Tensor:
        """Find the authority of the inputs over every constraint at states around the equilibrium, and return
        the decays that it allows, (k,)."""
        lean, slopes = Lean(*self.every(self.lean, x, t)), self.every(self.level, x, t)[2].sqrt()
        count, fastest = len(self.constraints), x.new_tensor(1 / (_PERIODS * self.hold))
        rest, slope, bounds = self.plant.resting_input().to(x), lean.slope, self.bounds.on(x.device)
        own = torch.where(slope > 0, slope * (bounds.high - rest), slope * (bounds.low - rest))
        sure = torch.where(torch.isfinite(own), own, 0.0).sum(-1)  # of the inputs that have bounds
        none, braked, limited, weak = x.new_tensor(math.inf), [], [], []
        repeats = len(TIMES) * _PROBES // len(x)  # of a constraint that stands still, one a time
        constant, usual, decays = [], [], []
        for k in range(count):
            value, reach, ability = lean.value[:, k], sure[:, k], lean.ability[:, k]
            inside = (value > 0) & (reach > _NOTHING)
            within = bool(inside.any()) and bool(torch.isfinite(ability).all())
            ratio = torch.where(inside, reach / slopes[:, k], torch.nan)
            usual.append(known_quantile(ratio.repeat(repeats), _RARE) if within else none)
            same = within and self.degree[k] == 2 and _same(ability) and _same(lean.slope[:, k])
            good = same and bool(ability[0] > _NOTHING)
            constant.append(ability[0] if good else none)
            unsure, middle = within and not good, torch.where(inside, reach, torch.nan).nanmedian()
            weak.append(_weakness(self, k, x, t, middle) if unsure else torch.zeros_like(none))
            slowest = _decay(value, reach, inside) if within and self.degree[k] == 2 else fastest
            decays.append(torch.minimum(slowest, fastest))
            braked.append(good)
            limited.append(within)
        any_weak = tuple(in_any_row(each > 0) for each in weak)
        alone = all(braked[k] or self.degree[k] == 1 or not limited[k] for k in range(count))
        second = [k for k in range(count) if self.degree[k] == 2]
        apart = all(_apart(lean, i, j) for i in second for j in second if j < i)
        own, most, often, rates = (torch.stack(each).detach() for each in (weak, constant, usual, decays))
        # Whether the largest h'' is the same everywhere, positive and finite; whether bounds limit what the
        # inputs can do; whether there are edges, h = h' = 0, at which they cannot hold it, in any row.
        self.braked, self.limited, self.weak = tuple(braked), tuple(limited), any_weak
        # Whether all are constant, and braking for one never drives another.
        self.apart = alone and apart and not any(any_weak)
        self.register_buffer("frail", None if all(map(agreed, weak)) else own)
        self.frail: Tensor | None  # (k,) 1 where a row's own brakes are weak; None where rows are alike
        self.register_buffer("brakes", most)
        self.brakes: Tensor  # (k,) the largest h'' where it is the same everywhere; inf where it is not
        self.register_buffer("usual", often)
        self.usual: Tensor  # (k,) what the inputs can add a unit of the gradient; inf where nothing limits it
        return rates


def _reachable(end: Tensor, bounds: Bounds, rest: Tensor) -> Tensor:
    """Bounds in which inputs without one of their own may go far beside the others that have one."""
    bounds = bounds.on(rest.device)
    end, both = end.to(rest.device), torch.cat((bounds.low - rest, bounds.high - rest)).double()
    finite = torch.isfinite(both)
    if not bool(finite.any()):
        return end.clone()
    known = torch.where(finite, both, 0.0).abs()
    far = _FAR * known.max()
    return torch.where(torch.isfinite(end), end, rest.to(end) + torch.sign(end) * far)


def _decay(value: Tensor, reach: Tensor, inside: Tensor) -> Tensor:
    """Return the decay at which the brakes just stop what is admitted at a usual distance, sqrt(2 reach / h),
    at the time at which it is fastest. A rate that the inputs move themselves is stopped at once."""
    share = torch.where(inside, reach / value, torch.nan).reshape(-1, _PROBES)
    return (2 * torch.nanmedian(share, dim=1).values.nan_to_num(0.0).max()).sqrt()


def _same(values: Tensor) -> bool:
    spread = (values - values[:1]).abs().max()
    return bool(spread <= _NOTHING * (1 + values.abs().max()))


def _apart(lean: Lean, i: int, j: int) -> bool:
    """Return whether two constraints want no input the opposite way, or are two sides of one corridor."""
    opposed = bool((lean.slope[:, i] * lean.slope[:, j] < 0).any())
    return not opposed or _same(lean.value[:, i] + lean.value[:, j])


def _weakness(of: Conditions, k: int, x: Tensor, t: Tensor, usual: Tensor) -> Tensor:
    """Return 1 if the bounds cannot hold h at several states of its edge, where h (and h') are 0; else 0."""

    def off(x: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        found = torch.stack(of.level(k, x.unsqueeze(0), t)[: of.degree[k]])
        return found, found

    edge = x
    for _ in range(6):  # Newton's steps of least length
        slope, value = torch.func.vmap(jacrev(off, has_aux=True))(edge, t)
        edge = edge - shortest_solution(torch.nan_to_num(slope), value)
        if not in_any_row(value.abs() > _ON_EDGE):
            break
    near = (torch.func.vmap(off)(edge, t)[0].abs() < 1e-6).all(-1) & torch.isfinite(edge).all(-1)
    (*_, ability) = torch.func.vmap(functools.partial(of.lean, k))(edge.unsqueeze(1), t)
    short = near & (ability < 1e-3 * usual * (of.degree[k] == 2))
    weak = short.double().sum() > _SEVERAL * near.double().sum()
    # Where the degree is one, whether rows brake apart depends on it: they agree, or part.
    return weak.to(x) if of.degree[k] == 2 else x.new_tensor(float(bool(weak)))


def speed_of(rate: Tensor) -> Tensor:
    """Return how fast h falls, at least 0."""
    return torch.where(rate < 0, -rate, 0.0)


def listed(call: str, constraints: Constraint | Sequence[Constraint], plant: Plant) -> list[Constraint]:
    """The constraints as a list, refused in the name of ``call`` where they are no functions of rows."""
    several = (
        [constraints] if callable(constraints) or not isinstance(constraints, Iterable) else [*constraints]
    )
    if not several or not all(map(callable, several)):
        raise fail(call, "constraints", "must be h(x, t) or a list of them", constraints)
    x, t = plant.equilibrium(), plant.equilibrium().new_zeros(())
    sizes = (len(several), plant.inputs, _PROBES, len(TIMES), _PROBES * len(TIMES))
    for k, h in enumerate(several):
        check_rows(f"{call}(constraints=...)` number {k} `h(x, t)", h, [x], shared=[t], sizes=sizes)
    return several


def check_traceable(call: str, plant: Plant) -> None:
    """Refuse a plant in discrete time, or with what torch cannot see into."""
    if isinstance(plant, StepPlant) or not isinstance(plant, Plant) or not plant.traceable:
        raise fail(call, "plant", "must be in continuous time and torch all through", plant)


def number(h: Constraint) -> RowValue:
    """h of one row: (1, n), () -> ()."""
    return lambda x, t: h(x, t)[0]


def rate_along(phi: RowValue, plant: Plant, x: Tensor, u: Tensor, t: Tensor) -> Tensor:
    """d phi / dt along the plant: (1, n), (1, m), () -> ()."""
    along_x, along_t = grad(phi, argnums=(0, 1))(x, t)
    rate: Tensor = (along_x * plant.motion(x, u)).sum() + along_t
    return rate

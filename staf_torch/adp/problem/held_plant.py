"""A control that is held for a time: where the plant goes with it, and what is paid."""

from __future__ import annotations

import copy
import logging
import math
from collections.abc import Callable

import torch
from torch import Tensor

from ...lanes import repeat
from ...lanes.per_row.decisions import each_row, is_of_rows, met_rows
from ...lanes.per_row.objects import made_by_rows
from ...lanes.row_numbers import nonzero
from ...lanes.trace.loops import untraced
from ...numerics.checks import integer, positive_real
from ...numerics.default_device import device_of, without_numbers
from ...numerics.rows import known_quantile
from ...numerics.runge_kutta import (
    GRACE,
    MOST,
    TOLERANCE,
    ExponentialStep,
    StepCount,
    exponential,
    exponential_stages,
    exponential_step,
    fewest_steps,
    runge_kutta_loop,
    stage_weights,
)
from ...systems import Clocked, Plant, StepPlant
from ...systems.base import spread_of
from .cost import Cost, quadratic
from .held_linear import periods

_log = logging.getLogger(__name__)
RESOLVED = 0.2  # of the time constant of the fastest mode, that one classical step may take: 3e-6 in error
_OUTSIDE = 100.0  # likewise in a few states far out
_SOME = 64  # substeps with which most plants stay finite
_SAMPLES, _SHARE = 24, 0.8  # states; the share that one step must serve, as it nearly must all
_MOVED = 0.1  # of the spread, in a hold, by inputs without bounds
_DEARER = 1.5  # work of an exponential step, in classical ones
_LEAST = 1e-6  # of a state, below which errors are absolute
_ROWS = 8  # with numbers of their own, that are looked at
_PAID = 0.1  # weight of the cost's error beside the state's
Substeps = int | tuple[int, int] | None


def fewest_and_most(call: str, substeps: int | tuple[int, int]) -> tuple[int, int]:
    """Return the numbers of integration steps, refused unless they are integers, the most no fewer than
    the least."""
    least, most = (substeps, substeps) if isinstance(substeps, int) else substeps
    return (
        integer(call, "substeps", least, least=1),
        integer(call, "substeps", most, least=least),
    )


class Holding:
    """x+ and the cost over ``dt`` seconds with u held: what simulators, designers and filters share.

    A plant in continuous time is integrated in equal steps of fourth order, and its cost rate with it: one
    classical Runge-Kutta step where it takes a fifth of the fastest time constant at most and its error is
    some 1e-6 of the state, else more of them or exponential steps around the linearisation, which solve its
    fast modes exactly: what is less work. The number is chosen once, by step doubling on states around the
    set-point (within the plant's ``spread``) and inputs within the bounds. A plant in discrete time takes
    its own steps, each of which pays its period times the cost rate at its start.

    Args:
        call: whose argument ``dt`` is, for messages.
        plant: the plant.
        cost: the cost rate, around the plant; None where nothing is paid.
        dt: s; of a plant in discrete time a multiple of its period.
        substeps: classical steps, at least 1; None for the rule above. Not for a plant in discrete time.
            Where the plant has a `Plant.step_limit` the first of them are no longer than that, and the last
            takes the rest. Two numbers: of such a plant the least where no limit is met, and the most.
        exponential: whether exponential steps may be chosen.

    Attributes:
        steps: integration steps of a hold, at most.
        error: relative error of a hold by step doubling, on the samples; None where nothing was chosen.

    Raises:
        ValueError: if ``dt`` is not positive, or no multiple of the plant's period.
    """

    told = ("error", "discount")

    def __init__(
        self,
        call: str,
        plant: Plant,
        cost: Cost | None,
        dt: float,
        substeps: Substeps = None,
        *,
        exponential: bool = True,
    ) -> None:
        self.call, self.plant, self.cost = call, plant, cost
        self.dt = positive_real(call, "dt", dt)
        self.least, self.steps = fewest_and_most(call, 1 if substeps is None else substeps)
        self.table: ExponentialStep | None = None
        self.curvature: Tensor | None = None  # of the cost, with a table
        self.discount = 0.0 if cost is None else cost.discount
        self.error: float | None = None
        if plant.period is not None:
            self.least = self.steps = periods(call, plant, dt)
        elif substeps is None and not without_numbers(plant, cost):
            with untraced(), torch.no_grad():  # a filter may ask for it in its first step
                self._choose_for_rows(exponential)

    @property
    def classical(self) -> bool:
        """True where a hold is one classical Runge-Kutta step of a state that steps are added to."""
        return self.steps == 1 and self.table is None and self.plant.period is None and _adds(self.plant)

    def __call__(
        self, x: Tensor, u: Tensor, renewed: Callable[[Tensor], Tensor] | None = None
    ) -> tuple[Tensor, Tensor]:
        """(..., n), (..., m) -> x+ (..., n) and the cost, discounted from the start, (...).

        Args:
            x: (..., n).
            u: (..., m).
            renewed: u from x, asked again before every further substep; None where u is held.
        """
        after, spent, *_ = self._hold(x, u, renewed, watch=False)
        return after, spent

    def watched(
        self, x: Tensor, u: Tensor, renewed: Callable[[Tensor], Tensor] | None = None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """`__call__`, and how much the rate bends within a substep: h |k_3 - k_2|, the largest, (...).

        It grows as (h / tau)^3 with the fastest mode that moves, and costs no call of the plant.
        """
        after, spent, *bent = self._hold(x, u, renewed, watch=True)
        return after, spent, bent[0] if bent else torch.zeros_like(spent)

    def of(self, plant: Plant) -> Holding:
        """Return a copy for a plant that differs from this in numbers."""
        other = copy.copy(self)
        other.plant = plant
        return other

    def checked(self) -> Holding:
        """Return this, with a warning in the log where steps that somebody chose are too few."""
        if self.error is None and self.plant.period is None:
            found = torch.cat(each_row(lambda: self.errors(*self._samples()), _ROWS))
            if len(found) and not float(found.max()) <= GRACE * TOLERANCE:
                _log.warning(
                    "%s: with %d integration steps a period of %.4g s the next state is wrong by up to %.2g "
                    "of its size; omit `substeps` for %.0e.",
                    *(self.call, self.steps, self.dt, float(found.max()), TOLERANCE),
                )
        return self

    def finer(self, factor: int) -> Holding:
        """Return a copy with so many times the steps."""
        other = copy.copy(self)
        other.steps, other.least = factor * self.steps, factor * self.least
        if self.table is not None:
            other.table = self._table(self.table.linear, other.steps)
        return other

    def _hold(
        self, x: Tensor, u: Tensor, renewed: Callable[[Tensor], Tensor] | None, watch: bool
    ) -> tuple[Tensor, ...]:
        if self.steps > 1 and (renewed is not None or self.plant.step_limit(x, u) is not None):
            return self._limited(x, u, renewed)
        length = self.dt / self.steps
        if self.steps == 1:
            return self._step(x, u, length, watch)
        decay, zero = exponential(-self.discount * length), torch.zeros_like(x[..., 0])

        def substep(now: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
            x, spent, share, most = now
            after, paid, *bent = self._step(x, u, length, watch)
            spent = spent + share * paid if nonzero(self.discount) else spent + paid
            return after, spent, decay * share, torch.maximum(most, bent[0]) if bent else most

        x, spent, _, most = repeat(self.steps, substep, (x, zero, zero + 1.0, zero))
        return x, spent, most

    def _limited(
        self, x: Tensor, u: Tensor, renewed: Callable[[Tensor], Tensor] | None
    ) -> tuple[Tensor, ...]:
        """Substeps of a row's own lengths."""
        none = torch.zeros_like(x[..., 0])
        longest = none + self.dt / self.least
        equal = self.least == self.steps

        def substep(now: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
            x, u, spent, left, count, most = now
            length = left / count if equal else torch.minimum(left, longest)
            limit = self.plant.step_limit(x, u)
            if limit is not None:
                length = torch.where(limit < length, limit, length)
            length = torch.where(count > 1, length, left)
            after, paid, bent = self._classical(x, u, length, watch=True)
            if nonzero(self.discount):
                paid = paid * torch.exp(-self.discount * (self.dt - left))
            return after, u, spent + paid, left - length, count - 1, torch.maximum(most, bent)

        def further(now: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
            return substep(now if renewed is None else (now[0], renewed(now[0]), *now[2:]))

        first = substep((x, u, none, none + self.dt, none + self.steps, none))
        some = None if equal else (lambda now: now[3] > 0)
        x, _, spent, _, _, most = repeat(self.steps - 1, further, first, where=some)
        return x, spent, most

    def _step(self, x: Tensor, u: Tensor, h: float, watch: bool) -> tuple[Tensor, ...]:
        if self.plant.period is not None:
            assert isinstance(self.plant, StepPlant | Clocked)
            paid = torch.zeros_like(x[..., 0]) if self.cost is None else h * self.cost.rate(x, u)
            return self.plant.step(x, u), paid
        return self._classical(x, u, h, watch) if self.table is None else self._exponential(x, u, h, watch)

    def _classical(self, x: Tensor, u: Tensor, h: float | Tensor, watch: bool) -> tuple[Tensor, ...]:
        """x+, what is paid, and `watched`'s number where it is wanted."""
        plant, cost = self.plant, self.cost
        none = torch.zeros_like(x[..., 0]) if cost is None else cost.input_rate(u)

        def field(at: Tensor) -> tuple[Tensor, Tensor]:
            return plant.velocity(at, u), none if cost is None else none + cost.state_rate(at)

        return runge_kutta_loop(plant.displaced, field, x, h, self.discount, watch)

    def _exponential(self, x: Tensor, u: Tensor, h: float, watch: bool) -> tuple[Tensor, ...]:
        plant, cost, table, none = self.plant, self.cost, self.table, torch.zeros_like(x[..., 0])
        assert table is not None
        begun = torch.zeros_like(x) if cost is None else cost.deviation(x)
        still = cost is None or _quadratic(cost)

        def field(away: Tensor) -> tuple[Tensor, Tensor]:
            at = x + away
            if cost is None or still:
                return plant.motion(at, u), none
            assert self.curvature is not None
            return plant.motion(at, u), cost.state_rate(at) - quadratic(self.curvature.to(x), begun + away)

        moved, rests, rates = exponential_stages(table, field, x)
        paid = none
        if cost is not None:
            shares = stage_weights(h, self.discount, x)[2]
            whole = h if not nonzero(self.discount) else -math.expm1(-self.discount * h) / self.discount
            paid = whole * cost.input_rate(u)
            if not still:  # what the rate differs from the quadratic form around the start, by Simpson's rule
                paid = paid + (shares.reshape(-1, *[1] * none.dim()) * rates).sum(0)
            assert table.paid is not None
            seen = torch.cat((begun, rests[0], 0.5 * (rests[1] + rests[2]), rests[3]), dim=-1)
            paid = paid + quadratic(table.paid.to(x), seen)
        after = plant.displaced(x, moved)
        return (after, paid, h * (rests[2] - rests[1]).abs().amax(-1)) if watch else (after, paid)

    def _table(self, linear: Tensor, steps: int) -> ExponentialStep:
        return made_by_rows(lambda: exponential_step(linear, self.dt / steps, self.curvature, self.discount))

    def _choose_for_rows(self, exponential: bool) -> None:
        """Choose by the rows that need most steps, where rows have numbers of their own; classical ones where
        not all of them would choose exponential ones. A row that needs more runs again."""

        def chosen(exponential: bool) -> Holding:
            other = copy.copy(self)
            other._choose(exponential)
            return other

        with met_rows() as met:
            found = each_row(lambda: chosen(exponential), _ROWS)
        tables = [each.table is not None for each in found]
        if any(tables) and not all(tables):
            found = each_row(lambda: chosen(False), _ROWS)
        vars(self).update(vars(max(found, key=lambda each: each.steps)))
        if met and self.table is not None:
            if self.cost is not None:
                self.curvature = made_by_rows(self.cost.state_curvature)
            linear = made_by_rows(self._linearisation)
            assert linear is not None
            self.table = self._table(linear, self.steps)

    def _choose(self, exponential: bool) -> None:
        """Choose the kind of the steps and their number."""
        x, u = self._samples()

        def errors(linear: Tensor | None) -> Callable[[int], Tensor]:
            return lambda count: self._with(count, linear).errors(x, u)

        one, linear = errors(None)(1), self._linearisation()
        found = StepCount(1, one.max() if len(one) else 0.0)
        usual = known_quantile(one, _SHARE, lower=True) if len(one) else 0.0
        slow = linear is None or bool(torch.linalg.eigvals(linear).abs().max() * self.dt <= RESOLVED)
        if not slow or bool(usual > GRACE * TOLERANCE) or bool(found.error > _OUTSIDE * TOLERANCE):
            x, u = _those(self._stays(x, u), x, u)
            if not (exponential and _adds(self.plant)):
                linear = None
            elif self.cost is not None:
                self.curvature = self.cost.state_curvature()
            dear = StepCount(MOST, math.inf)
            if linear is not None:
                dear = fewest_steps(errors(linear), TOLERANCE, MOST)
            most = MOST if bool(dear.error > TOLERANCE) else min(MOST, math.ceil(_DEARER * dear.number))
            found = fewest_steps(errors(None), TOLERANCE, most)
            cheaper = bool(found.error <= TOLERANCE) and found.number <= _DEARER * dear.number
            if not cheaper and bool(dear.error < found.error):
                found, self.table = dear, self._with(dear.number, linear).table
        self.least = self.steps = found.number
        self.error = found.error if is_of_rows(found.error) else float(found.error)  # type: ignore[assignment]
        if not bool(
            found.error <= (_OUTSIDE if found.number == 1 and self.table is None else GRACE) * TOLERANCE
        ):
            _log.warning(
                "%s: with %d integration steps a period of %.4g s the next state is wrong by %.2g of its "
                "size (wanted: %.0e): the rate is too fast for this dt, or has corners.",
                *(self.call, found.number, self.dt, found.error, TOLERANCE),
            )

    def _stays(self, x: Tensor, u: Tensor) -> Tensor:
        """Return which holds (P,) the plant itself survives: no number of steps serves a state from which it
        escapes to infinity within one."""
        stays = torch.ones(len(x), dtype=torch.bool, device=x.device)
        for count in (_SOME, MOST):
            asked = stays.clone() if count == _SOME else ~stays
            if bool(asked.any()):
                after = torch.isfinite(self._with(count, None)(*_those(asked, x, u))[0]).all(-1)
                stays = after if count == _SOME else stays.masked_scatter(asked, after)
        return stays

    def _with(self, count: int, linear: Tensor | None) -> Holding:
        """Return a copy with other steps."""
        other = copy.copy(self)
        other.least = other.steps = count
        other.table = None if linear is None else self._table(linear, count)
        return other

    def errors(self, x: Tensor, u: Tensor) -> Tensor:
        """Return the error of holds, relative to state and cost: (P, n), (P, m) -> (P,); inf where something
        is not finite."""
        (wrong, size), (off, due) = self.doubled(x, u)
        found = torch.maximum(wrong / size, _PAID * off / due)
        return found.nan_to_num(math.inf, math.inf)

    @torch.no_grad()
    def doubled(self, x: Tensor, u: Tensor) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
        """Return what twice the steps change of holds, and what that is compared with: of the state, (P,)
        each, and of the cost."""
        (after, paid), (better, due) = self(x, u), self.finer(2)(x, u)
        rest = self._rest().to(x)
        size = torch.stack([self.plant.difference(at, rest).abs().amax(-1) for at in (x, better)]).amax(0)
        least = _LEAST * (1 + rest.abs().max())
        rate = due.abs() if self.cost is None else self.dt * self.cost.rate(x, u).abs() + due.abs()
        wrong = (after - better).abs().amax(-1)
        return (wrong, size.clamp(min=least)), ((paid - due).abs(), rate.clamp(min=least**2))

    def _rest(self) -> Tensor:
        """The set-point, (n,)."""
        if self.cost is None or self.cost.target is None:
            return (
                self.plant.equilibrium()
                if self.plant.dim or self.cost is None
                else torch.zeros(self.cost.dim, dtype=torch.float64, device=device_of(self.cost))
            )
        return self.cost.target

    def _linearisation(self) -> Tensor | None:
        at, u = (None, None) if self.cost is None else (self.cost.target, self.cost.target_input)
        found = self.plant.linearisation(at, None if at is None else u).matrix.double()
        return found if bool(torch.isfinite(found).all()) else None

    def _samples(self) -> tuple[Tensor, Tensor]:
        """States around the set-point and inputs, (P, n) and (P, m), at which the plant moves."""
        plant, cost, rest = self.plant, self.cost, self._rest().double()
        generator = torch.Generator().manual_seed(0)
        x = torch.rand(_SAMPLES, len(rest), dtype=torch.float64, generator=generator, device="cpu")
        x = 2 * x.to(rest) - 1
        spread = spread_of(plant, rest)
        most = spread if isinstance(spread, float | int) or spread.dim() == 0 else spread.amax()
        x = rest + spread * (x.abs() if isinstance(plant, Clocked) else x)
        still = (
            plant.resting_input().double() if cost is None or cost.target_input is None else cost.target_input
        )
        u = still.expand(_SAMPLES, -1)
        chance = torch.rand(_SAMPLES, u.shape[-1], dtype=torch.float64, generator=generator, device="cpu")
        chance = chance.to(rest)
        bounds = plant.bounds if cost is None or cost.bounds is None else cost.bounds
        none = torch.full_like(still, math.inf)
        low, high = (-none, none) if bounds is None else (bounds.low.double(), bounds.high.double())
        rate, columns = plant.motion(x, u), []
        for k in range(u.shape[-1]):  # as far as a loop may go in a period
            one = torch.eye(len(still), dtype=torch.float64, device=still.device)[k]
            pushed = plant.motion(x, u + one) - rate
            push = known_quantile((pushed.abs() * (most / spread)).amax(-1).nan_to_num(0.0, 0.0), 0.5)
            width = torch.where(push > 0, _MOVED * most / (self.dt * push), 1.0)
            least = torch.maximum(low[k], still[k] - width)
            most = torch.minimum(high[k], still[k] + width)
            columns.append(least + (most - least) * chance[:, k])
        u = torch.stack(columns, dim=-1) if columns else u
        moves = torch.isfinite(plant.motion(x, u)).all(-1)
        return _those(moves, x, u)


def _those(keep: Tensor, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    """Return the samples (P, ...) to keep, (P,) bool."""
    return (x, u) if bool(keep.all()) else (x[keep], u[keep])


def _adds(plant: Plant) -> bool:
    """Return whether a step of the motion is added to the state."""
    kind = type(plant)
    return kind.displaced is Plant.displaced and kind.velocity is Plant.velocity


def _quadratic(cost: Cost) -> bool:
    """Return whether the state's rate is the quadratic form of the deviation, without turns."""
    kind = type(cost)
    own = kind.state_rate is not Cost.state_rate or kind.deviation is not Cost.deviation
    return not (own or cost.output is not None or cost.periodic)

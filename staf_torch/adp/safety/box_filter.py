"""A filter that keeps the plant of a `Barrier` in its box while the control is held."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor, nn

from ...lanes import compiled, repeat
from ...lanes.gradients import grad, vjp
from ...lanes.per_row.objects import OfRows
from ...numerics.checks import fail, positive_real, trailing
from ...numerics.default_device import device_of
from ...numerics.runge_kutta import runge_kutta_mean, runge_kutta_stages
from ...systems import Barrier, Bounds
from ..loop.controller import Policy
from .conditions import Constraint
from .quadratic_program import cases, nearest_admissible, sides_of

_LEFT, _LEAST = (
    0.5,
    1e-3,
)  # share of a distance that a hold leaves, and at least: where no control leaves half
_MET = 1e-4  # of u, by which a condition may be missed where it counts as met: less than `_LEAST` leaves
_PASSES = 5  # linearisations of the held plant: three are exact to 1e-6 from braking on, not from 0
_PROBES = 32  # states at which the effect of the inputs is looked for
_NOTHING = 1e-9  # slope below which there is none


class Held(NamedTuple):
    """Motion of a plant in a box under a held control."""

    middle: Tensor  # x(dt/2) - x, (B, n)
    end: Tensor  # x(dt) - x
    rates: tuple[Tensor, Tensor, Tensor]  # x' at the beginning, in the middle and at the end


class BoxFilter(nn.Module, metaclass=OfRows):
    """The control nearest to what a policy wants that keeps x in the box of a `Barrier` until it is renewed,
    and leaves room to brake from then on:

        min |u - policy(s)|^2 over the bounds of the plant, and for the distance d(t) of every wall
        d(t) >= d(0)/2 for 0 <= t <= hold, or d(hold) >= hold times the speed towards it at the end,

    the second where inputs move the speed of a coordinate (relative degree two) and that of now does not use
    up d(0) within the hold: the next hold can stop it, and a third of d(0) is left. Where no control leaves
    half of every distance a thousandth has to do. x(t) is that of the plant, by two Runge-Kutta steps and
    Hermite's cubic between; distances are those of s, with all digits also beside a wall. A wanted control
    that satisfies everything is applied bit for bit.

    Not every state can be kept: at 1e-6 from a wall and heading for it every admissible control carries the
    plant out, or through another wall; `share` says so. Where inputs have no bounds that is a matter of
    ``dt`` alone: with ``renewed`` a control is held for half the time to the next wall, if that is less;
    `simulate(..., substeps=16, renew=True)` renews it like that within ``dt``. One hold is looked ahead: a
    policy that never brakes, u = 0, comes to corners where the walls of two coordinates contradict.

    Example:
        >>> box = systems.Barrier(systems.TwoStateChain(), low=[-7.0, -5.0], high=[5.0, 7.0])
        >>> lqr = adp.LQR(box, adp.QuadraticCost(10.0, 0.1, dim=2, inputs=1))
        >>> guard = adp.BoxFilter(lqr, box, dt=0.001)
        >>> s = box.transform(torch.tensor([[4.995, 5.0], [5 - 1e-6, 5.0], [1.0, 1.0]]).double())
        >>> guard.share(s) < 1, bool(guard(s)[2] == lqr(s)[2])
        (tensor([ True, False,  True]), True)

        Shown by `staf experiment=safe_box`.

    Args:
        policy: u from s, (..., n) -> (..., m).
        box: the plant.
        dt: s, for which a control is held.
        renewed: whether `hold` shortens it near a wall.

    Raises:
        ValueError: if an argument breaks its rule, or the inputs move neither a walled coordinate nor its
            speed.
    """

    rowwise: ClassVar = {"hold": (1,), "inequalities": (1, 1, 0, 0)}

    def __init__(self, policy: Policy, box: Barrier, *, dt: float, renewed: bool = False) -> None:
        super().__init__()
        if not isinstance(box, Barrier):
            raise fail("BoxFilter", "box", "must be a systems.Barrier", box)
        self.policy, self.box, self.renewed = policy, box, renewed
        self.period = positive_real("BoxFilter", "dt", dt)
        self.bounds = box.bounds if box.bounds is not None else Bounds(None, None, box.inputs)
        walled = box.walled.cpu()
        self.walls = [
            (k, side) for k in range(box.dim or 0) for row, side in ((0, -1), (1, 1)) if walled[row, k]
        ]
        if not self.walls:
            raise fail("BoxFilter", "box", "must have a wall", box)
        degrees = _degrees(box)
        self.degree = [degrees[k] for k, _ in self.walls]
        if 0 in self.degree:
            raise ValueError(
                "`BoxFilter(box=...)` must have inputs that move every walled coordinate or its speed; not "
                f"so coordinate {self.walls[self.degree.index(0)][0]}."
            )
        table = cases(len(self.walls), *sides_of(self.bounds))
        self.register_buffer("table", table.to(device_of(box)))
        self.table: Tensor

    def forward(self, s: Tensor) -> Tensor:
        """u: (..., n) -> (..., m)."""
        trailing("BoxFilter", "s", s, 1, self.box.dim)
        return self.held(s, self.hold(s))

    def held(self, s: Tensor, hold: Tensor) -> Tensor:
        """u for a hold of its own a row, s: (..., n), (...) -> (..., m)."""
        return self._asked(s, hold)[..., :-1]

    def share(self, s: Tensor) -> Tensor:
        """The largest share of a distance to a wall that is used up while the control is held: (..., n) ->
        (...). From 1 on the plant leaves the box, and no admissible control keeps it inside."""
        return self._asked(s, self.hold(s))[..., -1]

    def hold(self, s: Tensor) -> Tensor:
        """For how long the control is held, s: (..., n) -> (...)."""
        whole = torch.full_like(s[..., 0], self.period)
        if not self.renewed:
            return whole
        rate = self.box.plant.motion(
            self.box.inverse(s), self.box.resting_input().to(s).expand(*s.shape[:-1], -1)
        )
        distances = self._apart(s)
        for (k, side), degree in zip(self.walls, self.degree, strict=True):
            if degree == 2:
                apart, speed = distances[side][..., k], side * rate[..., k]
                whole = torch.where(2 * whole * speed > apart, 0.5 * apart / speed, whole)
        return whole

    def _asked(self, s: Tensor, hold: Tensor) -> Tensor:
        trailing("BoxFilter", "s", s, 1, self.box.dim)
        return self._nearest(torch.cat((s, hold.unsqueeze(-1)), dim=-1))

    @compiled("a box filter")
    def _nearest(self, z: Tensor) -> Tensor:
        """u and what is missing, of rows of (s, hold): (..., n + 1) -> (..., m + 1)."""
        rows = z.reshape(-1, z.shape[-1])
        s, hold = rows[:, :-1], rows[:, -1]
        low, high = self.bounds.low.to(s), self.bounds.high.to(s)
        wanted = torch.minimum(torch.maximum(self.policy(s), low), high)

        def leaving(left: Tensor) -> tuple[Tensor, Tensor]:
            """The control that leaves such a share of every distance, and where there is one."""

            def linearise(now: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
                u, met = now
                found = nearest_admissible(
                    wanted, *self.inequalities(s, u, hold, left), low, high, self.table
                )
                # Where nothing fits, u is far out, where the plant is another one: the first stands.
                missed = found.shortfall > _MET * (1 + found.point.abs().amax(-1))
                return torch.where(met.unsqueeze(-1) > 0, found.point, u), torch.where(missed, 0 * met, met)

            result: tuple[Tensor, Tensor] = repeat(_PASSES, linearise, (wanted, torch.ones_like(hold)))
            return result

        def less(now: tuple[Tensor, Tensor, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
            u, done, left = now
            found, met = leaving(left)
            return torch.where(done.unsqueeze(-1) > 0, u, found), torch.maximum(done, met), 0 * left + _LEAST

        # Most controls ask for no correction: what is looked for costs ten times what finding this out does.
        half = torch.full_like(hold, _LEFT)
        fine = (self._conditions(s, wanted, hold, half) >= 0).all(-1).to(hold)
        u, _, _ = repeat(2, less, (wanted, fine, half), where=lambda now: now[1] == 0)
        return torch.cat((u, self._share(s, u, hold).unsqueeze(-1)), dim=-1).reshape(*z.shape[:-1], -1)

    def _share(self, s: Tensor, u: Tensor, hold: Tensor) -> Tensor:
        held, apart = self._held(self.box.inverse(s), u, hold), self._apart(s)
        used = [_excursion(held, k, side, hold) / apart[side][:, k] for k, side in self.walls]
        return torch.stack(used, dim=-1).amax(-1)

    def _apart(self, s: Tensor) -> dict[int, Tensor]:
        return dict(zip((-1, 1), self.box.walls(s), strict=True))

    def inequalities(self, s: Tensor, u: Tensor, hold: Tensor, left: Tensor) -> tuple[Tensor, Tensor]:
        """a_i and c_i of the conditions a_i'u >= c_i, linearised at u, one a wall: (B, n), (B, m), (B,), (B,)
        -> (B, W, m), (B, W)."""
        value, pull = vjp(lambda u: self._conditions(s, u, hold, left), u)
        # Reverse mode: forward mode in plain torch takes a hundred times as long, for its own reasons.
        walls = torch.eye(len(self.walls), dtype=u.dtype, device=u.device)
        normal = torch.func.vmap(lambda one: pull(one.expand_as(value))[0], out_dims=1)(walls)
        return normal, (normal * u.unsqueeze(-2)).sum(-1) - value

    def _conditions(self, s: Tensor, u: Tensor, hold: Tensor, left: Tensor) -> Tensor:
        """Return the conditions of the walls, each met where it is >= 0: (B, W)."""
        held, apart = self._held(self.box.inverse(s), u, hold), self._apart(s)
        found = [
            self._condition(held, k, side, degree, apart[side][:, k], hold, left)
            for (k, side), degree in zip(self.walls, self.degree, strict=True)
        ]
        return torch.stack(found, dim=-1)

    def _condition(
        self, held: Held, k: int, side: int, degree: int, apart: Tensor, hold: Tensor, left: Tensor
    ) -> Tensor:
        """Return the condition of a wall, met where it is >= 0: (B,)."""
        excursion = _excursion(held, k, side, hold)
        room = (1 - left) * apart
        if degree == 1:
            return room - excursion
        start, last = side * held.rates[0][:, k], side * held.rates[2][:, k]
        calm = (apart - side * held.end[:, k]) / hold - last
        if self.renewed:
            calm = torch.where(hold < self.period, -last, calm)
        # What is braked from v to 0 goes v^2/2a far: where that ends within the hold, 1/a is what is affine.
        stop = (start - last) / hold
        spread = torch.where((start > 0) & (last < 0), stop * excursion, 0.5 * start.square())
        return torch.where(start * hold > 2 * room, stop - spread / room, calm / hold)

    def _held(self, x: Tensor, u: Tensor, hold: Tensor) -> Held:
        motion, half = self.box.plant.motion, (0.5 * hold).unsqueeze(-1)

        def advance(done: Tensor) -> tuple[Tensor, Tensor]:
            slopes = runge_kutta_stages(lambda at, share: motion(x + at, u), done, half)[1]
            return done + runge_kutta_mean(slopes, half), slopes[0]

        middle, start = advance(torch.zeros_like(x))
        end, between = advance(middle)
        return Held(middle, end, (start, between, motion(x + end, u)))


def _excursion(held: Held, k: int, side: int, hold: Tensor) -> Tensor:
    """Return how far a coordinate comes towards a wall, at least 0: (B,)."""
    middle, end = side * held.middle[:, k], side * held.end[:, k]
    start, half, last = (side * rate[:, k] for rate in held.rates)
    first = _summit(torch.zeros_like(middle), middle, start, half, 0.5 * hold)
    return torch.maximum(first, _summit(middle, end, half, last, 0.5 * hold))


def _summit(first: Tensor, last: Tensor, rise: Tensor, fall: Tensor, length: Tensor) -> Tensor:
    """The largest value of the cubic over ``length`` that has these values and slopes at its ends: (B,)."""
    up, down, apart = rise * length, fall * length, last - first
    square, cube = 3 * apart - 2 * up - down, up + down - 2 * apart
    inside = square.square() - 3 * cube * up
    turns = (up > 0) & (inside > 0)
    below = torch.where(turns, inside, 1.0).sqrt() - square
    turns = turns & (below > up)  # within the length
    # Numbers in the place of those that are not used: where the cubic is a line the slope of a root of 0 and
    # of a division by 0 would make all slopes NaN, and the filter helpless. In float32 lines are common.
    at = torch.where(turns, up, 0.5) / torch.where(turns, below, 1.0)
    peak = first + at * (up + at * (square + at * cube))
    ends = torch.maximum(first, last)
    return torch.where(turns & (peak > ends), peak, ends)


def _degrees(box: Barrier) -> list[int]:
    """Return for every coordinate which derivative of x the inputs move, 1 or 2; 0 for neither."""
    plant, size = box.plant, box.dim or 0
    share = torch.rand(
        _PROBES, size, dtype=torch.float64, generator=torch.Generator().manual_seed(0), device="cpu"
    )
    x = box.floor + (box.ceiling - box.floor) * share.to(box.floor)
    rest = plant.resting_input().to(x).expand(_PROBES, -1)
    found = []
    for k in range(size):

        def speed(x: Tensor, u: Tensor, k: int = k) -> Tensor:
            return plant.motion(x, u)[:, k].sum()

        def pushed(u: Tensor) -> Tensor:
            slope = grad(speed)(x, u)
            rate: Tensor = (slope * plant.motion(x, u)).sum()
            return rate

        effects = grad(speed, argnums=1)(x, rest), grad(pushed)(rest)
        found.append(next((n for n, one in enumerate(effects, 1) if bool((one.abs() > _NOTHING).any())), 0))
    return found


def walls(low: Sequence[float], high: Sequence[float]) -> list[Constraint]:
    """Return h of every coordinate with a wall, in its units, of n limits, infinite for none: (x -
    low)(high - x)/(high - low), or the distance to its one wall."""
    pairs = enumerate(zip(low, high, strict=True))
    return [_within(k, *pair) for k, pair in pairs if not all(map(math.isinf, pair))]


def _within(k: int, low: float, high: float) -> Constraint:
    if math.isinf(low) or math.isinf(high):
        return lambda x, t: high - x[:, k] if math.isinf(low) else x[:, k] - low
    return lambda x, t: (x[:, k] - low) * (high - x[:, k]) / (high - low)

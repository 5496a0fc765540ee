"""A plant in coordinates in which a box of states is the whole space."""

from __future__ import annotations

import math
from typing import ClassVar

import torch
from torch import Tensor

from ..lanes.per_row.objects import by_rows
from ..numerics.angles import wrap
from ..numerics.checks import fail, fails, hold, states
from .base import ControlAffineSystem, Limit, Linearisation, Units, limit_of_each


class Barrier(ControlAffineSystem):
    """A plant in barrier coordinates s: every bounded coordinate of its state is measured by

        s = ln( (x - low) (high - c) / ((high - x) (c - low)) ),  ds/dx = 1/(x - low) + 1/(high - x),

    so that s runs from -inf to inf while x runs from one wall to the other, and s = 0 where the plant rests,
    at x = c. A policy, cost or learner of s then knows no constraint. With one wall the other factor is left
    out; a coordinate without walls is s = x - c.

    Next to a wall x has few digits of its distance, s has all of them: `walls` and `margin` read them from s,
    and a closed loop moves the distances, so that a step is as accurate there as anywhere and as little stiff
    as the plant is. A held control that carries the plant through a wall makes s NaN: `adp.simulate` freezes
    that row and counts it as diverged. No control keeps every state inside: whoever heads for a wall needs
    room to brake.

    A cost of x is one with an output: ``QuadraticCost(..., output=barrier.inverse)``.

    Example:
        >>> plant = systems.Barrier(systems.Pendulum(), low=[-1.0, None], high=[2.0, None])
        >>> s = plant.transform(torch.tensor([2.0 - 1e-6, 3.0], dtype=torch.float64))
        >>> s.round(decimals=4), plant.margin(s)
        (tensor([15.6073,  3.0000], dtype=torch.float64), tensor(1.0000e-06, dtype=torch.float64))

        Shown by `staf experiment=safe_box`.

    Args:
        plant: that says its dim, in continuous time and affine in the control.
        low, high: of the states, a number or one a coordinate, in their units; None or infinite for no wall.

    Raises:
        ValueError: if the plant is of another kind, a wall has another length or is NaN, or the plant's
            equilibrium is not strictly between the walls.

    Source: Mahmud et al., Front. Robot. AI 8 (2021), eq. (2), around 0; here around the equilibrium.
    """

    rowwise: ClassVar = dict.fromkeys(
        ("coordinates", "transform", "inverse", "margin", "stretch", "walls"), (1,)
    )

    def __init__(self, plant: ControlAffineSystem, low: Limit, high: Limit) -> None:
        if not isinstance(plant, ControlAffineSystem) or plant.dim is None:
            raise fail("Barrier", "plant", "must be a ControlAffineSystem with `dim`", plant)
        super().__init__()
        center = plant.equilibrium().double()
        lows = limit_of_each("Barrier", "low", low, -math.inf, plant.dim, "states").to(center)
        highs = limit_of_each("Barrier", "high", high, math.inf, plant.dim, "states").to(center)
        sides = ("low", lows, lows >= center, "below"), ("high", highs, highs <= center, "above")
        for name, wall, wrong, side in sides:
            if bool(wrong.any()):
                rule = f"must be {side} the equilibrium {center.tolist()} in every coordinate"
                raise fail("Barrier", name, rule, wall.tolist())
        self.plant = plant
        self.dim, self.inputs, self.bounds = plant.dim, plant.inputs, plant.bounds
        unbounded = torch.isinf(lows) & torch.isinf(highs)
        free = unbounded.tolist()
        own = zip(plant.units.of_states(plant.dim), free, strict=True)
        self.units = Units(", ".join(unit if same and unit else "1" for unit, same in own), plant.units.input)
        self.periodic = tuple(k for k in plant.periodic if free[k % plant.dim])
        self._turning = tuple(k for k in plant.periodic if not free[k % plant.dim])
        below, above = 1 / (center - lows), 1 / (highs - center)  # 0 for a wall that is not there
        self.low = hold(self, "low", lows)  # (n,)
        self.high = hold(self, "high", highs)
        self.center = hold(self, "center", center)
        # 1/(c - low) and 1/(high - c); where there is no wall at all any number: what it makes is not used.
        self.below = hold(self, "below", torch.where(unbounded, 0.5, below))
        self.above = hold(self, "above", torch.where(unbounded, 0.5, above))
        self.free = hold(self, "free", unbounded)  # (n,) bool: no wall at all
        # The walls, or a number in their place; and which there are, (2, n) bool: a low, a high one.
        self.floor = hold(self, "floor", torch.where(torch.isinf(lows), center - 1, lows))
        self.ceiling = hold(self, "ceiling", torch.where(torch.isinf(highs), center + 1, highs))
        self.walled = hold(self, "walled", torch.stack((torch.isfinite(lows), torch.isfinite(highs))))

    @property
    def traceable(self) -> bool:
        return self.plant.traceable

    def resting_input(self) -> Tensor:
        return self.plant.resting_input()

    def transform(self, x: Tensor) -> Tensor:
        """s from x: (..., n) -> (..., n).

        Raises:
            ValueError: if a state is not strictly inside the box; the message names the first such row.
        """
        low, high, center = self.low.to(x), self.high.to(x), self.center.to(x)
        x = center + wrap(x - center, self._turning) if self._turning else x
        inside = ((x > low) & (x < high)).all(-1)
        if fails(inside):
            row = int((~inside).flatten().nonzero()[0])
            raise ValueError(
                f"`Barrier.transform(x=...)` must lie strictly between the walls {low.tolist()} and "
                f"{high.tolist()}; not so row {row}, {x.reshape(-1, x.shape[-1])[row].tolist()}."
            )
        return self.coordinates(x)

    def coordinates(self, x: Tensor) -> Tensor:
        """`transform` without its check, NaN outside the box, for compiled loops: (..., n) -> (..., n)."""
        center = self.center.to(x)
        x = center + wrap(x - center, self._turning) if self._turning else x
        down = torch.where(self.walled[0].to(x.device), (x - self.floor.to(x)) * self.below.to(x), 1.0)
        up = torch.where(self.walled[1].to(x.device), (self.ceiling.to(x) - x) * self.above.to(x), 1.0)
        return self._coordinate(x - center, down, up)

    def inverse(self, s: Tensor) -> Tensor:
        """x from s: (..., n) -> (..., n), in the box up to rounding: 1e-17 beside a wall x is the wall."""
        apart, down, up = self._shares(s)
        # From the wall where that is near, from the middle where s is small: no digit is lost in either.
        from_low = self.floor.to(s) + down * (self.center - self.floor).to(s)
        from_high = self.ceiling.to(s) - up * (self.ceiling - self.center).to(s)
        x = torch.where((up < 0.5) & self.walled[1].to(s.device), from_high, self.center.to(s) + apart)
        return torch.where((down < 0.5) & self.walled[0].to(s.device), from_low, x)

    def walls(self, s: Tensor) -> tuple[Tensor, Tensor]:
        """x - low and high - x with all digits, inf where there is no wall: (..., n) -> two (..., n)."""
        _, down, up = self._shares(s)
        to_low, to_high = down * (self.center - self.floor).to(s), up * (self.ceiling - self.center).to(s)
        return torch.where(self.walled[0].to(s.device), to_low, torch.inf), torch.where(
            self.walled[1].to(s.device), to_high, torch.inf
        )

    def margin(self, s: Tensor) -> Tensor:
        """The distance to the nearest wall, in the units of its coordinate: (..., n) -> (...)."""
        return torch.minimum(*self.walls(s)).amin(-1)

    def stretch(self, s: Tensor) -> Tensor:
        """ds/dx of every coordinate: (..., n) -> (..., n)."""
        _, down, up = self._shares(s)
        return torch.where(self.free.to(s.device), 1.0, self.below.to(s) / down + self.above.to(s) / up)

    def drift(self, s: Tensor) -> Tensor:
        return self.stretch(states(self, "s", s, self.dim)) * self.plant.drift(self.inverse(s))

    def smooth_drift(self, s: Tensor) -> Tensor:
        return self.stretch(s) * self.plant.smooth_drift(self.inverse(s))

    def effectiveness(self, s: Tensor) -> Tensor:
        return self.stretch(s).unsqueeze(-1) * self.plant.effectiveness(self.inverse(s))

    def velocity(self, s: Tensor, u: Tensor) -> Tensor:
        """x' of the plant itself: (..., n), (..., m) -> (..., n)."""
        return self.plant.motion(self.inverse(s), u)

    def displaced(self, s: Tensor, step: Tensor) -> Tensor:
        """s of the state whose x is ``step`` further on, NaN beyond a wall: (..., n) twice -> (..., n)."""
        apart, down, up = self._shares(s)
        down = torch.where(self.walled[0].to(s.device), down + step * self.below.to(s), 1.0)
        up = torch.where(self.walled[1].to(s.device), up - step * self.above.to(s), 1.0)
        return self._coordinate(apart + step, down, up)

    def step_limit(self, s: Tensor, u: Tensor) -> Tensor:
        """Half the time in which the nearest wall would be reached at the speed of now, inf where none is
        ahead: (..., n), (..., m) -> (...). No stage of a Runge-Kutta step is then beyond a wall."""
        rate = self.velocity(s, u)
        (down, up), none = self.walls(s), torch.full_like(s, torch.inf)
        low, high = torch.where(rate < 0, -down / rate, none), torch.where(rate > 0, up / rate, none)
        return 0.5 * torch.minimum(low, high).amin(-1)

    @by_rows
    def linearisation(self, x: Tensor | None = None, u: Tensor | None = None) -> Linearisation:
        """D A D^-1 and D B with D = ds/dx, near a state of rest s and an input."""
        s = self.equilibrium() if x is None else x
        found = self.plant.linearisation(self.inverse(s), u)
        scale = self.stretch(s).to(found.matrix)
        rows = scale.unsqueeze(-1)
        return Linearisation(rows * found.matrix / scale, rows * found.input_matrix)

    def _shares(self, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """x - c, (x - low)/(c - low) and (high - x)/(high - c), the last two 1 where there is no wall."""
        below, above = self.below.to(s), self.above.to(s)
        left = s < 0
        small = torch.where(left, s, -s)  # -|s|, but with a slope at 0
        share = small.exp()
        whole = torch.where(left, below + above * share, above + below * share)
        far = (below + above) / whole
        near = far * share
        apart = torch.where(left, small.expm1(), -small.expm1()) / whole
        down, up = torch.where(left, near, far), torch.where(left, far, near)
        return torch.where(self.free.to(s.device), s, apart), down, up

    def _coordinate(self, apart: Tensor, down: Tensor, up: Tensor) -> Tensor:
        """s by log1p of what the nearer wall's share is short of the other, which loses no digit."""
        left = apart < 0
        whole = (self.below + self.above).to(apart)
        s = (torch.where(left, -apart, apart) * whole / torch.where(left, down, up)).log1p()
        s = torch.where(left, -s, s)
        # The far wall has no part in s, but a step may lead through it.
        return torch.where(
            self.free.to(apart.device), apart, torch.where((down > 0) & (up > 0), s, torch.nan)
        )

"""Optimal control in steps: a plant whose control is held for a period, its cost and its bounds."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from ...lanes import each, traced_as
from ...numerics.angles import turned, unwrapped, wrap
from ...numerics.checks import fail, integer, positive_real, trailing
from ...numerics.forward_mode import use_forward_mode
from ...numerics.linalg import discrete_riccati, positive_semidefinite
from ...numerics.runge_kutta import runge_kutta_mean, runge_kutta_stages
from ...systems import Bounds, Plant
from ...systems.bounds import Limit
from .cost import Cost
from .held_plant import Holding
from .tracking_cost import Path, TrackingCost

StepFunction = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
"""(x (B, n), u (B, m)) -> (x+ (B, n), cost of the step (B,))."""
_RESTS = 1e-6  # of the scale of the state: how far the goal may move in a step


class SampledProblem(nn.Module):
    """min sum_k l(x_k, u_k) over low <= u_k <= high, with x_{k+1} = F(x_k, u_k).

    Example:
        >>> def step(x, u):  # a cart without friction, for 0.1 s
        ...     after = torch.stack((x[:, 0] + 0.1 * x[:, 1], x[:, 1] + 0.1 * u[:, 0]), dim=-1)
        ...     return after, 0.1 * (x.square().sum(-1) + u.square().sum(-1))
        >>> problem = adp.SampledProblem(step, dim=2, inputs=1, low=-1.0, high=1.0)
        >>> problem.k.shape
        torch.Size([1, 2])

        Shown by `staf_torch/adp/README.md`.

    Args:
        step: maps x (B, n) and u (B, m), held for one period, to x+ (B, n) and the cost l (B,). No row sees
            another. It is differentiated twice by `torch.func` and compiled by `lanes`.
        dim: n.
        inputs: m.
        low: of u, as in `systems.Bounds`; None for none.
        high: likewise.
        periodic: the coordinates that are angles, in rad.
        goal: state at which the plant rests at no cost, (n,); the origin by default.
        rest: control that keeps it there, (m,); 0 by default.
        path: x_d from t, (...) -> (..., n - 1), for a problem whose last coordinate is the time: the goal
            moves along it. The linear feedback is that of ``goal``, where the plant rests, carried along.
        terminal: S of d'Sd, paid where a plan ends, (n, n) positive semidefinite, d = x - goal; None for P
            below, as the problem goes on without an end.

    Attributes:
        p: P of the value d'Pd of the best linear feedback near the goal, (n, n), d = x - goal.
        k: K of its control rest - K d, (m, n).

    Raises:
        ValueError: if an argument breaks its rule, ``step`` returns other shapes, the goal is not at rest at
            no cost, or the linearisation there cannot be stabilised.
    """

    def __init__(
        self,
        step: StepFunction,
        *,
        dim: int,
        inputs: int,
        low: Limit = None,
        high: Limit = None,
        periodic: Sequence[int] = (),
        goal: Tensor | None = None,
        rest: Tensor | None = None,
        path: Path | None = None,
        terminal: Tensor | None = None,
    ) -> None:
        super().__init__()
        self.step = step
        self.holding: Holding | None = None  # of a plant in continuous time
        self.path: Path | None = path
        self.dim = integer("SampledProblem", "dim", dim, least=1)
        self.inputs = integer("SampledProblem", "inputs", inputs, least=1)
        zeros = torch.zeros(self.dim, dtype=torch.float64)
        none = torch.zeros(self.inputs, dtype=torch.float64)
        self.bounds = Bounds(low, high, self.inputs)
        self.register_buffer("goal", zeros if goal is None else goal.double())
        self.register_buffer("rest", none if rest is None else rest.double())
        self.goal: Tensor
        self.rest: Tensor
        if not bool(((self.bounds.low < self.rest) & (self.rest < self.bounds.high)).all()):
            rule = f"must lie between the bounds, {self.bounds.low.tolist()} and {self.bounds.high.tolist()}"
            raise fail("SampledProblem", "rest", rule, self.rest.tolist())
        if not set(periodic) <= set(range(-self.dim, self.dim)):
            raise fail("SampledProblem", "periodic", f"must be coordinates of {self.dim}", list(periodic))
        self.periodic = tuple(sorted({index % self.dim for index in periodic}))
        self.tick = 0.0  # s of a step, where the last coordinate is the time
        self._check()
        p, k = self._regulator()
        self.register_buffer("p", p)
        self.register_buffer("k", k)
        self.p: Tensor
        self.k: Tensor
        self.endless = terminal is None
        if terminal is not None:
            terminal = positive_semidefinite("SampledProblem", "terminal", terminal, self.dim)
        self.register_buffer("end", p if terminal is None else terminal)
        self.end: Tensor

    @classmethod
    def of(
        cls,
        plant: Plant,
        cost: Cost,
        *,
        dt: float | None = None,
        low: Limit = None,
        high: Limit = None,
        substeps: int | None = None,
    ) -> SampledProblem:
        """A plant and a cost rate, with the control held for dt.

        A plant in continuous time is integrated to 1e-6 of its state, as `Holding` says: by one Runge-Kutta
        step of fourth order, where that is enough, and its cost with it; one in discrete time pays its period
        times the cost rate.

        Args:
            plant: the plant.
            cost: the cost rate, without a discount.
            dt: s, positive; None for the period of a plant in discrete time.
            low: of the inputs; None for those of the cost, or else of the plant.
            high: likewise.
            substeps: Runge-Kutta steps a period; None for as many as are accurate. Fewer are a warning.

        Raises:
            ValueError: if an argument breaks its rule, or as in `SampledProblem`.
        """
        if not plant.traceable:
            rule = (
                "must be written in torch all through: trajectories are optimised by its second derivatives"
            )
            raise fail("SampledProblem.of", "plant", rule, plant)
        cost = cost.bounded(low, high).around(plant)
        if cost.discount:
            raise fail("SampledProblem.of", "cost", "must have no discount", cost.discount)
        h = positive_real("SampledProblem.of", "dt", dt) if plant.period is None else plant.period
        if plant.period is not None and dt is not None and dt != plant.period:
            raise fail("SampledProblem.of", "dt", f"must be the plant's period, {plant.period} s", dt)

        box = cost.bounds
        holding: Holding | None = None
        step: StepFunction = partial(_stepped, plant, cost)
        if plant.period is None:
            holding = Holding("SampledProblem.of", plant, cost, h, substeps).checked()
            step = partial(_held, plant, cost, h) if holding.classical else holding
        problem = cls(
            step,
            dim=cost.dim,
            inputs=cost.inputs,
            low=None if box is None else box.low,
            high=None if box is None else box.high,
            periodic=plant.periodic,
            goal=plant.equilibrium() if isinstance(cost, TrackingCost) else cost.target,
            rest=cost.target_input,
            path=cost.path if isinstance(cost, TrackingCost) else None,
            terminal=cost.end,
        )
        problem.holding = holding
        return problem

    def advance(self, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """x+ and the cost of the step: (..., n), (..., m) -> (..., n), (...)."""
        after, paid = self.step(x.reshape(-1, self.dim), u.reshape(-1, self.inputs))
        return after.reshape(x.shape), paid.reshape(x.shape[:-1])

    def offset(self, x: Tensor, center: Tensor) -> Tensor:
        """x - center by the shorter way around: (..., n), (..., n) -> (..., n)."""
        return wrap(x - center, self.periodic)

    def goals(self, x: Tensor, steps: int) -> Tensor:
        """The goal after each of so many steps, 0 of them first: (B, n) -> (B, steps + 1, n). Angles of the
        first are near those of x, of every other one near those of the one before."""
        if self.path is None:
            return (x - self.offset(x, self.goal)).unsqueeze(1).expand(-1, steps + 1, -1)
        time = x[:, -1:] + self.tick * torch.arange(steps + 1, dtype=x.dtype)
        goal = torch.cat((self.path(time), time.unsqueeze(-1)), dim=-1)
        begun = turned(goal[:, :1], x.unsqueeze(1), self.periodic)
        return unwrapped(goal, self.periodic) + (begun - goal[:, :1])

    def away(self, x: Tensor) -> Tensor:
        """x - goal by the shorter way around: (..., n) -> (..., n)."""
        if self.path is None:
            return self.offset(x, self.goal)
        return self.offset(x, torch.cat((self.path(x[..., -1]), x[..., -1:]), dim=-1))

    def terminal(self, x: Tensor) -> Tensor:
        """Return the cost at the end of a plan: d'Pd of the linear feedback, or d'Sd: (..., n) -> (...)."""
        d = self.away(x)
        return ((d.unsqueeze(-2) * self.end).sum(-1) * d).sum(-1)

    def linear_feedback(self, x: Tensor) -> Tensor:
        """rest - K d within the bounds: (..., n) -> (..., m)."""
        return self.admissible(self.rest - (self.away(x).unsqueeze(-2) * self.k).sum(-1))

    def steered(self, x: Tensor, change: Tensor) -> Tensor:
        """The linear feedback and a change of it, within the bounds: (..., n), (..., m) -> (..., m)."""
        return self.admissible(self.linear_feedback(x) + change)

    def admissible(self, u: Tensor) -> Tensor:
        """The nearest control within the bounds: (..., m) -> (..., m)."""
        return self.bounds.clip(u)

    def levels(self) -> Tensor:
        """Every combination of lower bound, rest and upper bound, where there are bounds: (L, m)."""
        columns = [
            torch.stack([each for each in (low, rest, high) if bool(torch.isfinite(each))])
            for low, rest, high in zip(self.bounds.low, self.rest, self.bounds.high, strict=True)
        ]
        return torch.cartesian_prod(*columns).reshape(-1, self.inputs)

    def derivatives(self, x: Tensor, u: Tensor) -> Derivatives:
        """First and second derivatives of F and l with respect to z = (x, u): (B, n), (B, m).

        In a program along pairs of coordinates: it goes through them, and its text is that of one. In plain
        torch backwards: a product with a number takes a hundred times as long twice forward.
        """
        z, n = torch.cat((x, u), dim=-1), self.dim

        def both(z: Tensor) -> Tensor:
            after, paid = self.advance(z[..., :n], z[..., n:])
            return torch.cat((after, paid.unsqueeze(-1)), dim=-1)

        first, second = _slopes_and_bends(both, z, n + 1)
        return Derivatives(first[:, :n], second[:, :n], first[:, n], second[:, n])

    def _check(self) -> None:
        x, u = self.goal.expand(2, -1), self.rest.expand(2, -1)
        trailing("SampledProblem", "goal", self.goal, 1, self.dim)
        after, paid = self.step(x, u)
        if after.shape != x.shape or paid.shape != x.shape[:1]:
            raise ValueError(
                f"`SampledProblem(step=...)` must map x {tuple(x.shape)} and u {tuple(u.shape)} to x+ "
                f"{tuple(x.shape)} and costs {tuple(x.shape[:1])}; got {tuple(after.shape)} and "
                f"{tuple(paid.shape)}."
            )
        if self.path is not None:
            self.tick = float(after[0, -1] - x[0, -1])
            if not self.tick > 0:
                raise fail("SampledProblem", "step", "must move the time, the last coordinate", self.tick)
            return
        moved = float(self.offset(after, x).abs().max())
        if moved > _RESTS * (1 + float(x.abs().max())) or abs(float(paid[0])) > _RESTS:
            raise ValueError(
                f"`SampledProblem(goal=...)` must be a state of rest at no cost; within one step it moves by "
                f"{moved:.3g} and costs {float(paid[0]):.3g}."
            )

    def _regulator(self) -> tuple[Tensor, Tensor]:
        """P and K of the linear-quadratic problem at the goal."""
        at = self.derivatives(self.goal.unsqueeze(0), self.rest.unsqueeze(0))
        m, n = self.inputs, self.dim - (self.path is not None)
        kept = [*range(n), *range(self.dim, self.dim + m)]  # without the time
        paid = 0.5 * at.cost_second[0][kept][:, kept]
        try:
            p, k = discrete_riccati(at.first[0, :n, :n], at.first[0, :n, -m:], paid)
        except (np.linalg.LinAlgError, ValueError) as error:
            raise ValueError(
                "`SampledProblem(step=...)` has no linear-quadratic regulator at the goal: its linearisation "
                f"cannot be stabilised, or its cost is not convex there ({error})."
            ) from error
        clock = self.dim - n
        return pad(p, (0, clock, 0, clock)), pad(k, (0, clock))


def _held(plant: Plant, cost: Cost, h: float, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    """Step of a plant in continuous time, and its cost."""
    states, slopes = runge_kutta_stages(lambda at, share: plant.motion(at, u), x, h)
    paid = runge_kutta_mean([cost.rate(at, u) for at in states], h)
    return x + runge_kutta_mean(slopes, h), paid


def _stepped(plant: Plant, cost: Cost, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    """Step of a plant in discrete time, and its cost."""
    assert plant.period is not None
    return x + plant.motion(x, u), plant.period * cost.rate(x, u)


class Derivatives(NamedTuple):
    """Derivatives of x+ = F(z) and of the cost l(z) with respect to z = (x, u)."""

    first: Tensor  # dF/dz, (B, n, n + m)
    second: Tensor  # d2F/dz2, (B, n, n + m, n + m)
    cost_first: Tensor  # (B, n + m)
    cost_second: Tensor  # (B, n + m, n + m)


def _in_pairs(function: Callable[[Tensor], Tensor], z: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """First and second derivatives of ``count`` values of a row (B, d): (B, count, d), (B, count, d, d)."""
    use_forward_mode()

    def along(pairs: Tensor) -> Tensor:
        one, other = (direction.clone() for direction in pairs.chunk(2, dim=-1))
        at = z.unsqueeze(1).expand_as(one).clone()
        found = torch.func.jvp(lambda y: torch.func.jvp(function, (y,), (one,))[1], (at,), (other,))
        return torch.cat((found[0], found[1]), dim=-1)

    unit = torch.eye(z.shape[-1], dtype=z.dtype)
    rows, columns = torch.tril_indices(len(unit), len(unit)).unbind(0)
    pairs = torch.cat((unit[rows], unit[columns]), dim=-1).expand(len(z), -1, -1)
    slope, bend = each(along, pairs, together=1).split(count, dim=-1)  # (B, pairs, count)
    place = torch.zeros(len(unit), len(unit), dtype=torch.int64)
    place[rows, columns] = place[columns, rows] = torch.arange(len(rows))
    return slope[:, rows == columns].mT, bend[:, place.flatten()].mT.unflatten(-1, place.shape)


@traced_as(_in_pairs)
def _slopes_and_bends(function: Callable[[Tensor], Tensor], z: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """`_in_pairs` by the slope of slopes: a row of a batch has d copies for each of its values.

    Of few rows it is passes that take time: these are two, `row_jacobian` of itself makes ``count`` d.
    """
    d = z.shape[-1]
    value, entry = (torch.eye(size, dtype=z.dtype, device=z.device) for size in (count, d))

    def slopes(z: Tensor) -> Tensor:
        pull = torch.func.vjp(function, z)[1]
        found: Tensor = pull(value.repeat(d, 1).expand(*z.shape[:-1], count))[0]
        return found

    at = z.unsqueeze(1).expand(-1, d * count, d).clone()
    first, pull = torch.func.vjp(slopes, at)[:2]
    second = pull(entry.repeat_interleave(count, dim=0).expand_as(first))[0]
    return first[:, :count], second.unflatten(1, (d, count)).transpose(1, 2)

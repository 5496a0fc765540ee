"""Optimal control in steps: a plant whose control is held for a period, its cost and its bounds."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from ...lanes import each, traced_as
from ...lanes.gradients import vjp, without_gradient
from ...lanes.per_row.decisions import first_row, in_any_row
from ...lanes.per_row.objects import Note, OfRows
from ...numerics.angles import turned, unwrapped, wrap
from ...numerics.checks import fail, hold, integer, trailing
from ...numerics.default_device import beside, device_of
from ...numerics.derivatives import use_forward_mode
from ...numerics.linalg import Matrix, discrete_riccati, positive_semidefinite, square, unstabilisable_mode
from ...numerics.repr_text import limits, sizes
from ...numerics.rows import check_rows, is_ours
from ...numerics.runge_kutta import runge_kutta_mean, runge_kutta_stages
from ...systems import Bounds, Plant
from ...systems.base import Limit
from .cost import Cost, EndValue
from .held_plant import Holding
from .rules import check_objects, check_problem, check_torch, check_undiscounted, check_within, own_period
from .tracking_cost import Path, TrackingCost

StepFunction = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
"""(x (B, n), u (B, m)) -> (x+ (B, n), cost of the step (B,))."""
_log = logging.getLogger(__name__)
_RESTS = 1e-6  # of the scale of the state: how far the goal may move in a step


class SampledProblem(nn.Module, metaclass=OfRows):
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
        low, high: of u, as in `systems.Bounds`; None for none.
        periodic: the coordinates that are angles, in rad.
        goal: state that distances are measured from, (n,); the origin by default. Where the plant rests
            there at no cost the problem has a linear regulator; it need not.
        rest: control that keeps it there, (m,); 0 by default.
        path: x_d from t, (...) -> (..., n - 1), for a problem whose last coordinate is the time: the goal
            moves along it. The linear feedback is that of ``goal``, where the plant rests, carried along.
        terminal: what is paid where a plan ends: V_T, (B, n) -> (B,) with two derivatives, or S of d'Sd,
            (n, n) positive semidefinite, d = x - goal, a number s for s I; None for P below, as the problem
            goes on without an end.

    Attributes:
        p: P of the value d'Pd of the best linear feedback near the goal, (n, n), d = x - goal.
        k: K of its control rest - K d, (m, n).
        unregulated: why there is no such feedback: the plant does not rest at the goal at no cost within the
            bounds, or its linearisation cannot be stabilised. P and K are 0 then, and without ``terminal``
            the end of a plan costs nothing, with a warning in the log. "" where there is one.

    Raises:
        ValueError: if an argument breaks its rule or ``step`` returns other shapes.
    """

    rowwise: ClassVar = {
        **dict.fromkeys(("away", "terminal", "linear_feedback", "admissible", "end_model"), (1,)),
        **dict.fromkeys(("advance", "offset", "steered", "derivatives"), (1, 1)),
        "goals": (1,),
    }

    @without_gradient("SampledProblem", "step", "goal", "rest", "terminal")
    @beside
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
        terminal: Matrix | EndValue | None = None,
    ) -> None:
        super().__init__()
        self.step = step
        self.path: Path | None = path
        self.dim = integer("SampledProblem", "dim", dim, least=1)
        self.inputs = integer("SampledProblem", "inputs", inputs, least=1)
        device = device_of(goal, rest, step)
        zeros = torch.zeros(self.dim, dtype=torch.float64, device=device)
        none = torch.zeros(self.inputs, dtype=torch.float64, device=device)
        self.bounds = Bounds(low, high, self.inputs).on(device)
        self.register_buffer("goal", zeros if goal is None else goal.double())
        self.register_buffer("rest", none if rest is None else rest.double())
        self.goal: Tensor
        self.rest: Tensor
        if not set(periodic) <= set(range(-self.dim, self.dim)):
            raise fail("SampledProblem", "periodic", f"must be coordinates of {self.dim}", list(periodic))
        self.periodic = tuple(sorted({index % self.dim for index in periodic}))
        self.tick = 0.0  # s of a step, where the last coordinate is the time
        moved, paid = self._check()
        self.unregulated, p, k = Note(), none.new_zeros(self.dim, self.dim), none.new_zeros(inputs, self.dim)
        self.curved = False  # whether the cost bends in every input at the goal
        try:
            at = self._linearised()
            self._check_rest(moved, paid)
            p, k = self._regulator(at)
        except ValueError as error:
            self.unregulated = Note(error)
        self.p = hold(self, "p", p)
        self.k = hold(self, "k", k)
        self.endless = terminal is None
        self.end_value = terminal if callable(terminal) else None
        self.register_buffer("end", self._end(terminal))
        self.end: Tensor
        if self.unregulated and self.endless and first_row():
            _log.warning(
                "`SampledProblem` has no linear regulator at the goal (%s): the end of a plan costs nothing. "
                "Give `terminal`, V_T of x or S of d'Sd, or a horizon after which nothing counts.",
                self.unregulated,
            )

    def extra_repr(self) -> str:
        """Return sizes and bounds, and where plans begin if not from a linear feedback."""
        why = ["no linear feedback at the goal"] if self.unregulated else []
        return ", ".join(
            [sizes(self.dim, self.inputs), *limits(self.bounds if self.bounds.present else None), *why]
        )

    @classmethod
    @without_gradient("SampledProblem.of", "plant", "cost", "terminal")
    @beside
    def of(
        cls,
        plant: Plant,
        cost: Cost,
        *,
        dt: float | None = None,
        low: Limit = None,
        high: Limit = None,
        substeps: int | None = None,
        terminal: Matrix | EndValue | None = None,
    ) -> SampledProblem:
        """A plant and a cost rate, with the control held for dt.

        A plant in continuous time is integrated to 1e-6 of its state, as `Holding` says: by one Runge-Kutta
        step of fourth order, where that is enough, and its cost with it; one in discrete time pays its period
        times the cost rate.

        Args:
            plant: the plant.
            cost: the cost rate, without a discount.
            dt: s, positive; None for the period of a plant in discrete time.
            low, high: of the inputs; None for those of the cost, or else of the plant.
            substeps: Runge-Kutta steps a period; None for as many as are accurate. Fewer are a warning.
            terminal: as in `SampledProblem`; None for that of the cost, or else P.

        Raises:
            ValueError: if an argument breaks its rule, or as in `SampledProblem`.
        """
        check_objects("SampledProblem.of", plant=plant, cost=cost)
        check_torch("SampledProblem.of", "plant", plant)
        check_problem(plant, cost)
        cost = cost.bounded(low, high).around(plant)
        check_undiscounted("SampledProblem.of", cost)
        h = own_period("SampledProblem.of", plant, dt)

        box = cost.bounds
        step: StepFunction = partial(_stepped, plant, cost)
        if plant.period is None:
            holding = Holding("SampledProblem.of", plant, cost, h, substeps).checked()
            step = partial(_held, plant, cost, h) if holding.classical else holding
        return cls(
            step,
            dim=cost.dim,
            inputs=cost.inputs,
            low=None if box is None else box.low,
            high=None if box is None else box.high,
            periodic=plant.periodic,
            goal=plant.equilibrium() if isinstance(cost, TrackingCost) else cost.target,
            rest=cost.r.new_zeros(cost.inputs) if cost.target_input is None else cost.target_input,
            path=cost.path if isinstance(cost, TrackingCost) else None,
            terminal=cost.ending if terminal is None else terminal,
        )

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
        time = x[:, -1:] + self.tick * torch.arange(steps + 1, dtype=x.dtype, device=x.device)
        goal = torch.cat((self.path(time), time.unsqueeze(-1)), dim=-1)
        begun = turned(goal[:, :1], x.unsqueeze(1), self.periodic)
        return unwrapped(goal, self.periodic) + (begun - goal[:, :1])

    def away(self, x: Tensor) -> Tensor:
        """x - goal by the shorter way around: (..., n) -> (..., n)."""
        if self.path is None:
            return self.offset(x, self.goal)
        return self.offset(x, torch.cat((self.path(x[..., -1]), x[..., -1:]), dim=-1))

    def terminal(self, x: Tensor) -> Tensor:
        """Cost at the end of a plan, d'Pd of the linear feedback, d'Sd or V_T: (..., n) -> (...)."""
        if self.end_value is not None:
            return self.end_value(x.reshape(-1, self.dim)).reshape(x.shape[:-1])
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

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """Move the bounds, too."""
        moved: Self = super()._apply(fn, recurse)  # type: ignore[no-untyped-call]
        self.bounds = self.bounds.on(self.goal.device)
        return moved

    def levels(self) -> Tensor:
        """Every combination of lower bound, rest and upper bound, where there are bounds: (L, m)."""
        columns = [
            torch.stack([each for each in (low, rest, high) if bool(torch.isfinite(each))])
            for low, rest, high in zip(self.bounds.low, self.rest, self.bounds.high, strict=True)
        ]
        return torch.cartesian_prod(*columns).reshape(-1, self.inputs)

    def reach(self) -> tuple[Tensor, Tensor]:
        """The bounds, where there are none a unit of the input beside its rest: (m,), (m,)."""
        low, high, rest = self.bounds.low, self.bounds.high, self.admissible(self.rest)
        below, above = torch.minimum(rest, high) - 1.0, torch.maximum(rest, low) + 1.0
        return torch.where(torch.isfinite(low), low, below), torch.where(torch.isfinite(high), high, above)

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

    def end_model(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Slope and curvature of V_T at x (B, n), where it is a function: (B, n), (B, n, n)."""
        value = self.end_value
        assert value is not None

        def one(y: Tensor) -> Tensor:
            return value(y.reshape(-1, self.dim)).reshape(*y.shape[:-1], 1)

        first, second = _slopes_and_bends(one, x, 1)
        return first[:, 0], second[:, 0]

    def _end(self, terminal: Matrix | EndValue | None) -> Tensor:
        """S of the terminal cost, (n, n), checked; 0 where that is a function."""
        if terminal is None:
            return self.p.clone()
        if callable(terminal):
            check_rows("SampledProblem(terminal=...)", terminal, [self.goal], sizes=(self.inputs,))
            return torch.zeros_like(self.p)
        return positive_semidefinite(
            "SampledProblem", "terminal", square("SampledProblem", "terminal", terminal, self.dim), self.dim
        )

    @torch.no_grad()
    def _check(self) -> tuple[Tensor, Tensor]:
        """Check the shapes, and return how far the goal moves in a step, and at what cost."""
        x, u = self.goal.expand(2, -1), self.rest.expand(2, -1)
        trailing("SampledProblem", "goal", self.goal, 1, self.dim)
        if not is_ours(self.step):
            known, given = (self.dim, self.inputs), [self.goal, self.rest]
            for k, (part, inner) in enumerate((("x+", (self.dim,)), ("costs", ()))):
                what = f"SampledProblem(step=...)`, its {part}, `step(x, u)[{k}]"
                check_rows(what, lambda *z, k=k: self.step(*z)[k], given, inner, sizes=known)
        after, paid = self.step(x, u)
        if self.path is not None:
            self.tick = float(after[0, -1] - x[0, -1])
            if not self.tick > 0:
                raise fail("SampledProblem", "step", "must move the time, the last coordinate", self.tick)
            return torch.zeros_like(paid[0]), torch.zeros_like(paid[0])
        return self.offset(after, x).abs().max(), paid[0]

    def _check_rest(self, moved: Tensor, paid: Tensor) -> None:
        """Refuse a goal without a regulator: one that moves, costs something, or is held out of bounds."""
        if not bool((moved <= _RESTS * (1 + self.goal.abs().max())) & (paid.abs() <= _RESTS)):
            raise ValueError(
                "the goal is no state of rest at no cost: within one step it moves by "
                f"{float(moved):.3g} and costs {float(paid):.3g}"
            )

    @torch.no_grad()
    def _linearised(self) -> Derivatives:
        """Derivatives at the goal, of a network's values as they are now."""
        try:
            at = self.derivatives(self.goal.unsqueeze(0), self.rest.unsqueeze(0))
        except (RuntimeError, TypeError) as error:
            raise ValueError(f"`step` cannot be differentiated there: {error}") from error
        self.curved = not in_any_row(at.cost_second[0].diagonal()[self.dim :] <= 0)
        return at

    def _regulator(self, at: Derivatives) -> tuple[Tensor, Tensor]:
        """P and K of the linear-quadratic problem at the goal."""
        m, n = self.inputs, self.dim - (self.path is not None)
        kept = [*range(n), *range(self.dim, self.dim + m)]  # without the time
        slope, paid = at.cost_first[0][kept], 0.5 * at.cost_second[0][kept][:, kept]
        if self.path is None and bool(slope.abs().max() > _RESTS * (1 + paid.abs().max())):
            raise ValueError(f"its cost has a slope there, {slope.tolist()}: it is no minimum")
        check_within("SampledProblem", "rest", self.bounds, self.rest)
        a, b = at.first[0, :n, :n], at.first[0, :n, -m:]
        mode = unstabilisable_mode(a, b, discrete=True)
        if mode is not None:
            raise ValueError(f"no input reaches the mode of its linearisation with the eigenvalue {mode:.6g}")
        try:
            p, k = discrete_riccati(a, b, paid)
        except (np.linalg.LinAlgError, ValueError) as error:
            raise ValueError(
                f"its linearisation cannot be stabilised, or its cost is not convex there ({error})"
            ) from error
        clock = self.dim - n
        return pad(p, (0, clock, 0, clock)), pad(k, (0, clock))


def goal_of(planner: Any) -> Tensor:
    """Return a tensor of a planner's problem, which is where the planner computes."""
    goal: Tensor = planner.problem.goal
    return goal


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

    unit = torch.eye(z.shape[-1], dtype=z.dtype, device=z.device)
    rows, columns = torch.tril_indices(len(unit), len(unit), device=z.device).unbind(0)
    pairs = torch.cat((unit[rows], unit[columns]), dim=-1).expand(len(z), -1, -1)
    slope, bend = each(along, pairs, together=1).split(count, dim=-1)  # (B, pairs, count)
    place = torch.zeros(len(unit), len(unit), dtype=torch.int64, device=z.device)
    place[rows, columns] = place[columns, rows] = torch.arange(len(rows), device=z.device)
    return slope[:, rows == columns].mT, bend[:, place.flatten()].mT.unflatten(-1, place.shape)


@traced_as(_in_pairs)
def _slopes_and_bends(function: Callable[[Tensor], Tensor], z: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """`_in_pairs` by the slope of slopes: a row of a batch has d copies for each of its values.

    Of few rows it is passes that take time: these are two, `row_jacobian` of itself makes ``count`` d.
    """
    d = z.shape[-1]
    value, entry = (torch.eye(size, dtype=z.dtype, device=z.device) for size in (count, d))

    def slopes(z: Tensor) -> Tensor:
        pull = vjp(function, z)[1]
        found: Tensor = pull(value.repeat(d, 1).expand(*z.shape[:-1], count))[0]
        return found

    at = z.unsqueeze(1).expand(-1, d * count, d).clone()
    first, pull = vjp(slopes, at)[:2]
    second = pull(entry.repeat_interleave(count, dim=0).expand_as(first))[0]
    return first[:, :count], second.unflatten(1, (d, count)).transpose(1, 2)

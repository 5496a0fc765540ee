"""Direct shooting: the optimum where no formula knows it, from every state of a batch, on two meshes."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from ...numerics.checks import fail, integer, positive_real, trailing
from ...systems import ControlAffineSystem
from ..controllers import LQR, Policy, Value
from ..cost import BoundedInputCost, Cost
from .newton import Plan, Solution, choose, follow, minimise, replay
from .stage import Stage

_DECAY = 9.2  # time constants of the slowest mode in the horizon: it falls to 1e-4
_RESOLVED = 0.5  # mean interval in time constants of the fastest mode
_LEAST = 80  # intervals
_GRADING = 6.0  # ratio of the last interval to the first
_ROWS = 256  # states solved from at once: a graph of second derivatives is kept for each


class Optimum(NamedTuple):
    """The optimal trajectories from x0, a row each; NaN in the rows that did not converge.

    Example:
        >>> plant = systems.TwoState()
        >>> cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
        >>> found = adp.DirectShooting(plant, cost).solve(torch.tensor([[0.2, 0.1]]).double())
        >>> bool(found.converged.all()), bool(found.mesh_error.max() < 1e-4)
        (True, True)

        Shown by `staf experiment=adp_three_state`.
    """

    value: Tensor  # V*(x0), (B,): the cost of the control that was found
    gradient: Tensor  # grad V*(x0), (B, n)
    control: Tensor  # u*(x0), (B, m)
    state: Tensor  # (B, N + 1, n)
    time: Tensor  # (N + 1,) seconds
    mesh_error: Tensor  # relative change of the value since a mesh of half as many intervals, (B,); inf if
    # that mesh was too coarse to converge on
    horizon_error: Tensor  # share of the value that is the terminal cost, (B,)
    iterations: Tensor  # Newton steps, both meshes together, (B,)
    converged: Tensor  # (B,) bool


class DirectShooting:
    """min int_0^T (x'Qx + U(u)) dt + V_T(x(T)) over controls that are linear on each of N intervals, by
    Newton's method with the exact second derivatives from automatic differentiation.

    Each iteration solves the linear-quadratic problem of the second-order expansion around the current
    trajectory by a backward Riccati recursion, and takes the longest share of its step that lowers the cost,
    forward in time with the recursion's feedback. Where the expansion has no minimum, its absolute value
    takes its place. It starts from the base policy. A row has converged when the model promises a relative
    improvement of less than ``tolerance``. The problem is solved on N / 2 intervals first and then on N.

    Every control that is found is admissible, so the value is an upper bound of V*, but for the errors of
    the Runge-Kutta steps and of the horizon, which `Optimum` reports. The minimum is a local one.

    Example:
        >>> plant = systems.TwoState()
        >>> cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
        >>> x0 = torch.tensor([[0.2, 0.1]]).double()
        >>> round(float(adp.DirectShooting(plant, cost).solve(x0).value), 5)  # V* = x1^2 / 2 + x2^2
        0.03

        Shown by `staf experiment=adp_three_state`.

    Args:
        system: the plant; its drift must have second derivatives.
        cost: the cost rate.
        base: the policy to start from, (..., n) -> (..., m); the LQR by default.
        terminal: V_T, (..., n) -> (...), with two derivatives; the Riccati value by default.
        horizon: T in s; by default so long that the slowest mode of the LQR has fallen to 1e-4.
        intervals: N, even; by default so many that the fastest mode of the LQR is resolved.
        tolerance: positive, relative.
        iterations: at most, on each mesh.

    Raises:
        ValueError: if an argument breaks its rule, or the LQR that a default asks for does not exist.

    Source: Dunn and Bertsekas, "Efficient dynamic programming implementations of Newton's method for
    unconstrained optimal control problems", JOTA 63 (1989).
    """

    def __init__(
        self,
        system: ControlAffineSystem,
        cost: Cost,
        *,
        base: Policy | None = None,
        terminal: Value | None = None,
        horizon: float | None = None,
        intervals: int | None = None,
        tolerance: float = 1e-12,
        iterations: int = 50,
    ) -> None:
        cost = cost.around(system)
        if cost.bounds is not None and not isinstance(cost, BoundedInputCost):
            raise fail("DirectShooting", "cost", "must have smooth bounds (`BoundedInputCost`)", cost.bounds)
        self.stage = Stage(system, cost)
        rates = (1.0, 1.0)
        if base is None or terminal is None or horizon is None or intervals is None:
            lqr = LQR(system, cost)
            base, terminal = base or lqr, terminal or lqr.value
            rates = _rates(system, lqr)
        self.base, self.terminal = base, terminal
        chosen = _DECAY / rates[0] if horizon is None else horizon
        self.horizon = positive_real("DirectShooting", "horizon", chosen)
        if intervals is None:
            intervals = 2 * round(0.5 * max(_LEAST, self.horizon * rates[1] / _RESOLVED))
        self.intervals = integer("DirectShooting", "intervals", intervals, least=4)
        if self.intervals % 2:
            raise fail("DirectShooting", "intervals", "must be even", intervals)
        self.tolerance = positive_real("DirectShooting", "tolerance", tolerance)
        self.iterations = integer("DirectShooting", "iterations", iterations, least=1)

    def solve(self, x0: Tensor) -> Optimum:
        """The optima from x0, (B, n).

        Raises:
            ValueError: if x0 is no batch of states of the plant.
        """
        trailing("DirectShooting.solve", "x0", x0, dims=2, last=self.stage.system.dim)
        time = graded(self.horizon, self.intervals // 2).to(x0)
        with torch.no_grad():
            parts = [self._solve(rows, time) for rows in x0.split(_ROWS)]
        columns = {name: torch.cat([getattr(part, name) for part in parts]) for name in Optimum._fields}
        return Optimum(**columns | {"time": parts[0].time})

    def _solve(self, x0: Tensor, time: Tensor) -> Optimum:
        coarse = minimise(self, follow(self, x0, time.diff()), time.diff())
        start = self._finer(coarse, time.diff())
        time = halved(time)
        if not bool(coarse.converged.all()):  # costs time alone: the other rows go on from where they are
            start = choose(coarse.converged, start, follow(self, x0, time.diff()))
        fine = minimise(self, start, time.diff())
        return self._optimum(fine, coarse, time)

    def _finer(self, solution: Solution, lengths: Tensor) -> Plan:
        """The same control on a mesh of half the intervals, with its cost there."""
        plan, feedback = split(self.stage, solution.plan, solution.feedback, lengths)
        halves = (0.5 * lengths).repeat_interleave(2)
        none = torch.zeros_like(plan.control)
        return replay(self.stage, plan, plan.state[:, 0], halves, self.terminal, feedback, none)

    def _optimum(self, fine: Solution, coarse: Solution, time: Tensor) -> Optimum:
        x0, plan = fine.plan.state[:, 0], fine.plan
        value = self._finer(fine, time.diff()).cost  # the same control, more exactly integrated
        converged = fine.converged & torch.isfinite(value)
        rest = (x0 == 0).all(-1)  # where the optimum is to stay
        gradient = torch.where(rest.unsqueeze(-1), 0.0, fine.gradient)
        value = torch.where(rest, 0.0, value)
        control = self.stage.cost.policy(self.stage.system.effectiveness(x0), gradient)
        known = converged | rest

        def where_known(values: Tensor) -> Tensor:
            return torch.where(known[(..., *([None] * (values.dim() - 1)))], values, torch.nan)

        change = (plan.cost - coarse.plan.cost).abs() / value
        change = torch.where(coarse.converged, change, torch.inf)
        share = self.terminal(plan.state[:, -1]) / value
        return Optimum(
            value=where_known(value),
            gradient=where_known(gradient),
            control=where_known(control),
            state=where_known(plan.state),
            time=time,
            mesh_error=where_known(torch.where(rest, 0.0, change)),
            horizon_error=where_known(torch.where(rest, 0.0, share)),
            iterations=coarse.iterations + fine.iterations,
            converged=known,
        )


def _rates(system: ControlAffineSystem, lqr: LQR) -> tuple[float, float]:
    """The slowest decay and the fastest rate of the LQR's modes, 1/s."""
    a, b = system.linearisation()
    modes = torch.linalg.eigvals(a.to(lqr.p) - b.to(lqr.p) @ lqr.k)
    return float(-modes.real.max()), float(modes.abs().max())


def graded(horizon: float, intervals: int) -> Tensor:
    """Times of a mesh whose intervals grow in geometric progression: (N + 1,) from 0 to the horizon."""
    power = math.log(_GRADING) * torch.arange(intervals + 1, dtype=torch.float64) / max(1, intervals - 1)
    return horizon * power.expm1() / power[-1].expm1()


def halved(time: Tensor) -> Tensor:
    """The same times and those half-way: (N + 1,) -> (2N + 1,)."""
    middle = 0.5 * (time[1:] + time[:-1])
    return torch.cat((time[:1], torch.stack((middle, time[1:]), dim=-1).flatten()))


def split(stage: Stage, plan: Plan, feedback: Tensor, lengths: Tensor) -> tuple[Plan, Tensor]:
    """The same control on half intervals, and a feedback around it.

    Args:
        stage: of the problem.
        plan: on N intervals.
        feedback: around it, (B, N, 2m, n).
        lengths: of the N intervals, (N,).

    Returns:
        A plan on 2N intervals (of the old cost) and its feedback (B, 2N, 2m, n).
    """
    first, last = plan.control.chunk(2, dim=-1)
    middle = 0.5 * (first + last)
    early, late = torch.cat((first, middle), dim=-1), torch.cat((middle, last), dim=-1)
    between, _ = stage.advance(plan.state[:, :-1], early, 0.5 * lengths.expand(plan.control.shape[:2]))
    state = torch.stack((plan.state[:, :-1], between), dim=2).flatten(1, 2)
    state = torch.cat((state, plan.state[:, -1:]), dim=1)
    control = torch.stack((early, late), dim=2).flatten(1, 2)
    return Plan(state, control, plan.cost), feedback.repeat_interleave(2, dim=1)

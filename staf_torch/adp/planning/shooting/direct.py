"""Direct shooting: the optimum where no formula knows it, from every state of a batch, on two meshes."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from ....lanes.gradients import without_gradient
from ....lanes.per_row.objects import made_by_rows
from ....lanes.row_numbers import over_rows, points_of_rows, some_rows
from ....lanes.torch_compile.operators import opaque
from ....numerics.checks import fail, integer, positive_real, trailing
from ....numerics.default_device import beside, on_cpu
from ....numerics.linalg import Matrix
from ....signs import Sign
from ....systems import ControlAffineSystem, Linear, Plant
from ....systems.base import Limit
from ...loop.controller import LQR, Policy, Value
from ...problem.bounded_input_cost import BoundedInputCost
from ...problem.cost import Cost, QuadraticCost
from ...problem.rules import (
    check_objects,
    check_policy,
    check_problem,
    check_still,
    check_torch,
    check_undiscounted,
    restless,
    set_point,
)
from ..trajectories import Trajectories, chosen
from .newton import Interval, MeshPlan, NewtonSolution, follow, minimise, replay, why_none
from .starts import (
    MOST,
    ROWS,
    Optimum,
    PlanSearch,
    cheapest,
    dearer,
    end_value,
    graded,
    guesses,
    guided,
    halved,
    joined,
    merged,
    regulator,
    replaced,
    selected,
    split,
    times,
)

_GAP = 1e-3  # share of the value by which a stationary control may miss the minimum of the Hamiltonian
_NEAR = (0.5, 2.0)  # value over the LQR's, inside which one start is believed,
_PLAIN = 1.5  # where following the base costs at most so many times what was found from it
_REST = 1e-3  # share of the value that the terminal cost may be, before the horizon grows
_DOUBLINGS = 3  # of the horizon
_SPLINES = 8  # random guesses
_ROUNDED = 4.0  # rounding units of the state, within which it is at the set-point
_NOTHING = 1e-12  # terminal cost of a set-point at which the optimum is to stay


class DirectShooting:
    """min int_0^T (x'Qx + U(u)) dt + V_T(x(T)) over controls that are linear on each of N intervals, by
    Newton's method with the exact second derivatives from automatic differentiation.

    Each iteration solves the linear-quadratic problem of the second-order expansion around the current
    trajectory by a backward Riccati recursion, with hard bounds a box-constrained one, and takes the longest
    share of its step that lowers the cost, with the recursion's feedback. Where the expansion has no minimum,
    its absolute value takes its place. The problem is solved on N / 2 intervals first and then on N.

    A row is stationary when the model promises a relative improvement of less than ``tolerance`` and the
    control minimises the Hamiltonian in u to a share of 1e-3 of the value; else it is NaN, and its `reason`
    says why. A row whose value is not near its LQR's, or is much less than the base costs, is started from
    more guesses: constant controls at the bounds for a while, none, random splines, each followed by the base
    policies; with bounds also plans of `BoxDDP`, and where no two starts found the same lowest value to 1e-4,
    of at most two states, that of a memory of the plant's box (`learn_global_value`, once). A row has
    converged if two starts found the same, else its `reason` says ``local``. With bounds, but for a convex
    problem, the mesh has equal intervals; else they grow by a factor of six along it.

    Every control that is found is admissible, so the value is an upper bound of V*, but for the errors of
    the Runge-Kutta steps and of the horizon, which `Optimum` reports.

    Example:
        >>> plant = systems.TwoState()
        >>> cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
        >>> x0 = torch.tensor([[0.2, 0.1]]).double()
        >>> round(float(adp.DirectShooting(plant, cost).solve(x0).value), 5)  # V* = x1^2 / 2 + x2^2
        0.03
        >>> limited = adp.DirectShooting(plant, cost, low=-0.1, high=0.1, horizon=1.0)
        >>> limited.solve(x0).plan.abs().max() <= 0.1
        tensor(True)

        Shown by `staf experiment=adp_three_state`.

    Args:
        system: the plant, in continuous time and in torch; its rate must have second derivatives.
        cost: the cost rate, without a discount.
        base: the policy to start from, (..., n) -> (..., m), or several; the LQR by default, and where there
            is none the input of the set-point.
        terminal: V_T, (..., n) -> (...), with two derivatives, or S of e'Se, (n, n), its diagonal or a
            number; by default the cost's own terminal cost, or else the Riccati value, and where there is
            none nothing, with a warning in the log.
        low, high: of the inputs, as in `systems.Bounds`; by default those of the cost, or else of the plant.
        horizon: T in s; by default so long that the slowest mode of the LQR has fallen to 1e-4, and twice to
            eight times that where the terminal cost is more than 1e-3 of a value. With a horizon a plant
            needs no LQR, and a cost may be an economic one, with no set-point at all. Rows with numbers of
            their own share a horizon and intervals, by default those of the row that needs most.
        intervals: N, even; by default so many that the fastest mode of the LQR is resolved, 80 without one.
        tolerance: positive, relative.
        iterations: at most, on each mesh; by default 50, or 120 where inputs are bounded.
        starts: guesses that are improved in a row that needs more than the base, at least 1.
        seed: of the random guesses.

    Raises:
        ValueError: if an argument breaks its rule, or there is no horizon and no LQR.

    Source: Dunn and Bertsekas, "Efficient dynamic programming implementations of Newton's method for
    unconstrained optimal control problems", JOTA 63 (1989); Tassa, Mansard and Todorov, "Control-limited
    differential dynamic programming", ICRA 2014, for the box.
    """

    @without_gradient("DirectShooting", "system", "cost", "base", "terminal")
    @beside
    def __init__(
        self,
        system: Plant,
        cost: Cost,
        *,
        base: Policy | Sequence[Policy] | None = None,
        terminal: Value | Matrix | None = None,
        low: Limit = None,
        high: Limit = None,
        horizon: float | None = None,
        intervals: int | None = None,
        tolerance: float = 1e-12,
        iterations: int | None = None,
        starts: int = 6,
        seed: int = 0,
    ) -> None:
        check_objects("DirectShooting", system=system, cost=cost)
        # On the CPU: a search that branches on values.
        system, cost, terminal = on_cpu(system), on_cpu(cost), on_cpu(terminal)
        base = on_cpu(base) if base is None or callable(base) else [on_cpu(each) for each in base]
        check_torch("DirectShooting", "system", system, continuous=True)
        check_still("DirectShooting", "system", system, "`BoxDDP`")
        cost = cost.bounded(low, high).around(system)
        if cost.ending is not None and horizon is None:
            raise fail("DirectShooting", "horizon", "must be given beside a terminal cost", None)
        check_undiscounted("DirectShooting", cost)
        check_problem(system, cost)
        self.stage = Interval(system, cost)
        self.lqr: LQR | None = None
        if base is None or terminal is None or horizon is None or intervals is None:
            self.lqr = regulator(system, cost, horizon, terminal is None and cost.ending is None)
        given = () if base is None else tuple(base) if isinstance(base, Sequence) else (base,)
        if not given or (len(given) > 1 and self.lqr is not None):
            given = (*given, self._resting if self.lqr is None else self.lqr)
        check_policy("DirectShooting", "base", cost, *given)
        self.bases, self.alone = given, base is None and self.lqr is None
        self.terminal = end_value(terminal, cost, self.lqr)
        self.stays = made_by_rows(self._stays)  # 1 where the optimum at the set-point is to stay, else 0
        self.quadratic_end = not callable(cost.ending if terminal is None else terminal)
        self.stated = (horizon, intervals)
        self.horizon, self.intervals = times(system, cost, self.lqr, horizon, intervals)
        self.tolerance = positive_real("DirectShooting", "tolerance", tolerance)
        steps = (50 if cost.bounds is None else 120) if iterations is None else iterations
        self.iterations = integer("DirectShooting", "iterations", steps, least=1)
        self.starts = integer("DirectShooting", "starts", starts, least=1)
        self.seed = integer("DirectShooting", "seed", seed, least=0)
        self._searches: dict[tuple[float, int], PlanSearch | None] = {}

    def _stays(self) -> float:
        system, cost = self.stage.system, self.stage.cost
        ends = self.terminal(set_point(system, cost)[0].unsqueeze(0)).abs()
        return float(bool(ends <= _NOTHING) and not restless(system, cost))

    def _resting(self, x: Tensor) -> Tensor:
        """The input of the set-point, within the bounds: (..., n) -> (..., m)."""
        cost = self.stage.cost
        u = cost.input_of(x.new_zeros(*x.shape[:-1], cost.inputs))
        return cost.admissible(u)

    def __repr__(self) -> str:
        over = f"{self.intervals} intervals over {self.horizon:.4g} s, {self.starts} starts"
        return f"DirectShooting({self.stage.system!r}, {self.stage.cost!r}, {over})"

    @opaque
    @without_gradient("DirectShooting.solve", "x0", "self")
    @Sign("DirectShooting")
    @beside
    def solve(self, x0: Tensor, *, warm: Optimum | None = None) -> Optimum:
        """The optima from x0, (B, n).

        Args:
            x0: (B, n).
            warm: an earlier result for as many states, whose plans are one start more.

        Raises:
            ValueError: if x0 is no batch of states of the plant.
        """
        trailing("DirectShooting.solve", "x0", x0, dims=2, last=self.stage.system.dim, meta=False, vmap=False)
        if not x0.is_cpu:
            there = None if warm is None else warm.to(torch.device("cpu"))
            return self.solve(x0.cpu(), warm=there).to(x0.device)
        parts = list[Optimum]()
        with Sign("", len(x0), "states") as sign, points_of_rows(len(x0), 1):
            for k, rows in enumerate(x0.split(ROWS)):
                at = k * ROWS + torch.arange(len(rows), device=x0.device)
                with some_rows(at):
                    parts.append(self._solve(rows, None if warm is None else selected(warm, at)))
                sign.advance(len(rows))
        return parts[0] if len(parts) == 1 else joined(parts)

    def _solve(self, x0: Tensor, warm: Optimum | None) -> Optimum:
        horizon, intervals = self.horizon, self.intervals
        for doubling in range(_DOUBLINGS + 1):
            found = self._over(x0, horizon, intervals, warm)
            long = bool((found.horizon_error.nan_to_num() > _REST).any())
            if self.stated[0] is not None or not long or doubling == _DOUBLINGS:
                break
            horizon *= 2
            if self.stated[1] is None:
                intervals = max(intervals, min(2 * intervals, MOST))
        return found

    def _over(self, x0: Tensor, horizon: float, intervals: int, warm: Optimum | None) -> Optimum:
        """The optima over a horizon: from the base, and where that is not enough from more starts."""
        time = self._mesh(horizon, intervals // 2).to(x0)
        base = self.bases[0]
        start = follow(self, _always(base), x0, time.diff())
        found = self._improve(start, time, x0, base)
        hard = ~self._believed(found, x0, start.cost)
        if bool(hard.any()):  # costs time alone
            found = self._from_more(found, hard, start.cost, x0, time, warm)
        return self._as_base(found, x0)

    def _as_base(self, found: Optimum, x0: Tensor) -> Optimum:
        """Return what was found; where following the base costs less, improved from there, or NaN."""
        followed = follow(self, _always(self.bases[0]), x0, found.time.diff())
        rows = dearer(found.value, followed.cost).nonzero().flatten()
        if not len(rows):  # costs time alone
            return found
        with some_rows(rows):
            start, base = MeshPlan(*(part[rows] for part in followed)), x0[rows]
            end = minimise(self, start, found.time.diff())
            coarse = end._replace(converged=torch.zeros_like(end.converged))  # no mesh to compare with
            again = self._optimum(end, coarse, found.time)
            believed = self._believed(again, base, start.cost)
        return replaced(found, rows, again, believed, start.cost)

    def _from_more(
        self,
        found: Optimum,
        hard: Tensor,
        followed: Tensor,
        x0: Tensor,
        time: Tensor,
        warm: Optimum | None,
    ) -> Optimum:
        """The optima where one start is not enough, from more; what following the base costs: (B,)."""
        rows = hard.nonzero().flatten()
        search = self._search(time)
        with some_rows(rows):
            plans = self._guessed(x0[rows], time)
            if warm is not None:
                plans.append(self._warm(warm, x0[rows], rows, time))
            if search is not None and self.stage.cost.bounds is not None:
                plans += [self._replayed(plan, time.diff()) for plan in search.held(x0[rows])]
            plans = cheapest(plans, self.starts, followed[rows])
            if self.stage.cost.output is not None:  # plans that end with the base see one valley of the cost
                plans.append(follow(self, _always(self._resting), x0[rows], time.diff()))
        found = self._several(found, rows, plans, time)
        local = (hard & ~found.converged & torch.isfinite(found.value)).nonzero().flatten()
        if search is None or not len(local):
            return found
        with some_rows(local):
            plans = [self._replayed(plan, time.diff()) for plan in search.remembered(x0[local])]
        return self._several(found, local, plans, time)

    def _mesh(self, horizon: float, intervals: int) -> Tensor:
        """Times of the coarse mesh: in equal steps where plans are searched in such."""
        if self._graded():
            return graded(horizon, intervals)
        return torch.linspace(0, horizon, intervals + 1, dtype=torch.float64, device="cpu")

    def _several(self, found: Optimum, rows: Tensor, plans: list[MeshPlan], time: Tensor) -> Optimum:
        """The best of what was found and of what several plans lead to, in some rows."""
        if not plans:
            return found
        # All starts of all rows are one batch: what a step costs hardly depends on its size.
        together = MeshPlan(*(torch.cat(parts) for parts in zip(*plans, strict=True)))
        x0 = together.state[:, 0]
        with some_rows(rows.repeat(len(plans))):
            improved = self._improve(together, time, x0, self.bases[0])
        places = torch.arange(len(rows), device=rows.device)
        several = [selected(improved, k * len(rows) + places) for k in range(len(plans))]
        return merged(found, rows, several)

    def _search(self, time: Tensor) -> PlanSearch | None:
        """The search in the steps of a mesh; None where these are not equal."""
        stage, key = self.stage, (float(time[-1]), len(time) - 1)
        if self._graded():
            return None
        if key not in self._searches:
            self._searches[key] = PlanSearch.of(stage.system, stage.cost, key[0] / key[1], key[1])
        return self._searches[key]

    def _replayed(self, plan: Trajectories, lengths: Tensor) -> MeshPlan:
        """A plan in equal steps on a mesh of the same steps: constant on each, with its feedback."""
        control, feedback = self.stage.cost.unsaturated(plan.control), plan.feedback
        steps = MeshPlan(plan.state, torch.cat((control, control), dim=-1), plan.cost)
        twice, none = torch.cat((feedback, feedback), dim=-2), torch.zeros_like(steps.control)
        return replay(self.stage, steps, plan.state[:, 0], lengths, self.terminal, twice, none)

    def _believed(self, found: Optimum, x0: Tensor, followed: Tensor) -> Tensor:
        """Rows in which one start is enough, given what following the base costs there: (B,) bool."""
        if self.alone:  # a kink or a saddle looks stationary
            return torch.zeros_like(found.converged)
        if self._convex():
            return found.converged
        if self.stage.cost.output is not None:  # with valleys that the LQR does not know
            return found.converged & self._rests(x0, found.value)
        if self.lqr is None:
            return found.converged & (followed <= _PLAIN * found.value)
        ratio = found.value / self.lqr.value(x0)
        near = (ratio > _NEAR[0]) & (ratio < _NEAR[1]) & (followed <= _PLAIN * found.value)
        return found.converged & (self._rests(x0, found.value) | near)

    def _rests(self, x0: Tensor, value: Tensor) -> Tensor:
        """Return where the optimum is to stay: at the set-point up to rounding, or at no cost, (B,) bool."""
        rounding = _ROUNDED * torch.finfo(x0.dtype).eps * x0.abs()
        here = (self.stage.cost.deviation(x0).abs() <= rounding).all(-1) | (value == 0)
        return here & over_rows(lambda value: torch.ones_like(value) * self.stays > 0, value)

    def _graded(self) -> bool:
        """Return whether intervals grow along a mesh: without bounds, or if one start finds the optimum."""
        return self.stage.cost.bounds is None or self._convex()

    def _convex(self) -> bool:
        """Return whether every stationary plan is the optimum: a linear plant, a cost without an output."""
        system, cost = self.stage.system, self.stage.cost
        plain = type(cost) in (QuadraticCost, BoundedInputCost) and cost.output is None
        return isinstance(system, Linear) and not system.periodic and plain and self.quadratic_end

    def _guessed(self, x0: Tensor, time: Tensor) -> list[MeshPlan]:
        lengths, horizon = time.diff(), float(time[-1])

        def plans(x0: Tensor) -> list[MeshPlan]:
            found = [follow(self, _always(base), x0, lengths) for base in self.bases]
            for base in self.bases:
                several = guesses(self.stage.cost, base, x0, horizon, _SPLINES, self.seed, alone=self.alone)
                found += [follow(self, guided(guess, base), x0, lengths) for guess in several]
            return found

        return list(over_rows(plans, x0))

    def _warm(self, warm: Optimum, x0: Tensor, rows: Tensor, time: Tensor) -> MeshPlan:
        """An earlier plan, held open loop on this mesh."""

        def held(x0: Tensor, plan: Tensor) -> MeshPlan:
            def control(x: Tensor, t: float) -> Tensor:
                k = min(int(torch.searchsorted(warm.time, t, right=True)) - 1, len(warm.time) - 2)
                share = float((t - warm.time[k]) / (warm.time[k + 1] - warm.time[k]))
                first, last = plan[:, k].unbind(1)
                return first + min(share, 1.0) * (last - first)

            return follow(self, control, x0, time.diff())

        return over_rows(held, x0, warm.plan[rows])

    def _improve(self, start: MeshPlan, time: Tensor, x0: Tensor, base: Policy) -> Optimum:
        """Newton's method on two meshes from a plan on the coarse one."""
        coarse = minimise(self, start, time.diff())
        fine_start = self._finer(coarse, time.diff())
        time = halved(time)
        if not bool(coarse.converged.all()):  # costs time alone: the other rows go on from where they are
            again = follow(self, _always(base), x0, time.diff())
            lower = ~coarse.converged & (again.cost < fine_start.cost)
            fine_start = chosen(~lower, fine_start, again)
        return self._optimum(minimise(self, fine_start, time.diff()), coarse, time)

    def _finer(self, solution: NewtonSolution, lengths: Tensor) -> MeshPlan:
        """Replay the control on intervals of half the length, with its cost there."""
        plan, feedback = split(self.stage, solution.plan, solution.feedback, lengths)
        halves = (0.5 * lengths).repeat_interleave(2)
        none = torch.zeros_like(plan.control)
        return replay(self.stage, plan, plan.state[:, 0], halves, self.terminal, feedback, none)

    def _optimum(self, fine: NewtonSolution, coarse: NewtonSolution, time: Tensor) -> Optimum:
        x0, plan = fine.plan.state[:, 0], fine.plan
        value = self._finer(fine, time.diff()).cost  # the same control, more exactly integrated
        size = value.abs()
        left = self._left(fine, time) / size
        rest = self._rests(x0, value)
        good = fine.converged & torch.isfinite(value) & (left <= _GAP)
        gradient = torch.where(rest.unsqueeze(-1), 0.0, fine.gradient)
        value = torch.where(rest, 0.0, value)
        known = good | rest
        nodes = self.stage.input(plan.control.unflatten(-1, (2, -1)))
        control = nodes[:, 0, 0]
        if isinstance(self.stage.system, ControlAffineSystem):
            control = self.stage.cost.policy(self.stage.system.effectiveness(x0), gradient)

        # Where a plant has kinks no plan may be stationary: the cheapest is shown then, as a local one.
        shown = known | (torch.isfinite(value) & self.alone)

        def where_known(values: Tensor) -> Tensor:
            return chosen(shown, (values,), (torch.full_like(values, torch.nan),))[0]

        change = (plan.cost - coarse.plan.cost).abs() / size
        change = torch.where(coarse.converged, change, torch.inf)
        share = self.terminal(plan.state[:, -1]).abs() / size
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
            plan=where_known(nodes),
            optimality=torch.where(rest, 0.0, left),
            reason=tuple(why_none(bool(known[b]), fine, float(left[b]), b) for b in range(len(x0))),
        )

    def _left(self, solution: NewtonSolution, time: Tensor) -> Tensor:
        """int of the Hamiltonian over its minimum along a plan, (B,)."""
        state, costate, lengths = solution.plan.state, solution.costates, time.diff()
        first, last = solution.plan.control.chunk(2, dim=-1)
        start = self.stage.gap(state[:, :-1], first, costate[:, :-1])
        end = self.stage.gap(state[:, 1:], last, costate[:, 1:])
        return (0.5 * lengths * (start + end)).sum(-1)


def _always(policy: Policy) -> Callable[[Tensor, float], Tensor]:
    """A policy as a control u(x, t)."""
    return lambda x, t: policy(x)

"""The policy of `near_optimal`, with its report, and how far it leads."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from ..approximation.basis import StaFBasis
from ..lanes import ready, where_rows
from ..lanes.gradients import defer_gradient, marked
from ..lanes.per_row.decisions import numbers_of_rows
from ..lanes.per_row.kinds import Kind, by_kind, of_kinds
from ..lanes.per_row.objects import refuse_rows
from ..lanes.row_numbers import all_rows
from ..lanes.torch_compile.operators import opaque
from ..numerics.checks import integer, one_or_each, positive
from ..numerics.default_device import beside
from ..numerics.repr_text import shown, sizes
from ..signs import Sign
from ..systems import Plant
from ..systems.base import spread_of
from .loop.controller import LQR, Controller, ControllerOfKinds, Feedback
from .loop.simulation import simulate
from .planning.global_value import GlobalValue
from .planning.global_value_learning import box_of
from .planning.receding_horizon import BoundedPlans, StrainedPlans
from .planning.shooting import DirectShooting
from .policies.sampled_rollout import SampledRollout
from .problem.cost import Cost
from .problem.held_linear import held_stability
from .problem.rules import slowest
from .problem.sampled import SampledProblem

_REGULATED = 1e-2  # share of the distance from the set-point that is left
PLANNED = 3.0  # time constants of the slowest mode in the horizon of plans, whose end must be near the goal
_STEPS = (12, 60)  # periods in the horizon, at least and at most
_SHARES = (0.25, 0.5, 1.0, 2.0, 4.0)  # of the spread: boxes of states that a report tries
_TIMED, _TIMING = (20, 400), 1e5  # controls that are timed: at least, at most; us that are enough
_STATES, _FEWEST, _WORK = 20, 3, 6e6  # of a report: states, or steps of rollouts that take some seconds
_SHORTER = 0.75  # of the run, where that is of few states: the slowest mode falls to 1e-3
_SETTLED = 9.2  # time constants for which the loops of a report run: the slowest mode falls to 1e-4


class Reach(NamedTuple):
    """The reach of a policy: how many states of a box around its set-point it regulates, and at what cost.

    Of rows with numbers of their own three numbers a row, NaN for None."""

    way: str  # ``local``: the LQR and its rollouts; ``global``: a memory of optimal trajectories
    box: tuple[float, ...]  # half widths, in units of the state
    regulated: (
        float | Tensor | None
    )  # share of a sample that ends within 1 % of where it began; None: nobody looked
    over_best: float | Tensor | None  # mean cost over that of the best trajectories known, of the regulated
    base: float | Tensor | None  # share that the LQR within its bounds regulates
    note: str = ""  # why nobody looked, or why there is no global value


class NearOptimal(SampledRollout):
    """`SampledRollout` of an LQR as `near_optimal` makes it, or its global value, with a report.

    Attributes:
        reach: which of the two, and how far it led on a sample of the box.
        memory: the global value; None where the LQR and its rollouts are enough.
    """

    largest = ("steps",)

    def __init__(
        self,
        basis: StaFBasis,
        plant: Plant,
        lqr: LQR,  # the base, made for the period for which a control is held
        *,
        steps: int,
        substeps: int | None,
        radius: float,  # of the ball of centers, in units of the state
        plan: bool,  # whether to plan where the LQR would meet a bound
    ) -> None:
        assert lqr.period is not None
        settings = {"period": lqr.period, "steps": steps, "substeps": substeps}
        super().__init__(basis, plant, lqr.cost, lqr, lqr.value, lqr.p, **settings)  # type: ignore[arg-type]
        self.lqr, self.radius, self.substeps, self.plan = lqr, radius, self.holding.steps, plan
        self._planners: dict[Any, BoundedPlans] = {}  # each has programs, which take seconds
        self.memory: GlobalValue | None = None
        self.kinds = nn.ModuleList()
        self.box = box_of(plant, lqr.cost.dim)
        self.reach = Reach("local", tuple(self.box.tolist()), None, None, None)

    @property
    def planner(self) -> BoundedPlans | None:
        """Planner of the policy as a function of x; None where it does not plan."""
        return self.plans() if self.plan and self.memory is None else None

    @opaque
    def forward(self, x: Tensor) -> Tensor:
        """u: (..., n) -> (..., m); with numbers of rows (B, ..., n)."""
        if len(self.kinds):
            return self._by_kind("__call__", x, self.cost.inputs)
        # Without plans it has a derivative with respect to x.
        late = defer_gradient("near_optimal(plan=True)", x=x) if self.plan else ()
        if late or (self.lqr.layers and torch.is_grad_enabled() and not x.requires_grad):
            with torch.no_grad():
                u: Tensor = self(x)
            return marked("near_optimal", late or self.lqr.layers, u)
        if self.memory is not None:
            return self.memory(x)  # type: ignore[no-any-return]
        u, planner = super().forward(x), self.planner
        if planner is None:
            return u
        if x.dtype != self.metric.dtype:
            return self.forward(x.to(self.metric.dtype)).to(x.dtype)
        rows, controls = x.reshape(-1, x.shape[-1]), u.reshape(-1, u.shape[-1])
        return where_rows(planner.strained(rows), planner, rows, controls).view(u.shape)

    def value(self, x: Tensor) -> Tensor:
        """Return the cost that the chosen control promises: (..., n) -> (...)."""
        if len(self.kinds):
            return self._by_kind("value", x, 0)
        return super().value(x) if self.memory is None else self.memory.value(x)

    @classmethod
    def of_kinds(cls, kinds: list[Kind]) -> NearOptimal:
        """Return the policy of rows that are of several kinds: steps of integration, global values."""
        made: NearOptimal = of_kinds(kinds)
        made.memory, made._planners = None, {}
        return made

    def _by_kind(self, name: str, x: Tensor, size: int) -> Tensor:
        """Return what a method of every row's kind returns: (B, ..., n) to (B, ..., size) or (B, ...)."""
        kind, methods = self.get_buffer("kind"), [getattr(each, name) for each in self.kinds]
        x = x if x.dim() > 1 else x.expand(len(all_rows(kind)), -1)
        return by_kind(kind, methods, x, x.new_zeros(*x.shape[:-1], *([size] if size else [])))

    def controller(self) -> Controller:
        """Return the controller for loops: the policy, and where the LQR, followed from there, would meet a
        bound of the inputs, a plan that is carried as long as this lasts. With ``plan`` a `RecedingHorizon`,
        which carries its plan all the time, the first one the best of several. With a global value the
        policy alone. Rows with numbers of their own plan as far as the slowest of them needs."""
        if len(self.kinds):
            kinds: list[Any] = list(self.kinds)
            return ControllerOfKinds([each.controller() for each in kinds], self.get_buffer("kind"))
        if self.memory is not None:
            return Feedback(self)
        if (planner := self.planner) is not None:
            return planner.loop
        planner = self.plans(PLANNED)
        return Feedback(self) if planner is None else StrainedPlans(self, planner)

    def __repr__(self) -> str:
        plant, cost, reach = self.plant, self.cost, self.reach
        way = "the LQR and its rollouts" if self.memory is None else "a global value"
        share = math.nan if reach.regulated is None else reach.regulated  # of rows the least
        least = float(all_rows(torch.as_tensor(share, dtype=torch.float64, device="cpu")).min())
        known = "" if math.isnan(least) else f", {100 * least:.0f} % of it regulated"
        box = ", ".join(map(shown, reach.box))
        return (
            f"NearOptimal({type(plant).__name__}, {sizes(cost.dim, cost.inputs)}, held for "
            f"{self.period:g} s,\n  {way}: box +-({box}){known},\n  horizon {self.steps * self.period:.4g} s "
            f"({self.steps} periods), {self.basis.count} centers, plan={self.plan},\n  {cost!r},\n  "
            f"{self.lqr!r})"
        )

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_planners": {}}

    def plans(self, constants: float | None = None) -> BoundedPlans | None:
        """Return the planner for states where the LQR would meet a bound; None without bounds or torch.

        It looks so many time constants ahead, by default as far as the policy."""
        limited = self.cost.bounds is not None and not self.cost.discount
        if not limited or not self.plant.traceable or self.plant.period not in (None, self.period):
            return None
        steps = self.steps
        if constants is not None:
            steps = max(steps, self._ahead(constants))
        key = steps, self.plant, self.cost
        if key not in self._planners:
            problem = SampledProblem.of(self.plant, self.cost, dt=self.period)
            self._planners[key] = BoundedPlans(problem, steps, self)
        return self._planners[key]

    def _ahead(self, constants: float) -> int:
        """Return the periods in so many time constants of the slowest mode, of rows the most."""
        (decays,) = numbers_of_rows(lambda: (slowest(self.lqr, self.plant, self.cost, self.period),)).numbers
        return int(periods_in(constants / decays, self.period).max())

    @Sign("policy.report()")
    @beside
    @torch.no_grad()
    def report(
        self,
        *,
        states: int | None = None,
        spread: float | Sequence[float] | None = None,
        full: bool = False,
        optimum: bool = False,
        seed: int = 0,
    ) -> dict[str, Any]:
        """Report the choices, and the costs from states drawn uniformly around the set-point, in ten seconds.

        Args:
            states: how many; by default 20, or fewer where loops are long (of 3, they end when the
                slowest mode of the LQR has fallen to 1e-3, and not to 1e-4).
            spread: half the width of their box, in units of the state, one number or one a coordinate, of
                angles at most pi; by default that of `Reach.box`: the plant's ``spread``, and all angles.
            full: whether to run ``controller()``, with its plans, to look for ``good_spread``, and to compile
                the policy and time it: up to some minutes.
            optimum: whether to compare with direct shooting, where the plant allows it: from seconds for a
                plant of two states to many minutes for four within bounds.
            seed: of the states.

        Returns:
            ``dt``, ``base``, ``centers``, ``radius``, ``horizon`` in s, ``substeps``; ``spectral_radius`` and
            ``largest_period`` of the held linearised loop; ``reach``, ``local`` or ``global``; ``spread``,
            ``states``;
            ``regulated``, the share of the states that end within 1 % of where they began;
            ``over_base_median`` and ``over_base_max``, the cost over the LQR's in the states that both
            regulate; ``over_optimum_median`` and
            ``over_optimum_max`` likewise (the optimum is not held: part of it is the price of holding), None
            where it is not known; ``good_spread``, the largest of 1/4, 1/2, 1, 2, 4 times the spread at which
            all are regulated, else of 1/8 to 1/4096, 0 if none; ``microseconds`` a control of one row, the
            median; ``strained``, the share of the states from which the LQR would meet a bound within the
            horizon, where the policy as a function of x is no better than the LQR unless it plans, and its
            ``controller()`` plans; None without bounds or a plant in torch; ``left_out``, what is None
            because it was not asked for, and how to ask for it.
        """
        refuse_rows("NearOptimal.report", plant=self.plant, cost=self.cost)
        stated = spread_of(self.plant, self.box) if spread is None else spread
        width = positive("report", "spread", one_or_each("report", "spread", stated, len(self.box)))
        several = not (isinstance(stated, int | float) or getattr(stated, "ndim", 1) == 0)
        count = self._few() if states is None else integer("report", "states", states, least=1)
        x0 = drawn(self.cost, self.box if spread is None else self._box(width), count, seed)
        stability = held_stability(self.control, self.plant, self.period, at=self.cost.target)
        boxes = [self._drawn(count, share * width, seed + 1) for share in _SHARES if full]
        loop = self.controller() if full or self.plan else Feedback(self)
        steps = self.settles if states or count > _FEWEST or full else round(_SHORTER * self.settles)
        costs, all_fine = self._run(loop, torch.cat((x0, *boxes)), steps)  # at once: rows are alone
        ours, fine = costs[:count], all_fine[:count]
        base, also = self._run(Feedback(self.lqr), x0, steps)
        both = fine & also
        over_base = (ours / base)[both]
        over_optimum = self._over_optimum(x0, ours, fine) if optimum else ours[:0]
        planner = self.plans()
        strained = None if planner is None else float(planner.strained(x0).double().mean())
        good = self._good(all_fine[count:].view(-1, count), count, width, seed + 1) if full else None
        return {
            "dt": self.period,
            "base": type(self.lqr).__name__,
            "centers": self.basis.count,
            "radius": self.radius,
            "horizon": self.steps * self.period,
            "substeps": self.substeps,
            "reach": self.reach.way,
            "spectral_radius": stability.spectral_radius,
            "largest_period": stability.largest_period,
            "spread": tuple(width.tolist()) if several else float(width[0]),
            "states": count,
            "regulated": float(fine.double().mean()),
            "over_base_median": _median(over_base),
            "over_base_max": float(over_base.max()) if len(over_base) else None,
            "over_optimum_median": _median(over_optimum),
            "over_optimum_max": float(over_optimum.max()) if len(over_optimum) else None,
            "good_spread": good
            if good is None
            else tuple((good * width).tolist())
            if several
            else good * float(width[0]),
            "microseconds": self._microseconds(x0[:1]) if full else None,
            "strained": strained,
            "left_out": self._left_out(full, optimum, bool(strained)),
        }

    def _few(self) -> int:
        """States whose loops take seconds: of a horizon of 60 periods and thousands of periods a few."""
        memory = self.memory
        of_row = memory.candidates * memory.lookahead / 2 if memory else self.steps * self.basis.count
        return int(min(max(_WORK / (self.settles * of_row * self.substeps), _FEWEST), _STATES))

    def _left_out(self, full: bool, optimum: bool, strained: bool) -> str:
        """Say what a report has not, and how to get it."""
        plans = "the plans of controller(), " if strained and not self.plan and self.memory is None else ""
        parts = [] if full else [f"{plans}good_spread, microseconds: report(full=True)"]
        if not optimum and self._has_optimum:
            parts.append("over_optimum: report(optimum=True)")
        return "; ".join(parts)

    def _box(self, width: Tensor) -> Tensor:
        box = width.to(self.box, copy=True)
        box[list(self.plant.periodic)] = box[list(self.plant.periodic)].clamp(max=math.pi)
        return box

    def _drawn(self, states: int, width: Tensor, seed: int) -> Tensor:
        return drawn(self.cost, self._box(width), states, seed)

    def _run(self, controller: Controller, x0: Tensor, steps: int) -> tuple[Tensor, Tensor]:
        """Cost until the slowest mode has decayed, and which rows were regulated."""
        run = simulate(controller, self.plant, self.cost, x0, dt=self.period, steps=steps)
        return run.cost, arrived(self.cost, run.state[:, -1], x0) & ~run.diverged

    @property
    def settles(self) -> int:
        """Periods after which the slowest mode of the LQR has fallen to 1e-4, or plans have arrived."""
        periods = int(settling(slowest(self.lqr, self.plant, self.cost, self.period), self.period))
        return periods if self.memory is None else max(periods, 2 * self.memory.library.control.shape[1])

    def _good(self, fine: Tensor, states: int, width: Tensor, seed: int) -> float:
        """The largest of `_SHARES` of the box from which all states are regulated, ``fine``, else less."""
        shares: tuple[float, ...] = _SHARES
        if not fine.all(dim=1).any():  # where 1 is far, as a gap of a centimetre in metres
            shares = tuple(2.0**-k for k in range(3, 13))
            x0 = torch.cat([self._drawn(states, share * width, seed) for share in shares])
            fine = self._run(self.controller(), x0, self.settles)[1].view(-1, states)
        good = [share for share, kept in zip(shares, fine.all(dim=1).tolist(), strict=True) if kept]
        return max(good, default=0.0)

    def _over_optimum(self, x0: Tensor, cost: Tensor, fine: Tensor) -> Tensor:
        if not self._has_optimum:
            return cost[:0]
        best = DirectShooting(self.plant, self.cost).solve(x0)
        return (cost / best.value)[fine & torch.isfinite(best.value)]

    @property
    def _has_optimum(self) -> bool:
        """Return whether direct shooting takes the problem."""
        return self.plant.period is None and self.plant.traceable and not self.cost.discount

    def _microseconds(self, x: Tensor) -> float:
        ready(self, x)
        controller = self.controller()
        carried, none, taken = controller.init(x), x.new_zeros(len(x), 0), list[float]()
        while len(taken) < _TIMED[0] or (len(taken) < _TIMED[1] and sum(taken) < _TIMING):
            start = time.perf_counter_ns()
            _, carried = controller.step(x, carried, none, self.period)
            taken.append((time.perf_counter_ns() - start) / 1000)
        return statistics.median_high(taken[len(taken) // 2 :])  # the first ones warm the caches


def drawn(cost: Cost, width: Tensor, count: int, seed: int) -> Tensor:
    """States drawn uniformly from the box of half widths (n,) around the set-point, (count, n)."""
    generator = torch.Generator().manual_seed(seed)
    uniform = torch.rand(count, cost.dim, dtype=torch.float64, generator=generator, device="cpu")
    away = width * (2 * uniform.to(width) - 1)
    return away if cost.target is None else away + cost.target


def arrived(cost: Cost, x: Tensor, x0: Tensor) -> Tensor:
    """Return whether states (B, n) are within 1 % of where they began, (B,) bool."""
    left, began = cost.deviation(x).norm(dim=-1), cost.deviation(x0).norm(dim=-1)
    close: Tensor = torch.isfinite(left) & (left <= _REGULATED * began)
    return close


def periods_in(seconds: Tensor, period: float) -> Tensor:
    """Periods in a horizon, a multiple of four: a compiled rollout contains one quarter and loops over it."""
    return (((seconds / period).round() / 4).ceil() * 4).clamp(*_STEPS)


def settling(decay: Tensor, period: float) -> Tensor:
    """Periods after which the slowest mode, of a decay in 1/s, has fallen to 1e-4."""
    return (_SETTLED / decay / period).ceil()


def _median(values: Tensor) -> float | None:
    return float(values.median()) if len(values) else None

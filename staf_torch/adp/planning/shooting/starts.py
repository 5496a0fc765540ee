"""Meshes, defaults and starts of direct shooting, and its result: the best of what starts lead to."""

from __future__ import annotations

import functools
import logging
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ....lanes.per_row.decisions import decided, numbers_of_rows
from ....lanes.per_row.objects import made_by_rows
from ....lanes.row_numbers import over_rows, some_rows
from ....numerics.checks import fail, integer, positive_real
from ....numerics.linalg import Matrix, positive_semidefinite, square
from ....numerics.repr_text import span
from ....systems import Plant
from ...loop.controller import LQR, Controller, Policy, Value
from ...problem.cost import Cost, quadratic
from ...problem.rules import check_regulates, check_value
from ...problem.sampled import SampledProblem
from ..ddp import BoxDDP
from ..global_value import GlobalValue
from ..global_value_learning import best_from, box_of, global_value_of, held_plans
from ..trajectories import Trajectories
from .newton import Interval, MeshPlan

_GRADING = 6.0  # ratio of a mesh's last interval to the first
_log = logging.getLogger(__name__)
_DECAY = 9.2  # time constants of the slowest mode in the horizon: it falls to 1e-4
_RESOLVED = 0.5  # mean interval in time constants of the fastest mode
_LEAST = 80  # intervals
MOST = 120  # intervals that are chosen at most where inputs are bounded
_SHARES = (0.02, 0.04, 0.08, 0.14, 0.22, 0.32)  # of the horizon, for which a constant control is held first
_KNOTS = 6  # of a random spline
_REACH = 3.0  # times the largest control that the base asks for, where there is no bound
_BEST = 2  # plans of a state that begin with a held bound
_REMEMBERED = 2  # states of a plant at most, of which a memory is learnt
ROWS = 256  # states solved from at once: a graph of second derivatives is kept for each
_SAME = 1e-4  # relative, of the values of two starts that found the same
_MIRRORED = 1e-9  # relative difference of cost below which two guesses are one and its mirror image
_ROUGH = 1e-3  # relative: what a mesh may add to the value of the base's own control
_LONE = "local: one start alone"


def graded(horizon: float, intervals: int) -> Tensor:
    """Times of a mesh whose intervals grow in geometric progression: (N + 1,) from 0 to the horizon."""
    power = (
        math.log(_GRADING)
        * torch.arange(intervals + 1, dtype=torch.float64, device="cpu")
        / max(1, intervals - 1)
    )
    return horizon * power.expm1() / power[-1].expm1()


def halved(time: Tensor) -> Tensor:
    """Return the times and those half-way: (N + 1,) -> (2N + 1,)."""
    middle = 0.5 * (time[1:] + time[:-1])
    return torch.cat((time[:1], torch.stack((middle, time[1:]), dim=-1).flatten()))


def split(stage: Interval, plan: MeshPlan, feedback: Tensor, lengths: Tensor) -> tuple[MeshPlan, Tensor]:
    """Split the N intervals of a plan, of these lengths (N,), in half: the same control and a feedback
    around it, (B, N, 2m, n) -> (B, 2N, 2m, n); the cost is the old one."""
    first, last = plan.control.chunk(2, dim=-1)
    middle = 0.5 * (first + last)
    early, late = torch.cat((first, middle), dim=-1), torch.cat((middle, last), dim=-1)
    between, _ = stage.advance(plan.state[:, :-1], early, 0.5 * lengths.expand(plan.control.shape[:2]))
    state = torch.stack((plan.state[:, :-1], between), dim=2).flatten(1, 2)
    state = torch.cat((state, plan.state[:, -1:]), dim=1)
    control = torch.stack((early, late), dim=2).flatten(1, 2)
    return MeshPlan(state, control, plan.cost), feedback.repeat_interleave(2, dim=1)


def rates_of(system: Plant, lqr: LQR) -> tuple[Tensor, Tensor]:
    """The slowest decay and the fastest rate of the LQR's modes, 1/s, () each."""
    a, b = system.linearisation(lqr.cost.target, lqr.cost.target_input)
    modes = torch.linalg.eigvals(a.to(lqr.p) - b.to(lqr.p) @ lqr.k)
    return -modes.real.max(), modes.abs().max()


def regulator(system: Plant, cost: Cost, horizon: float | None, ends: bool) -> LQR | None:
    """Return the LQR of a problem; None where there is none and a horizon, s, does without, with a
    warning if a plan ``ends`` with its value. Refused where there is neither."""
    try:
        decided(lambda: check_regulates("DirectShooting", system, cost))
        return LQR(system, cost)
    except ValueError as error:
        why = str(error)
    if horizon is None:
        raise ValueError(
            f"`DirectShooting(horizon=...)` must be given, in s, where there is no LQR: {why} "
            "Give a `terminal` as well, V_T of x or S of e'Se, where the end is to count."
        )
    if ends:
        _log.warning(
            "`DirectShooting` has no LQR (%s): the end of a plan costs nothing: give `terminal`, V_T of x"
            " or S of e'Se, or a horizon after which nothing counts.",
            why,
        )
    return None


def end_value(terminal: Value | Matrix | None, cost: Cost, lqr: LQR | None) -> Value:
    """V_T: as given, of the cost, of the LQR, or nothing."""
    if terminal is None:
        if cost.ending is not None:
            return cost.terminal
        return (lambda x: torch.zeros_like(x[..., 0])) if lqr is None else lqr.value
    if callable(terminal):
        own = check_value("DirectShooting", "terminal", terminal, cost)
    else:

        def checked() -> Tensor:
            end = square("DirectShooting", "terminal", terminal, cost.dim)
            return positive_semidefinite("DirectShooting", "terminal", end, cost.dim)

        end = made_by_rows(checked)

        def own(x: Tensor) -> Tensor:
            return quadratic(end, cost.deviation(x))

    return lambda x: over_rows(own, x)


def times(
    system: Plant, cost: Cost, lqr: LQR | None, horizon: float | None, intervals: int | None
) -> tuple[float, int]:
    """Return the horizon, s, and the even number of its intervals, checked."""
    slowest, fastest = 1.0, 0.0
    if lqr is not None:
        slow, fast = numbers_of_rows(lambda: rates_of(system, lqr)).numbers
        slowest, fastest = float(slow.min()), float(fast.max())
    horizon = positive_real("DirectShooting", "horizon", _DECAY / slowest if horizon is None else horizon)
    if intervals is None:
        most = math.inf if cost.bounds is None else MOST
        intervals = 2 * round(0.5 * min(max(_LEAST, horizon * fastest / _RESOLVED), most))
    intervals = integer("DirectShooting", "intervals", intervals, least=4)
    if intervals % 2:
        raise fail("DirectShooting", "intervals", "must be even", intervals)
    return horizon, intervals


class Optimum(NamedTuple):
    """The best trajectories found from x0, a row each; NaN in the rows where none was found.

    Example:
        >>> plant = systems.TwoState()
        >>> cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
        >>> found = adp.DirectShooting(plant, cost, horizon=2.0).solve(torch.tensor([[0.2, 0.1]]).double())
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
    iterations: Tensor  # Newton steps, all meshes and starts together, (B,)
    converged: Tensor  # (B,) bool: stationary in u, and no other start was known to be lower by 1e-4
    plan: Tensor  # u at the start and at the end of every interval, linear in between, (B, N, 2, m)
    optimality: Tensor  # (B,) what is left of the Hamiltonian over its minimum, as a share of the value
    reason: tuple[str, ...]  # a row: "" where it converged, else why it did not, or "local: ..."

    def __repr__(self) -> str:
        rows, times = self.state.shape[:2]
        found = int(self.converged.sum())
        why = sorted({reason for reason in self.reason if reason})
        more = f"; {why[0]}" + (f" (and {len(why) - 1} more reasons)" if len(why) > 1 else "") if why else ""
        return (
            f"Optimum({rows} states, value {span(self.value)}, {found} converged, {times - 1} intervals over "
            f"{float(self.time[-1]):.4g} s{more})"
        )

    def to(self, device: torch.device) -> Optimum:
        """Return the optimum on a device."""
        moved: dict[str, Any] = {
            name: part.to(device) for name, part in self._asdict().items() if name != "reason"
        }
        return self._replace(**moved)

    def replay(self) -> PlanReplay:
        """A controller that runs the plan of every row, open loop; it holds the mean over each period."""
        return PlanReplay(self.time, self.plan)


class PlanReplay(Controller):
    """u(t) of a plan (B, N, 2, m), u at the start and the end of every interval between times (N + 1,)
    from 0, linear on each, averaged over each period; its last value afterwards."""

    def __init__(self, time: Tensor, plan: Tensor) -> None:
        super().__init__()
        self.register_buffer("time", time)
        self.register_buffer("plan", plan)
        self.time: Tensor
        self.plan: Tensor

    def init(self, x0: Tensor) -> Tensor:
        """The time, (B, 1)."""
        if len(x0) != len(self.plan):
            raise ValueError(f"This plan is for {len(self.plan)} initial states; got {len(x0)}.")
        return x0.new_zeros(len(x0), 1)

    def step(self, x: Tensor, carried: Tensor, uniform: Tensor, dt: float) -> tuple[Tensor, Tensor]:
        now = float(carried[0, 0])
        u = (self.integral(now + dt) - self.integral(now)) / dt
        return u.to(x), carried + dt

    def integral(self, until: float) -> Tensor:
        """int_0^t u dt, (B, m)."""
        lengths = self.time.diff()
        share = ((until - self.time[:-1]) / lengths).clamp(0.0, 1.0)
        first, last = self.plan.unbind(2)
        weights = (lengths * share)[:, None]
        reached = first + 0.5 * share[:, None] * (last - first)
        beyond = max(0.0, until - float(self.time[-1]))
        total: Tensor = (weights * reached).sum(1) + beyond * last[:, -1]
        return total


class StartControl(NamedTuple):
    """A control over time: what is added to, or stands in place of, the base policy."""

    knots: Tensor  # (K, m) at equal times over the part of the horizon before the base takes over
    until: float  # s


def guesses(
    cost: Cost, base: Policy, x0: Tensor, horizon: float, count: int, seed: int, *, alone: bool = False
) -> list[StartControl]:
    """Return constant controls at both bounds for several times, none at all, and ``count`` random
    splines; the base takes over after each. ``alone`` says that it is the input at rest, which does not
    say how large a control is."""
    rest = torch.zeros(cost.inputs, dtype=torch.float64, device="cpu")
    rest = rest if cost.target_input is None else cost.target_input
    wanted = (base(x0) - rest.to(x0)).abs().amax(0).clamp(min=1.0 if alone else 1e-3).to(rest)
    low, high = rest - _REACH * wanted, rest + _REACH * wanted
    if cost.bounds is not None:
        low, high = (
            torch.where(torch.isfinite(limit), limit, free)
            for limit, free in ((cost.bounds.low, low), (cost.bounds.high, high))
        )
    found = [StartControl(rest.expand(2, -1), 0.3 * horizon)]
    for share in _SHARES:
        for i in range(cost.inputs):
            for end in (low, high):
                level = torch.where(torch.arange(cost.inputs, device="cpu") == i, end, rest)
                found.append(StartControl(level.expand(2, -1), share * horizon))
    generator = torch.Generator().manual_seed(seed)
    for _ in range(count):
        knots = torch.rand(_KNOTS, cost.inputs, dtype=torch.float64, generator=generator, device="cpu")
        until = float(torch.rand((), dtype=torch.float32, generator=generator, device="cpu")) * 0.6 * horizon
        found.append(StartControl(low + (high - low) * (1.5 * knots - 0.25).clamp(0.0, 1.0), until))
    return found


def guided(guess: StartControl, base: Policy) -> Callable[[Tensor, float], Tensor]:
    """u(x, t) of a guess, the base policy once its time is over."""

    def control(x: Tensor, t: float) -> Tensor:
        if t >= guess.until:
            return base(x)
        place = t / guess.until * (len(guess.knots) - 1)
        k = min(int(place), len(guess.knots) - 2)
        level = guess.knots[k] + (place - k) * (guess.knots[k + 1] - guess.knots[k])
        return level.to(x).expand(*x.shape[:-1], -1)

    return control


class PlanSearch:
    """Plans from states over T steps, the controls held for a step each; ``width`` (n,) is half that of
    the memory's box."""

    def __init__(self, problem: SampledProblem, width: Tensor, steps: int) -> None:
        self.problem, self.width, self.steps = problem, width, steps
        self._search = BoxDDP(problem, steps=steps, iterations=60, tolerance=1e-6)

    @classmethod
    def of(cls, plant: Plant, cost: Cost, dt: float, steps: int) -> PlanSearch | None:
        """The search for a plant; None where it has no problem in steps."""
        try:
            problem = SampledProblem.of(plant, cost, dt=dt)
        except ValueError as error:
            _log.info("direct shooting begins without a search in steps: %s", str(error).splitlines()[0])
            return None
        return cls(problem, box_of(plant, problem.dim), steps)

    def held(self, x0: Tensor) -> list[Trajectories]:
        """The best plans from x0 (B, n) that begin with the goal's feedback or a held bound."""
        return held_plans(self._search, x0, _BEST)

    def remembered(self, x0: Tensor) -> list[Trajectories]:
        """The best plan from x0 (B, n) by a memory, if there is one."""
        return [] if self._memory is None else [best_from(self._memory, self._search, x0)]

    @functools.cached_property
    def _memory(self) -> GlobalValue | None:
        if self.problem.dim > _REMEMBERED or not self.problem.endless:
            return None
        try:
            with some_rows(None):  # its states are its own, and none of those that are planned from
                return global_value_of(self.problem, self.width, self.steps)
        except ValueError as error:
            _log.info("direct shooting begins without a memory: %s", str(error).splitlines()[0])
            return None


def cheapest(plans: list[MeshPlan], count: int, used: Tensor) -> list[MeshPlan]:
    """Return the ``count`` cheapest plans that differ from each other and from one of the cost ``used``
    (B,), row by row.

    Two that cost the same are mirror images, or one and the same: they would find the same, and agree with
    nobody but themselves. All but the first of them come last, as plans that cost inf.
    """
    costs = torch.stack([used, *(plan.cost for plan in plans)])  # (1 + S, B)
    apart = (costs.unsqueeze(1) - costs).abs() > _MIRRORED * costs.abs()
    same = ~apart & torch.isfinite(costs)
    earlier = torch.ones_like(same[..., 0]).tril(-1).unsqueeze(-1)  # plan i after plan j
    costs = torch.where((same & earlier).any(1), torch.inf, costs)[1:]
    order = costs.argsort(dim=0, stable=True)[: min(count, len(plans))]
    rows = torch.arange(costs.shape[1], device="cpu")
    state, control = (torch.stack([getattr(p, name) for p in plans]) for name in ("state", "control"))
    return [MeshPlan(state[k, rows], control[k, rows], costs[k, rows]) for k in order]


def selected(optimum: Optimum, rows: Tensor) -> Optimum:
    """Some rows of a result."""
    parts = {name: part[rows] for name, part in _tensors(optimum).items()}
    reason = tuple(optimum.reason[row] for row in rows.tolist())
    return optimum._replace(**parts, reason=reason)


def _tensors(optimum: Optimum) -> dict[str, Tensor]:
    """Return the tensors with a row a state."""
    return {name: part for name, part in optimum._asdict().items() if name not in ("time", "reason")}


def merged(found: Optimum, rows: Tensor, several: list[Optimum]) -> Optimum:
    """The best of several starts in some rows, and the others as they were."""
    every = [selected(found, rows), *several]
    values = torch.stack([each.value.nan_to_num(nan=torch.inf) for each in every])  # (S, B')
    best = values.argmin(0)
    same = values <= values.amin(0) + _SAME * values.amin(0).abs()
    known = torch.stack([_stationary(each) for each in every])
    count = (same & known).sum(0)  # starts that found the lowest value
    places = torch.arange(len(rows), device=rows.device)
    columns = {}
    for name, whole in _tensors(found).items():
        chosen = torch.stack([getattr(each, name) for each in every])[best, places]
        columns[name] = whole.index_copy(0, rows, chosen)
    spent = torch.stack([each.iterations for each in every]).sum(0)
    columns["iterations"] = found.iterations.index_copy(0, rows, spent)
    reasons, converged = list(found.reason), found.converged.clone()
    for place, row in enumerate(rows.tolist()):
        finite = [float(v) for v in values[:, place] if math.isfinite(v)]
        converged[row] = int(count[place]) > 1 and bool(finite)
        if not finite:
            reasons[row] = found.reason[row]
        else:
            most, least = max(finite), min(finite)
            others = f"up to {most / least:.7g} times as much" if least > 0 else f"{least:.4g} to {most:.4g}"
            alike = least > 0 and most <= least * (
                1 + _SAME
            )  # no number: others ended in the same, unfinished
            local = f"{_LONE} found it" + ("" if alike else f", others {others}")
            own = every[int(best[place])].reason[place]
            lone = not own or own.startswith(_LONE)
            reasons[row] = "" if bool(converged[row]) else local if lone else f"local: {own}"
    columns["converged"] = converged
    return found._replace(**columns, reason=tuple(reasons))


def dearer(value: Tensor, followed: Tensor) -> Tensor:
    """Rows whose value is more than following the base costs on the same mesh, (B,) bool."""
    return value > followed + _ROUGH * followed.abs()


def replaced(found: Optimum, rows: Tensor, again: Optimum, believed: Tensor, followed: Tensor) -> Optimum:
    """Join what was found with what was found ``again`` from the base in some rows (B',), or NaN where
    that costs more than following the base does; one start is enough where it is ``believed`` (B',)."""
    lost = ~torch.isfinite(again.value) | dearer(again.value, followed)
    columns, reasons = {}, list(found.reason)
    for name, whole in _tensors(found).items():
        part = getattr(again, name)
        if name == "iterations":
            part = part + whole[rows]
        elif name == "converged":
            part = part & believed & ~lost
        elif name != "optimality":
            none = lost.reshape(-1, *[1] * (part.dim() - 1))
            part = torch.where(none, torch.nan, part)
        columns[name] = whole.index_copy(0, rows, part)
    for place, row in enumerate(rows.tolist()):
        if bool(lost[place]):
            reasons[row] = (
                f"what was found costs {float(found.value[row]):.4g}, more than following the base "
                f"({float(followed[place]):.4g}): state more `intervals`, or another `base`"
            )
        else:
            reasons[row] = "" if bool(believed[place]) else f"{_LONE}, the base, found it"
    return found._replace(**columns, reason=tuple(reasons))


def _stationary(optimum: Optimum) -> Tensor:
    """Rows of a start that it ended well in, also those that no other start agreed with, (B,) bool."""
    lone = [reason.startswith(_LONE) for reason in optimum.reason]
    return optimum.converged | torch.tensor(lone, dtype=torch.bool, device="cpu")


def joined(parts: list[Optimum]) -> Optimum:
    """Join results of pieces of a batch, refused if a piece needed a longer horizon than another."""
    longest = max(parts, key=lambda part: float(part.time[-1])).time
    if any(not torch.equal(part.time, longest) for part in parts):
        raise ValueError(
            "`DirectShooting.solve` needed different horizons for different states: state a `horizon` of "
            f"{float(longest[-1]):.4g} s, or solve at most {ROWS} states at once."
        )
    columns = {name: torch.cat([_tensors(part)[name] for part in parts]) for name in _tensors(parts[0])}
    reason = tuple(one for part in parts for one in part.reason)
    return parts[0]._replace(**columns, reason=reason)

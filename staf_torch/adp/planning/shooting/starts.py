"""Starts of direct shooting: guesses, searches in equal steps, and the best of what they lead to."""

from __future__ import annotations

import functools
import logging
import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from ....lanes.row_numbers import some_rows
from ....systems import Plant
from ...loop.controller import Policy
from ...problem.cost import Cost
from ...problem.sampled import SampledProblem
from ..ddp import BoxDDP
from ..global_value import GlobalValue
from ..global_value_learning import best_from, box_of, global_value_of, held_plans
from ..trajectories import Trajectories
from .newton import MeshPlan
from .optimum import Optimum

_SHARES = (0.02, 0.04, 0.08, 0.14, 0.22, 0.32)  # of the horizon, for which a constant control is held first
_KNOTS = 6  # of a random spline
_REACH = 3.0  # times the largest control that the base asks for, where there is no bound
_log = logging.getLogger(__name__)
_BEST = 2  # plans of a state that begin with a held bound
_REMEMBERED = 2  # states of a plant at most, of which a memory is learnt
ROWS = 256  # states solved from at once: a graph of second derivatives is kept for each
_SAME = 1e-4  # relative, of the values of two starts that found the same
_MIRRORED = 1e-9  # relative difference of cost below which two guesses are one and its mirror image
_ROUGH = 1e-3  # relative: what a mesh may add to the value of the base's own control
_LONE = "local: one start alone"


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

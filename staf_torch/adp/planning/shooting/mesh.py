"""Meshes of times, and the defaults of direct shooting: regulator, end of a plan, horizon, intervals."""

from __future__ import annotations

import logging
import math

import torch
from torch import Tensor

from ....lanes.per_row.decisions import decided, numbers_of_rows
from ....lanes.per_row.objects import made_by_rows
from ....lanes.row_numbers import over_rows
from ....numerics.checks import fail, integer, positive_real
from ....numerics.linalg import Matrix, positive_semidefinite, square
from ....systems import Plant
from ...loop.controller import LQR, Value
from ...problem.cost import Cost, quadratic
from ...problem.rules import check_regulates, check_value
from .newton import Interval, MeshPlan

_GRADING = 6.0  # ratio of a mesh's last interval to the first
_log = logging.getLogger(__name__)
_DECAY = 9.2  # time constants of the slowest mode in the horizon: it falls to 1e-4
_RESOLVED = 0.5  # mean interval in time constants of the fastest mode
_LEAST = 80  # intervals
MOST = 120  # intervals that are chosen at most where inputs are bounded


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

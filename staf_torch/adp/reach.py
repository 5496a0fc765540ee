"""The reach of a held feedback, on a sample of the box around the goal, and a value for all of that box."""

from __future__ import annotations

import logging
import math
import time
from typing import NamedTuple

import torch
from torch import Tensor

from ..lanes.per_row.decisions import in_any_row, is_of_rows, of_first, rows_of
from ..lanes.per_row.objects import rows
from ..lanes.row_numbers import all_rows
from ..numerics.checks import fail
from ..systems import Bounds, Linear, Plant
from ..systems.user_plants import FunctionPlant
from .loop.controller import LQR
from .planning.ddp import BoxDDP
from .planning.global_value import GlobalValue
from .planning.global_value_learning import best_from, global_value_of
from .policies.sampled_rollout import SampledRollout
from .problem.cost import Cost
from .problem.sampled import SampledProblem

_log = logging.getLogger(__name__)
STATES = 24  # drawn from a box, beside the 2 n ends of its axes
REGULATED = 1e-2  # share of the distance from the set-point that is left
_LOOK = 16  # periods after which it is looked who arrived
_BUDGET, _PATIENCE = 0.4, 2.0  # s of the processor, and s, that following the base may take
_BATCHED = 4.0  # times the time that a problem may take where many are followed at once, in `vmap`
_DIMS, _INPUTS = 6, 2  # at most, of a plant whose global value is learnt
_SEED = 7  # of the sample
_DEAR = 4.0  # times the value of the LQR that it may cost within its bounds, to be a base
_GOOD = 1.02  # mean cost over the best known, beyond which the log warns


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


def drawn(cost: Cost, width: Tensor, count: int, seed: int) -> Tensor:
    """States drawn uniformly from the box of half widths (n,) around the set-point, (count, n)."""
    generator = torch.Generator().manual_seed(seed)
    uniform = torch.rand(count, cost.dim, dtype=torch.float64, generator=generator, device="cpu")
    away = width * (2 * uniform.to(width) - 1)
    return away if cost.target is None else away + cost.target


def sample(cost: Cost, width: Tensor) -> Tensor:
    """States of a box: the ends of its axes, and some drawn."""
    ends = torch.cat((torch.diag(width), -torch.diag(width)))
    return torch.cat((ends if cost.target is None else ends + cost.target, drawn(cost, width, STATES, _SEED)))


def arrived(cost: Cost, x: Tensor, x0: Tensor) -> Tensor:
    """Return whether states (B, n) are within 1 % of where they began, (B,) bool."""
    left, began = cost.deviation(x).norm(dim=-1), cost.deviation(x0).norm(dim=-1)
    close: Tensor = torch.isfinite(left) & (left <= REGULATED * began)
    return close


def whole(box: Tensor) -> Reach:
    """The reach of an LQR that regulates all of a box by nature."""
    return Reach("local", tuple(box.tolist()), 1.0, None, 1.0)


def reach_of_rows(ways: list[tuple[Tensor, Reach]], count: int) -> Reach:
    """Return the reach of all rows: NaN where nobody looked."""

    def numbers(name: str) -> Tensor:
        full = torch.full((count,), math.nan, dtype=torch.float64, device="cpu")
        for own, reach in ways:
            if (value := getattr(reach, name)) is not None:
                full[own] = all_rows(torch.as_tensor(value, dtype=torch.float64, device="cpu"))
        return rows(full)  # type: ignore[no-any-return]

    several = " and ".join(sorted({reach.way for _, reach in ways}))
    note = next((reach.note for _, reach in ways if reach.note), "")
    box = ways[0][1].box
    return Reach(several, box, numbers("regulated"), numbers("over_best"), numbers("base"), note)


class Looked(NamedTuple):
    """Measures how far a base leads from a sample of the box."""

    reach: Reach | None  # None where a global value is wanted
    base: Followed
    share: Tensor  # () that is regulated


def looked(policy: SampledRollout, lqr: LQR, box: Tensor, settles: Tensor, way: str) -> Looked | None:
    """Follow a base from a sample of the box; None where it regulates all by nature."""
    x0, widths = sample(policy.cost, box), tuple(box.tolist())
    if type(policy.plant) is Linear and not policy.bounds.present and way == "auto":
        return None
    base = follow_base(policy, x0, 2 * settles)
    share = base.regulated.double().mean()
    kept = share if is_of_rows(share) else float(share)
    if way == "auto" and not base.known:
        _log.warning(
            "near_optimal did not check from where the LQR regulates: its simulation from %d states of the "
            "box %s takes longer than 0.4 s (%.0f %% had arrived by then). `report()` checks.",
            *(len(x0), _shown(box), 100 * float(of_first(share))),
        )
        note = "the simulation of the LQR was stopped after 0.4 s"
        return Looked(Reach("local", widths, None, None, None, note), base, share)
    dear = policy.bounds.present & (base.cost > _DEAR * lqr.value(x0))
    good = way == "auto" and bool((base.regulated & ~dear).all())
    return Looked(Reach("local", widths, kept, None, kept) if good else None, base, share)


def extended(
    policy: SampledRollout, lqr: LQR, box: Tensor, settles: int, way: str
) -> tuple[Reach, GlobalValue | None]:
    """Return the reach of a base and, where that is not enough, of a global value; log what is left.

    Raises:
        ValueError: if the way is ``global`` and there is no global value.
    """
    cost, x0, widths = policy.cost, sample(policy.cost, box), tuple(box.tolist())
    found = looked(
        policy, lqr, box, torch.tensor(float(settles), dtype=torch.float64, device=box.device), way
    )
    if found is None:
        return whole(box), None
    if found.reach is not None:
        return found.reach, None
    base, share = found.base, float(found.share)
    try:
        problem = sampled_problem(policy.plant, cost, policy.period, x0)
        _log.info(
            "near_optimal: the LQR regulates %.0f %% of %d states of the box %s: learning a global value",
            *(100 * share, len(x0), _shown(box)),
        )
        memory = global_value_of(problem, box, settles)
    except ValueError as error:
        if way == "global":
            raise fail("near_optimal", "reach", f"must be local here: {error}", way) from error
        _log.warning(
            "near_optimal: the LQR regulates %.0f %% of %d states of the box %s, and its rollouts no "
            "more. There is no global value: %s",
            *(100 * share, len(x0), _shown(box), error),
        )
        return Reach("local", widths, share, None, share, str(error)), None
    return _judged(memory, cost, x0, base, box), memory


def _judged(memory: GlobalValue, cost: Cost, x0: Tensor, base: Followed, box: Tensor) -> Reach:
    """Return the reach of a global value from x0 (B, n)."""
    share, found = float(base.regulated.double().mean()), compared(memory, cost, x0)
    best = torch.where(base.regulated, torch.minimum(base.cost, found.best), found.best)
    good = found.regulated
    over = float(found.cost[good].sum() / best[good].sum()) if bool(good.any()) else math.inf
    known = float(good.double().mean())
    if known < 1 or over > _GOOD:
        _log.warning(
            "near_optimal: its global value regulates %.0f %% of %d states of the box %s (the LQR %.0f %%), "
            "at %.3g times the best cost known in the mean.",
            *(100 * known, len(x0), _shown(box), 100 * share, over),
        )
    return Reach("global", tuple(box.tolist()), known, over, share)


def _shown(box: Tensor) -> str:
    return "+-(" + ", ".join(f"{width:.3g}" for width in box.tolist()) + ")"


class Followed(NamedTuple):
    """The end of trajectories of a base."""

    regulated: Tensor  # (B,) bool
    cost: Tensor  # (B,), until all had arrived
    known: bool  # False where the time was over before all rows had arrived, diverged or had their time


@torch.no_grad()
def follow_base(policy: SampledRollout, x0: Tensor, periods: Tensor) -> Followed:
    """Follow the base of a policy, within its bounds, from x0 (B, n), for ``periods`` () at most and 0.4
    s of computing."""
    x, paid, began, since = x0, torch.zeros_like(x0[:, 0]), time.thread_time(), time.monotonic()
    good = torch.zeros_like(paid, dtype=torch.bool)
    known, k = good[0], 0
    longer = _BATCHED * rows_of(policy.metric) if is_of_rows(policy.metric) else 1.0
    while in_any_row(~known):
        k += 1
        moved, spent = policy.holding(x, policy.bounds.clip(policy.base(x)))
        moved = torch.where(torch.isfinite(moved).all(-1, keepdim=True), moved, torch.nan)
        # What is known of a problem does not change while others go on.
        x, paid = torch.where(known, x, moved), torch.where(known, paid, paid + spent)
        spent_time = time.thread_time() - began, time.monotonic() - since
        late = spent_time[0] > longer * _BUDGET or spent_time[1] > longer * _PATIENCE
        if k % _LOOK == 0 or late or in_any_row(periods == k):
            here = arrived(policy.cost, x, x0)
            every = k % _LOOK == 0 or late
            now = (k >= periods) | ((here | x.isnan().any(-1)).all() & every)
            good = torch.where(known | ~((k >= periods) | every), good, here)
            known = known | now
            if late:
                break
    return Followed(good, paid, bool(known))


def sampled_problem(plant: Plant, cost: Cost, period: float, x: Tensor) -> SampledProblem:
    """Return the plant and its cost in steps, as a global value needs them; x (B, n) are states of the
    box. Raises a ValueError that says why there is none."""
    if isinstance(plant, FunctionPlant):
        levels = Bounds(-1.0, 1.0, cost.inputs) if cost.bounds is None else cost.bounds
        at = torch.linspace(0, 1, len(x), dtype=torch.float64, device=x.device).unsqueeze(1)
        low, high = levels.low.clamp(min=-1e3), levels.high.clamp(max=1e3)
        plant = plant.in_torch(x, low + at * (high - low)) or plant
    if not plant.traceable:
        rule = "torch all through, or one function in NumPy that torch can follow (no np.array, no branches)"
        raise ValueError(f"it needs a plant that is {rule}")
    if cost.dim > _DIMS or cost.inputs > _INPUTS:
        raise ValueError(f"a global value is learnt of at most {_DIMS} states and {_INPUTS} inputs")
    return SampledProblem.of(plant, cost, dt=period)


class Compared(NamedTuple):
    """A policy beside the best trajectories that are known."""

    regulated: Tensor  # (B,) bool
    cost: Tensor  # (B,)
    best: Tensor  # (B,)


@torch.no_grad()
def compared(memory: GlobalValue, cost: Cost, x0: Tensor) -> Compared:
    """Return the cost of following a memory from x0 (B, n), and the best that is found from its plans."""
    problem, steps = memory.problem, memory.length - memory.lookahead - 1
    search = BoxDDP(problem, steps=steps, iterations=40, tolerance=1e-5)
    best = best_from(memory, search, x0).cost
    x, paid = x0, torch.zeros_like(x0[:, 0])
    for _ in range(2 * steps):
        x, spent = problem.advance(x, memory.choose(x).control)
        paid = paid + spent
    good = arrived(cost, x, x0)
    return Compared(good, paid + problem.terminal(x), best)

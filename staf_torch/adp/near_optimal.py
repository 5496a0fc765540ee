"""Make a policy from a plant and a cost in one call."""

from __future__ import annotations

import logging
import time

import torch

from ..approximation.basis import StaFBasis
from ..centers import StateFollowingCenters, cross_polytope
from ..kernels import ExponentialKernel
from ..lanes.gradients import without_gradient
from ..lanes.per_row.decisions import at_once, is_of_rows, most_of_rows, spread_rows, tried
from ..lanes.per_row.kinds import Kind, kinds_of_rows
from ..lanes.per_row.objects import row_of
from ..lanes.torch_compile.operators import opaque
from ..numerics.checks import choice, flag, positive_real
from ..numerics.default_device import beside
from ..signs import Sign
from ..systems import Plant
from ..systems.base import Limit
from .loop.controller import LQR
from .near_optimal_policy import PLANNED, NearOptimal, periods_in, settling
from .policies.rollout import ball_directions
from .problem.cost import Cost
from .problem.rules import (
    check_endless,
    check_objects,
    check_still,
    check_torch,
    held_period,
    regulated,
    slowest,
    warn_if_short,
)
from .reach import Reach, extended, looked, reach_of_rows, whole

_log = logging.getLogger(__name__)
_DECAY = 2.0  # time constants of the slowest mode of the LQR in the horizon
_TRIES, _PATIENCE = 8, 1.0  # controls, and s, after which a simulator is called slow
_SHARE = 0.5  # of a period that a control may take without a warning: another half for a slower moment
_Given = tuple[Plant, Cost, Limit, Limit, float]
"""Arguments that may hold numbers of rows: plant, cost, low, high, radius."""
_WAYS = ("auto", "local", "global")


@opaque
@without_gradient("adp.near_optimal", "plant", "cost")
@Sign("near_optimal")
@beside
def near_optimal(
    plant: Plant,
    cost: Cost,
    *,
    dt: float | None = None,
    low: Limit = None,
    high: Limit = None,
    radius: float = 0.1,
    horizon: float | None = None,
    plan: bool = False,
    reach: str = "auto",
    substeps: int | None = None,
) -> NearOptimal:
    """A policy for a plant, held for dt: never dearer than its LQR, and to the set-point from all of a box.

    **Reach.** The box is the plant's ``spread`` around the set-point, and of periodic coordinates the whole
    turn. The LQR is followed within its bounds from 24 states of it and the ends of its axes, in less than
    half a second. Where it regulates them all (to 1 % of where they began; within bounds for at most four
    times its value) the policy is the local one below. Else a global value of the box is learnt
    (`learn_global_value`), for a plant in torch of at most six states and two inputs, and the policy follows
    the cheapest of the optimal trajectories near x; where none is near enough it is the LQR within its
    bounds. States that are not regulated, cost more than 1.02 of the best trajectories known, or at which
    nobody could look, are one warning with the numbers; ``policy.reach`` and ``report()`` keep them.

    **Local.** The base is the LQR made for dt; the horizon is two time constants of its slowest mode (three
    with plans), 12 to 60 periods, four quarters; 2 m + 1 centers lie along the m inputs, at ``radius`` from
    the state and on it (with more inputs than states, around the state as many as quadratics need).

    **Bounds.** Where the LQR, followed from x over the horizon, meets a bound (``report()["strained"]``), the
    policy's ``controller()``, for loops, carries a plan by `BoxDDP` and improves it from control to control,
    in some milliseconds, until no bound is met any more. Rows that begin so get the best of several plans,
    made by ``init`` and, after `lanes.ready` of the policy, compiled there. That takes a plant in torch, held
    for one period of its own, without a discount; else ``controller()`` is the policy alone.

    **Rows.** With numbers of rows (`staf_torch.rows`) every row has its own policy, horizon and steps of
    integration. All are made at once, but for rows that need a global value: each is learnt by itself.

    A simulator so slow that a control takes more than half of dt is a warning in the log, with the share.

    Example:
        >>> import numpy as np
        >>> def step(x, u):  # a simulator in NumPy: rows (B, 2) and (B, 1)
        ...     return x + 0.1 * np.stack((x[:, 1], np.sin(x[:, 0]) + u[:, 0]), axis=1)
        >>> plant = systems.StepPlant(step, dim=2, inputs=1, dt=0.1, periodic=[0])
        >>> policy = adp.near_optimal(plant, adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1), low=-2.0, high=2.0)
        >>> policy(torch.tensor([[0.3, 0.0]], dtype=torch.float64)).shape
        torch.Size([1, 1])

        Shown by `staf_torch/adp/README.md`.

    Args:
        plant: in continuous or in discrete time.
        cost: the cost rate.
        dt: s, for which a control is held; by default the period of a plant in discrete time.
        low, high: of the inputs, as in `systems.Bounds`; by default those of the cost, or else of the plant.
        radius: of the ball of centers, in units of the state: measure states so that 1 is a large one.
        horizon: s; None for the rule above.
        plan: whether to plan all the time: ``controller()`` is a `RecedingHorizon`, and the policy as a
            function of x plans anew, in tens of milliseconds, where the LQR would meet a bound (in a loop two
            ways around that cost nearly the same would take turns). Exported to C as its ``controller()``;
            loops are compiled where that is asked for. Not with a global value.
        reach: ``auto`` for the rule above; ``local``: nobody looks how far the LQR leads; ``global``: the
            global value, also where the LQR would do.
        substeps: integration steps a period of a plant in continuous time; None for as many as are accurate.

    Raises:
        ValueError: if an argument breaks its rule, the plant has no LQR, or ``reach`` is ``global`` and there
            is no global value; the message says why.
    """
    check_objects("near_optimal", plant=plant, cost=cost)
    choice("near_optimal", "reach", reach, _WAYS)

    def single(given: _Given) -> NearOptimal:
        policy = _local(given, dt, horizon, plan, substeps)
        if reach != "local":
            policy.reach, policy.memory = extended(policy, policy.lqr, policy.box, policy.settles, reach)
        return policy

    def looked_at() -> tuple[NearOptimal, Reach | None]:
        policy = _local(given, dt, horizon, plan, substeps)
        if reach != "auto":
            return policy, policy.reach if reach == "local" else None
        decay = slowest(policy.lqr, plant, policy.cost, policy.period)
        found = looked(policy, policy.lqr, policy.box, settling(decay, policy.period), reach)
        return policy, whole(policy.box) if found is None else found.reach

    given = plant, cost, low, high, radius
    policy, count = tried(lambda: single(given))
    if count is None:
        assert policy is not None
        return policy
    check_torch("near_optimal", "plant", plant)
    parts = at_once(looked_at, count, spread_rows(count))
    kept = [part for part in parts if part.found[1] is not None]
    kinds = kinds_of_rows([part.found[0] for part in kept], [part.rows for part in kept], count)
    ways = [(part.rows, part.found[1]) for part in kept]
    for row in sorted(row for part in parts if part.found[1] is None for row in part.rows.tolist()):
        alone, own = single(row_of(given, row)), torch.tensor([row], dtype=torch.int64, device="cpu")
        kinds.append(Kind(own, alone))  # a global value is of one problem
        ways.append((own, alone.reach))
    made = kinds[0].object if len(kinds) == 1 and kept else NearOptimal.of_kinds(kinds)
    made.reach = reach_of_rows(ways, count)
    return made


def _local(
    given: _Given, dt: float | None, horizon: float | None, plan: bool, substeps: int | None
) -> NearOptimal:
    """Return the local policy; arguments as those of `near_optimal`."""
    plant, cost, low, high, radius = given
    period = held_period("near_optimal", plant, dt)
    check_still("near_optimal", "plant", plant, "`RecedingHorizon` or `LQR`")
    check_endless(
        "near_optimal", "cost", cost.ending, "the policy has no final time; plans have one: `RecedingHorizon`"
    )
    placed = regulated("near_optimal", plant, cost.bounded(low, high))
    lqr = LQR(plant, placed, period=period)
    decay = slowest(lqr, plant, placed, period)
    constants = PLANNED if flag("near_optimal", "plan", plan) else _DECAY
    counted = None
    if horizon is None:
        wanted = periods_in(constants / decay, period)
        steps, counted = most_of_rows(wanted), wanted / 4 if is_of_rows(wanted) else None
    else:
        steps = round(positive_real("near_optimal", "horizon", horizon) / period)
        warn_if_short("near_optimal", "horizon", horizon, decay)
    corners = cross_polytope(placed.inputs)
    along = torch.cat((corners, torch.zeros_like(corners[:1])))
    directions = along if placed.inputs <= placed.dim else ball_directions(None, placed.dim)
    basis = StaFBasis(ExponentialKernel(), StateFollowingCenters(directions, radius))
    policy = NearOptimal(basis, plant, lqr, steps=steps, substeps=substeps, radius=radius, plan=plan)
    if counted is not None:
        policy.counted = True
        policy.register_buffer("quarter", counted)
    if not plant.traceable:
        _warn_if_slow(policy)
    return policy


def _warn_if_slow(policy: NearOptimal) -> None:
    """Warn in the log where a simulator takes most of the period, or more."""
    x = policy.plant.equilibrium().unsqueeze(0)
    tries = list[float]()
    while len(tries) < 2 or (len(tries) < _TRIES and sum(tries) < _PATIENCE):
        began = time.perf_counter()  # the first call loads what later ones find, others share the processor
        with torch.no_grad():
            policy(x)
        tries.append(time.perf_counter() - began)
        if tries[-1] <= _SHARE * policy.period:
            return
    taken = min(tries)
    _log.warning(
        "a control of `near_optimal` takes about %.3g s with this %s, %.0f %% of the %.3g s for which it is "
        "held: %s. Shorten `horizon` (%d periods now), or use the LQR.",
        taken,
        type(policy.plant).__name__,
        100 * taken / policy.period,
        policy.period,
        "it cannot run beside the plant" if taken > policy.period else "a slower moment and it is late",
        policy.steps,
    )

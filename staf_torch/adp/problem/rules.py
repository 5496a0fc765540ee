"""Rules about a plant with its cost, each written once: every door asks those it needs before it computes.

A regulator needs a plant that rests at the set-point, an input within the bounds that holds it there, and a
linearisation that can be stabilised. A plan over a horizon, or a loop over some steps, needs none of these.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable

import torch
from torch import Tensor

from ...lanes.per_row.decisions import each_row, numbers_of_rows, of_first
from ...lanes.row_numbers import RowNumbers, nonzero
from ...numerics.checks import fail, object_of, positive_real
from ...numerics.default_device import device_of
from ...numerics.rows import check_rows, is_ours
from ...systems import Bounds, Clocked, ControlAffineSystem, Plant
from ...systems.equilibria import check_rest
from ...systems.user_plants import FunctionPlant
from .cost import Cost
from .held_linear import HeldLoop

Function = Callable[[Tensor], Tensor]


_PLANTS = "`systems.RatePlant(f, dim=n, inputs=m)` is that of x' = f(x, u), `StepPlant` of x+ = f(x, u)"
_COSTS = "`QuadraticCost(q, r, dim=n, inputs=m)` is x'Qx + u'Ru, a subclass with `state_rate` any other"
_log = logging.getLogger(__name__)
_NEAR, _NOTHING = 1e-4, 1e-9  # of a state around the set-point, and of the cost rate there
_ROWS = 16  # with numbers of their own, of which the loop is linearised
_CONSTANTS = 0.5  # time constants of the slowest mode that a horizon must have


def check_objects(call: str, *, cost: object, **plants: object) -> None:
    """Refuse what is no plant, or no cost, of a door that takes these; the error says what to write."""
    object_of(call, Plant, _PLANTS, **plants)
    object_of(call, Cost, _COSTS, cost=cost)


def check_problem(plant: Plant, cost: Cost) -> None:
    """Refuse a plant or a cost whose rates are not those of rows, whatever their number."""
    check_plant(plant)
    check_cost(cost)


def check_plant(plant: Plant) -> None:
    """Refuse a plant whose rates are not those of rows, whatever their number: the method, and what it
    returned."""
    _check_spread(plant)
    if plant.dim is None or isinstance(plant, FunctionPlant) or is_ours(type(plant)):
        return  # a function was tried when its plant was made
    name, x, u = type(plant).__name__, plant.equilibrium(), plant.resting_input()
    if isinstance(plant, ControlAffineSystem):
        check_rows(f"{name}.drift", plant.drift, [x], (len(x),), sizes=(len(u),))
        _check_torch(name, plant, x)
        check_rows(f"{name}.effectiveness", plant.effectiveness, [x], (len(x), len(u)))
    else:
        check_rows(f"{name}.motion", plant.motion, [x, u], (len(x),))


def _check_torch(name: str, plant: ControlAffineSystem, x: Tensor) -> None:
    """Refuse a drift that leaves torch: it is differentiated."""
    try:
        with torch.enable_grad():
            each_row(lambda: plant.drift(x.detach()[None].requires_grad_()), 1)
    except RuntimeError as error:
        if "numpy()" in str(error):
            raise ValueError(
                f"`{name}.drift` must be of torch's operations, as it is differentiated, and calls NumPy: "
                "`systems.RatePlant` and `systems.StepPlant` take a function in NumPy."
            ) from error


def _check_spread(plant: Plant) -> None:
    """Refuse a ``spread`` of a plant that is no positive number, and not one a coordinate."""
    spread: object = plant.spread
    if isinstance(spread, int | float | RowNumbers):
        return
    rule = f"must be one positive number, or one a coordinate{f' ({plant.dim})' if plant.dim else ''}"
    try:
        each = torch.as_tensor(spread, dtype=torch.float64, device="cpu")
    except (TypeError, ValueError, RuntimeError) as error:
        raise fail(type(plant).__name__, "spread", rule, spread) from error
    if each.dim() > 1 or (each.dim() and len(each) != (plant.dim or len(each))) or not bool((each > 0).all()):
        raise fail(type(plant).__name__, "spread", rule, spread)


def check_cost(cost: Cost) -> None:
    """Refuse a cost of a user whose rates are not numbers, one a row: the method, and what it returned."""
    if is_ours(type(cost)):
        return
    name, x = type(cost).__name__, state_of(cost)
    u = torch.zeros(cost.inputs, dtype=torch.float64, device=x.device)
    check_rows(f"{name}.state_rate", cost.state_rate, [x], sizes=(len(u),))
    check_rows(f"{name}.input_rate", cost.input_rate, [u], sizes=(len(x),))
    check_rows(f"{name}.rate", cost.rate, [x, u])


def check_value(call: str, name: str, value: Function, cost: Cost) -> Function:
    """Return a function of the state, refused where it is not one number a row: V, V_T, an energy."""
    if not is_ours(value):
        check_rows(f"{call}({name}=...)", value, [state_of(cost)], sizes=(cost.inputs,))
    return value


def check_policy(call: str, name: str, cost: Cost, *policies: Function) -> None:
    """Refuse policies that are not one control a row."""
    for policy in policies:
        if not is_ours(policy):
            check_rows(f"{call}({name}=...)", policy, [state_of(cost)], (cost.inputs,))


def state_of(cost: Cost) -> Tensor:
    """A state to try functions at, (n,): the set-point, or the origin."""
    zeros = torch.zeros(cost.dim, dtype=torch.float64, device=device_of(cost))
    return zeros if cost.target is None else cost.target


def check_torch(call: str, argument: str, plant: Plant, *, continuous: bool = False) -> None:
    """Refuse a plant with something that torch cannot differentiate, or one in discrete time."""
    kind = "in torch all through" if not continuous else "in continuous time and in torch all through"
    if not plant.traceable or (continuous and plant.period is not None):
        rule = f"must be {kind}: trajectories are optimised by its second derivatives"
        raise fail(call, argument, rule, type(plant).__name__)


def check_still(call: str, argument: str, plant: Plant, instead: str) -> None:
    """Refuse a plant with a clock, with who follows a path ``instead``."""
    if isinstance(plant, Clocked):
        raise fail(call, argument, f"must have no clock: a path is followed by {instead}", plant)


def check_undiscounted(call: str, cost: Cost) -> None:
    """Refuse a cost with a discount."""
    if nonzero(cost.discount):
        raise fail(call, "cost", "must have no discount", cost.discount)


def check_endless(call: str, argument: str, end: object, why: str) -> None:
    """Refuse a terminal cost ``end`` of a door that knows no end."""
    if end is not None:
        raise fail(call, argument, f"must have no terminal cost: {why}", end)


def check_regulator(call: str, argument: str, why: str) -> None:
    """Refuse a problem without a linear regulator, ``why``, of a door that leads to the goal; "" with one."""
    if why:
        raise ValueError(f"`{call}({argument}=...)` must have a linear regulator at its goal: {why}")


def held_period(call: str, plant: Plant, dt: float | None) -> float:
    """Return the time for which a control is held, s: ``dt``, by default a step of a plant in discrete
    time. Refused where it is not positive, or nobody says it."""
    period = plant.period if dt is None else dt
    if period is None:
        raise fail(call, "dt", "must be given, s: a plant in continuous time has no period of its own", dt)
    return positive_real(call, "dt", period)


def own_period(call: str, plant: Plant, dt: float | None) -> float:
    """`held_period` of a door that takes a plant in discrete time at its own period alone."""
    if plant.period is not None and dt not in (None, plant.period):
        raise fail(call, "dt", f"must be the plant's period, {plant.period} s", dt)
    return held_period(call, plant, dt)


def check_within(call: str, argument: str, bounds: Bounds | None, u: Tensor) -> bool:
    """Refuse bounds that do not contain the input (m,) which holds the plant at the set-point. False
    where it lies on a bound, of which a warning in the log tells."""
    if bounds is None:
        return True
    bounds = bounds.on(u.device)
    if not bool(bounds.contain(u)):
        low, high = bounds.low.tolist(), bounds.high.tolist()
        rule = f"must hold the plant at the set-point with an input within the bounds, {low} and {high}"
        raise fail(call, argument, rule, u.tolist())
    if bool(((u == bounds.low) | (u == bounds.high)).any()):
        _log.warning(
            "`%s`: the input %s that holds the plant at the set-point lies on a bound, %s and %s: a feedback "
            "can push one way only.",
            *(call, u.tolist(), bounds.low.tolist(), bounds.high.tolist()),
        )
        return False
    return True


def regulated(call: str, plant: Plant, cost: Cost) -> Cost:
    """Return the cost around the plant, of a door that regulates. Refused where the sizes differ, the
    plant does not rest at the set-point, or its input is not within the bounds."""
    check_problem(plant, cost)
    placed = cost.around(plant)
    _check_held(call, plant, placed)
    return placed


def set_point(plant: Plant, cost: Cost) -> tuple[Tensor, Tensor]:
    """Return the state and the input, (n,) and (m,), at which a cost around a plant wants it to rest."""
    x = plant.equilibrium() if cost.target is None else cost.target
    none = torch.zeros(cost.inputs, dtype=torch.float64, device=x.device)
    return x, none if cost.target_input is None else cost.target_input


def check_regulates(call: str, plant: Plant, cost: Cost) -> None:
    """Refuse an economic cost, around a plant, of a path or a set-point: one whose rate is not 0 there,
    or less somewhere beside it."""
    still_plant, still = cost.regulated(plant)
    x = set_point(still_plant, still)[0]
    near = _NEAR * (1 + x.abs()) * torch.eye(len(x), dtype=x.dtype, device=x.device)
    with torch.no_grad():
        rates = still.state_rate(torch.cat((x.unsqueeze(0), x + near, x - near)))
    at, least = rates[0], rates.min()
    if bool((at.abs() > _NOTHING) | ~(least >= at - _NOTHING)):
        rule = "must be 0 at the set-point and not less beside it, for a regulator"
        raise fail(
            call,
            "cost",
            f"{rule}: its rate is {float(at):.6g} there and {float(least):.6g} beside it",
            x.tolist(),
        )


def restless(plant: Plant, cost: Cost) -> str:
    """Return why nothing keeps a plant at the set-point of a cost around it at no cost; "" where
    something does."""
    try:
        check_regulates("restless", plant, cost)
        _check_held("restless", plant, cost)
    except ValueError as error:
        return str(error)
    return ""


def warn_if_restless(call: str, plant: Plant, cost: Cost) -> bool:
    """Say in the log that nothing holds a plant at the set-point of a cost, which is paid for ever then;
    True where nothing had to be said, as of an economic cost, which has no set-point."""
    try:
        check_regulates(call, plant, cost)
    except ValueError:
        return True
    try:
        return _check_held(call, plant, cost)
    except ValueError as error:
        _log.warning("`%s`: nothing holds the plant at the set-point: %s", call, error)
        return False


def _check_held(call: str, plant: Plant, placed: Cost) -> bool:
    """Refuse a set-point at which no input within the bounds holds the plant; as `check_within`."""
    still_plant, still = placed.regulated(plant)
    x, u = set_point(still_plant, still)
    check_rest(still_plant, x, u)
    return check_within(call, "cost", placed.bounds, u)


def slowest(policy: Callable[[Tensor], Tensor], plant: Plant, cost: Cost, period: float) -> Tensor:
    """Return the decay of the slowest mode of a held, linearised loop, 1/s, ()."""
    radius = HeldLoop.of(policy, plant, at=cost.target).radius(period)
    return -radius.clamp(1e-9, 1 - 1e-9).log() / period


def warn_if_short(call: str, argument: str, horizon: float, decay: Tensor) -> None:
    """Say in the log that a horizon, s, ends before the loop has decayed once; the slowest mode does in
    1/s, ()."""
    if bool(horizon * decay < _CONSTANTS):
        decay = of_first(decay)
        _log.warning(
            "`%s(%s=...)`: the horizon of %.3g s is %.2g time constants of the slowest mode of the regulated "
            "plant: what lies beyond is left to the linear regulator's value. Take %.3g s.",
            *(call, argument, horizon, horizon * decay, 4 * _CONSTANTS / decay),
        )


def warn_if_unstable(
    policy: Callable[[Tensor], Tensor], plant: Plant, cost: Cost, dt: float
) -> tuple[float, bool]:
    """Say in the log that the linearised loop of a policy held for dt is not stable, and which period is.

    Where rows have numbers of their own it is some of them that are looked at.

    Returns:
        The fastest mode of the linearised plant without control, 1/s, inf where it is not known; and whether
        the loop is stable.
    """

    def loop() -> HeldLoop:
        return HeldLoop.of(policy, plant, at=cost.set_point())

    def looked_at() -> tuple[Tensor, Tensor]:
        held = loop()
        return held.radius(dt), held.fastest()

    try:
        found = numbers_of_rows(looked_at, _ROWS)
        radii, fast = found.numbers
        fastest, radii = float(fast.max()), radii.nan_to_num(-1.0, math.inf)
        radius = float(radii.max())
        if not radius >= 1:
            return fastest, True
        held = found.of(int(radii.argmax()), loop)
    except (RuntimeError, ValueError) as error:  # a loop runs where nobody can say whether it is stable
        _log.info("the stability of the linearised loop was not checked: %s", error)
        return math.inf, False
    most = held.largest_period()
    remedy = "at no period" if most is None else f"up to {most:.4g} s"
    made = getattr(policy, "period", None)
    advice = (
        "This policy was made for that period: check the plant and the cost."
        if made == dt
        else "`LQR(plant, cost, period=dt)` is made to be held."
    )
    _log.warning(
        "the control is held for dt = %.4g s, at which the linearised loop has the spectral radius %.4g: it "
        "is unstable; it is stable %s. %s",
        *(dt, radius, remedy, advice),
    )
    return fastest, False

"""Shapes of what a user's plant, cost, policy and values return, checked where they are given."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from ...lanes.each_row import each_row
from ...lanes.row_numbers import RowNumbers
from ...numerics.checks import fail, object_of
from ...numerics.default_device import device_of
from ...numerics.row_checks import check_rows, is_ours
from ...systems import ControlAffineSystem, Plant
from ...systems.user_plants import FunctionPlant
from .cost import Cost

Function = Callable[[Tensor], Tensor]


_PLANTS = "`systems.RatePlant(f, dim=n, inputs=m)` is that of x' = f(x, u), `StepPlant` of x+ = f(x, u)"
_COSTS = "`QuadraticCost(q, r, dim=n, inputs=m)` is x'Qx + u'Ru, a subclass with `state_rate` any other"


def check_objects(call: str, *, cost: object, **plants: object) -> None:
    """Refuse what is no plant, or no cost, of a door that takes these.

    Raises:
        ValueError: in the name of ``call`` and its argument; it says what to write.
    """
    object_of(call, Plant, _PLANTS, **plants)
    object_of(call, Cost, _COSTS, cost=cost)


def check_problem(plant: Plant, cost: Cost) -> None:
    """Refuse a plant or a cost whose rates are not those of rows, whatever their number."""
    check_plant(plant)
    check_cost(cost)


def check_plant(plant: Plant) -> None:
    """Refuse a plant whose rates are not those of rows, whatever their number.

    Raises:
        ValueError: that names the method and what it returned.
    """
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
    """Refuse a ``spread`` of a plant that is no positive number, and not one a coordinate.

    Raises:
        ValueError: that names it.
    """
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
    """Refuse a cost of a user whose rates are not numbers, one a row.

    Raises:
        ValueError: that names the method and what it returned.
    """
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

"""What the arguments of an environment mean, for one and for many."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from torch import Tensor

from .. import systems
from .._checks import choice, fail, positive_real
from ..adp import Cost, QuadraticCost
from ..systems import ControlAffineSystem

Plant = str | ControlAffineSystem
Numbers = np.ndarray[Any, np.dtype[np.float64]]
NAMES = ("TwoState", "ThreeState", "Pendulum", "VanDerPol", "PlanarQuadrotor")
"""The plants with inputs, by the name of their class in `systems`."""


def make_plant(plant: Plant) -> ControlAffineSystem:
    """A plant by name, or the plant given."""
    if isinstance(plant, str):
        choice("PlantEnv", "plant", plant, NAMES)
        made: ControlAffineSystem = getattr(systems, plant)()
        return made
    if not isinstance(plant, ControlAffineSystem) or plant.dim is None or not plant.inputs:
        raise fail("PlantEnv", "plant", "must be a ControlAffineSystem with states and inputs", plant)
    return plant


def make_cost(plant: ControlAffineSystem, cost: Cost | None) -> Cost:
    """The cost given, or x'x + u'u."""
    assert plant.dim is not None
    return QuadraticCost(1.0, 1.0, plant.dim, plant.inputs) if cost is None else cost


def make_spaces(plant: ControlAffineSystem, limit: float, bound: float) -> tuple[spaces.Box, spaces.Box]:
    """Observations: the state, each coordinate within the limit. Actions: each input within the bound."""
    assert plant.dim is not None
    positive_real("PlantEnv", "bound", bound)
    seen = spaces.Box(-limit, limit, (plant.dim,), np.float64)
    return seen, spaces.Box(-bound, bound, (plant.inputs,), np.float64)


def to_control(action: Numbers | Tensor, shape: tuple[int, ...], bound: float) -> Tensor:
    """An action of NumPy or torch as float64, in the action space.

    Raises:
        ValueError: if it has another shape or leaves the bound: nothing is clipped behind your back.
    """
    u = torch.as_tensor(action).detach().to("cpu", torch.float64)
    if u.shape != shape:
        raise fail("step", "action", f"must have the shape {shape}", tuple(u.shape))
    if not bool((u.abs() <= bound).all()):
        rule = f"must lie in [-{bound:g}, {bound:g}] (make the environment with a larger `bound`, or clip)"
        raise fail("step", "action", rule, u)
    return u


def start(
    options: dict[str, Any] | None, generators: list[np.random.Generator], spread: float, dim: int
) -> Tensor:
    """The initial states, (B, n): those of options["state"], or uniform in [-spread, spread]^n, a generator
    a row.

    Raises:
        ValueError: if the stated ones have another shape or are not finite.
    """
    stated = None if options is None else options.get("state")
    if stated is None:
        return torch.stack([torch.from_numpy(g.uniform(-spread, spread, dim)) for g in generators])
    states = torch.as_tensor(stated).to("cpu", torch.float64)
    if states.dim() == 1:
        states = states.expand(len(generators), -1)
    if states.shape != (len(generators), dim) or not bool(torch.isfinite(states).all()):
        raise fail("reset", 'options["state"]', f"must be ({len(generators)}, {dim}) and finite", states)
    return states.clone()

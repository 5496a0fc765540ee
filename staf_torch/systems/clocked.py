"""A plant with a clock among its states, for costs that depend on the time."""

from __future__ import annotations

import torch
from torch import Tensor

from ..lanes.row_numbers import RowNumbers
from ..numerics.checks import fail
from .base import Linearisation, Plant, Units
from .user_plants import StepPlant


class Clocked(Plant):
    """A plant in the state (x, t), t' = 1, so that a dependence on time is one on the state.

    Its `equilibrium` is that of the plant at t = 0: the clock itself never rests. A policy of (x, t) that
    follows a path is an `adp.LQR` or an `adp.RecedingHorizon` of an `adp.TrackingCost`.

    Example:
        >>> plant = systems.Clocked(systems.Pendulum())
        >>> x = plant.at(torch.tensor([0.1, 0.0]), time=2.0)
        >>> x, plant.motion(x, torch.zeros(1))[-1]
        (tensor([0.1000, 0.0000, 2.0000]), tensor(1.))

        Shown by `staf_torch/adp/README.md`.

    Args:
        plant: that says its dim, in continuous or in discrete time.

    Raises:
        ValueError: if the plant does not say its dim.
    """

    def __init__(self, plant: Plant) -> None:
        super().__init__()
        if plant.dim is None:
            raise fail("Clocked", "plant", "must have `dim`, its number of states", plant)
        self.plant = plant
        self.dim, self.inputs, self.bounds = plant.dim + 1, plant.inputs, plant.bounds
        self.period, self.spread = plant.period, plant.spread
        if not isinstance(self.spread, int | float | RowNumbers):  # the time has the largest
            self.spread = [float(s) for s in self.spread]
            self.spread += [max(self.spread)]
        states = [unit or "1" for unit in plant.units.of_states(plant.dim)]
        self.units = Units(", ".join([*states, "s"]), plant.units.input)
        self.periodic = tuple(sorted(index % plant.dim for index in plant.periodic))

    @property
    def traceable(self) -> bool:
        return self.plant.traceable

    def at(self, x: Tensor, time: float = 0.0) -> Tensor:
        """(x, t): (..., n) -> (..., n + 1)."""
        return torch.cat((x, torch.full_like(x[..., :1], time)), dim=-1)

    def equilibrium(self) -> Tensor:
        return self.at(self.plant.equilibrium())

    def resting_input(self) -> Tensor:
        return self.plant.resting_input()

    def motion(self, x: Tensor, u: Tensor) -> Tensor:
        tick = 1.0 if self.period is None else self.period
        return torch.cat((self.plant.motion(x[..., :-1], u), torch.full_like(x[..., :1], tick)), dim=-1)

    def step(self, x: Tensor, u: Tensor) -> Tensor:
        """(x, t) a period later, of a plant in discrete time: (..., n + 1), (..., m) -> (..., n + 1)."""
        assert isinstance(self.plant, StepPlant)
        assert self.period is not None
        return torch.cat((self.plant.step(x[..., :-1], u), x[..., -1:] + self.period), dim=-1)

    def linearisation(self, x: Tensor | None = None, u: Tensor | None = None) -> Linearisation:
        """That of the plant, with nothing that moves the clock or depends on it."""
        found = self.plant.linearisation(None if x is None else x[:-1], u)
        pad = torch.nn.functional.pad
        still = 0.0 if self.period is None else 1.0  # of x+ in discrete time, as a plant's own linearisation
        matrix = pad(found.matrix, (0, 1, 0, 1))
        matrix[-1, -1] = still
        return Linearisation(matrix, pad(found.input_matrix, (0, 0, 0, 1)))

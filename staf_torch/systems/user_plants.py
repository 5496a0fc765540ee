"""Plants that a user brings as one function: of the next state, or of the rate."""

from __future__ import annotations

import copy
import logging
from collections.abc import Sequence
from typing import Self

import torch
from torch import Tensor

from ..lanes.per_row.objects import by_rows
from ..numerics.checks import fail, integer, numbers_of, positive_real, vector
from ..numerics.default_device import beside
from .base import Bounds, Limit, Linearisation, Plant
from .black_box import BlackBox, Motion, Slopes
from .equilibria import find_equilibrium

_log = logging.getLogger(__name__)
Guess = Sequence[float] | Tensor | tuple[Sequence[float] | Tensor, Sequence[float] | Tensor] | None


class FunctionPlant(Plant):
    """Base of `StepPlant` and `RatePlant`: the function, its equilibrium, its linearisation."""

    @beside
    def __init__(
        self,
        argument: str,
        function: Motion,
        dim: int,
        inputs: int,
        periodic: Sequence[int],
        equilibrium: Guess,
        low: Limit,
        high: Limit,
        slopes: Slopes | None,
    ) -> None:
        super().__init__()
        name = type(self).__name__
        self.dim = integer(name, "dim", dim, least=1)
        self.inputs = integer(name, "inputs", inputs, least=1)
        if not set(periodic) <= set(range(-dim, dim)):
            raise fail(name, "periodic", f"must be coordinates of {dim}", list(periodic))
        self.periodic = tuple(sorted({index % dim for index in periodic}))
        bounds = Bounds(low, high, inputs)
        self.bounds = bounds if bounds.present else None
        x, u = _guess(name, equilibrium, dim, inputs)
        self.function = BlackBox(f"{name}({argument}=...)", function, x, u, slopes)
        self._rest = x, u
        try:
            rest = find_equilibrium(self, x, u)
            self._rest = rest.state, rest.input
        except ValueError as error:  # a plan over a horizon needs none; who regulates asks again
            _log.info("%s", error)

    @property
    def traceable(self) -> bool:
        return self.function.torch

    def in_torch(self, x: Tensor, u: Tensor) -> Self | None:
        """Return the plant with a function that torch follows through NumPy, or itself if it is torch;
        both agree to rounding at states (B, n) and inputs (B, m). None of a plant that is more than its
        function, and where torch cannot follow or disagrees."""
        if self.traceable:
            return self
        box = self.function.in_torch(x, u) if type(self) in (StepPlant, RatePlant) else None
        if box is None:
            return None
        twin = copy.copy(self)
        twin.function = box
        return twin

    def equilibrium(self) -> Tensor:
        return self._rest[0]

    def resting_input(self) -> Tensor:
        return self._rest[1]

    @by_rows
    def linearisation(self, x: Tensor | None = None, u: Tensor | None = None) -> Linearisation:
        at = self._rest[0] if x is None else x
        return self.function.linearisation(at, self._rest[1] if u is None else u, self._apart)

    def _apart(self, one: Tensor, other: Tensor) -> Tensor:
        """The difference of two values of the function."""
        return one - other


class StepPlant(FunctionPlant):
    """x+ = step(x, u): a plant in discrete time, or a simulator whose inside nobody knows.

    Example:
        >>> import numpy as np
        >>> def step(x, u):  # NumPy or torch: rows (B, 2) and (B, 1) to (B, 2)
        ...     return np.stack((x[:, 0] + 0.1 * x[:, 1], x[:, 1] + 0.1 * u[:, 0]), axis=1)
        >>> plant = systems.StepPlant(step, dim=2, inputs=1, dt=0.1)

        Shown by `staf_torch/adp/README.md`.

    A step is one call, for all rows. Where the function is torch all through, loops with it are compiled and
    it is differentiated by autograd; else its slopes are central differences, all probes in one call.

    Args:
        step: (B, n), (B, m) -> (B, n), of torch tensors or NumPy arrays.
        dim: n.
        inputs: m.
        dt: s, the time of a step: the control is held as long, and a step pays dt times the cost rate.
        periodic: coordinates that are angles in rad.
        equilibrium: a guess of the state at rest, or of state and input; zeros by default. The nearest rest
            is searched: by the input alone, then by both. Where there is none the guess stays, and only what
            regulates is refused.
        low, high: of the inputs, as in `Bounds`.
        slopes: dx+/dx (n, n) and dx+/du (n, m) at a state (n,) and an input (m,), where a simulator knows
            them: NumPy arrays of NumPy arrays.

    Raises:
        ValueError: if an argument breaks its rule, the function raises, returns other shapes or ignores u.
    """

    def __init__(
        self,
        step: Motion,
        *,
        dim: int,
        inputs: int,
        dt: float,
        periodic: Sequence[int] = (),
        equilibrium: Guess = None,
        low: Limit = None,
        high: Limit = None,
        slopes: Slopes | None = None,
    ) -> None:
        period = positive_real("StepPlant", "dt", dt)
        super().__init__("step", step, dim, inputs, periodic, equilibrium, low, high, slopes)
        self.period = period

    def step(self, x: Tensor, u: Tensor) -> Tensor:
        """x+: (..., n), (..., m) -> (..., n)."""
        return self.function(x, u)

    def motion(self, x: Tensor, u: Tensor) -> Tensor:
        """x+ - x, angles in [-pi, pi]."""
        return self.difference(self.step(x, u), x)

    def _apart(self, one: Tensor, other: Tensor) -> Tensor:
        return self.difference(one, other)


class RatePlant(FunctionPlant):
    """x' = rate(x, u), not affine in u.

    Example:
        >>> plant = systems.RatePlant(lambda x, u: -x + u.sin(), dim=1, inputs=1)

        Shown by `staf_torch/adp/README.md`.

    Args:
        rate: (B, n), (B, m) -> (B, n), of torch tensors or NumPy arrays, in units of the state a second.
        dim, inputs, periodic, equilibrium, low, high: as in `StepPlant`.
        slopes: likewise, of the rate.

    Raises:
        ValueError: as in `StepPlant`.
    """

    def __init__(
        self,
        rate: Motion,
        *,
        dim: int,
        inputs: int,
        periodic: Sequence[int] = (),
        equilibrium: Guess = None,
        low: Limit = None,
        high: Limit = None,
        slopes: Slopes | None = None,
    ) -> None:
        super().__init__("rate", rate, dim, inputs, periodic, equilibrium, low, high, slopes)

    def rate(self, x: Tensor, u: Tensor) -> Tensor:
        """x': (..., n), (..., m) -> (..., n)."""
        return self.function(x, u)

    def motion(self, x: Tensor, u: Tensor) -> Tensor:
        return self.rate(x, u)


def _guess(call: str, given: Guess, dim: int, inputs: int) -> tuple[Tensor, Tensor]:
    x, u = (
        torch.zeros(dim, dtype=torch.float64, device="cpu"),
        torch.zeros(inputs, dtype=torch.float64, device="cpu"),
    )
    if given is None:
        return x, u
    pair = isinstance(given, tuple) and len(given) == 2 and isinstance(given[0], Sequence | Tensor)
    state, held = given if pair else (given, u)
    points = []
    for value, size in ((state, dim), (held, inputs)):
        numbers = vector(call, "equilibrium", numbers_of(call, "equilibrium", value))
        if len(numbers) != size:
            rule = f"must be {dim} numbers, or those and {inputs} of the input"
            raise fail(call, "equilibrium", rule, given)
        points.append(torch.tensor(numbers, dtype=torch.float64, device="cpu"))
    return points[0], points[1]

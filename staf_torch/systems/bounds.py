"""Bounds of the inputs of a plant."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ..lanes.gradients import refuse_gradient
from ..lanes.row_decisions import in_any_row
from ..lanes.row_numbers import all_rows
from ..numerics.checks import check_shared, fail

Limit = float | Sequence[float] | Tensor | None


class Bounds:
    """The box low <= u <= high, in the units of the inputs.

    Example:
        >>> bounds = systems.Bounds([0.0, -1.0], [20.0, 1.0], inputs=2)
        >>> bounds.clip(torch.tensor([-3.0, 0.5], dtype=torch.float64))
        tensor([0.0000, 0.5000], dtype=torch.float64)

        Shown by `staf experiment=adp adp/cost=bounded_input adp/policy=rollout`.

    Args:
        low: a number for all inputs, or one an input; None or -inf for none.
        high: likewise; None or inf for none.
        inputs: m.

    Raises:
        ValueError: if a bound has another length or is NaN, or one is not below the other.
    """

    def __init__(self, low: Limit, high: Limit, inputs: int) -> None:
        # Not a module: a class of plants may have its bounds as a class attribute.
        self.low = _limit("low", low, -math.inf, inputs)  # (m,)
        self.high = _limit("high", high, math.inf, inputs)  # (m,)
        if not bool((self.low < self.high).all()):
            raise fail("Bounds", "low", f"must be below high, {self.high.tolist()}", self.low.tolist())

    def on(self, device: torch.device) -> Bounds:
        """Return these bounds with tensors of a device; themselves where they are there."""
        if self.low.device == device:
            return self
        moved = copy.copy(self)
        moved.low, moved.high = self.low.to(device), self.high.to(device)
        return moved

    @property
    def present(self) -> bool:
        """Return whether any input is bounded, of numbers of rows in any row."""
        return self.low.is_meta or any(in_any_row(torch.isfinite(limit)) for limit in (self.low, self.high))

    def clip(self, u: Tensor) -> Tensor:
        """The nearest admissible input: (..., m) -> (..., m)."""
        return torch.minimum(torch.maximum(u, self.low.to(u)), self.high.to(u))

    def contain(self, u: Tensor) -> Tensor:
        """Return whether u is admissible: (..., m) -> (...) bool."""
        return ((u >= self.low.to(u)) & (u <= self.high.to(u))).all(-1)

    def measured_from(self, u: Tensor) -> Bounds:
        """The box of u' - u for every admissible u': the bounds of a deviation from u (m,)."""
        there = self.on(u.device)
        return Bounds(there.low - u, there.high - u, len(u))

    def __repr__(self) -> str:
        low, high = all_rows(self.low).tolist(), all_rows(self.high).tolist()
        return f"Bounds(low={low}, high={high})"


def _limit(name: str, given: Limit, none: float, inputs: int) -> Tensor:
    if given is None:
        given = none
    if isinstance(given, bool) or not isinstance(given, int | float | Sequence | Tensor):
        raise fail("Bounds", name, "must be a number or one an input", given)
    if isinstance(given, Tensor):
        check_shared("Bounds", name, given)
    refuse_gradient("Bounds", **{name: given})
    try:
        limit = torch.as_tensor(given, dtype=torch.float64, device="cpu").detach()
    except (TypeError, ValueError) as error:
        raise fail("Bounds", name, "must be a number or one an input", given) from error
    if limit.dim() == 0:
        limit = limit.repeat(inputs)
    if limit.shape != (inputs,):
        raise fail("Bounds", name, f"must be a number or one for each of the {inputs} inputs", given)
    if bool(torch.isnan(limit).any()) or bool((limit == -none).any()):
        raise fail("Bounds", name, f"must be finite or {none}", given)
    return limit

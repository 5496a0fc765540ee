"""The two-state example of the barrier transformation, with the four parameters of its drift."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ..numerics.checks import hold, numbers_of, states, vector
from .base import ControlAffineSystem
from .two_state import input_gain


class TwoStateChain(ControlAffineSystem):
    """x1' = a x2,  x2' = b x1 + c x2 + d x2 h^2 + h u,  with h = cos(2 x1) + 2 and theta = (a, b, c, d).

    Example:
        >>> plant = systems.TwoStateChain()
        >>> plant.drift(torch.tensor([0.0, 1.0]).double())  # h = 3
        tensor([1., 4.], dtype=torch.float64)

        Shown by `staf experiment=safe_box`.

    Args:
        theta: the parameters (a, b, c, d), in 1/s.

    Raises:
        ValueError: if theta is not four finite numbers.

    Source: Mahmud et al., Front. Robot. AI 8 (2021), first example.
    """

    dim = 2
    inputs = 1

    def __init__(self, theta: Sequence[float] = (1.0, -1.0, -0.5, 0.5)) -> None:
        super().__init__()
        given = list(numbers_of("TwoStateChain", "theta", theta))
        numbers = vector("TwoStateChain", "theta", given, 4)
        self.theta = hold(self, "theta", torch.tensor(numbers, dtype=torch.float64, device="cpu"))

    def drift(self, x: Tensor) -> Tensor:
        a, b, c, d = self.theta.to(states(self, "x", x, 2)).unbind(-1)
        x1, x2 = x.unbind(-1)
        return torch.stack((a * x2, b * x1 + c * x2 + d * x2 * input_gain(x1).square()), dim=-1)

    def effectiveness(self, x: Tensor) -> Tensor:
        gain = input_gain(x[..., 0])
        return torch.stack((torch.zeros_like(gain), gain), dim=-1).unsqueeze(-1)

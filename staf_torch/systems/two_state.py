"""The paper's optimal-regulation example, and the plant that its appendix prints."""

from __future__ import annotations

import torch
from torch import Tensor

from ..numerics.checks import states
from .base import ControlAffineSystem


class TwoState(ControlAffineSystem):
    """x1' = x2 - x1,  x2' = -x1/2 - x2/2 (1 - h^2) + h u,  with h = cos(2 x1) + 2.

    For the cost x'x + u^2 the optimal value is known, V*(x) = x1^2/2 + x2^2, and so is the optimal
    control u* = -h x2. The open loop is unstable.

    Example:
        >>> plant = systems.TwoState()
        >>> plant.drift(torch.tensor([1.0, 0.0]).double())
        tensor([-1.0000, -0.5000], dtype=torch.float64)

        Shown by `staf experiment=adp`.

    Args:
        as_printed: the drift of the paper's appendix, which lost a "1 -": x2' = -x1/2 - x2/2 h^2 + h u.
            It is stable without control, and V* above does not solve its HJB equation.

    Source: Vamvoudakis and Lewis, Automatica 46 (2010), via Rosenfeld et al., eq. (optimal-regulator).
    """

    dim = 2
    inputs = 1

    def __init__(self, as_printed: bool = False) -> None:
        super().__init__()
        self.as_printed = bool(as_printed)

    def drift(self, x: Tensor) -> Tensor:
        x1, x2 = states(self, "x", x, 2).unbind(-1)
        square = input_gain(x1).square()
        damping = square if self.as_printed else 1 - square
        return torch.stack((x2 - x1, -0.5 * x1 - 0.5 * x2 * damping), dim=-1)

    def effectiveness(self, x: Tensor) -> Tensor:
        gain = input_gain(x[..., 0])
        return torch.stack((torch.zeros_like(gain), gain), dim=-1).unsqueeze(-1)

    def optimal_value(self, x: Tensor, state_cost: Tensor, input_cost: Tensor) -> Tensor | None:
        """x1^2/2 + x2^2 for Q = c I, R = c, times c; None for other costs (and as printed: unknown)."""
        scale = input_cost[0, 0].to(state_cost)
        proportional = torch.equal(
            state_cost, scale * torch.eye(2, dtype=state_cost.dtype, device=state_cost.device)
        )
        if self.as_printed or not proportional:
            return None
        return scale.to(x) * (0.5 * x[..., 0].square() + x[..., 1].square())


def input_gain(x1: Tensor) -> Tensor:
    """h = cos 2 x1 + 2, the second entry of g, also of the plant's two successors."""
    return (2 * x1).cos() + 2

"""A cost of inputs that is finite at their bounds, where its slope is not: its policy saturates smoothly."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ...lanes.per_row.decisions import in_any_row
from ...numerics.checks import fail, one_or_each, positive
from ...numerics.linalg import Matrix
from ...systems.base import Limit
from .cost import Cost, pulled

_EDGE = 1 - 1e-9  # of the bound, beyond which artanh is that of this share


class BoundedInputCost(Cost):
    """x'Qx + U(u) with inputs inside their bounds, whose policy saturates smoothly:

        u = sat(-R^-1 g' grad V / 2),  sat(v)_i = b_i tanh(v_i / b_i),
        U(u) = 2 sum_i R_ii b_i int_0^{u_i} artanh(w / b_i) dw,

    with b_i the bound on the side of v_i. U is u'Ru for small u and finite at the bound.

    Example:
        >>> cost = adp.BoundedInputCost(1.0, 1.0, dim=2, inputs=1, bound=1.0)
        >>> float(cost.rate(torch.tensor([1.0, 0.0]).double(), torch.tensor([0.0]).double()))
        1.0

        Shown by `staf experiment=adp adp/cost=bounded_input adp/policy=rollout`.

    Args:
        bound: of every |u_i|, a positive number or one an input, in the units of u; None where ``low`` and
            ``high`` of `Cost` are given instead. The input at the set-point must lie between them.

    Raises:
        ValueError: if R is not diagonal, or the bounds are not finite with the set-point's input inside.

    Source: Abu-Khalaf and Lewis, Automatica 41 (2005), with a diagonal R.
    """

    def __init__(
        self,
        state: Matrix,
        control: Matrix,
        dim: int,
        inputs: int,
        *,
        bound: float | Sequence[float] | Tensor | None = None,
        low: Limit = None,
        high: Limit = None,
        **more: object,
    ) -> None:
        if bound is not None:
            if low is not None or high is not None:
                raise fail("BoundedInputCost", "bound", "must be None beside low and high", bound)
            high = one_or_each("BoundedInputCost", "bound", bound, inputs)
            positive("BoundedInputCost", "bound", high)
            low = -high
        super().__init__(state, control, dim, inputs, low=low, high=high, **more)  # type: ignore[arg-type]
        if not torch.equal(self.r, torch.diag(self.r.diagonal())):
            raise fail("BoundedInputCost", "control", "must be diagonal", control)

    def _prepare(self) -> None:
        if self.bounds is None:
            raise fail("BoundedInputCost", "bound", "must be given, or low and high", None)
        rest = self.r.new_zeros(self.inputs) if self.target_input is None else self.target_input
        box = self.bounds.measured_from(rest)
        around = (box.low < 0) & (box.high > 0) & torch.isfinite(box.high - box.low)
        if not bool(around.all()):
            rule = f"must be finite, with the input {rest.tolist()} of the set-point inside"
            raise fail("BoundedInputCost", "low", rule, self.bounds)
        self.register_buffer("_down", -box.low, persistent=False)
        self.register_buffer("_up", box.high, persistent=False)
        self._down: Tensor
        self._up: Tensor
        self._symmetric = not in_any_row(self._down != self._up)

    def input_rate(self, u: Tensor) -> Tensor:
        effort = self.effort(u)
        bound = self._side(effort)
        share = effort / bound
        # artanh's integral: v artanh v + log(1 - v^2)/2, in a form that is finite at |v| = 1.
        up, down = 1 + share, 1 - share
        integral = 0.5 * (torch.xlogy(up, up) + torch.xlogy(down, down))
        return 2 * (self.r.diagonal().to(u) * bound * bound * integral).sum(-1)

    def policy(self, effectiveness: Tensor, gradient: Tensor) -> Tensor:
        return self.saturate(self.input_of(self._unconstrained(pulled(effectiveness, gradient))))

    def saturate(self, v: Tensor) -> Tensor:
        """sat(v), measured from the input of the set-point."""
        effort = self.effort(v)
        bound = self._side(effort)
        return self.input_of(bound * (effort / bound).tanh())

    def unsaturated(self, u: Tensor) -> Tensor:
        """b artanh(u / b), finite at the bound itself."""
        effort = self.effort(u)
        bound = self._side(effort)
        return self.input_of(bound * (effort / bound).clamp(-_EDGE, _EDGE).atanh())

    def _side(self, effort: Tensor) -> Tensor:
        """The bound on the side of the effort, (..., m) or (m,)."""
        up = self._up.to(effort)
        return up if self._symmetric else torch.where(effort < 0, self._down.to(effort), up)

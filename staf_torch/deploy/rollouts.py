"""The rollout policy with its fit folded into one matrix."""

from __future__ import annotations

import copy

import torch
from torch import Tensor, nn

from ..adp import RolloutPolicy
from ..kernels import ExponentialKernel


class FoldedRollout(nn.Module):
    """u = policy(grad V^(x)) as in `RolloutPolicy`, for centers at constant offsets d_i and a kernel whose
    core does not depend on the state. The fit and its gradient at the state are then one matrix H for all
    states, and for the exponential kernel

        (v, g) = H (e^{-x'd_i} V_i),   grad V^(x) = g + x v;

    for a translation-invariant kernel grad V^(x) = g, without the factor. Nothing is factored at run time.

    Args:
        policy: the policy; a copy is kept.

    Raises:
        ValueError: if its radius depends on the state, or its kernel's core does.
    """

    def __init__(self, policy: RolloutPolicy) -> None:
        super().__init__()
        if not foldable(policy):
            raise ValueError(
                "`FoldedRollout(policy=...)` must have a constant radius and an exponential or radial "
                f"kernel; got {policy.basis}."
            )
        basis = policy.basis
        zero = torch.zeros(basis.dim, dtype=torch.float64)
        space = copy.deepcopy(basis).double().local(zero)
        unit = space.fit(torch.eye(basis.count, dtype=torch.float64))  # a row a center
        at = zero.expand(basis.count, 1, -1)
        value = space.evaluate(at, unit).squeeze(-1)
        slope = torch.func.grad(lambda z: space.evaluate(z, unit).sum())(at).squeeze(-2)  # (M, n)
        self.moving = isinstance(basis.kernel, ExponentialKernel)
        self.policy = copy.deepcopy(policy)
        if isinstance(policy.base, RolloutPolicy):
            self.policy.base = FoldedRollout(policy.base)
        self.register_buffer("offsets", basis.centers.offsets(zero).detach().clone())  # (M, n)
        self.register_buffer("fit", torch.cat((value.unsqueeze(-1), slope), dim=-1).detach())  # (M, 1 + n)
        self.offsets: Tensor
        self.fit: Tensor

    def forward(self, x: Tensor) -> Tensor:
        """u: (..., n) -> (..., m)."""
        values = self.policy.rollout(x.unsqueeze(-2) + self.offsets)
        if self.moving:
            values = values * (-(x.unsqueeze(-2) * self.offsets).sum(-1)).exp()
        both = values @ self.fit
        gradient = both[..., 1:]
        if self.moving:
            gradient = gradient + x * both[..., :1]
        return self.policy.cost.policy(self.policy.model.effectiveness(x), gradient)


def foldable(policy: RolloutPolicy) -> bool:
    """Whether `FoldedRollout` takes it: one scalar radius, a state-free core, a known factor."""
    kernel, radius = policy.basis.kernel, policy.basis.centers.radius
    bound = radius.bound()
    # Only the exponential kernel's factor e^{s(x, d)} depends on the state.
    known = kernel.state_free and (
        isinstance(kernel, ExponentialKernel) or kernel.log_gain(torch.zeros(1)) is None
    )
    return radius.constant and bound is not None and bound.dim() == 0 and known

"""What a device computes of a controller: u from x, with what was learned held fixed."""

from __future__ import annotations

import copy

import torch
from torch import Tensor, nn

from .._checks import fail, trailing
from ..adp import ActorCritic, Controller, Feedback, RolloutPolicy, Supervised
from .rollouts import FoldedRollout, foldable


class ActorPolicy(nn.Module):
    """u = -1/2 R^-1 g' Ds(x; x)' Wa: the actor without the learning.

    Args:
        learner: basis, plant and cost; copied.
        weights: Wa, (M,).

    Raises:
        ValueError: if the weights are not (M,) or not finite.

    Source: MATH.md section 4.
    """

    def __init__(self, learner: ActorCritic, weights: Tensor) -> None:
        super().__init__()
        trailing("ActorPolicy", "weights", weights, dims=1, last=learner.basis.count)
        if weights.dim() != 1 or not bool(torch.isfinite(weights).all()):
            raise fail("ActorPolicy", "weights", f"must be {learner.basis.count} finite numbers", weights)
        self.basis, self.model, self.cost = copy.deepcopy((learner.basis, learner.model, learner.cost))
        self.register_buffer("weights", weights.detach().clone())
        self.weights: Tensor

    def forward(self, x: Tensor) -> Tensor:
        """u: (..., n) -> (..., m)."""
        slopes = self.basis.gradient(x, x)  # (..., M, n)
        gradient = (slopes * self.weights.to(x).unsqueeze(-1)).sum(-2)
        return self.cost.policy(self.model.effectiveness(x), gradient)


class SupervisedPolicy(nn.Module):
    """A policy drawn towards the LQR as `Supervised` does it.

    Args:
        policy: (..., n) -> (..., m).
        supervisor: whose rule it is; copied.
    """

    def __init__(self, policy: nn.Module, supervisor: Supervised) -> None:
        super().__init__()
        self.policy = policy
        self.supervisor = copy.deepcopy(supervisor)

    def forward(self, x: Tensor) -> Tensor:
        """u: (..., n) -> (..., m)."""
        return self.supervisor.restrain(x, self.policy(x))


def policy_of(
    controller: Controller | nn.Module, weights: Tensor | None = None, dtype: torch.dtype = torch.float64
) -> nn.Module:
    """The feedback law u(x) of a controller, as a module with its constants folded where it can be.

    Example:
        >>> plant = systems.TwoState()
        >>> cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
        >>> deploy.policy_of(adp.LQR(plant, cost))(torch.ones(1, 2, dtype=torch.float64)).shape
        torch.Size([1, 1])

    Args:
        controller: `Feedback`, `ActorCritic`, `Supervised`, `LQR`, `RolloutPolicy`, or any module
            (..., n) -> (..., m).
        weights: Wa of an actor-critic, (M,); its initial ones by default.
        dtype: of the arithmetic.

    Raises:
        ValueError: if the controller is none of these.
    """
    return _policy_of(controller, weights).to(dtype).eval().requires_grad_(False)


def _policy_of(controller: Controller | nn.Module, weights: Tensor | None) -> nn.Module:
    if isinstance(controller, Supervised):
        return SupervisedPolicy(_policy_of(controller.controller, weights), controller)
    if isinstance(controller, ActorCritic):
        chosen = controller.actor if weights is None else weights
        return ActorPolicy(controller, chosen)
    if weights is not None:
        raise fail("policy_of", "weights", f"must be None for {type(controller).__name__}", weights)
    if isinstance(controller, Feedback):
        controller = controller.policy  # type: ignore[assignment]
    if isinstance(controller, RolloutPolicy) and foldable(controller):
        return FoldedRollout(controller)
    if isinstance(controller, Controller) or not isinstance(controller, nn.Module):
        raise fail("policy_of", "controller", "must be a feedback law without memory or an actor", controller)
    return copy.deepcopy(controller)

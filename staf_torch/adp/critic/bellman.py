"""The Hamilton-Jacobi-Bellman equation: how far a value function, or a critic, is from solving it."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from ...numerics.checks import trailing
from ...numerics.derivatives import slope_of
from ...systems import ControlAffineSystem
from ..problem.cost import Cost, matvec
from ..problem.rules import check_objects, check_value
from .bases import ValueBasis


def value_gradient(value: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    """grad V, row by row, 0 where V is constant, and differentiable where x or V is: (..., n) -> (..., n)."""
    learnt = torch.is_grad_enabled() and (x.requires_grad or value(x).requires_grad)
    with torch.enable_grad():
        at = x if learnt and x.requires_grad else x.detach().requires_grad_()
        return slope_of(value(at), at, create_graph=learnt)


def hjb_residual(
    system: ControlAffineSystem, cost: Cost, value: Callable[[Tensor], Tensor], x: Tensor
) -> Tensor:
    """min_u of x'Qx + U(u) + grad V'(f + g u), which is 0 everywhere for V = V* alone.

    Example:
        >>> plant = systems.TwoState()
        >>> cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
        >>> x = torch.tensor([[1.0, 0.5]]).double()
        >>> optimal = lambda x: 0.5 * x[..., 0] ** 2 + x[..., 1] ** 2
        >>> bool(adp.hjb_residual(plant, cost, optimal, x).abs().max() < 1e-12)
        True

        Shown by `staf experiment=adp`.

    Args:
        system: the plant.
        cost: the cost rate.
        value: V, (..., n) -> (...), differentiable.
        x: (..., n).

    Returns:
        (...).

    Source: MATH.md section 4; for a quadratic cost x'Qx + f'grad V - 1/4 grad V' g R^-1 g' grad V.
    """
    check_objects("hjb_residual", system=system, cost=cost)
    trailing("hjb_residual", "x", x, 1, cost.dim)
    check_value("hjb_residual", "value", value, cost)
    gradient = value_gradient(value, x)
    g = system.effectiveness(x)
    u = cost.policy(g, gradient)
    return cost.rate(x, u) + (gradient * (system.drift(x) + matvec(g, u))).sum(-1)


class BellmanTerms(NamedTuple):
    """Terms of the Bellman equation at some points, with the actor's control there.

    The Bellman error of the critic weights Wc is delta = rate + regressor'Wc.
    """

    control: Tensor  # u = policy(Ds'Wa), (..., P, m)
    regressor: Tensor  # w = Ds (f + g u), (..., P, M)
    rate: Tensor  # r = x'Qx + U(u), (..., P)
    push: Tensor  # G Wa = Ds g R^-1 g' Ds' Wa = -2 Ds g u, with bounds that of the u they leave, (..., P, M)


def bellman_terms(
    basis: ValueBasis, system: ControlAffineSystem, cost: Cost, points: Tensor, at: Tensor, actor: Tensor
) -> BellmanTerms:
    """Return the terms at ``points`` y (..., P, n), whose centers stand around the states ``at`` (..., P,
    n), for the actor weights Wa (..., M)."""
    gradient = basis.gradient(points, at)  # (..., P, M, n)
    g = system.effectiveness(points)
    value_gradient = (gradient * actor[..., None, :, None]).sum(-2)  # Ds'Wa, (..., P, n)
    u = cost.policy(g, value_gradient)
    driven = matvec(g, u)
    regressor = matvec(gradient, system.drift(points) + driven)
    pushed = matvec(g, cost.effort(u))
    return BellmanTerms(u, regressor, cost.rate(points, u), -2 * matvec(gradient, pushed))


def bellman_error(terms: BellmanTerms, critic: Tensor) -> Tensor:
    """delta = r + w'Wc: (..., M) -> (..., P)."""
    return terms.rate + (terms.regressor * critic.unsqueeze(-2)).sum(-1)

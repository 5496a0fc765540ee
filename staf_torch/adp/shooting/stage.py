"""One interval of a transcribed optimal-control problem, and its derivatives for all intervals at once."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from ...systems import ControlAffineSystem, runge_kutta_step
from ..cost import Cost


class Expansion(NamedTuple):
    """Derivatives of every interval's map and cost in z = (x, v)."""

    slope: Tensor  # dF/dz, (B, N, n, n + 2m)
    gradient: Tensor  # dl/dz, (B, N, n + 2m)
    curvature: Tensor  # d2/dz2 of l + lambda'F, (B, N, n + 2m, n + 2m)


class Stage:
    """x+ = F(x, v) and the cost l(x, v) of an interval on which the input runs linearly from v's first half
    to its second, by one Runge-Kutta step; a bounded input is the saturated v.

    Args:
        system: the plant.
        cost: the cost rate.
    """

    def __init__(self, system: ControlAffineSystem, cost: Cost) -> None:
        self.system, self.cost = system, cost

    def advance(self, x: Tensor, v: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
        """(..., n), (..., 2m), lengths h (...) in s: x+ (..., n), the cost (...)."""
        first, last = v.chunk(2, dim=-1)
        middle = 0.5 * (first + last)
        u1, u2, u4 = (self.cost.saturate(u) for u in (first, middle, last))
        step = h.unsqueeze(-1)
        k1, c1 = self._field(x, u1)
        k2, c2 = self._field(x + 0.5 * step * k1, u2)
        k3, c3 = self._field(x + 0.5 * step * k2, u2)
        k4, c4 = self._field(x + step * k3, u4)
        return x + (step / 6) * (k1 + 2 * (k2 + k3) + k4), (h / 6) * (c1 + 2 * (c2 + c3) + c4)

    def expand(self, x: Tensor, v: Tensor, h: Tensor, end: Tensor) -> Expansion:
        """Derivatives at (B, N, n), (B, N, 2m), for the costate ``end`` (B, n) at the horizon."""
        size = x.shape[-1]
        with torch.enable_grad():
            z = torch.cat((x, v), dim=-1).detach().requires_grad_()
            after, spent = self.advance(z[..., :size], z[..., size:], h)
            # What does not depend on z at all still gets a derivative, 0.
            rows = [_gradient(after[..., i], z) for i in range(size)]
            slope = torch.stack(rows, dim=-2)
            gradient = _gradient(spent, z)
            costate = adjoint(slope[..., :size], gradient[..., :size], end)
            weighted = spent + (costate * after).sum(-1)
            (along,) = torch.autograd.grad(weighted.sum(), z, create_graph=True)
            columns = [_gradient(along[..., i], z) for i in range(z.shape[-1])]
        curvature = torch.stack(columns, dim=-1)
        return Expansion(slope, gradient, 0.5 * (curvature + curvature.mT))

    def _field(self, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        return self.system.rate(x, u), self.cost.rate(x, u)


def adjoint(slope: Tensor, gradient: Tensor, end: Tensor) -> Tensor:
    """Costates lambda_{k+1} of every interval: lambda_k = l_x + F_x' lambda_{k+1}, (B, N, n)."""
    costates = [end]
    for k in range(slope.shape[1] - 1, 0, -1):
        costates.append(gradient[:, k] + (slope[:, k] * costates[-1].unsqueeze(-1)).sum(-2))
    return torch.stack(costates[::-1], dim=1)


def _gradient(values: Tensor, z: Tensor) -> Tensor:
    if not values.requires_grad:
        return torch.zeros_like(z)
    return torch.autograd.grad(values.sum(), z, retain_graph=True, materialize_grads=True)[0]


def closed_stage(stage: Stage, policy: Callable[[Tensor], Tensor], x: Tensor, h: Tensor) -> Tensor:
    """x+ under a policy that sees the state all the time, by one Runge-Kutta step: (B, n), () -> (B, n)."""
    return runge_kutta_step(lambda at: stage.system.rate(at, policy(at)), x, float(h))

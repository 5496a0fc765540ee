"""Interval of a transcribed optimal-control problem, and its derivatives for all intervals at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ....numerics.linalg import row_jacobian
from ....numerics.runge_kutta import SHARES, runge_kutta_mean, runge_kutta_stages, runge_kutta_step
from ....systems import ControlAffineSystem, Plant
from ...problem.cost import BoundedInputCost, Cost


class Expansion(NamedTuple):
    """Derivatives of every interval's map and cost in z = (x, v)."""

    slope: Tensor  # dF/dz, (B, N, n, n + 2m)
    gradient: Tensor  # dl/dz, (B, N, n + 2m)
    curvature: Tensor  # d2/dz2 of l + lambda'F, (B, N, n + 2m, n + 2m)


class Interval:
    """x+ = F(x, v) and the cost l(x, v) of an interval on which the input runs linearly from v's first half
    to its second, by one Runge-Kutta step. A smoothly bounded input is the saturated v; a hard bound is one
    of v itself.

    Args:
        system: the plant.
        cost: the cost rate.
    """

    def __init__(self, system: Plant, cost: Cost) -> None:
        self.system, self.cost = system, cost
        hard = cost.bounds is not None and not isinstance(cost, BoundedInputCost)
        self.box: tuple[Tensor, Tensor] | None = None
        if hard and cost.bounds is not None:
            self.box = (cost.bounds.low.repeat(2), cost.bounds.high.repeat(2))

    def admitted(self, v: Tensor) -> Tensor:
        """v with hard bounds kept: (..., 2m) -> (..., 2m)."""
        if self.box is None:
            return v
        return torch.minimum(torch.maximum(v, self.box[0].to(v)), self.box[1].to(v))

    def room(self, v: Tensor) -> tuple[Tensor, Tensor] | None:
        """Return how far v may fall and rise, (..., 2m) each; None without hard bounds."""
        return None if self.box is None else (self.box[0].to(v) - v, self.box[1].to(v) - v)

    def gap(self, x: Tensor, v: Tensor, costate: Tensor) -> Tensor:
        """Return how much the Hamiltonian r + p'f of a control exceeds its minimum over the admissible ones.

        It is measured in u, so that a saturated control that should be another is seen, which the slope in v
        is not. Of a plant that is not affine in u it is measured along the slope there.

        Args:
            x: (..., n).
            v: half of a control, (..., m).
            costate: p, (..., n).
        """
        u = self.input(v)
        with torch.no_grad():
            if isinstance(self.system, ControlAffineSystem):
                g = self.system.effectiveness(x)
            else:
                g = _input_slope(self.system, x, u)
            best = self.cost.policy(g, costate)
            pull = (g * costate.unsqueeze(-1)).sum(-2)
            now, least = (self.cost.input_rate(w) + (pull * w).sum(-1) for w in (u, best))
        return (now - least).clamp(min=0.0)

    def input(self, v: Tensor) -> Tensor:
        """u of a half of v, (..., m); a smooth bound saturates it, a hard one it keeps already."""
        return v if self.box is not None else self.cost.saturate(v)

    def advance(self, x: Tensor, v: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
        """(..., n), (..., 2m), lengths h (...) in s: x+ (..., n), the cost (...)."""
        after, at = self.moved(x, v, h)
        return after, self.paid(at, v, h)

    def moved(self, x: Tensor, v: Tensor, h: Tensor) -> tuple[Tensor, list[Tensor]]:
        """x+ as of `advance`, and the four states (..., n) at which the Runge-Kutta step looks."""
        u, step = self._inputs(v), h.unsqueeze(-1)
        at, slopes = runge_kutta_stages(lambda at, share: self.system.motion(at, u[share]), x, step)
        return x + runge_kutta_mean(slopes, step), at

    def paid(self, at: Sequence[Tensor], v: Tensor, h: Tensor) -> Tensor:
        """The cost (...) of steps with these four states, which `moved` returned, (..., n) each."""
        u = self._inputs(v)
        return runge_kutta_mean([self.cost.rate(x, u[share]) for x, share in zip(at, SHARES, strict=True)], h)

    def _inputs(self, v: Tensor) -> dict[float, Tensor]:
        """u (..., m) at the shares of a step at which its stages stand."""
        first, last = v.chunk(2, dim=-1)
        return {0.0: self.input(first), 0.5: self.input(0.5 * (first + last)), 1.0: self.input(last)}

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


def _input_slope(system: Plant, x: Tensor, u: Tensor) -> Tensor:
    """df/du, (..., n, m)."""
    with torch.enable_grad():
        return row_jacobian(lambda w: system.motion(x.detach(), w), u.detach())[1].detach()


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


def closed_stage(stage: Interval, policy: Callable[[Tensor], Tensor], x: Tensor, h: Tensor) -> Tensor:
    """x+ under a policy that sees the state all the time, by one Runge-Kutta step: (B, n), () -> (B, n)."""
    return runge_kutta_step(lambda at: stage.system.motion(at, policy(at)), x, float(h))

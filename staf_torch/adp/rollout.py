"""The rollout policy: one Newton step on the HJB equation, by moving centers."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from .._checks import fail, integer, positive_real
from ..basis import StaFBasis
from ..systems import ControlAffineSystem
from .cost import Cost, matvec

Policy = Callable[[Tensor], Tensor]
"""u from x: (..., n) -> (..., m)."""
Value = Callable[[Tensor], Tensor]
"""V from x: (..., n) -> (...)."""


class RolloutPolicy(nn.Module):
    """u(x) = policy(grad V^(x)) with V^ fitted to the cost of a base policy at the moving centers:

        V_i = int_0^horizon (x'Qx + U(u_base)) dt + V_T(x(horizon)),  x(0) = c_i(x),
        V^ = the StaF approximation with the ideal weights K(c)^-1 (V_1, ..., V_M),

    differentiated with the centers frozen. Where V_T is the value of the base policy, this is policy
    improvement: one Newton step on the HJB equation. It can be repeated, the improved policy becoming the
    base; each repetition multiplies the work by the number of centers and steps.

    Args:
        basis: kernel and centers. At a constant radius it must fit quadratics, else the gradient has an
            error that does not vanish at 0: C(n + 2, 2) points, or a radius that shrinks.
        model: the plant.
        cost: the cost rate.
        base: the base policy, (..., n) -> (..., m).
        terminal: V_T, (..., n) -> (...): the Riccati value for an LQR base.
        horizon: s, positive.
        steps: Runge-Kutta steps over the horizon, at least 1.
        depth: how many times the policy is improved, at least 1.

    Raises:
        ValueError: if an argument breaks its rule.

    Source: Bertsekas, "Rollout, Policy Iteration, and Distributed Reinforcement Learning" (2020), ch. 2,
    with Rosenfeld et al., eq. (5), for the fit.
    """

    def __init__(
        self,
        basis: StaFBasis,
        model: ControlAffineSystem,
        cost: Cost,
        base: Policy,
        terminal: Value,
        *,
        horizon: float = 0.5,
        steps: int = 10,
        depth: int = 1,
    ) -> None:
        super().__init__()
        if model.dim != basis.dim:
            raise fail("RolloutPolicy", "basis", f"must have the plant's {model.dim} states", basis.dim)
        self.basis, self.model, self.cost, self.terminal = basis, model, cost, terminal
        self.horizon = positive_real("RolloutPolicy", "horizon", horizon)
        self.steps = integer("RolloutPolicy", "steps", steps, least=1)
        self.depth = integer("RolloutPolicy", "depth", depth, least=1)
        self.base: Policy = base
        if depth > 1:
            settings = {"horizon": horizon, "steps": steps, "depth": depth - 1}
            self.base = RolloutPolicy(basis, model, cost, base, terminal, **settings)  # type: ignore[arg-type]

    def forward(self, x: Tensor) -> Tensor:
        """u: (..., n) -> (..., m)."""
        return self.cost.policy(self.model.effectiveness(x), self.gradient(x))

    def gradient(self, x: Tensor) -> Tensor:
        """grad V^ at x, the centers frozen: (..., n) -> (..., n)."""
        space = self.basis.local(x)
        coefficients = space.fit(self.rollout(self.basis.centers(x)))
        rise: Tensor = torch.func.grad(lambda z: space.evaluate(z.unsqueeze(-2), coefficients).sum())(
            torch.zeros_like(x)
        )
        return rise

    def value(self, x: Tensor) -> Tensor:
        """V^(x): (..., n) -> (...)."""
        space = self.basis.local(x)
        coefficients = space.fit(self.rollout(self.basis.centers(x)))
        return space.evaluate(torch.zeros_like(x).unsqueeze(-2), coefficients).squeeze(-1)

    def rollout(self, x: Tensor) -> Tensor:
        """Cost of the base policy over the horizon, and the terminal value: (..., n) -> (...)."""
        h = self.horizon / self.steps
        spent = torch.zeros_like(x[..., 0])
        for _ in range(self.steps):
            k1, c1 = self._field(x)
            k2, c2 = self._field(x + 0.5 * h * k1)
            k3, c3 = self._field(x + 0.5 * h * k2)
            k4, c4 = self._field(x + h * k3)
            x = x + (h / 6) * (k1 + 2 * (k2 + k3) + k4)
            spent = spent + (h / 6) * (c1 + 2 * (c2 + c3) + c4)
        return spent + self.terminal(x)

    def _field(self, x: Tensor) -> tuple[Tensor, Tensor]:
        u = self.base(x)
        rate = self.model.drift(x) + matvec(self.model.effectiveness(x), u)
        return rate, self.cost.rate(x, u)

"""The rollout policy: one Newton step on the HJB equation, by moving centers."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from ...approximation.basis import StaFBasis
from ...centers import Radius, StateFollowingCenters, ball, cross_polytope, rings
from ...kernels import ExponentialKernel, GaussianKernel, Kernel
from ...lanes import compiled, each, repeat
from ...lanes.calls import inputs
from ...lanes.calls.planned_call import PlannedCall
from ...lanes.dependencies.contents import Contents
from ...lanes.gradients import grad
from ...lanes.per_row.decisions import each_row
from ...lanes.per_row.objects import Rowwise
from ...lanes.prepared_call import Plan
from ...lanes.row_numbers import RowNumbers, points_of_rows
from ...lanes.shared_programs import Rows, check_states
from ...lanes.threads import small
from ...numerics.checks import fail, integer, object_of, positive_real, trailing
from ...numerics.default_device import beside, device_of
from ...numerics.runge_kutta import runge_kutta_loop, stalls
from ...systems import Barrier, ControlAffineSystem
from ...systems.base import spread_of
from ..loop.controller import LQR, Policy, Value
from ..problem.cost import Cost
from ..problem.rules import check_objects, check_policy, check_problem, check_value

_NAME = "a rollout policy"
_KEPT = 64  # forms of one state that are remembered
_log = logging.getLogger(__name__)
_STEPS, _MOST = 10, 4096  # over the horizon: usually, and at most
_ERROR, _WRONG, _LEAST = 1e-2, 3e-2, 1e-12  # of costs: more steps are tried, a warning, next to nothing
_SAMPLES = 16
_ROWS = 8  # with numbers of their own, that are looked at


class RolloutPolicy(nn.Module, metaclass=Rowwise):
    """u(x) = policy(grad V^(x)) with V^ fitted to the cost of a base policy at the moving centers:

        V_i = int_0^horizon (x'Qx + U(u_base)) dt + V_T(x(horizon)),  x(0) = c_i(x),
        V^ = the StaF approximation with the ideal weights K(c)^-1 (V_1, ..., V_M),

    differentiated with the centers frozen. Where V_T is the value of the base policy, this is policy
    improvement: one Newton step on the HJB equation. It can be repeated, the improved policy becoming the
    base; each repetition multiplies the work by the number of centers and steps.

    Example:
        >>> plant = systems.TwoState()
        >>> cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
        >>> lqr = adp.LQR(plant, cost)
        >>> basis = StaFBasis(ExponentialKernel(), StateFollowingCenters(rings(6), radius=0.1))
        >>> policy = adp.RolloutPolicy(basis, plant, cost, lqr, lqr.value)
        >>> x = torch.tensor([1.0, 0.5]).double()
        >>> round(float(policy.control(x)), 2)  # the optimal control is -0.79, the LQR's -1.50
        -0.93

        Shown by `staf experiment=adp adp/policy=rollout`.

    Args:
        basis: kernel and centers. At a constant radius it must fit quadratics, else the gradient has an
            error that does not vanish at 0: C(n + 2, 2) points, or a radius that shrinks.
        model: the plant.
        cost: the cost rate.
        base: the base policy, (..., n) -> (..., m).
        terminal: V_T, (..., n) -> (...): the Riccati value for an LQR base.
        horizon: s, positive.
        steps: Runge-Kutta steps over the horizon, at least 1; None for 10, or as many as find the costs of
            the base to 1 %. Fewer are a warning in the log.
        depth: how many times the policy is improved, at least 1.
        period: least time for which a closed loop holds the control, s, positive; None where any will do.

    Raises:
        ValueError: if an argument breaks its rule.

    Source: Bertsekas, "Rollout, Policy Iteration, and Distributed Reinforcement Learning" (2020), ch. 2,
    with Rosenfeld et al., eq. (5), for the fit.
    """

    rowwise: ClassVar = dict.fromkeys(("control", "gradient", "value", "rollout"), (1,))

    @beside
    @small
    def __init__(
        self,
        basis: StaFBasis,
        model: ControlAffineSystem,
        cost: Cost,
        base: Policy,
        terminal: Value,
        *,
        horizon: float = 0.5,
        steps: int | None = None,
        depth: int = 1,
        period: float | None = None,
    ) -> None:
        super().__init__()
        object_of("RolloutPolicy", StaFBasis, basis=basis)
        check_objects("RolloutPolicy", model=model, cost=cost)
        if not isinstance(model, ControlAffineSystem):
            raise fail(
                "RolloutPolicy", "model", "must be a ControlAffineSystem; `near_optimal` takes others", model
            )
        if model.dim != basis.dim:
            raise fail("RolloutPolicy", "basis", f"must have the plant's {model.dim} states", basis.dim)
        check_problem(model, cost)
        self.basis, self.model, self.cost, self.terminal = basis, model, cost.around(model), terminal
        check_policy("RolloutPolicy", "base", self.cost, base)
        check_value("RolloutPolicy", "terminal", terminal, self.cost)
        self.horizon = positive_real("RolloutPolicy", "horizon", horizon)
        self.steps = integer("RolloutPolicy", "steps", _STEPS if steps is None else steps, least=1)
        self.depth = integer("RolloutPolicy", "depth", depth, least=1)
        self.period = None if period is None else positive_real("RolloutPolicy", "period", period)
        self.base: Policy = base
        if depth > 1:
            settings = {"horizon": horizon, "steps": steps, "depth": depth - 1}
            inner = RolloutPolicy(basis, model, cost, base, terminal, **settings)  # type: ignore[arg-type]
            self.base, self.steps = inner, inner.steps
        else:
            self._check_steps(chosen=steps is None)

    @classmethod
    @beside
    def of_lqr(
        cls,
        system: ControlAffineSystem,
        cost: Cost,
        *,
        centers: int | None = None,
        radius: float | Radius = 0.1,
        horizon: float = 0.5,
        steps: int | None = None,
        depth: int = 1,
        period: float | None = None,
        kernel: Kernel | None = None,
    ) -> RolloutPolicy:
        """Improve the LQR of the plant, with centers of a kernel in a ball around the state.

        Example:
            >>> plant = systems.Pendulum()
            >>> policy = adp.RolloutPolicy.of_lqr(plant, adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1))
            >>> policy(torch.tensor([0.4, 0.0], dtype=torch.float64)).shape
            torch.Size([1])

        Args:
            system: the plant, at rest in 0.
            cost: the cost rate.
            centers: their number; None for as many as quadratics need, and with four states or more for the
                cross-polytope and its middle.
            radius: of the ball, a positive number or a `Radius`, in the units of the state.
            horizon: as in `RolloutPolicy`, and so are ``steps``, ``depth`` and ``period``.
            kernel: None for the exponential one; of a `Barrier` for the Gaussian of width 1, because beside a
                wall its coordinates are far from 0, where the exponential kernel errs.

        Raises:
            ValueError: if an argument breaks its rule, or the plant has no LQR.
        """
        lqr = LQR(system, cost)
        directions = ball_directions(centers, lqr.k.shape[-1])
        if kernel is None:
            kernel = GaussianKernel() if isinstance(system, Barrier) else ExponentialKernel()
        basis = StaFBasis(kernel, StateFollowingCenters(directions, radius))
        end = lqr.value if cost.ending is None else lqr.cost.terminal
        return cls(basis, system, cost, lqr, end, horizon=horizon, steps=steps, depth=depth, period=period)

    @torch.no_grad()
    def _check_steps(self, chosen: bool) -> None:
        """Find out by step doubling whether the steps are enough, and take more where they may be chosen; of
        rows with numbers of their own as many as one of some of them needs."""
        self.steps, error = max(each_row(lambda: self._enough(chosen), _ROWS))
        if error > _WRONG:
            _log.warning(
                "RolloutPolicy: with %d integration steps over the horizon of %.3g s the costs of the base "
                "are wrong by %.2g; they need more `steps`, or a shorter horizon.",
                *(self.steps, self.horizon, error),
            )

    def _enough(self, chosen: bool) -> tuple[int, float]:
        """Return the steps that are enough, or those that somebody chose, and the relative error of costs."""
        rest = (
            torch.zeros(self.basis.dim, dtype=torch.float64, device=device_of(self))
            if self.cost.target is None
            else self.cost.target
        )
        generator = torch.Generator().manual_seed(0)
        away = (
            2 * torch.rand(_SAMPLES, self.basis.dim, dtype=torch.float64, generator=generator, device="cpu")
            - 1
        )
        x, error, steps = (
            rest.double() + spread_of(self.model, away) * away.to(rest.device),
            math.inf,
            self.steps,
        )
        now = self.rollout(x, steps)
        while True:
            finer = self.rollout(x, 2 * steps)
            errors = ((now - finer).abs() / (finer.abs() + _LEAST)).nan_to_num(math.inf, math.inf)
            last, error = error, float(errors.quantile(0.8, interpolation="lower"))
            if error <= _ERROR or stalls(error, last) or not chosen or 4 * steps > _MOST:
                return steps, error
            now, steps = finer, 2 * steps

    @compiled(_NAME, by=lambda policy: _TwoPrograms(policy))
    def forward(self, x: Tensor) -> Tensor:  # type: ignore[override]
        """u: (..., n) -> (..., m)."""
        return self.control(x)

    def control(self, x: Tensor) -> Tensor:
        """`forward` in plain torch: (..., n) -> (..., m)."""
        trailing("RolloutPolicy", "x", x, 1, self.basis.dim)
        return self.cost.policy(self.model.effectiveness(x), self.gradient(x))

    def gradient(self, x: Tensor) -> Tensor:
        """grad V^ at x, the centers frozen: (..., n) -> (..., n)."""
        return fitted_slope(self.basis, x, self.rollout(self.basis.centers(x)))

    def value(self, x: Tensor) -> Tensor:
        """V^(x): (..., n) -> (...)."""
        space = self.basis.local(x)
        coefficients = space.fit(self.rollout(self.basis.centers(x)))
        return space.evaluate(torch.zeros_like(x).unsqueeze(-2), coefficients).squeeze(-1)

    def rollout(self, x: Tensor, steps: int | None = None) -> Tensor:
        """Cost of the base policy over the horizon, in these integration steps or those of the policy,
        and the terminal value: (..., n) -> (...)."""
        trailing("RolloutPolicy.rollout", "x", x, 1, self.basis.dim)
        count = self.steps if steps is None else steps
        length = self.horizon / count

        def field(x: Tensor) -> tuple[Tensor, Tensor]:
            u = self.base(x)
            return self.model.velocity(x, u), self.cost.rate(x, u)

        def step(now: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
            after, paid = runge_kutta_loop(self.model.displaced, field, now[0], length)
            return after, now[1] + paid

        def whole(x: Tensor) -> Tensor:
            x, spent = repeat(count, step, (x, torch.zeros_like(x[..., 0])))
            total: Tensor = spent + self.terminal(x)
            return total

        return each(whole, x, dim=x.dim() - 2) if x.dim() > 1 else whole(x)


def _rolled(policy: RolloutPolicy, _: str = "") -> Callable[[Tensor, Tensor], Tensor]:
    """The cost of a rollout from the center in a direction u: (B, n), (B, n) -> (B,)."""
    centers = policy.basis.centers
    return lambda x, u: policy.rollout(x + centers.radius(x)[..., None] * u)


def _improved(policy: RolloutPolicy, _: str = "") -> Callable[[Tensor, Tensor], Tensor]:
    """The control from the costs at all centers: (B, n), (B, M) -> (B, m)."""
    return lambda x, values: policy.cost.policy(
        policy.model.effectiveness(x), fitted_slope(policy.basis, x, values)
    )


class _TwoPrograms:
    """`RolloutPolicy.control`, a center in every lane, then a state in every lane: (..., n) -> (B, 1, m)."""

    def __init__(self, policy: RolloutPolicy) -> None:
        centers = policy.basis.centers
        self._directions = centers.directions.detach()
        self._roll = Rows(_rolled(policy), _NAME, policy, "rollout", make=_rolled)
        self._improve = Rows(_improved(policy), _NAME, policy, "improvement", make=_improved)

        self._of_rows = any(isinstance(tensor, RowNumbers) for tensor in Contents(policy).tensors)
        self._one: dict[Any, tuple[Tensor, Plan, Plan]] = {}  # calls with one state
        self.at_once: dict[Any, Callable[[Tensor], Tensor]] = {}  # those that are two calls of machine code

    @property
    def compiled(self) -> bool:
        return bool(self._one) or (self._roll.compiled and self._improve.compiled)

    def __call__(self, x: Tensor) -> Tensor:
        key = x.shape, x.stride(), x.dtype, inputs.processor if x.is_cpu else x.device
        one = self._one.get(key)
        if one is not None:  # the plans read where the numbers are, and not in which shape
            u, roll, improve = one
            at = x.reshape(1, -1)  # of another dtype than the program's: what is copied needs its shape
            return improve((at, roll((at.expand(len(u), -1), u))[0].view(1, len(u))))[0]
        check_states((x,))
        rows = x if x.dim() == 2 else x.unsqueeze(0)
        (batch, dim), u = rows.shape, self._directions.to(x)
        count = len(u)
        if batch > 1 or self._of_rows:
            at = rows.unsqueeze(1).expand(batch, count, dim).reshape(-1, dim)
            u = u.expand(batch, count, dim).reshape(-1, dim)
            with points_of_rows(batch, count):
                values = self._roll(at, u)
            return self._improve(rows, values.view(batch, count))
        first, values = self._roll.planned(rows.expand(count, dim), u)
        second, found = self._improve.planned(rows, values.view(1, count))
        if first is not None and second is not None:
            if len(self._one) >= _KEPT:
                self._one.clear()
                self.at_once.clear()
            self._one[key] = u, first, second
            if isinstance(first, PlannedCall) and isinstance(second, PlannedCall):
                values_at, u_of = first.of_states(count), second.of_states(*x.shape[:-1])
                if values_at is not None and u_of is not None:
                    self.at_once[key[:3]] = lambda x: u_of(x, values_at(x, u))
        return found


def fitted_slope(basis: StaFBasis, x: Tensor, values: Tensor) -> Tensor:
    """The slope at x of what fits the values at the centers there: (..., n), (..., M) -> (..., n)."""
    space = basis.local(x)
    coefficients = space.fit(values)
    slope: Tensor = grad(lambda z: space.evaluate(z.unsqueeze(-2), coefficients).sum())(torch.zeros_like(x))
    return slope


def ball_directions(count: int | None, dim: int) -> Tensor:
    """Directions whose fit has an unbiased gradient at 0: all that quadratics need, or a symmetric cross."""
    if count is None and dim > 3:
        corners = cross_polytope(dim)
        return torch.cat((corners, torch.zeros_like(corners[:1])))
    number = math.comb(dim + 2, 2) if count is None else count
    return rings(6) if (dim, number) == (2, 6) else ball(number, dim)

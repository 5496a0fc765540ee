"""A drift of which no form is known: learned by kernels that follow the state, and the LQR that trusts it."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ...kernels import Kernel
from ...lanes.per_row.objects import OfRows
from ...lanes.row_numbers import nonzero
from ...numerics.checks import fail, non_negative, positive_real, real, trailing
from ...numerics.default_device import device_of
from ...numerics.derivatives import row_jacobian
from ...numerics.linalg import newton_basis
from ...numerics.riccati import measured, product
from ...numerics.rows import chosen
from ...systems import ControlAffineSystem
from ..loop.controller import LQR, Controller, Policy
from ..problem.cost import Cost, matvec, quadratic
from ..problem.rules import regulated
from .adaptive_lqr import Redesign
from .identification import Equation, IntegralWindows, Window
from .parametric import ParametricPlant

_NODES = (0.06943184420297371, 0.33000947820757187, 0.6699905217924281, 0.9305681557970262)
_WEIGHTS = (0.17392742256872692, 0.32607257743127307, 0.32607257743127307, 0.17392742256872692)
# Gauss and Legendre's, on [0, 1]: exact for slopes that are polynomials of degree 7 along the way


class DriftEstimate(NamedTuple):
    """Estimate of a `StreamDrift`, a row a trajectory."""

    anchor: Tensor  # (..., n) the state that the centers surround
    mean: Tensor  # (..., r, M n) weights of the rows
    covariance: Tensor  # (..., M n, M n) of the weights of every row, in units of ``deviation``^2


class StreamDrift(metaclass=OfRows):
    """d(x) in x' = h(x) + d(x) + g(x) u as a stream of StaF models, where nothing of d is known but that it
    vanishes at the plant's equilibrium x_s:

        d_r(x) = sum_j a_rj(x) (x - x_s)_j,  a_rj a Gaussian process of standard deviation ``deviation``.

    Around the state each a_rj is psi(z)'u with the orthonormal functions psi of the kernels at the centers
    c + d_i, z = x - c, and weights u by a Kalman filter. When the state leaves the ball around c the centers
    move on: the posterior at the old ones predicts the values at the new ones, and what it cannot say there
    is uncertain again (as the filter of `StaFRegressor` does it). Equations are integrals over a window of
    time, from measured states alone.

    With a wide kernel the a_rj are constants, and this is least squares for a linear drift; with a narrow one
    every place is learned by itself.

    Example:
        >>> known = systems.Linear([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])
        >>> centers = torch.tensor([[1.0, 0.0], [-0.5, 0.9], [-0.5, -0.9]]).double()
        >>> kernel = GaussianKernel(2.0)
        >>> drift = adp.StreamDrift(known, kernel, 0.5 * centers, rows=[1], deviation=2.0, length=0.05)
        >>> now = drift.init(torch.tensor([[1.0, 0.0]]).double())
        >>> mean, spread = drift.predict(now, torch.tensor([[1.0, 0.0]]).double())
        >>> mean, spread.round(decimals=3)  # nothing is known yet
        (tensor([[0.]], dtype=torch.float64), tensor([[2.]], dtype=torch.float64))

        Shown by `tests/adp/adaptation/test_stream_drift.py`.

    Args:
        known: h and g, whose equilibrium is x_s; its input there is held.
        kernel: translation invariant, such as `GaussianKernel`; its width is how far a_rj are alike.
        offsets: d_i of the M centers from the state, (M, n), in the units of the state.
        rows: the states whose rates have an unknown part, in order.
        deviation: of a_rj before anything was seen, positive, 1/s.
        length: s, of a window.
        noise: standard deviation of the noise of a measured state, not negative.
        floor: standard deviation of an error of an equation beside the noise, positive: that of the integral.
        forgetting: 1/s, not negative: the rate at which what was learned fades towards the prior.

    Raises:
        ValueError: if an argument breaks its rule.

    Source: the filter as in the class `StaFRegressor`; windows as in `IntegralWindows`.
    """

    def __init__(
        self,
        known: ControlAffineSystem,
        kernel: Kernel,
        offsets: Tensor,
        *,
        rows: Sequence[int],
        deviation: float,
        length: float,
        noise: float = 0.0,
        floor: float = 1e-4,
        forgetting: float = 0.0,
    ) -> None:
        if not isinstance(known, ControlAffineSystem) or known.dim is None:
            raise fail("StreamDrift", "known", "must be a ControlAffineSystem with `dim`", known)
        if not isinstance(kernel, Kernel) or not kernel.state_free or kernel.scale_slope != 0.0:
            raise fail("StreamDrift", "kernel", "must be translation invariant", kernel)
        if not isinstance(offsets, Tensor) or offsets.dim() != 2 or offsets.shape[1] != known.dim:
            raise fail("StreamDrift", "offsets", f"must be numbers (M, {known.dim})", offsets)
        if not bool(torch.isfinite(offsets).all()) or not bool(offsets.any()):
            raise fail("StreamDrift", "offsets", "must be finite, and not all of them 0", offsets)
        self.known, self.kernel = known, kernel
        self.offsets = offsets.double().to(device_of(kernel, known))
        self.radius = float(self.offsets.norm(dim=-1).max())
        self.basis = newton_basis(kernel(self.offsets, self.offsets).detach())
        self.deviation = positive_real("StreamDrift", "deviation", deviation)
        self.floor = positive_real("StreamDrift", "floor", floor)
        non_negative("StreamDrift", "forgetting", forgetting)
        self.forgetting = real("StreamDrift", "forgetting", forgetting)
        self.center, self.rest = known.equilibrium(), known.resting_input()
        self.rows = list(rows)
        count, dim = self.offsets.shape
        plant = ParametricPlant(
            lambda x, u: self._spread_over_rows(x, x),
            lambda x, u: known.rate(x, u),
            dim=dim,
            inputs=known.inputs,
            theta=self.offsets.new_zeros(count * dim),
            rows=self.rows,
            periodic=known.periodic,
        )
        self.windows = IntegralWindows(plant, length, noise=noise)

    def init(self, x: Tensor) -> DriftEstimate:
        """Return the prior around the states (..., n), around the equilibrium in what is NaN."""
        x = torch.where(x.isnan(), self.center.to(x), x)
        count = self.offsets.numel()
        identity = torch.eye(count, dtype=x.dtype, device=x.device).expand(*x.shape[:-1], count, count)
        return DriftEstimate(x, x.new_zeros(*x.shape[:-1], len(self.rows), count), identity.contiguous())

    def window_of(self, estimate: DriftEstimate) -> IntegralWindows:
        """The windows whose equations are of this estimate's weights."""
        windows = copy.copy(self.windows)
        windows.model = copy.copy(windows.model)
        windows.model.regressor = lambda x, u: self._spread_over_rows(x, estimate.anchor)
        return windows

    def step(self, estimate: DriftEstimate, equation: Equation, x: Tensor, dt: float) -> DriftEstimate:
        """Return the estimate with an equation of `window_of` it, where it is ready, and around x (...,
        n), measured at the equation's end, where that left the ball; dt in s since the step before."""
        mean, p, ready = estimate.mean, estimate.covariance, equation.ready
        scale, x = self.deviation, torch.where(ready.unsqueeze(-1), x, estimate.anchor)
        if nonzero(self.forgetting):
            identity = torch.eye(p.shape[-1], dtype=p.dtype, device=p.device)
            p = identity + (p - identity) / (1 + self.forgetting * dt)
        s = scale * equation.s[..., 0, :]
        reach = self.windows.length * scale
        left = self._rest(x, estimate.anchor) * self._deviation(x).square().sum(-1)
        noise = equation.variance + self.floor**2 + reach**2 * left
        ps = (p * s.unsqueeze(-2)).sum(-1)
        gain = torch.where(ready, 1 / ((ps * s).sum(-1) + noise), 0.0)
        missing = equation.z - (s.unsqueeze(-2) * mean).sum(-1)  # (..., r)
        mean = mean + (gain.unsqueeze(-1) * missing).unsqueeze(-1) * ps.unsqueeze(-2)
        p = measured(p, gain.unsqueeze(-1) * ps, s, noise)
        return self._moved(DriftEstimate(estimate.anchor, mean, p), x, ready)

    def predict(self, estimate: DriftEstimate, x: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation of d at x, of the rows: (..., n) -> (..., r), (..., r)."""
        a, covariance = self.slopes(estimate, x)
        e = self._deviation(x)
        mean = (a * e.unsqueeze(-2)).sum(-1)
        variance = (e.unsqueeze(-1) * covariance * e.unsqueeze(-2)).sum((-2, -1))
        return mean, variance.sqrt().unsqueeze(-1).expand(mean.shape)

    def slopes(self, estimate: DriftEstimate, x: Tensor) -> tuple[Tensor, Tensor]:
        """a at x, (..., r, n), and the covariance of every row of it, (..., n, n)."""
        psi = self._functions(x, estimate.anchor)
        m, n = self.offsets.shape
        a = (psi[..., None, :, None] * estimate.mean.unflatten(-1, (m, n))).sum(-2)
        both = psi[..., :, None, None, None] * psi[..., None, None, :, None]  # (..., M, 1, M, 1)
        p = (both * estimate.covariance.unflatten(-1, (m, n)).unflatten(-3, (m, n))).sum((-4, -2))
        identity = torch.eye(n, dtype=x.dtype, device=x.device)
        left = self._rest(x, estimate.anchor)[..., None, None] * identity
        return self.deviation * a, self.deviation**2 * (p + left)

    def matrix(self, estimate: DriftEstimate, x: Tensor) -> tuple[Tensor, Tensor]:
        """A(x) with h(x) + d(x) = A(x) (x - x_s), (..., n, n), and the covariance of its unknown rows.

        h counts by the mean of its slope along the way from x_s to x.
        """
        e, center = self._deviation(x), self.center.to(x)
        idle = self.rest.to(x).expand(*x.shape[:-1], -1)
        a = torch.zeros_like(x).unsqueeze(-1) * e.unsqueeze(-2)
        for node, weight in zip(_NODES, _WEIGHTS, strict=True):
            slope = row_jacobian(lambda y: self.known.rate(y, idle), center + node * e)[1]
            a = a + weight * slope
        own, covariance = self.slopes(estimate, x)
        places = torch.eye(len(self.center), dtype=x.dtype, device=x.device)[:, self.rows]
        return a + product(places, own), covariance

    def _deviation(self, x: Tensor) -> Tensor:
        return self.known.difference(x, self.center.to(x))

    def _functions(self, x: Tensor, anchor: Tensor) -> Tensor:
        """psi at x: (..., n), (..., n) -> (..., M)."""
        z, basis = self.known.difference(x, anchor), self.basis.to(x)
        near = self.kernel(z.unsqueeze(-2), self.offsets.to(x))  # (..., 1, M)
        return product(near, basis).squeeze(-2)

    def _rest(self, x: Tensor, anchor: Tensor) -> Tensor:
        """The share of the prior's variance at x that no weights explain, in [0, 1]: (...)."""
        left = 1 - self._functions(x, anchor).square().sum(-1)
        return torch.where(left > 0, left, 0.0)  # at a center it is 0, up to rounding on either side

    def _spread_over_rows(self, x: Tensor, anchor: Tensor) -> Tensor:
        """psi_i (x - x_s)_j in the rows of `rows`, (..., n, M n)."""
        features = (self._functions(x, anchor).unsqueeze(-1) * self._deviation(x).unsqueeze(-2)).flatten(-2)
        places = torch.zeros(x.shape[-1], dtype=x.dtype, device=x.device)
        places[self.rows] = 1.0
        return places.unsqueeze(-1) * features.unsqueeze(-2)

    def _moved(self, now: DriftEstimate, x: Tensor, ready: Tensor) -> DriftEstimate:
        """Move the centers to x where a window ended outside the ball."""
        step = self.known.difference(x, now.anchor)
        moves = ready & (step.square().sum(-1) > self.radius**2)
        step = torch.where(moves.unsqueeze(-1), step, 0.0)
        m, n = self.offsets.shape
        offsets, basis = self.offsets.to(x), self.basis.to(x)
        there = self.kernel(step.unsqueeze(-2) + offsets, offsets)
        transfer = product(product(basis.mT, there), basis)  # (..., M, M)
        mean = (transfer[..., None, :, :, None] * now.mean.unflatten(-1, (m, n)).unsqueeze(-3)).sum(-2)
        known = torch.eye(m * n, dtype=x.dtype, device=x.device) - now.covariance
        split = known.unflatten(-1, (m, n)).unflatten(-3, (m, n))  # (..., M, n, M, n)
        half = (transfer[..., :, :, None, None, None] * split.unsqueeze(-5)).sum(-4)
        whole = (half.unsqueeze(-3) * transfer[..., None, None, :, :, None]).sum(-2)
        covariance = torch.eye(m * n, dtype=x.dtype, device=x.device) - whole.flatten(-2).flatten(-3, -2)
        wide = moves[..., None, None]
        return DriftEstimate(
            torch.where(moves[..., None], x, now.anchor),
            torch.where(wide, mean.flatten(-2), now.mean),
            torch.where(wide, covariance, now.covariance),
        )


class DriftAdaptation(NamedTuple):
    """Carried state of a `DriftLQR`, a row a trajectory."""

    estimate: DriftEstimate
    certain: Tensor  # (...) 1 where the learned model has the control, 0 where the robust policy has it
    window: Window
    p: Tensor  # (..., n, n) of the design


class DriftLQR(Controller):
    """u = -R^-1 g(x)'P (x - x_s) with P from the Riccati equation of x' = A(x) (x - x_s) + g(x) u, where A(x)
    is that of the learned drift at the state of now (`StreamDrift.matrix`) and certain enough:

        certain:  2 c s |(Pe)_rows| < e'We,   e = x - x_s,   W = Q + K'RK,

    with s the standard deviation of the drift at x: e'Pe falls at x for every drift within c deviations. The
    robust policy has the control elsewhere; `LoopResult` records it as ``certain``. Where a measured state
    has a NaN the control is held and nothing is learned; ``missed`` counts it.

    Example:
        >>> known = systems.Linear([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])
        >>> cost, offsets = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1), 0.5 * rings(3)
        >>> drift = adp.StreamDrift(known, GaussianKernel(2.0), offsets, rows=[1], deviation=3.0, length=0.05)
        >>> control = adp.DriftLQR(drift, cost)
        >>> x0 = torch.tensor([[1.0, 0.0]]).double()
        >>> run = adp.simulate(control, systems.Pendulum(), cost, x0, dt=0.02, steps=70)
        >>> run["certain"][0, [0, -1]], bool(run.state[0, -1].norm() < 0.5)
        (tensor([0., 1.], dtype=torch.float64), True)

        Shown by `tests/adp/adaptation/test_stream_drift.py`.

    Args:
        drift: the model and what learns it.
        cost: the cost rate, without discount.
        robust: the policy in doubt; None for the LQR of what is known.
        confidence: c, positive.
        doublings: of a design, at least 1.

    Raises:
        ValueError: if an argument breaks its rule.

    Source: Cloutier, "State-dependent Riccati equation techniques", ACC (1997), for the policy of a known
    drift.
    """

    def __init__(
        self,
        drift: StreamDrift,
        cost: Cost,
        *,
        robust: Policy | None = None,
        confidence: float = 2.0,
        doublings: int = 14,
    ) -> None:
        super().__init__()
        self.drift, self.model = drift, drift.known
        self.cost = regulated("DriftLQR", drift.known, cost)
        self.confidence = positive_real("DriftLQR", "confidence", confidence)
        self.redesign = Redesign("DriftLQR", self.cost, doublings)
        self.robust: Policy = LQR(drift.known, cost) if robust is None else robust

    def init(self, x0: Tensor) -> DriftAdaptation:
        trailing(type(self).__name__, "x0", x0, 2)
        window, p = self.drift.windows.init(x0), x0.new_zeros(*x0.shape, x0.shape[-1])
        window = self.drift.windows.holding(window, self.cost.input_of(window.u))
        return DriftAdaptation(self.drift.init(x0), x0.new_zeros(len(x0)), window, p)

    def recorded(self, carried: DriftAdaptation) -> dict[str, Tensor]:
        return {"certain": carried.certain, "missed": carried.window.missed}

    def step(
        self, x: Tensor, now: DriftAdaptation, uniform: Tensor, dt: float
    ) -> tuple[Tensor, DriftAdaptation]:
        windows, missing = self.drift.window_of(now.estimate), x.isnan().any(-1)
        window, equation = windows.step(now.window, x, dt)
        estimate = self.drift.step(now.estimate, equation, x, dt)
        a, covariance = self.drift.matrix(estimate, x)
        b = self.model.effectiveness(x)
        p = self.redesign.step(now.p, a, b)
        k = product(product(self.cost.r_inverse.to(b), b.mT), p)
        e = self.cost.deviation(x)
        # e'Pe falls by e'We a second, with d as it is believed; of d every row counts by 2 (Pe)_r.
        falls = quadratic(self.redesign.curvature, e) + quadratic(self.cost.r, matvec(k, e))
        lever = matvec(p, e)[..., self.drift.rows].square().sum(-1)
        spread = 2 * (lever * quadratic(covariance, e)).sqrt()
        certain = self.redesign.solved(p, a, b) & (self.confidence * spread < falls)
        wanted = self.cost.saturate(self.cost.input_of(-matvec(k, e)))
        # What the actuator will give, which the window must know.
        u = self.cost.admissible(torch.where(certain.unsqueeze(-1), wanted, self.robust(x)))
        after = u, certain.to(x), p
        u, sure, p = chosen(missing, (now.window.u, now.certain, now.p), after)
        return u, DriftAdaptation(estimate, sure, windows.holding(window, u), p)

"""The certainty-equivalent policy on a drift that is learned without a form, robust while in doubt."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ...numerics.checks import positive_real
from ..loop.carried import pack, unpack
from ..loop.controller import LQR, Controller, ControllerState, Policy
from ..problem.cost import Cost, matvec, quadratic
from .drift import DriftEstimate, StreamDrift
from .redesign import Doubling, Redesign, product
from .windows import Window


class DriftAdaptation(NamedTuple):
    """What a `DriftLQR` knows and does, a row a trajectory.

    Example:
        >>> adp.DriftAdaptation._fields[:2]
        ('estimate', 'certain')

        Shown by `tests/adp/adaptation/test_stream_drift.py`.
    """

    estimate: DriftEstimate
    certain: Tensor  # (...) 1 where the learned model has the control, 0 where the robust policy has it
    window: Window
    doubling: Doubling
    stage: Tensor  # (...) doublings done of the design that is under way
    p: Tensor  # (..., n, n) of the design that is used


class DriftLQR(Controller):
    """u = -R^-1 g(x)'P (x - x_s) with P from the Riccati equation of x' = A(x) (x - x_s) + g(x) u, where A(x)
    is that of the learned drift at the state of now (`StreamDrift.matrix`) and certain enough:

        certain:  2 c s |(Pe)_rows| < e'We,   e = x - x_s,   W = Q + K'RK,

    with s the standard deviation of the drift at x: e'Pe falls at x for every drift within c deviations. The
    robust policy has the control elsewhere; `DriftAdaptation.certain` says where.

    Example:
        >>> known = systems.Linear([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])
        >>> cost, offsets = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1), 0.5 * rings(3)
        >>> drift = adp.StreamDrift(known, GaussianKernel(2.0), offsets, rows=[1], deviation=3.0, length=0.05)
        >>> control = adp.DriftLQR(drift, cost)
        >>> x0 = torch.tensor([[1.0, 0.0]]).double()
        >>> run = adp.simulate(control, systems.Pendulum(), cost, x0, dt=0.02, steps=150)
        >>> now = control.adaptation(run.identifier)
        >>> now.certain[0, [0, -1]], bool(run.state[0, -1].norm() < 0.05)
        (tensor([0., 1.], dtype=torch.float64), True)

        Shown by `tests/adp/adaptation/test_stream_drift.py`.

    Args:
        drift: the model and what learns it.
        cost: the cost rate, without discount.
        robust: the policy in doubt; None for the LQR of what is known.
        confidence: c, positive.
        doublings: of a design, at least 1.
        a_step: doublings a control; None for all of them at once.

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
        a_step: int | None = None,
    ) -> None:
        super().__init__()
        self.drift, self.model, self.cost = drift, drift.known, cost.around(drift.known)
        self.confidence = positive_real("DriftLQR", "confidence", confidence)
        self.redesign = Redesign.of("DriftLQR", self.cost, doublings, a_step)
        self.robust: Policy = LQR(drift.known, cost) if robust is None else robust
        self._like = self._start(torch.zeros(1, int(drift.known.dim or 0), dtype=torch.float64))

    def init(self, x0: Tensor) -> ControllerState:
        none = x0.new_zeros(len(x0), 0)
        return ControllerState(none, none, x0.new_zeros(len(x0), 0, 0), pack(self._start(x0), 1))

    def adaptation(self, identifier: Tensor) -> DriftAdaptation:
        """What the rows of `LoopResult.identifier` say, (..., K)."""
        found: DriftAdaptation = unpack(self._like, identifier, 1)
        return found

    def step(
        self, x: Tensor, carried: ControllerState, uniform: Tensor, dt: float
    ) -> tuple[Tensor, ControllerState]:
        now = self.adaptation(carried.identifier)
        windows = self.drift.window_of(now.estimate)
        window, equation = windows.step(now.window, x, dt)
        estimate = self.drift.step(now.estimate, equation, x, dt)
        a, covariance = self.drift.matrix(estimate, x)
        b = self.model.effectiveness(x)
        doubling, stage, p = self.redesign.step(now.doubling, now.stage, now.p, a, b)
        k = product(product(self.cost.r_inverse.to(b), b.mT), p)
        e = self.cost.deviation(x)
        # e'Pe falls by e'We a second, with d as it is believed; of d every row counts by 2 (Pe)_r.
        falls = quadratic(self.redesign.curvature, e) + quadratic(self.cost.r, matvec(k, e))
        lever = matvec(p, e)[..., self.drift.rows].square().sum(-1)
        spread = 2 * (lever * quadratic(covariance, e)).sqrt()
        certain = self.redesign.solved(p, a, b) & (self.confidence * spread < falls)
        wanted = self.cost.saturate(self.cost.input_of(-matvec(k, e)))
        u = torch.where(certain.unsqueeze(-1), wanted, self.robust(x))
        if self.cost.bounds is not None:  # what the actuator will give, which the window must know
            u = self.cost.bounds.clip(u)
        after = DriftAdaptation(estimate, certain.to(x), windows.holding(window, u), doubling, stage, p)
        return u, carried._replace(identifier=pack(after, x.dim() - 1))

    def _start(self, x: Tensor) -> DriftAdaptation:
        square, zero = x.new_zeros(len(x), x.shape[-1], x.shape[-1]), x.new_zeros(len(x))
        empty = Doubling(square, square.clone(), square.clone())
        windows = self.drift.windows.init(x)
        return DriftAdaptation(self.drift.init(x), zero, windows, empty, zero.clone(), square.clone())

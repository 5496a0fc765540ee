"""Parameters by recursive least squares: with forgetting, a covariance, and a test of what is new."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ...lanes.per_row.objects import OfRows
from ...lanes.row_numbers import nonzero
from ...numerics.checks import non_negative, one_or_each, positive, positive_real, real, vector
from ...numerics.riccati import measured
from .windows import Equation


class Estimate(NamedTuple):
    """theta^ with its covariance, a row a trajectory."""

    theta: Tensor  # (..., p)
    covariance: Tensor  # (..., p, p)
    surprise: Tensor  # (...) largest innovation of the last equation, in its standard deviations
    resets: Tensor  # (...) how often the covariance was opened again
    missed: Tensor | None = None  # (...) equations with a row that was not finite, where counted

    def recorded(self) -> dict[str, Tensor]:
        """Return the parts that a `LoopResult` keeps."""
        return {"theta": self.theta, "theta_covariance": self.covariance, "resets": self.resets}


class LeastSquares(metaclass=OfRows):
    """theta^ of the equations S theta = z + noise by recursive least squares, one row of S after the other:

        k = P s / (s'P s + r),   theta^ += k (z - s'theta^),   P = (I - k s') P (I - k s')' + r k k',

    with the noise's variance r of the equation and ``floor``^2 more. Between equations P grows at the rate
    ``forgetting``, up to its first trace. Where an innovation exceeds ``alarm`` standard deviations the plant
    is another one: P opens to its first size again, and the old data are forgotten at once. A row of S or z
    that is not finite, as of a missing measurement, is left out and counted: `Estimate.missed`.

    Example:
        >>> from staf_torch.adp.adaptation.windows import Equation
        >>> law = adp.LeastSquares([0.0, 0.0], deviation=10.0, floor=1e-6)
        >>> now = law.init(torch.zeros(1, 2).double())
        >>> s = torch.tensor([[[1.0, 2.0], [1.0, -1.0]]]).double()
        >>> z = s @ torch.tensor([3.0, 4.0]).double()
        >>> equation = Equation(s, z, torch.zeros(1), torch.tensor([True]))
        >>> law.step(now, equation, 0.01).theta.round(decimals=6)
        tensor([[3., 4.]], dtype=torch.float64)

        Shown by `staf experiment=faults`.

    Args:
        theta: first estimate, p numbers.
        deviation: standard deviation of the first estimate, positive, one number or p.
        floor: standard deviation of an error of z beside the noise, positive: that of the integrals, of what
            the model leaves out.
        forgetting: 1/s, not negative.
        alarm: positive; None for no test.

    Raises:
        ValueError: if an argument breaks its rule.
    """

    def __init__(
        self,
        theta: Sequence[float],
        deviation: float | Sequence[float],
        *,
        floor: float = 1e-6,
        forgetting: float = 0.0,
        alarm: float | None = None,
    ) -> None:
        first = vector("LeastSquares", "theta", theta)
        sizes = one_or_each("LeastSquares", "deviation", deviation, len(first))
        self.first = torch.tensor(first, dtype=torch.float64, device="cpu")
        self.prior = torch.diag(positive("LeastSquares", "deviation", sizes).square())
        self.floor = positive_real("LeastSquares", "floor", floor)
        non_negative("LeastSquares", "forgetting", forgetting)
        self.forgetting = real("LeastSquares", "forgetting", forgetting)
        self.alarm = None if alarm is None else positive_real("LeastSquares", "alarm", alarm)

    def init(self, x: Tensor, theta: Tensor | None = None) -> Estimate:
        """Return the first estimate, a row each of (..., n): theta (..., p), or the common one."""
        lead, p = x.shape[:-1], len(self.first)
        start = self.first.to(x).expand(*lead, p).clone() if theta is None else theta.to(x)
        zero = x.new_zeros(lead)
        prior = self.prior.to(x).expand(*lead, p, p).clone()
        return Estimate(start, prior, zero, zero.clone(), zero.clone())

    def step(self, state: Estimate, equation: Equation, dt: float) -> Estimate:
        """Return the estimate with an equation S theta = z, where it is ready, dt s after the step
        before."""
        theta, p, ready = state.theta, state.covariance, equation.ready
        equation, fine = equation.finite()
        missed = torch.zeros_like(state.resets) if state.missed is None else state.missed
        missed = missed + (ready & ~fine.all(-1)).to(missed)
        prior = self.prior.to(theta)
        if nonzero(self.forgetting):
            grown = p * (1 + self.forgetting * dt)
            room = grown.diagonal(dim1=-2, dim2=-1).sum(-1) <= prior.diagonal().sum()
            p = torch.where(room[..., None, None], grown, p)
        noise = equation.variance + self.floor**2
        surprise, resets = state.surprise, state.resets
        if self.alarm is not None:
            seen = (equation.s.unsqueeze(-2) * p.unsqueeze(-3)).sum(-1)  # S P, (..., n, p)
            spread = (seen * equation.s).sum(-1) + noise.unsqueeze(-1)
            left = equation.z - (equation.s * theta.unsqueeze(-2)).sum(-1)
            sigmas = (left.square() / spread).amax(-1).sqrt()
            alarmed = ready & (sigmas > self.alarm)
            p = torch.where(alarmed[..., None, None], prior, p)
            surprise = torch.where(ready, sigmas, surprise)
            resets = resets + alarmed.to(resets)
        for row in range(equation.s.shape[-2]):
            s, z = equation.s[..., row, :], equation.z[..., row]
            ps = (p * s.unsqueeze(-2)).sum(-1)
            gain = torch.where(ready & fine[..., row], 1 / ((ps * s).sum(-1) + noise), 0.0)
            theta = theta + (gain * (z - (s * theta).sum(-1))).unsqueeze(-1) * ps
            p = measured(p, gain.unsqueeze(-1) * ps, s, noise)
        return Estimate(theta, p, surprise, resets, missed)

"""The state from noisy measurements of all of it, with a model whose parameters are being identified."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ...lanes.per_row.objects import OfRows
from ...numerics.checks import non_negative, one_or_each, positive
from ...numerics.derivatives import row_jacobian
from ...numerics.riccati import product
from ..problem.held_plant import Holding
from .least_squares import Estimate
from .parametric import ParametricPlant

_UNKNOWN = 1e3  # deviations of the noise: that of a state that the first measurement lacks


class Considered(NamedTuple):
    """Estimate of a `ConsiderFilter`: x = mean + e + sensitivity (theta - theta^), Cov e = covariance."""

    mean: Tensor  # (..., n)
    covariance: Tensor  # (..., n, n) of what noise and disturbances make
    sensitivity: Tensor  # (..., n, p)
    theta: Tensor  # (..., p) that the mean was made with
    steps: Tensor  # (...) measurements so far
    missed: Tensor  # (..., n) of every state, measurements of it that were missing


class ConsiderFilter(metaclass=OfRows):
    """The Schmidt-Kalman filter of measured states y = x + noise around an estimate theta^ with covariance C:

        x^ += H d theta^,   x^-, F = step of x^ with theta^,   H- = F H + dt Y,   P- = F P F' + Q dt,
        T = P- + H- C H-',   K = T (T + R)^-1,   x^ = x^- + K (y - x^-),
        H = (I - K) H-,   P = (I - K) P- (I - K)' + K R K'.

    H says how an error of theta^ shows in x^: while theta is unknown the measurement counts, once it is known
    the model does, and where theta^ changes x^ follows. theta itself is left to a law as `LeastSquares`.

    An entry of y that is NaN is missing: the others are used, and `Considered.missed` counts it. What the
    first measurement lacks is the plant's equilibrium, with 1000 times the deviation of the noise.

    Example:
        >>> plant = adp.ParametricPlant.of_effectiveness(systems.Pendulum())
        >>> filter = adp.ConsiderFilter(plant, noise=0.01)
        >>> unknown = adp.LeastSquares([1.0], deviation=0.5).init(torch.zeros(1, 2).double())
        >>> y, u = torch.tensor([[0.1, 0.0]]).double(), torch.zeros(1, 1).double()
        >>> now = filter.step(filter.init(y), y, u, unknown, 0.01)
        >>> torch.equal(now.mean, y)  # the first measurement is all that is known
        True

        Shown by `staf experiment=faults`.

    Args:
        model: the plant; its theta is not used.
        noise: standard deviation of every measured state, positive, one number or n.
        process: standard deviation of what disturbs each state in a second, one number or n, not negative:
            the variance grows by its square times the time.

    Raises:
        ValueError: if an argument breaks its rule.

    Source: Schmidt, "Application of state-space methods to navigation problems", Adv. Control Syst. 3 (1966).
    """

    def __init__(
        self,
        model: ParametricPlant,
        *,
        noise: float | Sequence[float],
        process: float | Sequence[float] = 0.0,
    ) -> None:
        n = model._size()
        self.model = model
        self._held: dict[float, Holding] = {}  # of every period
        self.noise = positive("ConsiderFilter", "noise", one_or_each("ConsiderFilter", "noise", noise, n))
        disturbed = one_or_each("ConsiderFilter", "process", process, n)
        self.process = non_negative("ConsiderFilter", "process", disturbed)

    def init(self, x: Tensor) -> Considered:
        """Return the estimate before the first measurement, a row each of (..., n)."""
        lead, n, p = x.shape[:-1], x.shape[-1], self.model.parameters_count
        return Considered(
            torch.zeros_like(x),
            x.new_zeros(*lead, n, n),
            x.new_zeros(*lead, n, p),
            x.new_zeros(*lead, p),
            x.new_zeros(lead),
            torch.zeros_like(x),
        )

    def step(self, state: Considered, y: Tensor, u: Tensor, estimate: Estimate, dt: float) -> Considered:
        """Return the estimate with y (..., n), measured now, NaN where it was not; u (..., m) was held
        for dt s since the measurement before, and theta is estimated with its covariance."""
        theta = estimate.theta
        believed = self.model.believing(theta)
        if dt not in self._held:
            self._held[dt] = Holding("ConsiderFilter", self.model, None, dt, exponential=False)
        held = self._held[dt]
        follows = (state.sensitivity * (theta - state.theta).unsqueeze(-2)).sum(-1)
        mean, slope = row_jacobian(lambda x: held.of(believed)(x, u)[0], state.mean + follows)
        sensitivity = product(slope, state.sensitivity) + dt * self.model.regressor(state.mean + follows, u)
        own = product(product(slope, state.covariance), slope.mT)
        own = own + torch.diag(self.process.to(y).square() * dt)
        shown = product(product(sensitivity, estimate.covariance), sensitivity.mT)
        missing, variance = y.isnan(), self.noise.to(y).square()
        seen, r = (~missing).to(y), torch.diag(variance)
        whole = (own + shown) * seen.unsqueeze(-2)  # of the measured states, (..., n, n)
        gain = product(whole, torch.linalg.inv_ex(whole * seen.unsqueeze(-1) + r)[0])
        kept = torch.eye(y.shape[-1], device=y.device).to(y) - gain
        left = self.model.difference(torch.where(missing, mean, y), mean)
        mean = mean + (gain * left.unsqueeze(-2)).sum(-1)
        own = product(product(kept, own), kept.mT) + product(product(gain, r), gain.mT)
        first = state.steps == 0
        wide = first[..., None, None]
        begun = torch.where(missing, self.model.equilibrium().to(y), y)
        unknown = torch.where(missing, _UNKNOWN**2 * variance, variance)
        return Considered(
            torch.where(first.unsqueeze(-1), begun, mean),
            torch.where(wide, torch.diag_embed(unknown), own),
            torch.where(wide, 0.0, product(kept, sensitivity)),
            theta,
            state.steps + 1,
            state.missed + missing.to(y),
        )

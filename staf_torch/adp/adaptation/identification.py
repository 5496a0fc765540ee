"""Parameters from measured states alone: equations over windows of time, and recursive least squares."""

from __future__ import annotations

import abc
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ...lanes.per_row.objects import OfRows
from ...lanes.row_numbers import nonzero
from ...numerics.checks import choice, fail, non_negative, one_or_each, positive, positive_real, real, vector
from ...numerics.riccati import measured
from .parametric import ParametricPlant


class Equation(NamedTuple):
    """S theta = z up to noise, a row a trajectory."""

    s: Tensor  # (..., r, p), a row each of the model's ``rows``
    z: Tensor  # (..., r)
    variance: Tensor  # (...) of the noise of every entry of z
    ready: Tensor  # (...) bool: whether there is one at this time

    def finite(self) -> tuple[Equation, Tensor]:
        """The equation with zeros in rows that are not finite, or whose squares are not, and which rows are:
        (..., r) bool."""
        several = self.z.dim() == self.s.dim()  # right-hand sides
        known = torch.isfinite(self.z.square())
        fine = torch.isfinite(self.s.square().sum(-1)) & (known.all(-1) if several else known)
        there = fine.unsqueeze(-1)
        z = torch.where(there if several else fine, self.z, 0.0)
        return self._replace(s=torch.where(there, self.s, 0.0), z=z), fine


class Window(NamedTuple):
    """Window so far: integrals, or of `SlopeWindows` Y and h in its middle."""

    x: Tensor  # (..., n) the state that was measured last
    u: Tensor  # (..., m) the input held since
    s: Tensor  # (..., r, p)
    z: Tensor  # (..., r)
    elapsed: Tensor  # (...) s; -1 before the first measurement
    length: Tensor  # (...) s of this window
    longest: Tensor  # (...) s
    moved: Tensor  # (..., n) the way since the window's beginning, of `SlopeWindows` alone
    missed: Tensor  # (...) measurements that were missing so far


class Windows(metaclass=OfRows):
    """Equations S theta = z, one a window of time.

    A measurement with an entry that is NaN is missing: it ends its window without an equation, the next one
    begins with the next measurement, and `Window.missed` counts it.
    """

    model: ParametricPlant
    first: float  # s, length of the first window
    length: float  # s, of the longest

    def init(self, x: Tensor, length: Tensor | None = None) -> Window:
        """Return an empty window, a row each of the states (..., n), of the length (...) of every row or
        the common one."""
        lead, count = x.shape[:-1], len(self.model.rows)
        return Window(
            torch.zeros_like(x),
            x.new_zeros(*lead, self.model.inputs),
            x.new_zeros(*lead, count, self.model.parameters_count),
            x.new_zeros(*lead, count),
            x.new_full(lead, -1.0),
            x.new_zeros(lead) + self.first if length is None else length.to(x),
            x.new_zeros(lead) + self.length if length is None else length.to(x),
            torch.zeros_like(x),
            x.new_zeros(lead),
        )

    @abc.abstractmethod
    def step(self, state: Window, x: Tensor, dt: float) -> tuple[Window, Equation]:
        """Return the window with x (..., n) measured now, NaN where it was not, and the equation where it
        is complete; dt in s since the measurement before."""

    def holding(self, state: Window, u: Tensor) -> Window:
        """The window with the input that is held from now on, (..., m)."""
        return state._replace(u=u)


class IntegralWindows(Windows):
    """Equations S theta = z from states alone, one a window of time, where x' is not measured:

        S = sum_k phi_k int_k Y dt,   z = sum_k phi_k (x_k+1 - x_k - int_k h dt),

    over the steps k of the window, the integrals by the trapezoidal rule with the input held. With phi = 1
    (``box``) that is integral concurrent learning. With phi = sin^2(pi t / T) (``smooth``) the noise of a
    measurement counts as the slope of phi and not as 1: of white noise of the states a window keeps
    pi^2 dt / (4 T) of the variance of a box.

    Example:
        >>> plant = adp.ParametricPlant.of_effectiveness(systems.Pendulum())
        >>> windows = adp.IntegralWindows(plant, length=0.02)
        >>> now, x, u = windows.init(torch.zeros(1, 2).double()), torch.zeros(1, 2).double(), torch.ones(1, 1)
        >>> for _ in range(3):
        ...     now, equation = windows.step(now, x, 0.01)
        ...     now = windows.holding(now, u.double())
        ...     x = systems.runge_kutta_step(lambda x: plant.motion(x, u.double()), x, 0.01)
        >>> equation.ready, (equation.z / equation.s[..., 0])[..., 1].round(decimals=3)
        (tensor([True]), tensor([1.], dtype=torch.float64))

        Shown by `staf experiment=icl`.

    Args:
        model: the plant, whose theta is not used.
        length: T, s, positive.
        shape: ``box`` or ``smooth``.
        first: s, the length of the first window; every other one is twice as long, up to T. None for T. Short
            windows know something soon, long ones are worth more against noise.
        noise: standard deviation of the noise of a measured state, in its units, not negative.
        states: the plant's states from what is measured, (..., n) -> (..., n); None where these are it. With
            the `inverse` of a `Barrier` equations are of x, as smooth beside a wall as anywhere.

    Raises:
        ValueError: if an argument breaks its rule.

    Source: Parikh, Kamalapurkar and Dixon, "Integral concurrent learning", IJACSP 33 (2019), for the box.
    """

    def __init__(
        self,
        model: ParametricPlant,
        length: float,
        *,
        shape: str = "box",
        first: float | None = None,
        noise: float = 0.0,
        states: Callable[[Tensor], Tensor] | None = None,
    ) -> None:
        self.model, self.states = model, states
        self.length = positive_real("IntegralWindows", "length", length)
        self.first = self.length if first is None else positive_real("IntegralWindows", "first", first)
        if self.first > self.length:
            raise fail("IntegralWindows", "first", f"must be at most the length of {length:g} s", first)
        choice("IntegralWindows", "shape", shape, ("box", "smooth"))
        self.smooth = shape == "smooth"
        non_negative("IntegralWindows", "noise", noise)
        self.noise = real("IntegralWindows", "noise", noise)

    def step(self, state: Window, x: Tensor, dt: float) -> tuple[Window, Equation]:
        x, missing = _known(x if self.states is None else self.states(x), state)
        begun = state.elapsed >= 0
        share = torch.ones_like(state.elapsed)
        if self.smooth:  # phi in the middle of the step
            share = (math.pi * (state.elapsed + 0.5 * dt) / state.length).sin().square()
        share = torch.where(begun, share, 0.0)
        model, rows, half = self.model, self.model.rows, 0.5 * dt * share
        s = model.regressor(state.x, state.u) + model.regressor(x, state.u)
        moved = model.difference(x, state.x)
        h = model.rest_of(state.x, state.u) + model.rest_of(x, state.u)
        whole_s = state.s + half[..., None, None] * s[..., rows, :]
        whole_z = state.z + (share.unsqueeze(-1) * moved - half.unsqueeze(-1) * h)[..., rows]
        elapsed = torch.where(begun, state.elapsed + dt, 0.0)
        ready = ~missing & (elapsed > state.length - 0.5 * dt)
        kept = (~ready & ~missing).to(x)
        after = state._replace(
            x=x,
            s=kept[..., None, None] * whole_s,
            z=kept.unsqueeze(-1) * whole_z,
            elapsed=torch.where(missing, -1.0, kept * elapsed),
            length=torch.where(ready, torch.minimum(2 * state.length, state.longest), state.length),
            missed=state.missed + missing.to(x),
        )
        return after, Equation(whole_s, whole_z, self._variance(state, dt), ready)

    def _variance(self, state: Window, dt: float) -> Tensor:
        """Return the variance of the noise of z: sum (phi_k - phi_k-1)^2 of the noise's."""
        share = 0.5 * math.pi**2 * dt / state.length if self.smooth else torch.full_like(state.length, 2.0)
        return self.noise**2 * share


class SlopeWindows(Windows):
    """Equations Y theta = x' - h in the middle of a window, with x' from the difference over the window.

    This is concurrent learning with a differentiated state, the rival of `IntegralWindows`: the same two
    states make z, but Y is that of one noisy state and not the mean over the window.

    Example:
        >>> plant = adp.ParametricPlant.of_effectiveness(systems.Pendulum())
        >>> adp.SlopeWindows(plant, 0.02).init(torch.zeros(5, 2)).s.shape
        torch.Size([5, 2, 1])

        Shown by `staf experiment=icl`.

    Args:
        model: the plant, whose theta is not used.
        length: s, positive.

    Raises:
        ValueError: if the length is not positive.
    """

    def __init__(self, model: ParametricPlant, length: float) -> None:
        self.model = model
        self.first = self.length = positive_real("SlopeWindows", "length", length)

    def step(self, state: Window, x: Tensor, dt: float) -> tuple[Window, Equation]:
        x, missing = _known(x, state)
        begun = state.elapsed >= 0
        elapsed = torch.where(begun, state.elapsed + dt, 0.0)
        half = 0.5 * state.length
        middle = begun & (elapsed > half - 0.5 * dt) & (elapsed <= half + 0.5 * dt)
        rows = self.model.rows
        s = torch.where(middle[..., None, None], self.model.regressor(x, state.u)[..., rows, :], state.s)
        h = torch.where(middle.unsqueeze(-1), self.model.rest_of(x, state.u)[..., rows], state.z)
        ready = ~missing & begun & (elapsed > state.length - 0.5 * dt)
        moved = state.moved + self.model.difference(x, state.x)  # step by step: an angle may turn meanwhile
        slope = moved[..., rows] / elapsed.clamp(min=dt).unsqueeze(-1)
        begins = ~begun | ready
        after = state._replace(
            x=x,
            s=s,
            z=h,
            elapsed=torch.where(missing, -1.0, torch.where(begins, 0.0, elapsed)),
            moved=torch.where(begins.unsqueeze(-1), 0.0, moved),
            missed=state.missed + missing.to(x),
        )
        return after, Equation(s, slope - h, torch.zeros_like(elapsed), ready)


def _known(x: Tensor, state: Window) -> tuple[Tensor, Tensor]:
    """The measurement, where it is missing the one before, (..., n), and where that is, (...) bool."""
    missing = x.isnan().any(-1)
    return torch.where(missing.unsqueeze(-1), state.x, x), missing


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
        >>> from staf_torch.adp.adaptation.identification import Equation
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

"""The certainty-equivalent policy: identified while it runs, redesigned on the fly, robust while in doubt."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ...lanes.per_row.objects import OfRows
from ...lanes.row_numbers import nonzero
from ...numerics.checks import (
    fail,
    integer,
    non_negative,
    one_or_each,
    positive,
    positive_real,
    real,
    trailing,
)
from ...numerics.derivatives import row_jacobian
from ...numerics.riccati import control_rate, product, riccati_residual, riccati_rows
from ...numerics.rows import chosen
from ..loop.controller import LQR, Controller, Policy
from ..policies.rollout import RolloutPolicy, fitted_slope
from ..problem.cost import Cost, matvec, quadratic
from ..problem.held_plant import Holding
from ..problem.rules import check_objects, regulated
from .identification import Estimate, IntegralWindows, LeastSquares, Window
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


_RESIDUAL = 1e-2  # residual of the Riccati equation, for the model of the moment, of a design that is used


class Redesign:
    """Riccati equations of rows, solved anew at every control of a loop, for a cost without discount."""

    def __init__(self, call: str, cost: Cost, doublings: int) -> None:
        if cost.discount:
            raise fail(call, "cost", "must have no discount", cost.discount)
        self.doublings = integer(call, "doublings", doublings, least=1)
        self.curvature, self.r_inverse = cost.state_curvature(), cost.r_inverse

    def step(self, p: Tensor, a: Tensor, b: Tensor) -> Tensor:
        """P of the model of now, or the one before, (..., n, n), where that is not finite: A, B as in
        `riccati_rows`."""
        found = riccati_rows(a, b, self.curvature, self.r_inverse, doublings=self.doublings)
        return torch.where(torch.isfinite(found).flatten(-2).all(-1)[..., None, None], found, p)

    def solved(self, p: Tensor, a: Tensor, b: Tensor) -> Tensor:
        """Return where P solves the equation of the model of now, (...) bool."""
        return riccati_residual(p, a, control_rate(b, self.r_inverse), self.curvature) < _RESIDUAL


class Adaptation(NamedTuple):
    """Carried state of an `AdaptiveLQR`, a row a trajectory."""

    estimate: Estimate
    certain: Tensor  # (...) 1 where the redesigned policy has the control, 0 where the robust one has it
    alarmed_at: Tensor  # (...) s, when the plant was last found to be another one; -1: never
    time: Tensor  # (...) s
    window: Window
    p: Tensor  # (..., n, n) of the design
    belief: Considered | None = None  # of the state, where it is filtered


class AdaptiveLQR(Controller):
    """u = -K(theta^) e with K = R^-1 B'P and P from the Riccati equation of the model of the moment, where
    that model is certain enough; the control of a robust policy where it is not:

        certain:  c^2 sum_ij C_ij tr(W^-1 M_i W^-1 M_j) < 1,   W = Q + K'RK,   M_i = P (A_i - B_i K) + (..)',

    with C the covariance of theta^ and A_i, B_i the slopes of A and B in theta_i. Then e'Pe falls along the
    linearised loop for every theta within c standard deviations. Each row has its own model, gain and doubt.

    The Riccati equation is solved by structured doubling, anew at every control. With a ``rollout`` the LQR
    of the moment is its base and the model of the moment its model. With a ``filter`` that LQR sees the
    filter's mean in place of what is measured; the identifier and the robust policy see the measurement.

    Where a measured state has a NaN its window is lost, and the result records how often so far as
    ``missed``. The control is then held; with a ``filter`` it is that of the mean, as both policies see it.

    Example:
        >>> plant = adp.ParametricPlant.of_effectiveness(systems.Pendulum())
        >>> cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
        >>> law = adp.LeastSquares([0.6], deviation=0.5)  # the actuator is healthy: theta = 1
        >>> control = adp.AdaptiveLQR(plant, cost, adp.IntegralWindows(plant, 0.05), law)
        >>> run = adp.simulate(control, plant, cost, torch.tensor([[0.5, 0.0]]).double(), dt=0.02, steps=15)
        >>> run["theta"][0, -1].round(decimals=2)
        tensor([1.], dtype=torch.float64)

        Shown by `staf experiment=faults`.

    Args:
        model: the plant; its theta is not used.
        cost: the cost rate, without discount.
        windows: of the integrals.
        law: of theta, with the first estimate.
        robust: the policy in doubt; None for the LQR of the first estimate.
        confidence: c, positive.
        probe: amplitude of a square wave that is added to every input while the model is uncertain, in its
            units, not negative: under a linear feedback alone not all parameters can be told apart.
        doublings: of a design, at least 1.
        rollout: improves the LQR of the moment; its own model and base are not used.
        filter: of the measured state, for the policy of the model of the moment; None for none.

    Raises:
        ValueError: if an argument breaks its rule, or the plant rests at the set-point for some theta only.
    """

    def __init__(
        self,
        model: ParametricPlant,
        cost: Cost,
        windows: IntegralWindows,
        law: LeastSquares,
        *,
        robust: Policy | None = None,
        confidence: float = 3.0,
        probe: float = 0.0,
        doublings: int = 14,
        rollout: RolloutPolicy | None = None,
        filter: ConsiderFilter | None = None,
    ) -> None:
        super().__init__()
        check_objects("AdaptiveLQR", model=model, cost=cost)
        self.model, self.cost = model, regulated("AdaptiveLQR", model, cost)
        p = model.parameters_count
        if len(law.first) != p:
            raise fail("AdaptiveLQR", "law", f"must have the model's {p} parameters", len(law.first))
        if filter is not None and filter.model is not model:
            raise fail("AdaptiveLQR", "filter", "must be of the same model", filter.model)
        self.windows, self.law, self.rollout, self.filter = windows, law, rollout, filter
        self.confidence = positive_real("AdaptiveLQR", "confidence", confidence)
        non_negative("AdaptiveLQR", "probe", probe)
        self.probe = real("AdaptiveLQR", "probe", probe)
        self.redesign = Redesign("AdaptiveLQR", self.cost, doublings)
        self.family = model.family(self.cost.target, self.cost.target_input)
        self.robust: Policy = LQR(model.believing(law.first), cost) if robust is None else robust
        self.theta: Tensor | None = None

    def starting_from(self, theta: Tensor) -> AdaptiveLQR:
        """A copy whose rows have first estimates of their own, (B, p)."""
        other = copy.copy(self)
        other.theta = theta
        return other

    def init(self, x0: Tensor) -> Adaptation:
        trailing(type(self).__name__, "x0", x0, 2)
        zero, filter = x0.new_zeros(len(x0)), self.filter
        estimate, window = self.law.init(x0, self.theta), self.windows.init(x0)
        belief = None if filter is None else filter.init(x0)
        window = self.windows.holding(window, self.cost.input_of(window.u))
        square = x0.new_zeros(*x0.shape, x0.shape[-1])
        return Adaptation(estimate, zero, zero - 1, zero.clone(), window, square, belief)

    def recorded(self, carried: Adaptation) -> dict[str, Tensor]:
        own = {"certain": carried.certain, "alarmed_at": carried.alarmed_at, "missed": carried.window.missed}
        return {**carried.estimate.recorded(), **own}

    def step(self, x: Tensor, now: Adaptation, uniform: Tensor, dt: float) -> tuple[Tensor, Adaptation]:
        window, equation = self.windows.step(now.window, x, dt)
        estimate = self.law.step(now.estimate, equation, dt)
        a, b = self.family.at(estimate.theta)
        p = self.redesign.step(now.p, a, b)
        k = product(product(self.cost.r_inverse.to(b), b.mT), p)
        certain = self.redesign.solved(p, a, b) & (self.doubt(estimate.covariance, p, k) < 1)
        belief, missing = now.belief, x.isnan()
        if self.filter is not None and belief is not None:
            belief = self.filter.step(belief, x, now.window.u, estimate, dt)
            x, missing = torch.where(missing, belief.mean, x), torch.zeros_like(missing)
        u = self._control(x if belief is None else belief.mean, estimate.theta, p, k)
        doubtful = self.robust(x)
        if nonzero(self.probe):
            doubtful = doubtful + self._probing(now.time)
        # What the actuator will give, which the window must know.
        u = self.cost.admissible(torch.where(certain.unsqueeze(-1), u, doubtful))
        (u,) = chosen(missing.any(-1), (now.window.u,), (u,))
        alarmed = estimate.resets > now.estimate.resets
        alarmed_at = torch.where(alarmed, now.time, now.alarmed_at)
        window = self.windows.holding(window, u)
        return u, Adaptation(estimate, certain.to(x), alarmed_at, now.time + dt, window, p, belief)

    def doubt(self, covariance: Tensor, p: Tensor, k: Tensor) -> Tensor:
        """c^2 sum_ij C_ij tr(W^-1 M_i W^-1 M_j) of a covariance C (..., p, p) and a design, P (..., n, n)
        and k = R^-1 B'P (..., m, n): below 1 it is certain, (...)."""
        r = self.cost.r.to(p)
        weight = torch.linalg.inv_ex(self.redesign.curvature.to(p) + product(product(k.mT, r), k))[0]
        slopes = self.family.a_slopes.to(p) - product(self.family.b_slopes.to(p), k.unsqueeze(-3))
        pushed = product(p.unsqueeze(-3), slopes)
        turned = product(weight.unsqueeze(-3), pushed + pushed.mT)  # (..., p, n, n)
        paired = (turned.unsqueeze(-3) * turned.mT.unsqueeze(-4)).sum((-2, -1))
        doubt = self.confidence**2 * (covariance * paired).sum((-2, -1))
        return torch.where(torch.isfinite(doubt), doubt, torch.inf)

    def _control(self, x: Tensor, theta: Tensor, p: Tensor, k: Tensor) -> Tensor:
        """The certainty-equivalent control."""
        if self.rollout is None:
            return self._linear(x, k)
        policy = copy.copy(self.rollout)
        policy._modules = dict(policy._modules)
        for name in ("model", "base", "terminal"):  # modules there, functions here
            policy._modules.pop(name, None)
        policy.model = self.model.believing(theta.unsqueeze(-2))  # one a row, for all its centers
        many_k, many_p = k.unsqueeze(-3), p.unsqueeze(-3)
        policy.base = lambda x: self._linear(x, many_k)
        policy.terminal = lambda x: quadratic(many_p, self.cost.deviation(x))
        values = policy.rollout(policy.basis.centers(x))
        slope = fitted_slope(policy.basis, x, values)
        return self.cost.policy(self.model.believing(theta).effectiveness(x), slope)

    def _linear(self, x: Tensor, k: Tensor) -> Tensor:
        return self.cost.saturate(self.cost.input_of(-matvec(k, self.cost.deviation(x))))

    def _probing(self, time: Tensor) -> Tensor:
        """Square waves, every input's of another period: (..., m)."""
        length = self.windows.length
        turns = [time * (3.141592653589793 / (length * (2 + j))) for j in range(self.model.inputs)]
        return self.probe * torch.stack([(turn + 0.1).sin().sign() for turn in turns], dim=-1)

"""Control of what is measured with noise: outputs, and Kalman filters before any controller."""

from __future__ import annotations

import abc
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ..lanes.per_row.decisions import in_any_row
from ..lanes.per_row.objects import OfRows
from ..numerics.angles import periods_of, wrap_each
from ..numerics.checks import fail, non_negative, object_of, one_or_each, positive, trailing, vector
from ..numerics.derivatives import row_jacobian
from ..numerics.riccati import measured, product
from ..numerics.rows import check_rows
from ..systems import Plant
from .loop.controller import Carried, Controller
from .problem.cost import Output, matvec
from .problem.held_plant import Holding


def gaussian(uniform: Tensor, count: int) -> Tensor:
    """Normal numbers of uniform ones of [-1, 1), by Box and Muller: (..., 2 k) -> (..., count <= 2 k)."""
    first, second = uniform.chunk(2, dim=-1)
    size = (-2 * (0.5 * (1 - first)).log()).sqrt()  # 1 - u > 0, for u is drawn from [-1, 1)
    angle = math.pi * second
    return torch.cat((size * angle.cos(), size * angle.sin()), dim=-1)[..., :count]


class Measured(Controller):
    """A controller that sees y = h(x) + noise in place of x, the noise white and normal.

    Example:
        >>> plant, cost = systems.Pendulum(), adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
        >>> seen = adp.Measured(adp.Feedback(adp.LQR(plant, cost)), noise=0.01, dim=2)
        >>> x0 = torch.tensor([[0.3, 0.0]]).double()
        >>> run = adp.simulate(seen, plant, cost, x0, dt=0.02, steps=150)
        >>> bool(run.state[0, -1].norm() < 0.2), bool(run.state[0, -1].norm() > 1e-6)
        (True, True)

        Shown by `staf experiment=faults`.

    Args:
        controller: of y.
        noise: standard deviation, one number or one an output, in the units of y, not negative. Where it is
            0 nothing is drawn, of rows where it is 0 in all.
        dim: q, entries of y.
        output: h, (..., n) -> (..., q); None for the first q states.

    Raises:
        ValueError: if the noise is negative or has another length.
    """

    def __init__(
        self,
        controller: Controller,
        *,
        noise: float | Sequence[float],
        dim: int,
        output: Output | None = None,
    ) -> None:
        super().__init__()
        self.controller, self.dim, self.output = controller, dim, output
        self.noise = non_negative("Measured", "noise", one_or_each("Measured", "noise", noise, dim))
        # Normal numbers come in pairs: an odd number of outputs takes two points of the state's size.
        self._own = (1 + dim % 2) if in_any_row(self.noise > 0) else 0
        self.period = controller.period

    @property
    def label(self) -> str:
        return self.controller.label

    @property
    def draws(self) -> int:  # type: ignore[override]
        return self._own + self.controller.draws

    def seen(self, x: Tensor) -> Tensor:
        """h(x): (..., n) -> (..., q)."""
        return x[..., : self.dim] if self.output is None else self.output(x)

    def init(self, x0: Tensor) -> Carried:
        trailing(type(self).__name__, "x0", x0, 2)
        return self.controller.init(self.seen(x0))

    def recorded(self, carried: Carried) -> dict[str, Tensor]:
        return self.controller.recorded(carried)

    def step(self, x: Tensor, carried: Carried, uniform: Tensor, dt: float) -> tuple[Tensor, Carried]:
        y = self.seen(x)
        if self._own:
            drawn = uniform[..., : self._own, : self.dim].flatten(-2)
            y = y + self.noise.to(y) * gaussian(drawn, self.dim)
        return self.controller.step(y, carried, uniform[..., self._own :, : self.dim], dt)


class Belief(NamedTuple):
    """Mean and covariance of the state, a row a trajectory."""

    mean: Tensor  # (..., n)
    covariance: Tensor  # (..., n, n)
    u: Tensor  # (..., m) held since the last measurement
    missed: Tensor | None = None  # (..., q) measurements of every output that were missing, where counted


class KalmanFilter(metaclass=OfRows):
    """The state from outputs y = h(x) + noise, with the model of the plant between measurements.

    An entry of y that is NaN is missing: the other outputs are used, without any the model alone goes on, and
    ``missed`` of the belief counts it. Of outputs that are angles y - h(x^) is in [-pi, pi].

    Args:
        model: the plant, of a known number of states.
        output: h, (..., n) -> (..., q).
        noise: standard deviation of every output, q positive numbers.
        process: standard deviation of what disturbs each state in a second, one number or n, not negative:
            the variance grows by its square times the time.
        periodic: outputs that are angles in rad, as a bearing by ``atan2`` is. Those that turn with a
            periodic coordinate of the model, in any unit, are found without.

    Raises:
        ValueError: if an argument breaks its rule.
    """

    def __init__(
        self,
        model: Plant,
        output: Output,
        *,
        noise: Sequence[float],
        process: float | Sequence[float] = 0.0,
        periodic: Sequence[int] = (),
    ) -> None:
        name = type(self).__name__
        object_of(name, Plant, model=model)
        n = model._size()
        noises = vector(name, "noise", noise)
        if not noises or min(noises) <= 0:
            raise fail(name, "noise", "must be positive numbers, one an output", noise)
        self.model, self.output = model, output
        self._held: dict[float, Holding] = {}  # of every period
        self.noise = torch.tensor(noises, dtype=torch.float64, device="cpu")
        self.process = non_negative(name, "process", one_or_each(name, "process", process, n))
        seen = output(torch.zeros(1, n, dtype=torch.float64, device="cpu"))
        if tuple(seen.shape) != (1, len(noises)):
            raise fail(name, "output", f"must map (1, {n}) to (1, {len(noises)})", tuple(seen.shape))
        q = len(noises)
        check_rows(f"{name}(output=...)", output, [torch.zeros(n, dtype=torch.float64, device="cpu")], (q,))
        if not set(periodic) <= set(range(-q, q)):
            raise fail(name, "periodic", f"must be places of {q} outputs", list(periodic))
        angles = {index % q for index in periodic}
        found = periods_of(output, n, model.periodic) if model.periodic else (0.0,) * q
        self.periods = tuple(2 * math.pi if k in angles else found[k] for k in range(q))

    def step(self, belief: Belief, y: Tensor, dt: float, first: Tensor) -> Belief:
        """Return the belief after ``dt`` seconds with the input held, and the measurement y (..., q)
        then; no time has passed in rows whose ``first`` (...), bool, it is."""
        moved = self.predicted(belief, dt)
        mean = torch.where(first.unsqueeze(-1), belief.mean, moved.mean)
        covariance = torch.where(first[..., None, None], belief.covariance, moved.covariance)
        return self.corrected(moved._replace(mean=mean, covariance=covariance), y)

    @abc.abstractmethod
    def predicted(self, belief: Belief, dt: float) -> Belief:
        """The belief after dt seconds without a measurement."""

    @abc.abstractmethod
    def corrected(self, belief: Belief, y: Tensor) -> Belief:
        """The belief with a measurement (..., q), NaN where it is missing."""

    def left(self, y: Tensor, seen: Tensor) -> Tensor:
        """y - seen, of outputs that are angles by the shorter way around: (..., q), (..., q) -> (..., q)."""
        return wrap_each(y - seen, self.periods)

    def counted(self, belief: Belief, y: Tensor | None = None) -> Tensor:
        """`Belief.missed` after a measurement (..., q), or after none."""
        before = belief.missed
        if before is None:
            before = belief.mean.new_zeros(*belief.mean.shape[:-1], len(self.noise))
        return before if y is None else before + y.isnan().to(before)

    def moved(self, x: Tensor, u: Tensor, dt: float) -> Tensor:
        """x after dt seconds with u held: (..., n), (..., m) -> (..., n)."""
        if self.model.period is not None:
            return x + self.model.motion(x, u)
        if dt not in self._held:
            self._held[dt] = Holding(type(self).__name__, self.model, None, dt)
        return self._held[dt](x, u)[0]

    def disturbance(self, like: Tensor, dt: float) -> Tensor:
        """The covariance that dt seconds add, (n, n)."""
        return torch.diag(self.process.to(like).square() * dt)


class ExtendedKalman(KalmanFilter):
    """Mean and covariance by the derivatives of the step and the output at the mean:

        P- = F P F' + Q dt,   k = P- h / (h'P- h + r),   x^ += k (y - h(x^)),   P = P- - k h'P-,

    the outputs one after the other.

    Example:
        >>> plant = systems.Pendulum()
        >>> sees_angle = adp.ExtendedKalman(plant, lambda x: x[..., :1], noise=[0.01])
        >>> from staf_torch.adp.estimation import Belief
        >>> unknown = Belief(torch.zeros(1, 2), torch.eye(2)[None], torch.zeros(1, 1))
        >>> sees_angle.corrected(unknown, torch.tensor([[0.5]])).mean.round(decimals=2)
        tensor([[0.5000, 0.0000]])

        Shown by `tests/adp/estimation/test_kalman.py`.

    Args: see `KalmanFilter`.
    """

    def predicted(self, belief: Belief, dt: float) -> Belief:
        def step(x: Tensor) -> Tensor:
            return self.moved(x, belief.u, dt)

        mean, slope = row_jacobian(step, belief.mean)
        covariance = product(product(slope, belief.covariance), slope.mT)
        return Belief(mean, covariance + self.disturbance(mean, dt), belief.u, self.counted(belief))

    def corrected(self, belief: Belief, y: Tensor) -> Belief:
        mean, covariance = belief.mean, belief.covariance
        seen, slope = row_jacobian(self.output, mean)
        missing, variance = y.isnan(), self.noise.to(y).square()
        left = self.left(torch.where(missing, seen, y), seen)
        start = mean
        for k in range(y.shape[-1]):
            h = slope[..., k, :]
            ph = matvec(covariance, h)
            gain = ph / ((h * ph).sum(-1) + variance[k]).unsqueeze(-1)
            gain = torch.where(missing[..., k : k + 1], 0.0, gain)
            # What the outputs before have changed counts to first order, as everywhere in this filter.
            new = left[..., k] - (h * (mean - start)).sum(-1)
            mean = mean + gain * new.unsqueeze(-1)
            covariance = measured(covariance, gain, h, variance[k])
        return Belief(mean, covariance, belief.u, self.counted(belief, y))


class UnscentedKalman(KalmanFilter):
    """Mean and covariance from 2n + 1 points mean, mean +- sqrt(n + 1) L e_i that are moved and measured.

    Example:
        >>> plant = systems.Pendulum()
        >>> sees_sine = adp.UnscentedKalman(plant, lambda x: x[..., :1].sin(), noise=[0.01])
        >>> from staf_torch.adp.estimation import Belief
        >>> unknown = Belief(torch.zeros(1, 2), 0.01 * torch.eye(2)[None], torch.zeros(1, 1))
        >>> sees_sine.corrected(unknown, torch.tensor([[0.1]])).mean.round(decimals=2)
        tensor([[0.1000, 0.0000]])

        Shown by `tests/adp/estimation/test_kalman.py`.

    Args: see `KalmanFilter`.

    Source: Julier and Uhlmann, "Unscented filtering and nonlinear estimation", Proc. IEEE 92 (2004).
    """

    def predicted(self, belief: Belief, dt: float) -> Belief:
        points, weights = self._points(belief)
        held = belief.u.unsqueeze(-2).expand(*points.shape[:-1], -1)
        mean, away = _mean(self.moved(points, held, dt), weights, self.model.difference)
        spread = product((weights * away).mT, away)
        return Belief(mean, spread + self.disturbance(mean, dt), belief.u, self.counted(belief))

    def corrected(self, belief: Belief, y: Tensor) -> Belief:
        points, weights = self._points(belief)
        seen, off = _mean(self.output(points), weights, self.left)
        missing, variance = y.isnan(), torch.diag(self.noise.to(y).square())
        off = torch.where(missing.unsqueeze(-2), 0.0, off)
        inverse = torch.linalg.inv_ex(product((weights * off).mT, off) + variance)[0]
        away = points - belief.mean.unsqueeze(-2)
        gain = product(product((weights * away).mT, off), inverse)
        mean = belief.mean + matvec(gain, self.left(torch.where(missing, seen, y), seen))
        # The sum of squares that P - k S k' is, which rounding leaves positive; of no measurement P itself.
        apart = away - product(off, gain.mT)
        covariance = product((weights * apart).mT, apart) + product(product(gain, variance), gain.mT)
        none = missing.all(-1)[..., None, None]
        covariance = torch.where(none, belief.covariance, covariance)
        return Belief(mean, covariance, belief.u, self.counted(belief, y))

    def _points(self, belief: Belief) -> tuple[Tensor, Tensor]:
        """The points (..., 2n + 1, n) and their weights (2n + 1, 1)."""
        n = belief.mean.shape[-1]
        root = torch.linalg.cholesky_ex(belief.covariance)[0].mT * (n + 1) ** 0.5
        middle = belief.mean.unsqueeze(-2)
        weights = belief.mean.new_full((2 * n + 1, 1), 0.5 / (n + 1))
        weights[0] = 1 / (n + 1)
        return torch.cat((middle, middle + root, middle - root), dim=-2), weights


class Observing(NamedTuple):
    """Carried state of `Observed`."""

    belief: Belief
    steps: Tensor  # (B,) measurements so far
    inner: Carried  # of the controller behind it


class Observed(Controller):
    """A controller of x that is told the mean of a Kalman filter in place of x; what it sees is y. The result
    records the filter's ``mean`` and ``covariance``, and ``outputs_missed``: of each output, how many
    measurements were NaN so far.

    Example:
        >>> plant, cost = systems.Pendulum(), adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
        >>> def angle(x):
        ...     return x[..., :1]
        >>> filter = adp.ExtendedKalman(plant, angle, noise=[0.01], process=0.01)
        >>> inside = adp.Observed(adp.Feedback(adp.LQR(plant, cost)), filter, deviation=0.5)
        >>> outside = adp.Measured(inside, noise=0.01, dim=1, output=angle)
        >>> x0 = torch.tensor([[0.3, -0.2]]).double()
        >>> run = adp.simulate(outside, plant, cost, x0, dt=0.02, steps=100)
        >>> bool(run.state[0, -1].norm() < 0.1), bool(run.diverged)
        (True, False)

        Shown by `tests/adp/estimation/test_kalman.py`.

    Args:
        controller: of the state.
        filter: the Kalman filter.
        deviation: of the first guess of the state, positive, one number or n.
        mean: that guess, n numbers; None for the plant's equilibrium.

    Raises:
        ValueError: if an argument breaks its rule.
    """

    def __init__(
        self,
        controller: Controller,
        filter: KalmanFilter,
        *,
        deviation: float | Sequence[float],
        mean: Sequence[float] | None = None,
    ) -> None:
        super().__init__()
        n = filter.model._size()
        spread = positive("Observed", "deviation", one_or_each("Observed", "deviation", deviation, n))
        guess = filter.model.equilibrium()
        if mean is not None:
            guess = torch.tensor(vector("Observed", "mean", mean, n), dtype=torch.float64, device="cpu")
        self.controller, self.filter = controller, filter
        self.guess, self.deviation = guess, spread
        self.draws, self.period = controller.draws, controller.period

    @property
    def label(self) -> str:
        return f"{self.controller.label} of observed states"

    def init(self, x0: Tensor) -> Observing:
        trailing(type(self).__name__, "x0", x0, 2)
        rows, n, m = len(x0), len(self.guess), self.filter.model.inputs
        covariance = torch.diag(self.deviation.to(x0).square()).expand(rows, n, n).clone()
        mean = self.guess.to(x0).expand(rows, n).clone()
        missed = x0.new_zeros(rows, len(self.filter.noise))
        belief = Belief(mean, covariance, x0.new_zeros(rows, m), missed)
        return Observing(belief, x0.new_zeros(rows), self.controller.init(mean))

    def recorded(self, carried: Observing) -> dict[str, Tensor]:
        belief, _, inner = carried
        own = {"mean": belief.mean, "covariance": belief.covariance}
        if belief.missed is not None:
            own["outputs_missed"] = belief.missed
        return {**self.controller.recorded(inner), **own}

    def step(self, x: Tensor, carried: Observing, uniform: Tensor, dt: float) -> tuple[Tensor, Observing]:
        belief, steps, inner = carried
        belief = self.filter.step(belief, x, dt, steps == 0)
        u, inner = self.controller.step(belief.mean, inner, uniform, dt)
        bounds = self.filter.model.bounds
        held = u if bounds is None else bounds.clip(u)
        return u, Observing(belief._replace(u=held), steps + 1, inner)


def _mean(
    points: Tensor, weights: Tensor, apart: Callable[[Tensor, Tensor], Tensor]
) -> tuple[Tensor, Tensor]:
    """Return the weighted mean (..., k) of points (..., P, k), the first of them in the middle, and what
    each is away from it; weights (P, 1), ``apart`` the difference of two by the shorter way around."""
    middle = points[..., :1, :]
    away = apart(points, middle)
    off = (weights * away).sum(-2, keepdim=True)
    return (middle + off).squeeze(-2), away - off

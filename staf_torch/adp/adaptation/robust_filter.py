"""A safety filter for a plant whose parameters are not known: safe for all that they may still be."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ...lanes.tree import flatten, unflatten
from ...numerics.checks import fail, positive_real, trailing, vector
from ...numerics.rows import chosen
from ..loop.controller import Carried, Controller
from ..safety.conditions import Constraint, listed
from ..safety.quadratic_program import nearest_admissible
from ..safety.safety_filter import INFEASIBLE, SafetyFilter
from .identification import Estimate, IntegralWindows, LeastSquares, Window
from .parametric import ChangingPlant, ParametricPlant

_FAR = 1e300  # h before anything was seen: finite, as what is carried must be
_PASSES = 2  # linearisations of the conditions in u


class Guarded(NamedTuple):
    """Carried state of a `RobustFilter`, a row a trajectory."""

    inner: Carried  # of the controller behind it
    estimate: Estimate
    window: Window
    time: Tensor  # (...) s
    least_margin: Tensor  # (...) smallest h so far
    largest_slack: Tensor  # (...) largest shortfall of a condition so far
    acted: Tensor  # (...) steps in which the control was another than the wanted one


class RobustFilter(Controller):
    """The control nearest to the wanted one that keeps h(x, t) >= 0 for every theta that is still possible:

        max(low, theta^ - c s) <= theta <= min(high, theta^ + c s),

    with s the standard deviations of the estimate and ``low``, ``high`` what was known before. The condition
    of `SafetyFilter` is asked at the corners of that box and the largest demand counts; it is affine in theta
    up to the length of a hold where inputs act in a known way. As the estimate sharpens, the filter lets go.

    Where a measured state has a NaN no condition can be asked: the control is held, nothing is learned, and
    the result records how often so far as ``missed``. The controller's own carried state stays as it was,
    unless it gave a control without the state.

    Example:
        >>> trolley = systems.Linear([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]])
        >>> plant = adp.ParametricPlant.of_effectiveness(trolley)
        >>> def wall(x, t):
        ...     return x[:, 0] + 0.1
        >>> wanted = adp.Feedback(adp.LQR(plant, adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)))
        >>> windows, law = adp.IntegralWindows(plant, 0.1), adp.LeastSquares([0.7], deviation=0.3)
        >>> box = {"theta_low": [0.4], "theta_high": [1.0]}
        >>> safe = adp.RobustFilter(wanted, plant, wall, windows, law, dt=0.02, **box)
        >>> cost, x0 = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1), torch.tensor([[1.0, -2.0]]).double()
        >>> run = adp.simulate(safe, plant, cost, x0, steps=15)
        >>> bool(run["least_margin"][0, -1] > 0), run["theta"][0, -1].round(decimals=2)
        (True, tensor([1.], dtype=torch.float64))

        Shown by `tests/adp/adaptation/test_robust_filter.py`.

    Args:
        controller: of the wanted control.
        plant: its theta is not used.
        constraints: h(x, t), as in `SafetyFilter`.
        windows: of the integrals.
        law: of theta.
        dt: s, for which a control is held.
        theta_low, theta_high: p numbers, below and above which no parameter is.
        confidence: c, positive.
        decay: as in `SafetyFilter`, and so are ``degree`` and ``margin``.

    Raises:
        ValueError: if an argument breaks its rule.
    """

    def __init__(
        self,
        controller: Controller,
        plant: ParametricPlant,
        constraints: Constraint | Sequence[Constraint],
        windows: IntegralWindows,
        law: LeastSquares,
        *,
        dt: float,
        theta_low: Sequence[float],
        theta_high: Sequence[float],
        confidence: float = 4.0,
        decay: float | Sequence[float] = 2.0,
        degree: int | Sequence[int] = 2,
        margin: float | Sequence[float] = 0.0,
    ) -> None:
        super().__init__()
        p, n = plant.parameters_count, plant._size()
        self.low = torch.tensor(
            vector("RobustFilter", "theta_low", theta_low), dtype=torch.float64, device="cpu"
        )
        self.high = torch.tensor(
            vector("RobustFilter", "theta_high", theta_high), dtype=torch.float64, device="cpu"
        )
        if self.low.shape != (p,) or self.high.shape != (p,) or not bool((self.low <= self.high).all()):
            rule = f"must be {p} numbers, none above that of theta_high"
            raise fail("RobustFilter", "theta_low", rule, theta_low)
        self.confidence = positive_real("RobustFilter", "confidence", confidence)
        self.controller, self.plant, self.windows, self.law = controller, plant, windows, law
        several = listed("RobustFilter", constraints, plant)

        def of_states(h: Constraint) -> Constraint:
            return lambda z, t: h(z[:, :n], t)  # of the plant's states alone

        self.filter = SafetyFilter(
            lambda z: z[..., : plant.inputs] * 0,  # only its conditions are asked
            ChangingPlant(plant),
            [of_states(h) for h in several],
            dt=dt,
            decay=decay,
            degree=degree,
            margin=margin,
        )
        self.period, self.draws = dt, controller.draws

    def init(self, x0: Tensor) -> Guarded:
        trailing(type(self).__name__, "x0", x0, 2)
        zero, inner = x0.new_zeros(len(x0)), self.controller.init(x0)
        estimate, window = self.law.init(x0), self.windows.init(x0)
        unseen = torch.full_like(zero, min(_FAR, torch.finfo(zero.dtype).max))
        return Guarded(inner, estimate, window, zero, unseen, zero.clone(), zero.clone())

    def recorded(self, carried: Guarded) -> dict[str, Tensor]:
        own = {name: getattr(carried, name) for name in Guarded._fields[-3:]}
        own["missed"] = carried.window.missed
        return {**self.controller.recorded(carried.inner), **carried.estimate.recorded(), **own}

    def step(self, x: Tensor, now: Guarded, uniform: Tensor, dt: float) -> tuple[Tensor, Guarded]:
        missing = x.isnan().any(-1)
        wanted, inner = self.controller.step(x, now.inner, uniform, dt)
        inner = _kept(missing & ~torch.isfinite(wanted).all(-1), now.inner, inner)
        window, equation = self.windows.step(now.window, x, dt)
        estimate = self.law.step(now.estimate, equation, dt)
        u, h, slack = self._restrained(x, wanted, now.time, estimate)
        if self.plant.bounds is not None:
            u = self.plant.bounds.clip(u)
        acted = (u != wanted).any(-1).to(x)
        least, most = torch.minimum(now.least_margin, h), torch.maximum(now.largest_slack, slack)
        before = now.window.u, now.least_margin, now.largest_slack, torch.zeros_like(acted)
        u, least, most, acted = chosen(missing, before, (u, least, most, acted))
        window = self.windows.holding(window, u)
        return u, Guarded(inner, estimate, window, now.time + dt, least, most, now.acted + acted)

    def _restrained(
        self, x: Tensor, wanted: Tensor, time: Tensor, estimate: Estimate
    ) -> tuple[Tensor, Tensor, Tensor]:
        """u, the least h and the shortfall."""
        filter = self.filter
        spread = self.confidence * estimate.covariance.diagonal(dim1=-2, dim2=-1).sqrt()
        low = torch.maximum(self.low.to(x), estimate.theta - spread)
        high = torch.minimum(self.high.to(x), estimate.theta + spread)
        corners = [
            torch.stack([(low, high)[side][..., k] for k, side in enumerate(sides)], dim=-1)
            for sides in itertools.product((0, 1), repeat=low.shape[-1])
        ]
        clock = torch.full_like(x[..., :1], 2.0)  # the plant of the filter has not changed yet
        states = [torch.cat((x, theta, theta, clock), dim=-1) for theta in corners]
        count, every = len(states), torch.cat(states)
        least_u, most_u = filter.bounds.low.to(x), filter.bounds.high.to(x)
        u, met, slack, margin = wanted, None, torch.zeros_like(time), torch.zeros_like(time)
        for _ in range(_PASSES):
            # All corners at once: a call of a few rows takes as long as one of many.
            parts = filter.inequalities(every, u.repeat(count, 1), time.repeat(count))
            found = list(zip(*(part.chunk(count) for part in parts), strict=True))
            normal = sum((part[0] for part in found[1:]), found[0][0]) / count
            # The demand of every corner, taken over to the mean normal at this u.
            demands = [part[1] + ((normal - part[0]) * u.unsqueeze(-2)).sum(-1) for part in found]
            demand = torch.stack(demands, dim=-1).amax(-1)
            if met is None:
                met = ((normal * u.unsqueeze(-2)).sum(-1) >= demand).all(-1)
                margin = found[0][2].amin(-1)
            nearest = nearest_admissible(wanted, normal, demand, least_u, most_u, filter.table)
            u, slack = nearest.point, nearest.shortfall
        assert met is not None
        slack = torch.where(met, 0.0, slack)
        outside = filter.hold * filter.conditions.decay.to(x).amax() * -margin  # h < 0 is never fine
        slack = torch.where(margin < 0, torch.maximum(slack, torch.clamp(outside, min=2 * INFEASIBLE)), slack)
        return torch.where(met.unsqueeze(-1), wanted, u), margin, slack


def _kept(rows: Tensor, before: Carried, after: Carried) -> Carried:
    """Return the carry of before in ``rows`` (B,), that of after in the others."""
    (old, _), (new, structure) = flatten(before), flatten(after)
    return unflatten(structure, iter(chosen(rows, tuple(old), tuple(new))))

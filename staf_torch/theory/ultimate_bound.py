"""A-priori ultimate bounds of a gradient chase: by our constants, and by the paper's own."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import NamedTuple, cast

import torch
from torch import Tensor

from ..approximation.basis import StaFBasis, Target
from ..engine import along, gram_rates
from ..lanes.gradients import grad
from ..lanes.per_row.objects import refuse_rows
from ..numerics.checks import fail, integer, positive_real, trailing
from ..numerics.linalg import condition_number
from ..optim import SteepestDescent, UpdateLaw
from ..signs import Sign

_STARTS, _ASCENTS = 8, 60


class DriftConstants(NamedTuple):
    """The worst over a set of states, in the norm |v|^2 = v'K(c(x))v of each.

    Example:
        >>> theory.DriftConstants(condition_number=2.0, speed=1.0, growth=0.0).speed
        1.0

        Shown by `staf experiment=laws`.
    """

    condition_number: float  # kappa = max lambda_max(K) / lambda_min(K)
    speed: float  # W = max |w'|, of the ideal weights, a second
    growth: float  # G = max(0, max lambda_max(K^-1 K') / 2), 1/s: how fast the norm itself can grow


class UltimateBound(NamedTuple):
    """limsup of the excess F(a_k) - F(w_k); inf where nothing is promised."""

    before: float  # as brought to x_k
    after: float  # as corrected at x_k


@Sign("drift_constants")
def drift_constants(basis: StaFBasis, target: Target, states: Tensor, velocities: Tensor) -> DriftConstants:
    """The constants of `ultimate_bound` over given states.

    They hold for trajectories that stay among these states; sample the region, or a trajectory, densely.

    Example:
        >>> basis = StaFBasis(GaussianKernel(), StateFollowingCenters(rings(3), radius=0.1))
        >>> plant = systems.Oscillator()
        >>> states = systems.simulate(plant, torch.tensor([[1.0, 0.0]]).double(), dt=0.5, steps=12)[0]
        >>> constants = theory.drift_constants(basis, targets.Paper(), states, plant.drift(states))
        >>> constants.growth >= 0
        True

        Shown by `staf experiment=laws`.

    Args:
        basis: kernel and centers.
        target: V.
        states: x, (..., n).
        velocities: x' there, (..., n), in units of the state a second: ``system.drift(states)``.

    Raises:
        ValueError: if the shapes differ, or K is numerically singular at one of the states.
    """
    refuse_rows("drift_constants", basis=basis, target=target)
    trailing("drift_constants", "states", states, dims=1, last=basis.dim)
    if velocities.shape != states.shape:
        raise ValueError(
            f"`drift_constants(velocities=...)` must have the shape of the states, {tuple(states.shape)}; "
            f"got {tuple(velocities.shape)}."
        )
    rates = gram_rates(basis, target, states, velocities)
    factor, failed = torch.linalg.cholesky_ex(rates.gram)
    if bool((failed > 0).any()) or not bool(torch.isfinite(rates.gram).all()):
        raise fail("drift_constants", "states", "must have a positive definite K(c(x)) each", states)
    gain = gain_rate = states.new_zeros(states.shape[:-1])  # g(x), and its derivative along the velocity
    if basis.kernel.log_gain(states) is not None:
        gain, gain_rate = along(lambda x: cast(Tensor, basis.kernel.log_gain(x)), states, velocities)
    lower = functools.partial(torch.linalg.solve_triangular, factor, upper=False)

    # With L L' = e^{-g} K, in orthonormal coordinates L'v: K^-1 K' is L^-1 gram' L^-T + g', and
    # w' = e^{-g} (gram^-1 (V' - gram' w~) - g' w~), w~ = e^g w = gram^-1 V.
    inner = lower(lower(rates.gram_rate).mT)
    inner = (inner + inner.mT) / 2 + gain_rate[..., None, None] * torch.eye(basis.count, device="cpu").to(
        inner
    )
    value = lower(rates.values.unsqueeze(-1))
    speed = (lower(rates.values_rate.unsqueeze(-1)) - inner @ value).squeeze(-1).norm(dim=-1)
    growth = torch.linalg.eigvalsh(inner)[..., -1] / 2
    return DriftConstants(
        condition_number=float(condition_number(rates.gram).max()),
        speed=float((speed * (-gain / 2).exp()).max()),
        growth=max(0.0, float(growth.max())),
    )


@Sign("ultimate_bound")
def ultimate_bound(
    constants: DriftConstants, law: UpdateLaw, *, dt: float, inner_steps: int
) -> UltimateBound:
    """The a-priori radius that the excess of a chase without predictor ends in.

    With q = delta(kappa)^{its/2} the law's contraction of sqrt(e) and D = W (e^{G dt} - 1) / G >= W dt the
    way of the ideal weights in a step, sqrt(e) before the correction follows

        s_{k+1} <= q e^{G dt} s_k + D,   so   limsup s <= D / (1 - q e^{G dt}),

    and q times that after it: the excess is O(dt^2), where the theorem of the paper gives O(dt).

    Example:
        >>> constants = theory.DriftConstants(condition_number=50.0, speed=10.0, growth=0.1)
        >>> bound = theory.ultimate_bound(constants, optim.SteepestDescent(), dt=1e-6, inner_steps=10)
        >>> bound.after < bound.before
        True

        Shown by `staf experiment=laws`.

    Args:
        constants: of the region or trajectory, `drift_constants`.
        law: an update law with a known `contraction`.
        dt: step, s.
        inner_steps: iterations a step.

    Raises:
        ValueError: if the law has no known rate, or a number breaks its rule.

    Source: Rosenfeld et al., section 6, with the norm that changes along the way taken into account.
    """
    positive_real("ultimate_bound", "dt", dt)
    q = _contraction("ultimate_bound", constants, law, inner_steps)
    growth = constants.growth * dt
    left = 1 - q * math.exp(growth) if growth <= 700 else 0.0
    if left <= 0:
        return UltimateBound(math.inf, math.inf)
    way = _way(constants, dt)
    before, after = way / left, q * way / left
    return UltimateBound(before * before, after * after)  # inf past the largest number, where ** raises


def step_for_bound(
    constants: DriftConstants, law: UpdateLaw, *, excess: float, inner_steps: int, before: bool = False
) -> float:
    """The largest dt (s) whose `ultimate_bound` is at most ``excess``, after the correction or before it.

    Example:
        >>> constants = theory.DriftConstants(condition_number=50.0, speed=10.0, growth=0.1)
        >>> dt = theory.step_for_bound(constants, optim.SteepestDescent(), excess=0.35, inner_steps=10)
        >>> 0 < dt < 1
        True

        Shown by `staf experiment=laws`.

    Raises:
        ValueError: if the law has no known rate, or a number breaks its rule.
    """
    radius = math.sqrt(positive_real("step_for_bound", "excess", excess))
    q = _contraction("step_for_bound", constants, law, inner_steps)
    way = constants.speed * (1.0 if before else q)  # W q expm1(G dt) / G + q r expm1(G dt) <= r (1 - q)
    room, growth = radius * (1 - q), constants.growth
    if way == 0 and q * growth == 0:
        return math.inf
    if growth == 0:
        return room / way
    return math.log1p(room / (way / growth + q * radius)) / growth


@Sign("steps_for_bound")
def steps_for_bound(
    constants: DriftConstants, law: UpdateLaw, *, excess: float, dt: float, before: bool = False
) -> int | None:
    """The fewest iterations a step whose `ultimate_bound` is at most ``excess``; None where none are enough.

    Example:
        >>> constants = theory.DriftConstants(condition_number=50.0, speed=10.0, growth=0.1)
        >>> theory.steps_for_bound(constants, optim.SteepestDescent(), excess=0.35, dt=1e-6) >= 1
        True

        Shown by `staf experiment=laws`.

    Raises:
        ValueError: if the law has no known rate, or a number breaks its rule.
    """
    radius = math.sqrt(positive_real("steps_for_bound", "excess", excess))
    growth = positive_real("steps_for_bound", "dt", dt) * constants.growth
    one = _contraction("steps_for_bound", constants, law, 1)
    if growth > 700:
        return None
    way = _way(constants, dt)
    # The largest contraction of a whole step that will do.
    q = (1 - way / radius) * math.exp(-growth) if before else radius / (way + radius * math.exp(growth))
    if q <= 0 or one >= 1:
        return None
    return 1 if one <= q else math.ceil(math.log(q) / math.log(one) - 1e-12)


def _contraction(call: str, constants: DriftConstants, law: UpdateLaw, inner_steps: int) -> float:
    """q = delta(kappa)^{its/2}."""
    integer(call, "inner_steps", inner_steps, least=1)
    rate = law.contraction(torch.tensor(constants.condition_number, dtype=torch.float64, device="cpu"))
    if rate is None:
        raise fail(call, "law", "must have a known contraction an iteration", type(law).__name__)
    return math.pow(float(rate), inner_steps / 2)


def _way(constants: DriftConstants, dt: float) -> float:
    """D = W (e^{G dt} - 1) / G."""
    growth = constants.growth * dt
    return constants.speed * dt * (math.expm1(growth) / growth if growth > 0 else 1.0)


class PaperStep(NamedTuple):
    """The constants of the gradient chase theorem over given states, and the step that they allow."""

    dt: float  # s
    contraction: float  # delta, of one iteration
    speed: float  # R_0 + R_3 over the M centers: max |c'|, in R^{nM}
    gradient: float  # R_1 = max |grad_c F(a, c)|, |a| <= R
    ideal_gradient: float  # R_2 = max |grad_c F(w(c), c)|
    radius: float  # R = max(|a^0|, |w(c)|)


def paper_step(
    basis: StaFBasis,
    target: Target,
    states: Tensor,
    velocities: Tensor,
    *,
    excess: float,
    initial_weights: Tensor | None = None,
) -> PaperStep:
    """dt = excess (1 - delta) / (2 max|c'| max(R_1, R_2)), one iteration a step.

    The proof bounds the two drift terms |eps_1| <= R_1 |c^{k+1} - c^k| and |eps_2| <= R_2 |c^{k+1} - c^k| by
    excess (1 - delta) / 2 each. As printed, R_1 is the gradient in a and not in c, over the wrong ball, and
    |c'| <= R_0 + R_3 lacks the sqrt(M) of M centers that move at once. For the paper's simulation and an
    excess of 0.35, which it reaches with dt = 1e-2 s, this step is 5.2e-7 s. R_1 is found by ascent
    from a few starts: a maximum that it misses would make the step smaller still.

    Example:
        >>> basis = StaFBasis(GaussianKernel(), StateFollowingCenters(rings(3), radius=0.1))
        >>> plant = systems.Oscillator()
        >>> states = systems.simulate(plant, torch.tensor([[1.0, 0.0]]).double(), dt=0.5, steps=12)[0]
        >>> found = theory.paper_step(basis, targets.Paper(), states, plant.drift(states), excess=0.35)
        >>> 0 < found.dt < 1  # s
        True

        Shown by `staf experiment=laws`.

    Args:
        basis: kernel and centers.
        target: V.
        states: x, (N, n), sampling the region or trajectory.
        velocities: x' there, (N, n).
        excess: the radius wanted, positive.
        initial_weights: a^0, (M,), the paper's w; zero by default.

    Raises:
        ValueError: if ``excess`` is not positive, or the states are not (N, n).

    Source: Rosenfeld et al., section 6; MATH.md, section 2.
    """
    refuse_rows("paper_step", basis=basis, target=target)
    positive_real("paper_step", "excess", excess)
    trailing("paper_step", "states", states, dims=2, last=basis.dim)
    centers, moving = along(basis.centers, states, velocities)
    weights = basis.ideal_weights(states, target)
    radius = weights.norm(dim=-1).max()
    if initial_weights is not None:
        radius = torch.maximum(radius, initial_weights.norm())

    def slope(a: Tensor) -> Tensor:
        """|grad_c F(a, c)|: (..., M) -> (...)."""

        def error(c: Tensor) -> Tensor:
            quadratic = torch.einsum("...i,...ij,...j->...", a, basis.kernel(c, c), a)
            return (quadratic - 2 * (a * target(c)).sum(-1)).sum()

        gradient: Tensor = grad(error)(centers.expand(*a.shape, -1)).flatten(-2).norm(dim=-1)
        return gradient

    kappa = condition_number(basis.gram_structure(states).scaled()).max()
    delta = float(SteepestDescent().contraction(kappa))
    speed = float(moving.flatten(-2).norm(dim=-1).max())
    largest, ideal = float(_ascend(slope, weights, radius)), float(slope(weights).max())
    dt = excess * (1 - delta) / (2 * speed * max(largest, ideal)) if speed > 0 else torch.inf
    return PaperStep(dt, delta, speed, largest, ideal, float(radius))


def _ascend(function: Callable[[Tensor], Tensor], like: Tensor, radius: Tensor) -> Tensor:
    """max of a function (..., M) -> (...) over |a| <= radius at each state, ``like`` being (..., M), by
    normalised gradient ascent on the sphere from all starts side by side."""
    generator = torch.Generator().manual_seed(0)
    drawn = [
        torch.randn(like.shape[-1], generator=generator, dtype=torch.float64, device="cpu")
        for _ in range(_STARTS)
    ]
    starts = torch.stack(drawn).to(like)
    starts = radius * starts / starts.norm(dim=-1, keepdim=True)
    a = starts.view(_STARTS, *[1] * (like.dim() - 1), -1).expand(-1, *like.shape)
    for _ in range(_ASCENTS):
        gradient: Tensor = grad(lambda at: function(at).sum())(a)
        a = radius * gradient / gradient.norm(dim=-1, keepdim=True)
    return function(a).max()

"""The Bellman equation and its error, and the laws by which an actor-critic moves its weights."""

from __future__ import annotations

import abc
import dataclasses
import math
from collections.abc import Callable
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor

from ...lanes import traced_as
from ...lanes.per_row.objects import OfRows
from ...lanes.trace import factorisations
from ...numerics.checks import fail, non_negative, positive_real, trailing
from ...numerics.derivatives import slope_of
from ...systems import ControlAffineSystem
from ..problem.cost import Cost, matvec
from ..problem.rules import check_objects, check_value
from .bases import ValueBasis

_UNROLLED = 12  # unknowns up to which elimination by whole-batch operations is the faster one
Gain = float | Tensor
"""A number, or one a row of `rows`."""


def value_gradient(value: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    """grad V, row by row, 0 where V is constant, and differentiable where x or V is: (..., n) -> (..., n)."""
    learnt = torch.is_grad_enabled() and (x.requires_grad or value(x).requires_grad)
    with torch.enable_grad():
        at = x if learnt and x.requires_grad else x.detach().requires_grad_()
        return slope_of(value(at), at, create_graph=learnt)


def hjb_residual(
    system: ControlAffineSystem, cost: Cost, value: Callable[[Tensor], Tensor], x: Tensor
) -> Tensor:
    """min_u of x'Qx + U(u) + grad V'(f + g u), which is 0 everywhere for V = V* alone.

    Example:
        >>> plant = systems.TwoState()
        >>> cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
        >>> x = torch.tensor([[1.0, 0.5]]).double()
        >>> optimal = lambda x: 0.5 * x[..., 0] ** 2 + x[..., 1] ** 2
        >>> bool(adp.hjb_residual(plant, cost, optimal, x).abs().max() < 1e-12)
        True

        Shown by `staf experiment=adp`.

    Args:
        system: the plant.
        cost: the cost rate.
        value: V, (..., n) -> (...), differentiable.
        x: (..., n).

    Returns:
        (...).

    Source: MATH.md section 4; for a quadratic cost x'Qx + f'grad V - 1/4 grad V' g R^-1 g' grad V.
    """
    check_objects("hjb_residual", system=system, cost=cost)
    trailing("hjb_residual", "x", x, 1, cost.dim)
    check_value("hjb_residual", "value", value, cost)
    gradient = value_gradient(value, x)
    g = system.effectiveness(x)
    u = cost.policy(g, gradient)
    return cost.rate(x, u) + (gradient * (system.drift(x) + matvec(g, u))).sum(-1)


class BellmanTerms(NamedTuple):
    """Terms of the Bellman equation at some points, with the actor's control there.

    The Bellman error of the critic weights Wc is delta = rate + regressor'Wc.
    """

    control: Tensor  # u = policy(Ds'Wa), (..., P, m)
    regressor: Tensor  # w = Ds (f + g u), (..., P, M)
    rate: Tensor  # r = x'Qx + U(u), (..., P)
    push: Tensor  # G Wa = Ds g R^-1 g' Ds' Wa = -2 Ds g u, with bounds that of the u they leave, (..., P, M)


def bellman_terms(
    basis: ValueBasis, system: ControlAffineSystem, cost: Cost, points: Tensor, at: Tensor, actor: Tensor
) -> BellmanTerms:
    """Return the terms at ``points`` y (..., P, n), whose centers stand around the states ``at`` (..., P,
    n), for the actor weights Wa (..., M)."""
    gradient = basis.gradient(points, at)  # (..., P, M, n)
    g = system.effectiveness(points)
    value_gradient = (gradient * actor[..., None, :, None]).sum(-2)  # Ds'Wa, (..., P, n)
    u = cost.policy(g, value_gradient)
    driven = matvec(g, u)
    regressor = matvec(gradient, system.drift(points) + driven)
    pushed = matvec(g, cost.effort(u))
    return BellmanTerms(u, regressor, cost.rate(points, u), -2 * matvec(gradient, pushed))


def bellman_error(terms: BellmanTerms, critic: Tensor) -> Tensor:
    """delta = r + w'Wc: (..., M) -> (..., P)."""
    return terms.rate + (terms.regressor * critic.unsqueeze(-2)).sum(-1)


@dataclasses.dataclass(frozen=True)
class Gains(metaclass=OfRows):
    """Gains of the actor-critic laws; the defaults are the published ones of the two-state example.

    Each is a number, or by `staf_torch.rows` one a trajectory.

    Example:
        >>> adp.Gains(actor=15.0).actor
        15.0

        Shown by `staf experiment=adp adp.gains.critic=0.01`.

    Args:
        critic: ec1, of the Bellman error at the state, 1/s.
        critic_extrapolated: ec2, of the mean Bellman error at the extrapolated points, 1/s.
        actor: ea1, towards the critic, 1/s.
        actor_decay: ea2, towards zero, 1/s.
        forgetting: beta of the least-squares gain, 1/s.
        normalisation: nu in rho = 1 + nu w'w.
        information: k1 of the least-squares gain; 1 in the published code, ec1 in its theory.
        information_extrapolated: k2; 1 in the published code, ec2 in its theory.

    Raises:
        ValueError: if a gain is negative or not finite.

    Source: MATH.md section 4.
    """

    critic: Gain = 0.001
    critic_extrapolated: Gain = 0.25
    actor: Gain = 1.2
    actor_decay: Gain = 0.01
    forgetting: Gain = 0.003
    normalisation: Gain = 0.05
    information: Gain = 1.0
    information_extrapolated: Gain = 1.0

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = non_negative("Gains", field.name, getattr(self, field.name))
            if value.dim():
                raise fail("Gains", field.name, "must be a number, or `rows` of numbers", tuple(value.shape))


class Weights(NamedTuple):
    """The state of an actor-critic."""

    critic: Tensor  # Wc, (..., M)
    actor: Tensor  # Wa, (..., M)
    gain: Tensor  # (..., M, M): Gam as published, Lam = Gam^-1 in information form


class BellmanSums(NamedTuple):
    """Sums over the state (index 0) and the extrapolated points of what drives the weights."""

    critic_force: Tensor  # sum a_j w_j delta_j / rho_j, (..., M)
    curvature: Tensor  # sum a_j w_j w_j' / rho_j, (..., M, M): d critic_force / d Wc
    information: Tensor  # sum k_j w_j w_j' / rho_j^2, (..., M, M)
    actor_force: Tensor  # sum a_j G_j Wa w_j'Wc / (4 rho_j), (..., M)


class ActorCriticLaw(metaclass=OfRows):
    """Law by which the weights move, given the Bellman terms.

    Example:
        >>> [issubclass(law, adp.ActorCriticLaw) for law in (adp.Information, adp.Published, adp.Frozen)]
        [True, True, True]

        Shown by `staf experiment=adp_comparison`.

    Args:
        gains: the gains.
        bound: of the norm of Wc and of Wa: after a step they are projected onto that ball. None for no
            projection.

    Raises:
        ValueError: if ``bound`` is not positive.
    """

    rowwise: ClassVar = {"sums": (0, 1, 0), "rates": (0, 0), "step": (0, 0)}

    def __init__(self, gains: Gains | None = None, bound: float | None = None) -> None:
        self.gains = Gains() if gains is None else gains
        self.bound = None if bound is None else positive_real(type(self).__name__, "bound", bound)

    def init(self, critic: Tensor, actor: Tensor, gain: Tensor) -> Weights:
        """Weights from Wc0 (..., M), Wa0 (..., M) and Gam0 (..., M, M)."""
        return Weights(critic, actor, gain)

    @abc.abstractmethod
    def rates(self, sums: BellmanSums, weights: Weights) -> Weights:
        """d/dt of the weights: the law in continuous time."""

    def step(self, sums: BellmanSums, weights: Weights, dt: float) -> Weights:
        """The weights after ``dt`` seconds with the sums held, projected."""
        critic, actor, gain = self._move(sums, weights, dt)
        return Weights(self._project(critic), self._project(actor), gain)

    @abc.abstractmethod
    def _move(self, sums: BellmanSums, weights: Weights, dt: float) -> Weights:
        """Return the weights after ``dt`` seconds, not projected."""

    def _project(self, weights: Tensor) -> Tensor:
        if self.bound is None:
            return weights
        norm = weights.square().sum(-1, keepdim=True).sqrt()
        return torch.where(norm > self.bound, self.bound / norm, 1.0) * weights

    def sums(self, terms: BellmanTerms, masses: Tensor, weights: Weights) -> BellmanSums:
        """Sums over the points of ``terms``, the state first, the others of weights ``masses`` (N,)."""
        gains, w = self.gains, terms.regressor
        masses = masses.to(w)
        a = _shares(gains.critic, gains.critic_extrapolated, masses)
        k = _shares(gains.information, gains.information_extrapolated, masses)
        rho = 1 + gains.normalisation * w.square().sum(-1)  # (..., P)
        share = a / rho
        force = share * bellman_error(terms, weights.critic)
        along = 0.25 * share * (w * weights.critic.unsqueeze(-2)).sum(-1)
        outer = w.unsqueeze(-1) * w.unsqueeze(-2)  # (..., P, M, M)
        return BellmanSums(
            critic_force=(force.unsqueeze(-1) * w).sum(-2),
            curvature=(share[..., None, None] * outer).sum(-3),
            information=((k / rho.square())[..., None, None] * outer).sum(-3),
            actor_force=(along.unsqueeze(-1) * terms.push).sum(-2),
        )

    def actor_rate(self, sums: BellmanSums, weights: Weights) -> Tensor:
        """Wa' = -ea1 (Wa - Wc) - ea2 Wa + actor_force: (..., M)."""
        pull = self.gains.actor * (weights.actor - weights.critic)
        return sums.actor_force - pull - self.gains.actor_decay * weights.actor


def _shares(here: Gain, there: Gain, masses: Tensor) -> Tensor:
    """The gain at the state, then those at the points: (P,)."""
    return torch.cat((here * masses.new_ones(1), there * masses))


class Published(ActorCriticLaw):
    """Forward Euler on

        Wc'  = -Gam sum_j a_j w_j delta_j / rho_j
        Gam' = beta Gam - Gam (sum_j k_j w_j w_j' / rho_j^2) Gam
        Wa'  = -ea1 (Wa - Wc) - ea2 Wa + sum_j a_j G_j Wa w_j'Wc / (4 rho_j).

    Euler does not keep Gam positive definite: at the published gains and 1 ms a quarter of the seeds
    diverge. `Information` is the same law without that defect.

    Example:
        >>> law = adp.Published(adp.Gains(critic=0.01), bound=10.0)
        >>> law.gains.critic, law.bound
        (0.01, 10.0)

        Shown by `staf experiment=adp adp/law=published`.

    Source: Kamalapurkar, Rosenfeld and Dixon, via MATH.md section 4.
    """

    def rates(self, sums: BellmanSums, weights: Weights) -> Weights:
        gain = weights.gain
        descent = (gain.unsqueeze(-2) * sums.information.unsqueeze(-3)).sum(-1)  # Gam S, with S = S'
        shrink = (descent.unsqueeze(-1) * gain.unsqueeze(-3)).sum(-2)
        return Weights(
            critic=-matvec(gain, sums.critic_force),
            actor=self.actor_rate(sums, weights),
            gain=self.gains.forgetting * gain - shrink,
        )

    def _move(self, sums: BellmanSums, weights: Weights, dt: float) -> Weights:
        rates = self.rates(sums, weights)
        return Weights(*(w + dt * rate for w, rate in zip(weights, rates, strict=True)))


class Information(ActorCriticLaw):
    """The published laws with Lam = Gam^-1,

        Lam' = -beta Lam + sum_j k_j w_j w_j' / rho_j^2,

    a sum of positive semidefinite terms: Lam is positive definite by construction at any step. The
    critic's step is implicit in Wc, with A = sum_j a_j w_j w_j' / rho_j,

        (Lam + dt A) (Wc+ - Wc) = -dt sum_j a_j w_j delta_j / rho_j,

    which no least-squares gain can make unstable, and the actor's decay is implicit.

    Example:
        >>> law = adp.Information(adp.Gains(critic=0.01), bound=10.0)
        >>> law.gains.critic, law.bound
        (0.01, 10.0)

        Shown by `staf experiment=adp adp/law=information`.

    Source: MATH.md section 4 (the laws); the recursion is that of regularised recursive least squares.
    """

    def init(self, critic: Tensor, actor: Tensor, gain: Tensor) -> Weights:
        return Weights(critic, actor, torch.linalg.inv_ex(gain)[0].contiguous())  # waits for no device

    def rates(self, sums: BellmanSums, weights: Weights) -> Weights:
        return Weights(
            critic=-solve_definite(weights.gain, sums.critic_force),
            actor=self.actor_rate(sums, weights),
            gain=sums.information - self.gains.forgetting * weights.gain,
        )

    def _move(self, sums: BellmanSums, weights: Weights, dt: float) -> Weights:
        gains = self.gains
        gain = _decay(gains.forgetting, dt) * weights.gain + dt * sums.information
        move = solve_definite(gain + dt * sums.curvature, dt * sums.critic_force)
        critic = weights.critic - move
        decay = gains.actor + gains.actor_decay
        actor = (weights.actor + dt * (gains.actor * critic + sums.actor_force)) / (1 + dt * decay)
        return Weights(critic, actor, gain)


def _decay(forgetting: Gain, dt: float) -> Gain:
    """e^{-beta dt}."""
    if isinstance(forgetting, Tensor):
        return (-forgetting * dt).exp()
    return math.exp(-forgetting * dt)


class Frozen(ActorCriticLaw):
    """Wc' = Wa' = 0: the initial weights throughout.

    Example:
        >>> law = adp.Frozen(adp.Gains(critic=0.01), bound=10.0)
        >>> law.gains.critic, law.bound
        (0.01, 10.0)

        Shown by `staf experiment=adp adp/law=frozen`.
    """

    def rates(self, sums: BellmanSums, weights: Weights) -> Weights:
        return Weights(*(0 * part for part in weights))

    def _move(self, sums: BellmanSums, weights: Weights, dt: float) -> Weights:
        return weights


@traced_as(factorisations.solve_definite)
def solve_definite(matrix: Tensor, right: Tensor) -> Tensor:
    """M^-1 b for M positive definite: (..., M, M), (..., M) -> (..., M).

    Gauss-Jordan elimination without pivoting, which is stable for a positive definite matrix, as operations
    over the whole batch: a library call a row would take most of a step's time. A row whose matrix is not
    finite comes out non-finite, and the loop's monitor catches it. Where a program is traced, one half of the
    matrix decides.
    """
    size = right.shape[-1]
    if size > _UNROLLED:
        solution: Tensor = torch.linalg.solve_ex(matrix, right.unsqueeze(-1))[0].squeeze(-1)
        return solution
    identity = torch.eye(size, dtype=right.dtype, device=right.device)
    augmented = torch.cat((matrix, right.unsqueeze(-1)), dim=-1)
    for k in range(size):
        pivot = augmented[..., k, :] / augmented[..., k, k, None]
        # In row k this subtracts (a_kk - 1) times the scaled row, which leaves the scaled row.
        column = augmented[..., :, k] - identity[k]
        augmented = augmented - column.unsqueeze(-1) * pivot.unsqueeze(-2)
    return augmented[..., size]


class PolicyIteration(ActorCriticLaw):
    """The critic relaxes, within ``settling``, to the weights that solve the Bellman equation of the present
    policy at the state and the extrapolated points in the least-squares sense; the actor follows it:

        Wc' = -(damping I + A)^-1 sum_j a_j w_j delta_j / rho_j / settling,   A = sum_j a_j w_j w_j' / rho_j,
        Wa' = -ea1 (Wa - Wc) - ea2 Wa,

    both implicit over a step. That is policy iteration, a step of it a time step, around the state alone.
    Unlike `Information` it has no least-squares gain that remembers other states, which a basis that follows
    the state makes stale, and no actor force of the Lyapunov proof, which outweighs the critic where basis
    functions are steep. It has no proof either, and failed on plants whose drift is unstable (Van der Pol,
    pendulum: adp/critic/README.md).

    The points must determine the weights: M of them at least. The default gains are other than the published.

    Example:
        >>> law = adp.PolicyIteration(damping=1e-3)
        >>> law.gains.actor, law.damping
        (100.0, 0.001)

        Shown by `staf experiment=adp_policy_iteration`.

    Args:
        gains: ec1 and ec2 weigh the state against the points, ea1 and ea2 move the actor, nu normalises; the
            others are not used. By default 1, 1, 100, 0 and 0.
        bound: as in `ActorCriticLaw`.
        damping: in the units of A, positive: weights that the points leave open stay what they were.
        settling: s, positive.

    Raises:
        ValueError: if an argument breaks its rule.

    Source: D. L. Kleinman, IEEE Trans. Autom. Control 13 (1968), for the linear plant; G. N. Saridis and
    C. S. G. Lee, IEEE Trans. Syst. Man Cybern. 9 (1979).
    """

    def __init__(
        self,
        gains: Gains | None = None,
        bound: float | None = None,
        *,
        damping: float = 1e-3,
        settling: float = 0.01,
    ) -> None:
        if gains is None:
            gains = Gains(1.0, 1.0, actor=100.0, actor_decay=0.0, normalisation=0.0)
        super().__init__(gains, bound)
        self.damping = positive_real("PolicyIteration", "damping", damping)
        self.settling = positive_real("PolicyIteration", "settling", settling)

    def rates(self, sums: BellmanSums, weights: Weights) -> Weights:
        gains = self.gains
        pull = gains.actor * (weights.critic - weights.actor) - gains.actor_decay * weights.actor
        return Weights(self._newton(sums) / self.settling, pull, 0 * weights.gain)

    def _move(self, sums: BellmanSums, weights: Weights, dt: float) -> Weights:
        gains = self.gains
        critic = weights.critic + dt / (self.settling + dt) * self._newton(sums)
        actor = (weights.actor + dt * gains.actor * critic) / (1 + dt * (gains.actor + gains.actor_decay))
        return Weights(critic, actor, weights.gain)

    def _newton(self, sums: BellmanSums) -> Tensor:
        one = sums.curvature.new_ones(sums.curvature.shape[-1]).diag_embed()
        return -solve_definite(sums.curvature + self.damping * one, sums.critic_force)

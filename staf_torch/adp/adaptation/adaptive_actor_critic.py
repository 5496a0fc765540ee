"""The actor-critic on a plant that is identified while it controls; its weights wait for the model."""

from __future__ import annotations

import copy
from typing import NamedTuple

import torch
from torch import Tensor

from ...numerics.checks import fail, positive_real
from ..actor_critic import ActorCritic
from ..bellman import BellmanTerms
from ..controllers import Controller, ControllerState, Policy
from ..cost import matvec
from .carried import pack, unpack
from .least_squares import Estimate, LeastSquares
from .parametric import ParametricPlant
from .windows import IntegralWindows, Window


class LearnedModel(NamedTuple):
    """What an `AdaptiveActorCritic` knows of the plant, a row a trajectory.

    Example:
        >>> adp.LearnedModel._fields
        ('estimate', 'certain', 'window')

        Shown by `tests/benchmarks/identified_policy_iteration.py`.
    """

    estimate: Estimate
    certain: Tensor  # (...) 1 where the weights move, 0 where they wait
    window: Window


class AdaptiveActorCritic(Controller):
    """`ActorCritic` on the model x' = h + Y theta^ of the moment, whose weights wait while that is in doubt.

    At the state and at every extrapolated point y the Bellman equation says that V^ falls by the cost rate
    r(y) a second. The weights move only where c standard deviations of theta^ change that by a small share,

        certain:  c^2 v'C v < (share r(y))^2 at all points,   v = Y(y, u)' grad V^(y),

    with C the covariance of theta^ and grad V^ that of the critic. The weights of a wrong model may be such
    that a law that iterates policies does not find back when the model is right. In doubt the ``robust``
    policy has the control. Where an alarm of ``law`` says that the plant is another one, the weights begin
    anew.

    Example:
        >>> def regressor(x, u):  # damping of a pendulum that hangs
        ...     return torch.stack((torch.zeros_like(u), -x[..., 1:]), dim=-2)
        >>> def known(x, u):
        ...     return torch.stack((x[..., 1], u[..., 0] - x[..., 0].sin()), dim=-1)
        >>> plant = adp.ParametricPlant(regressor, known, dim=2, inputs=1, theta=[0.3], rows=[1])
        >>> cost = adp.QuadraticCost(1.0, 1.0, dim=2, inputs=1)
        >>> points = adp.QuadraturePoints(3, 2, half_width=0.2)
        >>> learner = adp.ActorCritic(
        ...     adp.QuadraticBasis(2), plant, cost, points, adp.PolicyIteration(),
        ...     critic=[1.0, 0.0, 1.0], actor=[1.0, 0.0, 1.0])
        >>> law = adp.LeastSquares([0.0], deviation=1.0, floor=1e-5)
        >>> control = adp.AdaptiveActorCritic(learner, plant, adp.IntegralWindows(plant, 0.02), law)
        >>> x0 = torch.tensor([[1.0, 0.0]]).double()
        >>> run = adp.simulate(control, plant, cost, x0, dt=0.02, steps=50)
        >>> now = control.knowledge(run.identifier)
        >>> now.estimate.theta[0, -1].round(decimals=2), now.certain[0, [0, -1]]
        (tensor([0.3000], dtype=torch.float64), tensor([0., 1.], dtype=torch.float64))

        Shown by `tests/benchmarks/identified_policy_iteration.py`.

    Args:
        learner: the actor-critic; its own model is not used.
        model: the plant; its theta is not used.
        windows: of the integrals from which theta is found.
        law: of theta, with the first estimate.
        robust: the policy in doubt; None for that of the weights, which wait.
        confidence: c, positive.
        share: of the cost rate, positive: 1 asks no more than that V^ falls for every theta within c
            deviations, which leaves weights from which `PolicyIteration` diverges.

    Raises:
        ValueError: if an argument breaks its rule.
    """

    def __init__(
        self,
        learner: ActorCritic,
        model: ParametricPlant,
        windows: IntegralWindows,
        law: LeastSquares,
        *,
        robust: Policy | None = None,
        confidence: float = 3.0,
        share: float = 0.1,
    ) -> None:
        super().__init__()
        if model.dim != learner.basis.dim:
            rule = f"must have the {learner.basis.dim} states of the learner's basis"
            raise fail("AdaptiveActorCritic", "model", rule, model.dim)
        if len(law.first) != model.parameters_count:
            rule = f"must have the model's {model.parameters_count} parameters"
            raise fail("AdaptiveActorCritic", "law", rule, len(law.first))
        self.learner, self.model, self.windows, self.law = learner, model, windows, law
        self.robust = robust
        self.confidence = positive_real("AdaptiveActorCritic", "confidence", confidence)
        self.share = positive_real("AdaptiveActorCritic", "share", share)
        self.draws = learner.draws
        self.known: Estimate | None = None
        self._like = self._start(torch.zeros(1, model._size(), dtype=torch.float64))

    def knowing(self, estimate: Estimate) -> AdaptiveActorCritic:
        """A copy that begins with what an episode has learned of theta, of one row (p,) or of each (B, p)."""
        other = copy.copy(self)
        other.known = estimate
        return other

    def init(self, x0: Tensor) -> ControllerState:
        return self.learner.init(x0)._replace(identifier=pack(self._start(x0, self.known), 1))

    def knowledge(self, identifier: Tensor) -> LearnedModel:
        """What the rows of `LoopResult.identifier` say, (..., K)."""
        found: LearnedModel = unpack(self._like, identifier, 1)
        return found

    def step(
        self, x: Tensor, carried: ControllerState, uniform: Tensor, dt: float
    ) -> tuple[Tensor, ControllerState]:
        now = self.knowledge(carried.identifier)
        window, equation = self.windows.step(now.window, x, dt)
        estimate = self.law.step(now.estimate, equation, dt)
        if self.law.alarm is not None:
            anew = estimate.resets > now.estimate.resets
            carried = _chosen(anew, self.learner.init(x), carried)
        model = self.model.believing(estimate.theta.unsqueeze(-2))  # one a row, for all its points
        terms = self.learner.terms(x, carried.actor, uniform, model)
        certain = self._certain(x, carried.critic, uniform, terms, estimate)
        moved = _chosen(certain, self.learner.moved(terms, carried, dt), carried)
        u = terms.control[..., 0, :]
        if self.robust is not None:
            u = torch.where(certain.unsqueeze(-1), u, self.robust(x))
        bounds = self.learner.cost.bounds
        if bounds is not None:  # what the actuator will give, which the window must know
            u = bounds.clip(u)
        after = LearnedModel(estimate, certain.to(x), self.windows.holding(window, u))
        return u, moved._replace(identifier=pack(after, x.dim() - 1))

    def value(self, x: Tensor, carried: ControllerState) -> Tensor | None:
        return self.learner.value(x, carried)

    def _start(self, x: Tensor, known: Estimate | None = None) -> LearnedModel:
        estimate = self.law.init(x)
        if known is not None:
            rows = (part.to(x).expand(like.shape).clone() for part, like in zip(known, estimate, strict=True))
            estimate = Estimate(*rows)
        return LearnedModel(estimate, torch.zeros_like(x[..., 0]), self.windows.init(x))

    def _certain(
        self, x: Tensor, critic: Tensor, uniform: Tensor, terms: BellmanTerms, estimate: Estimate
    ) -> Tensor:
        """Whether V^ falls at all points nearly as it should for every theta that may be: (...) bool."""
        slope = self.learner.value_gradient(x, critic, uniform)  # (..., P, n)
        points = self.learner.points(x, uniform)
        lever = (self.model.regressor(points, terms.control) * slope.unsqueeze(-1)).sum(-2)  # v, (..., P, p)
        variance = (lever * matvec(estimate.covariance.unsqueeze(-3), lever)).sum(-1)
        return (self.confidence**2 * variance < (self.share * terms.rate).square()).all(-1)


def _chosen(where: Tensor, one: ControllerState, other: ControllerState) -> ControllerState:
    """The weights of one where it says so, those of the other elsewhere."""
    critic, actor, gain = (
        torch.where(where[(..., *[None] * (new.dim() - where.dim()))], new, old)
        for new, old in zip(one[:3], other[:3], strict=True)
    )
    return ControllerState(critic, actor, gain, other.identifier)

"""Actor-critics on a plant that is identified while it is controlled."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from ...numerics.checks import fail, positive_real, trailing
from ...numerics.rows import chosen
from ...systems.two_state_tracking import TwoStateTracking, feedforward, parametric_drift, regressor
from ..critic.actor_critic import ActorCritic
from ..critic.laws import BellmanTerms, Weights
from ..loop.controller import Controller, Policy
from ..problem.cost import matvec
from .concurrent_learning import ConcurrentLearning, Identified
from .identification import Estimate, IntegralWindows, LeastSquares, Window
from .parametric import ParametricPlant


class LearnedModel(NamedTuple):
    """Carried state of an `AdaptiveActorCritic`, a row a trajectory."""

    weights: Weights
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
    anew. Where a measured state has a NaN the control is held and nothing is learned; the result records how
    often so far as ``missed``.

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
        >>> run["theta"][0, -1].round(decimals=2), run["certain"][0, [0, -1]]
        (tensor([0.3000], dtype=torch.float64), tensor([0., 1.], dtype=torch.float64))

        Shown by `tests/adp/adaptation/test_adaptive_policies.py`.

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
        self.learner, self.draws = learner, learner.draws
        if model.dim != learner.basis.dim:
            rule = f"must have the {learner.basis.dim} states of the learner's basis"
            raise fail("AdaptiveActorCritic", "model", rule, model.dim)
        if len(law.first) != model.parameters_count:
            rule = f"must have the model's {model.parameters_count} parameters"
            raise fail("AdaptiveActorCritic", "law", rule, len(law.first))
        self.model, self.windows, self.law, self.robust = model, windows, law, robust
        self.confidence = positive_real("AdaptiveActorCritic", "confidence", confidence)
        self.share = positive_real("AdaptiveActorCritic", "share", share)
        self.known: Estimate | None = None

    def knowing(self, estimate: Estimate) -> AdaptiveActorCritic:
        """A copy that begins with what an episode has learned of theta, of one row (p,) or of each (B, p)."""
        other = copy.copy(self)
        other.known = estimate
        return other

    def init(self, x0: Tensor) -> LearnedModel:
        trailing(type(self).__name__, "x0", x0, 2)
        estimate = self.law.init(x0)
        if self.known is not None:
            pairs = zip(self.known[:-1], estimate[:-1], strict=True)  # all but what was missed
            learned = (part.to(x0).expand(like.shape).clone() for part, like in pairs)
            estimate = Estimate(*learned)._replace(missed=estimate.missed)
        window = self.windows.init(x0)
        window = self.windows.holding(window, self.learner.cost.input_of(window.u))
        return LearnedModel(self.learner.init(x0), estimate, torch.zeros_like(x0[:, 0]), window)

    def recorded(self, carried: LearnedModel) -> dict[str, Tensor]:
        weights, estimate, certain, window = carried
        own = {"certain": certain, "missed": window.missed}
        return {**self.learner.recorded(weights), **estimate.recorded(), **own}

    def step(self, x: Tensor, now: LearnedModel, uniform: Tensor, dt: float) -> tuple[Tensor, LearnedModel]:
        window, equation = self.windows.step(now.window, x, dt)
        estimate, weights = self.law.step(now.estimate, equation, dt), now.weights
        if self.law.alarm is not None:
            anew = estimate.resets > now.estimate.resets
            weights = chosen(anew, self.learner.init(x), weights)
        model = self.model.believing(estimate.theta.unsqueeze(-2))  # one a row, for all its points
        terms = self.learner.terms(x, weights.actor, uniform, model)
        certain = self.certain(x, weights.critic, uniform, terms, estimate)
        weights = chosen(certain, self.learner.moved(terms, weights, dt), weights)
        u = terms.control[..., 0, :]
        if self.robust is not None:
            u = torch.where(certain.unsqueeze(-1), u, self.robust(x))
        u = self.learner.cost.admissible(u)  # what the actuator will give, which the window must know
        missing = x.isnan().any(-1)
        weights = chosen(missing, now.weights, weights)
        u, sure = chosen(missing, (now.window.u, now.certain), (u, certain.to(x)))
        return u, LearnedModel(weights, estimate, sure, self.windows.holding(window, u))

    def value(self, x: Tensor, recorded: Mapping[str, Tensor]) -> Tensor:
        return self.learner.value(x, recorded)

    def certain(
        self, x: Tensor, critic: Tensor, uniform: Tensor, terms: BellmanTerms, estimate: Estimate
    ) -> Tensor:
        """Return where V^ of the weights ``critic`` (..., M) falls at all extrapolated points of x (...,
        n) nearly as it should for every possible theta, (...) bool; ``terms`` are those of the Bellman
        equation there, with the model of the moment."""
        slope = self.learner.value_gradient(x, critic, uniform)  # (..., P, n)
        points = self.learner.points(x, uniform)
        lever = (self.model.regressor(points, terms.control) * slope.unsqueeze(-1)).sum(-2)  # v, (..., P, p)
        variance = (lever * matvec(estimate.covariance.unsqueeze(-3), lever)).sum(-1)
        return (self.confidence**2 * variance < (self.share * terms.rate).square()).all(-1)


class Identifying(NamedTuple):
    """Carried state of an `IdentifyingTracker`."""

    weights: Weights
    known: Identified
    u: Tensor  # (..., m) held since the last measurement
    missed: Tensor  # (...) measurements with a NaN so far


class IdentifyingTracker(Controller):
    """`ActorCritic` on the model theta^ of the moment, and u = mu + ud(theta^).

    The plant takes mu measured from the ud of the true theta, so this returns mu + ud(theta^) - ud(theta):
    the control u that reaches the plant knows theta^ alone, and the cost counts what it deviates from the
    true feedforward. The plant's rate x' is measured without noise. Where a measured state has a NaN the
    control is held and nothing is learned; the result records how often so far as ``missed``.

    Example:
        >>> plant, cost = systems.TwoStateTracking(), adp.tracking_cost(10.0, 1.0)
        >>> basis = adp.LeadingCoordinates(adp.QuadraticBasis(2), dim=4)
        >>> learner = adp.ActorCritic(basis, plant, cost, adp.RandomPoints(1, half_width=0.3))
        >>> unknown = torch.zeros(3, 2).double()
        >>> tracker = adp.IdentifyingTracker(learner, plant, adp.ConcurrentLearning(3, 2), unknown)
        >>> x0 = torch.tensor([[-0.1, 0.1, 0.0, 1.0]]).double()  # e and xd
        >>> run = adp.simulate(tracker, plant, cost, x0, dt=0.005, steps=10)
        >>> run["theta"].shape
        torch.Size([1, 11, 3, 2])

        Shown by `staf experiment=adp_tracking`.

    Args:
        learner: the actor-critic.
        plant: the true plant; only its measured drift and its ud, to convert the input, are used.
        identifier: of theta, p = 3 and n = 2.
        theta: the first estimate, (3, 2).
    """

    def __init__(
        self, learner: ActorCritic, plant: TwoStateTracking, identifier: ConcurrentLearning, theta: Tensor
    ) -> None:
        super().__init__()
        self.learner, self.draws = learner, learner.draws
        self.plant, self.identifier = plant, identifier
        self.model = TwoStateTracking(theta)
        self.register_buffer("first", self.model.theta)
        self.first: Tensor

    def init(self, x0: Tensor) -> Identifying:
        trailing(type(self).__name__, "x0", x0, 2)
        first = self.first.to(x0).repeat(len(x0), 1, 1)
        held = x0.new_zeros(len(x0), self.plant.inputs)
        return Identifying(
            self.learner.init(x0), self.identifier.init(first), held, torch.zeros_like(x0[:, 0])
        )

    def recorded(self, carried: Identifying) -> dict[str, Tensor]:
        own = {"theta": carried.known.theta, "missed": carried.missed}
        return {**self.learner.recorded(carried.weights), **own}

    def step(self, x: Tensor, carried: Identifying, uniform: Tensor, dt: float) -> tuple[Tensor, Identifying]:
        weights, known, held, missed = carried
        missing = x.isnan().any(-1)
        model = self.model.believing(known.theta.unsqueeze(-3))  # one theta a row, for all its points
        terms = self.learner.terms(x, weights.actor, uniform, model)
        state, desired = x[..., :2] + x[..., 2:], x[..., 2:]
        excess = feedforward(desired, known.theta) - feedforward(desired, self.plant.theta)
        measured = parametric_drift(self.plant.theta, state)
        known = self.identifier.step(known, regressor(state), measured, dt)
        u = terms.control[..., 0, :] + excess.unsqueeze(-1)
        (theta, u) = chosen(missing, (carried.known.theta, held), (known.theta, u))
        weights = chosen(missing, weights, self.learner.moved(terms, weights, dt))
        return u, Identifying(weights, known._replace(theta=theta), u, missed + missing.to(missed))

    def value(self, x: Tensor, recorded: Mapping[str, Tensor]) -> Tensor:
        return self.learner.value(x, recorded)

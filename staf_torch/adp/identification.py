"""Parameters of the drift from measurements, and an actor-critic that identifies them while it controls."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ..numerics.checks import integer, positive_real
from .actor_critic import ActorCritic
from .controllers import Controller, ControllerState
from .tracking import TwoStateTracking, feedforward, parametric_drift, regressor


class Identified(NamedTuple):
    """The state of an identifier, a row a trajectory.

    Example:
        >>> adp.ConcurrentLearning(3, 2).init(torch.zeros(1, 3, 2)).rates.shape  # the history stack
        torch.Size([1, 10, 2])

        Shown by `staf experiment=adp_tracking`.
    """

    theta: Tensor  # estimate, (..., p, n)
    regressors: Tensor  # s_j of the history stack, (..., N, p); zero rows are empty
    rates: Tensor  # y_j = x'_j - g_j u_j, (..., N, n)


class ConcurrentLearning:
    """theta' = gain (s (y - theta's)' + sum_j s_j (y_j - theta's_j)'), with y = x' - g u measured.

    The stack of N remembered pairs (s_j, y_j) makes theta converge without persistent excitation once
    sum_j s_j s_j' has full rank. It is kept by singular-value maximisation: empty places are filled with
    pairs that differ enough from the last; after that a new pair takes the place with which the least
    eigenvalue of sum_j s_j s_j' grows most, if it grows.

    Example:
        >>> learning = adp.ConcurrentLearning(parameters=3, outputs=2, size=10)
        >>> known = learning.init(torch.zeros(1, 3, 2).double())
        >>> known.theta.shape, known.regressors.shape
        (torch.Size([1, 3, 2]), torch.Size([1, 10, 3]))

        Shown by `staf experiment=adp_tracking`.

    Args:
        parameters: p, rows of theta.
        outputs: n, columns of theta.
        size: N, at least p.
        gain: positive, 1/s. The step is implicit, so no gain is too large for it.
        novelty: relative change of s that fills an empty place.

    Raises:
        ValueError: if an argument breaks its rule.

    Source: Chowdhary and Johnson, "Concurrent learning for convergence in adaptive control without
    persistency of excitation", CDC 2010, and its singular-value maximising algorithm (ACC 2011).
    """

    def __init__(
        self, parameters: int, outputs: int, size: int = 10, gain: float = 1.0, novelty: float = 0.05
    ) -> None:
        self.parameters = integer("ConcurrentLearning", "parameters", parameters, least=1)
        self.outputs = integer("ConcurrentLearning", "outputs", outputs, least=1)
        self.size = integer("ConcurrentLearning", "size", size, least=parameters)
        self.gain = positive_real("ConcurrentLearning", "gain", gain)
        self.novelty = positive_real("ConcurrentLearning", "novelty", novelty)

    def init(self, theta: Tensor) -> Identified:
        """An empty stack with the first estimate theta (..., p, n)."""
        lead = theta.shape[:-2]
        return Identified(
            theta,
            theta.new_zeros(*lead, self.size, self.parameters),
            theta.new_zeros(*lead, self.size, self.outputs),
        )

    def step(self, state: Identified, s: Tensor, y: Tensor, dt: float) -> Identified:
        """The estimate after ``dt`` seconds of the measurement y (..., n) at the regressor s (..., p)."""
        stack = self.remember(state, s, y)
        regressors = torch.cat((stack.regressors, s.unsqueeze(-2)), dim=-2)
        rates = torch.cat((stack.rates, y.unsqueeze(-2)), dim=-2)
        information = (regressors.unsqueeze(-1) * regressors.unsqueeze(-2)).sum(-3)  # (..., p, p)
        moment = (regressors.unsqueeze(-1) * rates.unsqueeze(-2)).sum(-3)  # (..., p, n)
        step = self.gain * dt
        identity = torch.eye(self.parameters, dtype=s.dtype, device=s.device)
        theta = torch.linalg.solve_ex(identity + step * information, state.theta + step * moment)[0]
        return Identified(theta, stack.regressors, stack.rates)

    def remember(self, state: Identified, s: Tensor, y: Tensor) -> Identified:
        """The stack with the pair in it, where that is worth it."""
        place = torch.where(
            self._empty(state) < self.size, self._filling(state, s), self._replacing(state, s)
        )
        slots = torch.arange(self.size, device=s.device)
        chosen = (slots == place.unsqueeze(-1)).unsqueeze(-1)  # (..., N, 1); nowhere for place -1
        return Identified(
            state.theta,
            torch.where(chosen, s.unsqueeze(-2), state.regressors),
            torch.where(chosen, y.unsqueeze(-2), state.rates),
        )

    def _empty(self, state: Identified) -> Tensor:
        """The first empty place, N if there is none: (...)."""
        return (state.regressors.square().sum(-1) > 0).sum(-1)

    def _filling(self, state: Identified, s: Tensor) -> Tensor:
        """The place of a pair that differs enough from the last one, else -1: (...)."""
        empty = self._empty(state)
        last = (empty - 1).clamp(min=0)[..., None, None].expand(*empty.shape, 1, self.parameters)
        before = state.regressors.gather(-2, last).squeeze(-2)
        change = (s - before).square().sum(-1)
        return torch.where(change > self.novelty**2 * s.square().sum(-1), empty, -1)

    def _replacing(self, state: Identified, s: Tensor) -> Tensor:
        """The place whose pair is worth less than the new one, else -1: (...)."""
        kept = state.regressors.unsqueeze(-1) * state.regressors.unsqueeze(-2)  # (..., N, p, p)
        whole = kept.sum(-3)
        trial = whole.unsqueeze(-3) - kept + (s.unsqueeze(-1) * s.unsqueeze(-2)).unsqueeze(-3)
        least = torch.linalg.eigvalsh(torch.where(torch.isfinite(trial), trial, 0.0))[..., 0]  # (..., N)
        now = torch.linalg.eigvalsh(torch.where(torch.isfinite(whole), whole, 0.0))[..., 0]
        best, place = least.max(dim=-1)
        return torch.where(best > 1.001 * now, place, -1)


class IdentifyingTracker(Controller):
    """`ActorCritic` on the model theta^ of the moment, and u = mu + ud(theta^).

    The plant takes mu measured from the ud of the true theta, so this returns mu + ud(theta^) - ud(theta):
    the control u that reaches the plant knows theta^ alone, and the cost counts what it deviates from the
    true feedforward. The plant's rate x' is measured without noise.

    Example:
        >>> plant, cost = adp.TwoStateTracking(), adp.tracking_cost(10.0, 1.0)
        >>> basis = adp.LeadingCoordinates(adp.QuadraticBasis(2), dim=4)
        >>> learner = adp.ActorCritic(basis, plant, cost, adp.RandomPoints(1, half_width=0.3))
        >>> unknown = torch.zeros(3, 2).double()
        >>> tracker = adp.IdentifyingTracker(learner, plant, adp.ConcurrentLearning(3, 2), unknown)
        >>> x0 = torch.tensor([[-0.1, 0.1, 0.0, 1.0]]).double()  # e and xd
        >>> adp.simulate(tracker, plant, cost, x0, dt=0.005, steps=10).identifier.shape[:2]
        torch.Size([1, 11])

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
        self.learner, self.plant, self.identifier = learner, plant, identifier
        self.draws = learner.draws
        self.register_buffer("first", TwoStateTracking(theta).theta)
        self.model = TwoStateTracking(theta)
        self.first: Tensor

    def init(self, x0: Tensor) -> ControllerState:
        start = self.identifier.init(self.first.to(x0).repeat(len(x0), 1, 1))
        return self.learner.init(x0)._replace(identifier=_pack(start))

    def step(
        self, x: Tensor, carried: ControllerState, uniform: Tensor, dt: float
    ) -> tuple[Tensor, ControllerState]:
        known = self.identified(carried)
        model = self.model.believing(known.theta.unsqueeze(-3))  # one theta a row, for all its points
        mu, after = self.learner.step_with(model, x, carried, uniform, dt)
        state, desired = x[..., :2] + x[..., 2:], x[..., 2:]
        excess = feedforward(desired, known.theta) - feedforward(desired, self.plant.theta)
        measured = parametric_drift(self.plant.theta, state)
        known = self.identifier.step(known, regressor(state), measured, dt)
        return mu + excess.unsqueeze(-1), after._replace(identifier=_pack(known))

    def identified(self, carried: ControllerState) -> Identified:
        """The identifier's part of what the controller carries."""
        sizes = (6, 3 * self.identifier.size, 2 * self.identifier.size)
        theta, s, y = carried.identifier.split(sizes, dim=-1)
        return Identified(theta.unflatten(-1, (3, 2)), s.unflatten(-1, (-1, 3)), y.unflatten(-1, (-1, 2)))

    def value(self, x: Tensor, carried: ControllerState) -> Tensor | None:
        return self.learner.value(x, carried)


def _pack(state: Identified) -> Tensor:
    return torch.cat([part.flatten(-2) for part in state], dim=-1)

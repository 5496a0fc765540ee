"""An actor-critic that identifies the drift of the tracking problem while it controls."""

from __future__ import annotations

import torch
from torch import Tensor

from .actor_critic import ActorCritic
from .controller import Controller, Memory
from .identification import ConcurrentLearning, Identified
from .tracking import TwoStateTracking, feedforward, parametric_drift, regressor


class IdentifyingTracker(Controller):
    """`ActorCritic` on the model theta^ of the moment, and u = mu + ud(theta^).

    The plant takes mu measured from the ud of the true theta, so this returns mu + ud(theta^) - ud(theta):
    the control u that reaches the plant knows theta^ alone, and the cost counts what it deviates from the
    true feedforward. The plant's rate x' is measured without noise.

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

    def init(self, x0: Tensor) -> Memory:
        start = self.identifier.init(self.first.to(x0).repeat(len(x0), 1, 1))
        return self.learner.init(x0)._replace(identifier=_pack(start))

    def step(self, x: Tensor, memory: Memory, uniform: Tensor, dt: float) -> tuple[Tensor, Memory]:
        known = self.identified(memory)
        model = self.model.believing(known.theta.unsqueeze(-3))  # one theta a row, for all its points
        mu, after = self.learner.step_with(model, x, memory, uniform, dt)
        state, desired = x[..., :2] + x[..., 2:], x[..., 2:]
        excess = feedforward(desired, known.theta) - feedforward(desired, self.plant.theta)
        measured = parametric_drift(self.plant.theta, state)
        known = self.identifier.step(known, regressor(state), measured, dt)
        return mu + excess.unsqueeze(-1), after._replace(identifier=_pack(known))

    def identified(self, memory: Memory) -> Identified:
        """The identifier's state in the memory."""
        sizes = (6, 3 * self.identifier.size, 2 * self.identifier.size)
        theta, s, y = memory.identifier.split(sizes, dim=-1)
        return Identified(theta.unflatten(-1, (3, 2)), s.unflatten(-1, (-1, 3)), y.unflatten(-1, (-1, 2)))

    def value(self, x: Tensor, memory: Memory) -> Tensor | None:
        return self.learner.value(x, memory)


def _pack(state: Identified) -> Tensor:
    return torch.cat([part.flatten(-2) for part in state], dim=-1)

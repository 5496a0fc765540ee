"""No learning: the baseline that the laws must beat."""

from __future__ import annotations

from torch import Tensor

from .base import ActorCriticLaw, BellmanSums, Weights


class Frozen(ActorCriticLaw):
    """Wc' = Wa' = 0: the initial weights throughout."""

    def init(self, critic: Tensor, actor: Tensor, gain: Tensor) -> Weights:
        return Weights(critic, actor, gain)

    def rates(self, sums: BellmanSums, weights: Weights) -> Weights:
        return Weights(*(0 * part for part in weights))

    def _move(self, sums: BellmanSums, weights: Weights, dt: float) -> Weights:
        return weights

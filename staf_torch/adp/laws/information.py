"""The same laws in information form with an implicit critic step."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from .base import ActorCriticLaw, BellmanSums, Gain, Weights, over_matrices
from .elimination import solve_definite


class Information(ActorCriticLaw):
    """The published laws with Lam = Gam^-1,

        Lam' = -beta Lam + sum_j k_j w_j w_j' / rho_j^2,

    a sum of positive semidefinite terms: Lam is positive definite by construction at any step. The
    critic's step is implicit in Wc, with A = sum_j a_j w_j w_j' / rho_j,

        (Lam + dt A) (Wc+ - Wc) = -dt sum_j a_j w_j delta_j / rho_j,

    which no least-squares gain can make unstable, and the actor's decay is implicit.

    Source: MATH.md section 4 (the laws); the recursion is that of regularised recursive least squares.
    """

    def init(self, critic: Tensor, actor: Tensor, gain: Tensor) -> Weights:
        return Weights(critic, actor, torch.linalg.inv(gain))

    def rates(self, sums: BellmanSums, weights: Weights) -> Weights:
        return Weights(
            critic=-solve_definite(weights.gain, sums.critic_force),
            actor=self.actor_rate(sums, weights),
            gain=sums.information - over_matrices(self.gains.forgetting) * weights.gain,
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
    """e^{-beta dt} as a factor of (B, M, M)."""
    if isinstance(forgetting, Tensor):
        return over_matrices((-forgetting * dt).exp())
    return math.exp(-forgetting * dt)

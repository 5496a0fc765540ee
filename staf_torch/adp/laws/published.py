"""The published laws, by forward Euler on the least-squares gain."""

from __future__ import annotations

from torch import Tensor

from ..cost import matvec
from .base import ActorCriticLaw, BellmanSums, Weights, over_matrices


class Published(ActorCriticLaw):
    """Forward Euler on

        Wc'  = -Gam sum_j a_j w_j delta_j / rho_j
        Gam' = beta Gam - Gam (sum_j k_j w_j w_j' / rho_j^2) Gam
        Wa'  = -ea1 (Wa - Wc) - ea2 Wa + sum_j a_j G_j Wa w_j'Wc / (4 rho_j).

    Euler does not keep Gam positive definite: at the published gains and 1 ms a quarter of the seeds
    diverge. `Information` is the same law without that defect.

    Source: Kamalapurkar, Rosenfeld and Dixon, via MATH.md section 4.
    """

    def init(self, critic: Tensor, actor: Tensor, gain: Tensor) -> Weights:
        return Weights(critic, actor, gain)

    def rates(self, sums: BellmanSums, weights: Weights) -> Weights:
        gain = weights.gain
        descent = (gain.unsqueeze(-2) * sums.information.unsqueeze(-3)).sum(-1)  # Gam S, with S = S'
        shrink = (descent.unsqueeze(-1) * gain.unsqueeze(-3)).sum(-2)
        return Weights(
            critic=-matvec(gain, sums.critic_force),
            actor=self.actor_rate(sums, weights),
            gain=over_matrices(self.gains.forgetting) * gain - shrink,
        )

    def _move(self, sums: BellmanSums, weights: Weights, dt: float) -> Weights:
        rates = self.rates(sums, weights)
        return Weights(*(w + dt * rate for w, rate in zip(weights, rates, strict=True)))

"""The actor-critic law that solves the Bellman equation of the moment instead of descending on it."""

from __future__ import annotations

from torch import Tensor

from ...numerics.checks import positive_real
from .laws import ActorCriticLaw, BellmanSums, Gains, Weights, over_matrices, solve_definite


class PolicyIteration(ActorCriticLaw):
    """The critic relaxes, within ``settling``, to the weights that solve the Bellman equation of the present
    policy at the state and the extrapolated points in the least-squares sense; the actor follows it:

        Wc' = -(damping I + A)^-1 sum_j a_j w_j delta_j / rho_j / settling,   A = sum_j a_j w_j w_j' / rho_j,
        Wa' = -ea1 (Wa - Wc) - ea2 Wa,

    both implicit over a step. That is policy iteration, a step of it a time step, around the state alone.
    Unlike `Information` it has no least-squares gain that remembers other states, which a basis that follows
    the state makes stale, and no actor force of the Lyapunov proof, which outweighs the critic where basis
    functions are steep. It has no proof either, and failed on plants whose drift is unstable (Van der Pol,
    pendulum: adp/README.md).

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

    def init(self, critic: Tensor, actor: Tensor, gain: Tensor) -> Weights:
        return Weights(critic, actor, gain)

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
        return -solve_definite(sums.curvature + over_matrices(self.damping) * one, sums.critic_force)
